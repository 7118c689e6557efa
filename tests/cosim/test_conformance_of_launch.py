"""`cosim launch --connect` as the agent under test of the conformance kit."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

from flights import ROOT

from protocol.conformance.rule import Level, Outcome
from protocol.conformance.run import run_rule, select

ONE_LANE_AND_TUBE = {"tube-releases-sound", "lanes-own-commands"}


def test_a_flight_keeps_the_rules_for_agents(tmp_path: Path) -> None:
    """The core of them, and that about signals; a flight of a few steps, into a folder of its own each time."""
    launch = f"{shlex.quote(sys.executable)} -m cosim launch --policy pure-pursuit --max-steps 10"
    folder = f'"$(mktemp -d -p {shlex.quote(str(tmp_path))})"/run'
    script = f'PYTHONPATH={shlex.quote(str(ROOT))} exec {launch} --out {folder} --connect "$0"'
    command = shlex.join(["sh", "-c", script])
    rules = select("agent", [Level.CORE, Level.LANES]) + select("agent", names=["told-to-stop"])
    results = [run_rule(rule, command, "shm", 60.0) for rule in rules]
    not_passed = {r.rule.name: r for r in results if r.outcome is not Outcome.PASSED}
    assert set(not_passed) == ONE_LANE_AND_TUBE, not_passed
    assert all(result.outcome is Outcome.SKIPPED for result in not_passed.values())
