"""The kit's rules about faults and about agents: sound peers keep them all, and a broken one is caught by name."""

from __future__ import annotations

import itertools
import os
import shlex
import sys
import tempfile
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from protocol.conformance import agent_faults, agent_violations, agents, occupancy, robustness, violations
from protocol.conformance.rig import with_rendezvous
from protocol.conformance.rule import AGENT_RULES, SERVER_RULES, Outcome, Result, Rule
from protocol.conformance.run import run_rule, select
from protocol.states import TRANSITIONS, Event, State

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
TUBE = ROOT / "meshes" / "industrial" / "industrial.obj"
HASTE_S = 2.0
"""How long a broken peer is waited for."""

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="the kit stops processes by POSIX signals")

OURS = {
    module.__name__ for module in (robustness, violations, occupancy, agents, agent_faults, agent_violations)
}
SERVER = [rule for rule in SERVER_RULES.values() if rule.check.__module__ in OURS]
AGENT = list(AGENT_RULES.values())
LANES_ALONE = {"lanes-own-commands"}


def by_hand(peer: str, broken: str = "none") -> str:
    """The command of a peer that breaks one rule, or none."""
    return shlex.join([sys.executable, "-S", "-E", str(HERE / "by_hand" / f"{peer}.py"), broken])


def module(name: str) -> str:
    """The command of a module of this repository."""
    return shlex.join(["env", f"PYTHONPATH={ROOT}", sys.executable, "-m", name])


def run_all(rules: Iterable[Rule], command: str, transport: str, timeout: float = 20.0) -> list[Result]:
    """Run rules two at a time: they wait for most of it."""
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(lambda rule: run_rule(rule, command, transport, timeout), rules))


def not_passed(results: Iterable[Result]) -> dict[str, str]:
    """Rules that were skipped or failed, and why."""
    return {
        r.rule.name: f"{r.outcome.value}: {r.details}" for r in results if r.outcome is not Outcome.PASSED
    }


def test_a_server_by_hand_keeps_every_rule_about_faults() -> None:
    """A peer that shares no code with ours: what is broken one by one below is sound otherwise."""
    assert not_passed(run_all(SERVER, by_hand("server"), "file")) == {}


def test_an_agent_by_hand_keeps_every_rule() -> None:
    """As for servers; over the file transport nobody sees whether storage was reserved."""
    results = not_passed(run_all(AGENT, by_hand("agent"), "file"))
    assert set(results) == {"memory-reserved"}
    assert results["memory-reserved"].startswith("skipped")


def test_the_toy_agent_keeps_every_rule() -> None:
    """The session of this package, with several lanes and a tube, in every state."""
    assert TUBE.exists()
    command = f"{module('protocol.conformance.toy_agent')} --lanes 2 --tube {shlex.quote(str(TUBE))}"
    assert not_passed(run_all(AGENT, command, "shm")) == {}


def test_what_an_agent_never_does_is_skipped_with_a_reason() -> None:
    """One lane and no tube: the rules about both say so."""
    rules = select("agent", names=["lanes-own-commands", "tubes-sound", "tube-releases-sound"])
    results = run_all(rules, module("protocol.conformance.toy_agent"), "shm")
    assert {r.rule.name: r.details for r in results if r.outcome is Outcome.SKIPPED} == {
        "lanes-own-commands": "the agent offers one lane",
        "tubes-sound": "the agent never asked for register_tube",
        "tube-releases-sound": "the agent never asked for release_tube",
    }


@pytest.mark.parametrize("rule", SERVER, ids=lambda rule: rule.name)
def test_a_server_that_breaks_a_rule_is_caught_by_it(rule: Rule) -> None:
    """One broken server for each rule about faults."""
    _is_caught(rule, by_hand("server", rule.name))


@pytest.mark.parametrize("rule", AGENT, ids=lambda rule: rule.name)
def test_an_agent_that_breaks_a_rule_is_caught_by_it(rule: Rule) -> None:
    """One broken agent for each rule."""
    _is_caught(rule, by_hand("agent", rule.name))


def _is_caught(rule: Rule, command: str) -> None:
    result = run_rule(rule, command, "shm", HASTE_S)
    assert result.outcome is Outcome.FAILED, result.details
    assert "expected" in result.details
    assert "Traceback" not in result.last_words


@pytest.mark.parametrize("event", [Event.LOSS, Event.FAREWELL, Event.VIOLATION], ids=lambda event: event.name)
@pytest.mark.parametrize("side", ["server", "agent"])
def test_a_fault_falls_into_every_state_of_the_table(side: str, event: Event) -> None:
    """The rules claim every state in which the table has the fault, but for what nobody outside can bring about."""
    covered = set(itertools.chain.from_iterable(rule.covers for rule in select(side)))
    wanted = {(state, event) for state, moves in TRANSITIONS.items() if event in moves}
    if (
        side == "agent"
    ):  # it knows the process of a physics side by its header, in which nothing is a violation
        wanted -= {(State.OFFERED, Event.LOSS), (State.OFFERED, Event.VIOLATION)}
    assert wanted - covered == set()


def test_the_rendezvous_stands_where_the_command_wants_it() -> None:
    """Behind the last word, or in place of every `{}`."""
    assert with_rendezvous(["peer", "-v"], "shm:a") == ["peer", "-v", "shm:a"]
    assert with_rendezvous(["peer", "--at={}", "-v"], "shm:a") == ["peer", "--at=shm:a", "-v"]


@pytest.mark.parametrize("transport", ["shm", "file"])
def test_nothing_is_left_behind(transport: str) -> None:
    """A rule that fails ends its peers and stand-ins and removes its segments and folders all the same."""
    places = (Path("/dev/shm"), Path(tempfile.gettempdir()))

    def left() -> set[Path]:
        return {path for place in places for path in place.glob(f"conformance-*{os.getpid()}*")}

    before = left(), _children()
    for rule, peer in ((SERVER_RULES["step-skipped"], "server"), (AGENT_RULES["answer-magic"], "agent")):
        assert run_rule(rule, by_hand(peer, rule.name), transport, HASTE_S).outcome is Outcome.FAILED
    assert (left(), _children()) == before


def _children() -> set[str]:
    """Pids of the processes that this one has started and that still are there, zombies among them."""
    return set(" ".join(path.read_text() for path in Path("/proc/self/task").glob("*/children")).split())
