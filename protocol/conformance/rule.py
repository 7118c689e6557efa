"""What a rule is: a name, where the specification says it, and a check that is run against a started peer.

    Failure     the peer broke the rule
    Silence     it did so by saying nothing until its time was out
    Skip        the rule cannot be shown on this peer; says why

A module of rules registers its checks by `server_rule` or `agent_rule`; `run.py` runs what is registered.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final

from protocol.states import Event, State

if TYPE_CHECKING:
    from protocol.conformance.rig import Rig

Check = Callable[["Rig"], str | None]
"""Runs a rule on a fresh rig and returns nothing, or what it measured in words; raises Failure or Skip."""

_NAME: Final = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")


class Level(Enum):
    """What a group of rules is about, in the order of reports."""

    CORE = "core"
    """Handshake, requests, refusals, frames, the law, the orderly end."""
    ROBUSTNESS = "robustness"
    """Death, silence, violations and nonsense of the other side."""
    LANES = "lanes"
    """Several drones in one session."""
    PERFORMANCE = "performance"
    """Latency, idle processor time, cost of many lanes."""


class Outcome(Enum):
    """How a rule ended."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True)
class Rule:
    """One rule; its name is unique among the rules for the same side."""

    name: str
    level: Level
    section: str
    """Section of the specification: "7", or "A" for an annex."""
    title: str
    """What holds, in one line."""
    check: Check
    required: bool = True
    """Whether a peer that breaks it does not conform; else it is information."""
    covers: tuple[tuple[State, Event], ...] = ()
    """Transitions of the table of states that the check makes the peer take."""


@dataclass(frozen=True)
class Result:
    """How one rule ended on one peer."""

    rule: Rule
    outcome: Outcome
    details: str
    """Failed: expected and found; skipped: the reason; passed: what was measured, or nothing."""
    last_words: str
    """What a failed peer wrote to stdout and stderr, its end."""
    seconds: float
    silent: bool = False
    """Whether it failed because the peer, which ran, said nothing until its time was out."""


class Failure(Exception):  # noqa: N818  the kit's own word
    """The peer broke the rule that is run; names what was looked at, what was expected and what was found."""

    def __init__(self, what: str, expected: object, found: object) -> None:
        self.what = what
        self.expected = str(expected)
        self.found = str(found)
        super().__init__(f"{what}: expected {expected}, found {found}")


class Silence(Failure):
    """The peer runs and said nothing for as long as it is waited for."""


class Skip(Exception):  # noqa: N818  the kit's own word
    """The rule cannot be shown on this peer, for the reason given."""


SERVER_RULES: Final[dict[str, Rule]] = {}
"""Rules for physics sides by name."""
AGENT_RULES: Final[dict[str, Rule]] = {}
"""Rules for agents by name."""

Register = Callable[[Check], Check]
Covers = tuple[tuple[State, Event], ...]


def server_rule(
    name: str, level: Level, section: str, title: str, *, required: bool = True, covers: Covers = ()
) -> Register:
    """Register the decorated check as a rule for physics sides.

    Raises:
        ValueError: the name is taken or no kebab-case.
    """
    return _registering(SERVER_RULES, name, level, section, title, required, covers)


def agent_rule(
    name: str, level: Level, section: str, title: str, *, required: bool = True, covers: Covers = ()
) -> Register:
    """Register the decorated check as a rule for agents.

    Raises:
        ValueError: the name is taken or no kebab-case.
    """
    return _registering(AGENT_RULES, name, level, section, title, required, covers)


def _registering(
    registry: dict[str, Rule],
    name: str,
    level: Level,
    section: str,
    title: str,
    required: bool,
    covers: Covers,
) -> Register:
    def register(check: Check) -> Check:
        if not _NAME.fullmatch(name) or name in registry:
            raise ValueError(f"rule {name!r}: expected a new name in kebab-case")
        registry[name] = Rule(name, level, section, title, check, required, covers)
        return check

    return register


def expect(what: str, found: object, expected: object) -> None:
    """Demand that a value is as expected.

    Raises:
        Failure: it is another.
    """
    if found != expected:
        raise Failure(what, expected, found)


def demand(holds: bool, what: str, expected: object, found: object) -> None:
    """Demand that a condition holds, which `expected` puts into words.

    Raises:
        Failure: it does not hold.
    """
    if not holds:
        raise Failure(what, expected, found)
