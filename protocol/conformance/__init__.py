"""The conformance kit: rules that a physics side or an agent must keep, proved on any program from the outside."""
