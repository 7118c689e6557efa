"""Sessions of the agent under test brought to one state of the protocol, and what is demanded of its end.

The physics side is played by the kit, which has the turn in these states: a fault falls exactly into them.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from protocol.conformance.flight import flown, meeting
from protocol.conformance.raw_physics import RawPhysics, Request
from protocol.conformance.rig import LEAVING_S, Rig, await_end, segments_left
from protocol.conformance.rule import Failure, Skip, demand
from protocol.conformance.scenes import ALLOWANCE_S, NOTICE_S, UNDER_WAY
from protocol.layout import COMMAND, Farewell, Op, read_i64
from protocol.states import State

BOUND_S: Final = NOTICE_S + ALLOWANCE_S
POLL_S: Final = 0.001


def entered(rig: Rig) -> dict[State, Op]:
    """The states with a request under way that this agent enters by itself.

    Raises:
        Failure: the agent does not come to a goodbye in a session where all goes well.
    """
    ops = flown(rig).ops
    return {state: op for state, op in UNDER_WAY.items() if op in ops}


@contextmanager
def asked(rig: Rig, op: Op) -> Iterator[tuple[RawPhysics, Request]]:
    """Bring a session to the agent's first request of a kind, for a step the second; it waits for the reply."""
    with meeting(rig) as physics:
        physics.attach()
        request = physics.serve_until(lambda r: r.op == op and (op is not Op.STEP or physics.steps > 0))
        if request is None:
            raise Skip(f"the agent did not ask for {op.name.lower()} this time")
        yield physics, request


def has_left(physics: RawPhysics) -> bool:
    """Whether the agent has ended the session by a farewell or by its end."""
    return physics.farewell()[0] != 0 or physics.process.watch() is not None


def ends(physics: RawPhysics, since: float, what: str) -> float:
    """Demand that the agent ends the session in time and leaves nothing; return how long it took to leave (s).

    Args:
        physics: the session.
        since: when it could notice first (monotonic).
        what: what happened, for messages.
    """
    stood = bool(
        segments_left(physics.rendezvous)
    )  # they are gone before a goodbye, which shows nothing then
    while not has_left(physics) and not (stood and not segments_left(physics.rendezvous)):
        if time.monotonic() - since > BOUND_S:
            raise Failure(
                f"the agent after {what}", f"to end the session within {BOUND_S * 1e3:.0f} ms", "it has not"
            )
        time.sleep(POLL_S)
    took = time.monotonic() - since
    _leaves_nothing(physics, what)
    return took


def turns_down(physics: RawPhysics, what: str, kind: Farewell, *, last: int) -> str:
    """Demand that the agent ends the session with a farewell of one kind, and return its text.

    Args:
        physics: the session.
        what: what was wrong, for messages.
        kind: the farewell that it calls for.
        last: number of the last request that the agent could make before it saw that.
    """
    until = time.monotonic() + LEAVING_S
    while not has_left(physics):
        demand(
            physics.rung() <= last,
            f"the agent after {what}",
            "to end the session",
            "it made its next request",
        )
        demand(time.monotonic() < until, f"the agent after {what}", "to end the session", "it has not")
        time.sleep(POLL_S)
    _leaves_nothing(physics, what)
    found, text = physics.farewell()
    right = found == kind and bool(text)
    demand(right, f"farewell after {what}", f"kind {kind.value} with a text", f"kind {found}, {text!r}")
    return text


def _leaves_nothing(physics: RawPhysics, what: str) -> None:
    """Demand that the agent ends, with nothing left; who had come to its goodbye may have succeeded all the same."""
    code = await_end(physics.process, f"after {what}")
    left = segments_left(physics.rendezvous)
    demand(not left, f"segments after {what}", "both removed by the agent", left)
    said_goodbye = physics.rung() > 0 and read_i64(physics.command, COMMAND["op"]) == Op.GOODBYE
    demand(code != 0 or said_goodbye, f"exit status after {what}", "another than 0", code)
