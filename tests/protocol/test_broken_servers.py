"""The kit is proved by broken servers: each required rule catches the one that breaks it, by name."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from protocol.conformance.rule import Level, Outcome, Rule
from protocol.conformance.run import run_rule, select

BROKEN = Path(__file__).parent / "broken_server.py"
COMMAND = shlex.join([sys.executable, str(BROKEN)])
LEVELS = (Level.CORE, Level.LANES, Level.PERFORMANCE)
REQUIRED = [rule for rule in select("server", LEVELS) if rule.required]
PATIENCE_S = 60.0


@pytest.mark.parametrize("rule", REQUIRED, ids=[rule.name for rule in REQUIRED])
def test_a_broken_server_is_caught_by_its_rule(rule: Rule) -> None:
    """A server with one fault fails the rule of the fault's name, and not because it cannot run."""
    result = run_rule(rule, f"{COMMAND} {rule.name}")
    assert result.outcome is Outcome.FAILED, result.details
    assert "NOT MEANT" not in result.last_words, result.last_words
    assert result.details


def test_every_required_rule_has_a_broken_server() -> None:
    """No rule of these levels is believed without a server that breaks it, and no fault is without a rule."""
    listed = subprocess.run(
        [sys.executable, str(BROKEN), "--list"],
        capture_output=True,
        text=True,
        check=True,
        timeout=PATIENCE_S,
    )
    assert sorted(listed.stdout.split()) == sorted(rule.name for rule in REQUIRED)
