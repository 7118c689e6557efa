"""The session's states and what leads from one to the next.

Rule 1: everything that decides whether something may happen now stands in this table and nowhere else.
Rule 2: this file does not know which side it works for; both sides follow the same table.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from protocol.errors import SessionError
from protocol.layout import Op


class State(IntEnum):
    """What the session is doing."""

    ABSENT = 0
    """No segments, or an agent header without its magic."""
    OFFERED = 1
    """The agent's header stands; physics has not answered."""
    READY = 2
    """No request is under way."""
    STEPPING = 3
    RESETTING = 4
    REGISTERING = 5
    RELEASING = 6
    CLOSING = 7
    CLOSED = 8
    """The orderly end."""
    BROKEN = 9
    """Ended by a farewell, a violation or a loss."""


class Event(IntEnum):
    """What happens to a session; the requests have the numbers of their ops."""

    STEP = Op.STEP
    RESET = Op.RESET
    REGISTER_TUBE = Op.REGISTER_TUBE
    RELEASE_TUBE = Op.RELEASE_TUBE
    GOODBYE = Op.GOODBYE
    OFFER = 10
    """The agent publishes its header."""
    ATTACH = 11
    """Physics publishes its header."""
    DONE = 12
    """Physics publishes a reply with status done."""
    REFUSED = 13
    """Physics publishes a reply with status refused."""
    FAREWELL = 14
    """Either side writes why it leaves."""
    VIOLATION = 15
    """Either side finds that the other broke the protocol."""
    LOSS = 16
    """Either side finds the other's process gone."""


class Side(IntEnum):
    """Who may write, apart from farewells."""

    NOBODY = 0
    AGENT = 1
    PHYSICS = 2


_ENDS: Final = {Event.FAREWELL: State.BROKEN, Event.VIOLATION: State.BROKEN, Event.LOSS: State.BROKEN}
_ANSWERS: Final = {Event.DONE: State.READY, Event.REFUSED: State.READY, **_ENDS}

TRANSITIONS: Final[dict[State, dict[Event, State]]] = {
    State.ABSENT: {Event.OFFER: State.OFFERED},
    State.OFFERED: {Event.ATTACH: State.READY, **_ENDS},
    State.READY: {
        Event.STEP: State.STEPPING,
        Event.RESET: State.RESETTING,
        Event.REGISTER_TUBE: State.REGISTERING,
        Event.RELEASE_TUBE: State.RELEASING,
        Event.GOODBYE: State.CLOSING,
        **_ENDS,
    },
    State.STEPPING: _ANSWERS,
    State.RESETTING: _ANSWERS,
    State.REGISTERING: _ANSWERS,
    State.RELEASING: _ANSWERS,
    State.CLOSING: {Event.DONE: State.CLOSED, **_ENDS},
    State.CLOSED: {},
    State.BROKEN: {},
}

TURN: Final[dict[State, Side]] = {
    State.ABSENT: Side.AGENT,
    State.OFFERED: Side.PHYSICS,
    State.READY: Side.AGENT,
    State.STEPPING: Side.PHYSICS,
    State.RESETTING: Side.PHYSICS,
    State.REGISTERING: Side.PHYSICS,
    State.RELEASING: Side.PHYSICS,
    State.CLOSING: Side.PHYSICS,
    State.CLOSED: Side.NOBODY,
    State.BROKEN: Side.NOBODY,
}


def follow(state: State, event: Event) -> State:
    """Return the state that an event leads to.

    Raises:
        SessionError: the table has no such transition.
    """
    try:
        return TRANSITIONS[state][event]
    except KeyError:
        allowed = ", ".join(e.name for e in TRANSITIONS[state]) or "nothing"
        raise SessionError(
            f"session state {state.name}: expected one of {allowed}, found {event.name}"
        ) from None


def markdown_table() -> str:
    """Write the transitions as they stand in the specification."""
    lines = ["| state | whose turn | event: next state |", "| --- | --- | --- |"]
    for state, moves in TRANSITIONS.items():
        listed = ", ".join(f"{event.name}: {after.name}" for event, after in moves.items()) or "the end"
        lines.append(f"| {state.name} | {TURN[state].name.lower()} | {listed} |")
    return "\n".join(lines)
