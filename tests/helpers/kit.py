"""Running the conformance suite on servers whose plant is the toy: free bodies, neither walls nor gusts."""

from __future__ import annotations

from collections.abc import Iterable

from protocol.conformance.rule import Level, Outcome, Rule
from protocol.conformance.run import run_suite, select

_NO_WALLS = "the plant has no walls"
SKIPPED = {
    "contact-wall": _NO_WALLS,
    "contact-hollow": _NO_WALLS,
    "tube-scale": _NO_WALLS,
    "tube-axes": _NO_WALLS,
    "tube-left": _NO_WALLS,
    "tube-of-each-lane": _NO_WALLS,
    "refusal-plant": "the plant has no walls, and need not read a tube's file",
    "gusts": "the plant refuses gusts "
    "(refusal 10: gust in lane 0: expected 0, since this plant has no gusts, found 3)",
}
"""The rules that are skipped on such a plant, and why."""

_TRANSPORTED = {"2", "3", "4", "5", "9", "11"}
"""Sections whose rules see the transport, but for those about death and pauses, which take long."""


def transported_rules() -> list[Rule]:
    """The rules for servers that the transport could touch."""
    levels = (Level.CORE, Level.ROBUSTNESS, Level.LANES)
    rules = [rule for rule in select("server", levels) if rule.section in _TRANSPORTED]
    return rules + select("server", names=["agent-killed", "reset-forgets", "contact-none-promised"])


def count_in_words() -> str:
    """What the pages of such servers have to say of the whole suite."""
    return f"{len(select('server')) - len(SKIPPED)} passed, {len(SKIPPED)} skipped"


def run(command: str, transport: str, rules: Iterable[Rule]) -> tuple[list[str], dict[str, str]]:
    """Run rules; what failed, with the server's last words, and why others were skipped, by name."""
    results = run_suite(rules, command, transport)
    assert results
    failed = [f"{r.rule.name}: {r.details} {r.last_words}" for r in results if r.outcome is Outcome.FAILED]
    return failed, {r.rule.name: r.details for r in results if r.outcome is Outcome.SKIPPED}
