"""One whole session of the agent under test, recorded from the physics side; rules look at the record.

An agent decides by itself what it asks for, so what it never does is never judged: rules skip it and say so.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Final

from protocol import layout
from protocol.conformance.raw_physics import RawPhysics, Request
from protocol.conformance.rig import LEAVING_S, Rig, segments_left
from protocol.conformance.rule import Failure, Skip
from protocol.errors import Refusal
from protocol.layout import COMMAND, Op
from protocol.memory import COMMAND_SUFFIX, parse_rendezvous
from protocol.read_only import open_read_only

HOLD_S: Final = 0.05
"""How long the first reply to each kind of request is held back, to see whether the agent keeps still."""
LONGEST_S: Final = 600.0
"""How long a session of the agent under test may take until its goodbye (s)."""


@dataclass
class Flight:
    """What one session looked like from the physics side."""

    pid: int
    """The process that was started."""
    offer: bytes
    """The command segment when its magic showed."""
    offer_later: bytes
    """The same when the first request came."""
    blank_pose: bool
    """Whether the pose segment was all zero then."""
    pose_bytes: int
    """Size of the pose segment."""
    locked: bool
    """Whether the lock on the command segment was held."""
    reserved: dict[str, int]
    """Bytes of storage behind each segment."""
    requests: list[Request] = field(default_factory=list)
    out_of_turn: list[str] = field(default_factory=list)
    """What the agent wrote while it was the physics side's turn, or into the pose segment."""
    refused: list[str] = field(default_factory=list)
    """Requests that a sound physics side refuses, and why."""
    names_at_goodbye: list[str] = field(default_factory=list)
    """Segments whose names stood when the goodbye came."""
    trouble: Failure | None = None
    """Why the record ends without a goodbye."""
    ended: bool = False
    """Whether the agent's process ended in time after its goodbye."""

    @property
    def lanes(self) -> int:
        """Number of lanes."""
        return int.from_bytes(self.offer[COMMAND["lanes"].bytes], "little", signed=True)

    @property
    def ops(self) -> set[int]:
        """The kinds of requests that were made."""
        return {request.op for request in self.requests}

    def of(self, op: Op) -> list[Request]:
        """The requests of one kind.

        Raises:
            Skip: there are none.
        """
        found = [request for request in self.requests if request.op == op]
        if not found:
            raise Skip(f"the agent never asked for {op.name.lower()}")
        return found


@contextmanager
def meeting(rig: Rig) -> Iterator[RawPhysics]:
    """Start the agent under test and meet it at a rendezvous of its own; no header is written yet.

    Raises:
        Failure: it offered no session.
    """
    rendezvous = rig.new_rendezvous()
    process = rig.start(rendezvous)
    try:
        with RawPhysics(rendezvous, process, rig.timeout) as physics:
            yield physics
    finally:
        process.end()


def flown(rig: Rig) -> Flight:
    """Return the record of the agent's session, which is flown once for all rules.

    Raises:
        Failure: it did not come to a goodbye.
    """
    flight = _fly(rig.command, rig.transport, rig.timeout)
    if flight.trouble is not None:
        raise flight.trouble
    return flight


@lru_cache(maxsize=4)
def _fly(command: str, transport: str, timeout: float) -> Flight:
    with Rig(command, transport, timeout) as rig, meeting(rig) as physics:
        return _record(physics)


def _record(physics: RawPhysics) -> Flight:
    # Storage comes first: reading a page of shared memory reserves it.
    reserved = {name: Path(name).stat().st_blocks * 512 for name in segments_left(physics.rendezvous)}
    offer = bytes(physics.command)
    flight = Flight(
        pid=physics.process.pid,
        offer=offer,
        offer_later=offer,
        blank_pose=not any(physics.pose),
        pose_bytes=len(physics.pose),
        locked=_locked(physics.rendezvous),
        reserved=reserved,
    )
    until = time.monotonic() + LONGEST_S
    physics.attach()
    try:
        while Op.GOODBYE not in flight.ops:
            _exchange(physics, flight)
            if time.monotonic() > until:
                raise Failure("the agent", f"a goodbye within {LONGEST_S:g} s", "none")
    except Failure as failure:
        flight.trouble = failure
        return flight
    flight.ended = physics.process.wait(LEAVING_S) is not None
    return flight


def _exchange(physics: RawPhysics, flight: Flight) -> None:
    """Record one request and answer it soundly."""
    pose = bytes(physics.pose)
    request = physics.await_request()
    if not flight.requests:
        flight.offer_later = request.segment
    first = request.op not in flight.ops
    flight.requests.append(request)
    if request.op == Op.GOODBYE:
        flight.names_at_goodbye = segments_left(physics.rendezvous)
    if first:
        time.sleep(HOLD_S)
    if bytes(physics.command) != request.segment:
        flight.out_of_turn.append(f"the command segment, while {request.name} was not answered yet")
    if bytes(physics.pose) != pose:
        flight.out_of_turn.append(f"the pose segment, by {request.name}")
    refusal: Refusal | None = physics.answer(request)
    if refusal is not None:
        flight.refused.append(f"{request.name}: {refusal}")


def _locked(rendezvous: str) -> bool:
    segment = open_read_only(parse_rendezvous(rendezvous), COMMAND_SUFFIX)
    if segment is None:
        return False
    try:
        return segment.locked()
    finally:
        segment.close()


def unnamed_bytes(segment: bytes, lanes: int) -> list[tuple[int, int]]:
    """Places in a command segment that no table names and that are not zero."""
    named = sorted((f.offset, f.offset + f.size) for f in layout.COMMAND_SEGMENT if f.size)
    named.append((COMMAND["commands"].offset, layout.command_bytes(lanes)))
    places, at = [], 0
    for start, end in named:
        if any(segment[at:start]):
            places.append((at, start))
        at = end
    return places
