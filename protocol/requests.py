"""The requests of an agent, as data: what of each kind is always the same, and how its payload travels."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from protocol import layout
from protocol.errors import Refusal, RefusalCode, SessionError
from protocol.layout import COMMAND, POSE, Axes, read_i64, read_text
from protocol.plant import TubeReference
from protocol.states import TRANSITIONS, Event, State


@dataclass(frozen=True)
class Request:
    """One kind of request."""

    event: Event
    op: int
    asking: State
    """State of the session while it is under way."""
    done: State
    """State once it is done."""
    phase: str
    """Its name in messages."""


def _request(event: Event) -> Request:
    # Looked up in the table once: an enumeration's member as a key costs more than the rest of a request.
    asking = TRANSITIONS[State.READY][event]
    return Request(event, event.value, asking, TRANSITIONS[asking][Event.DONE], event.name.lower())


STEP: Final = _request(Event.STEP)
RESET: Final = _request(Event.RESET)
REGISTER_TUBE: Final = _request(Event.REGISTER_TUBE)
RELEASE_TUBE: Final = _request(Event.RELEASE_TUBE)
GOODBYE: Final = _request(Event.GOODBYE)

TUBE: Final = struct.Struct("<qqd32sq4096s")
"""Words of a registration: index, axes, scale, SHA-256, length of the path, path."""


@dataclass(frozen=True)
class Wire:
    """Where the payloads stand in the two segments."""

    commands: memoryview
    resets: memoryview
    tube: memoryview
    tube_index: memoryview
    poses: memoryview


def cut_wire(
    command: memoryview, pose: memoryview, lanes: int, keep: Callable[[memoryview], memoryview]
) -> Wire:
    """Find the payloads in the two segments; `keep` notes each view, so that it is released in the end."""
    tube = COMMAND["tube_index"]
    return Wire(
        commands=keep(command[layout.command_rows(lanes)]),
        resets=keep(command[layout.reset_rows(lanes)]),
        tube=keep(command[tube.offset : tube.offset + TUBE.size]),
        tube_index=keep(command[tube.bytes]),
        poses=keep(pose[layout.pose_rows(lanes)]),
    )


def pack_tube(index: int, tube: TubeReference) -> bytes:
    """Write a tube registration as it stands on the wire.

    Raises:
        SessionError: the reference cannot be written down.
    """
    path, most = tube.path.encode(), COMMAND["tube_path"].count
    if tube.axes not in Axes.__members__:
        raise SessionError(f"axes of tube {index}: expected zup or yup, found {tube.axes!r}")
    if not 1 <= len(path) <= most:
        raise SessionError(f"path of tube {index}: expected 1 to {most} bytes, found {len(path)}")
    try:
        digest = bytes.fromhex(tube.sha256)
    except ValueError:
        digest = b""
    if len(digest) != COMMAND["tube_sha256"].count:
        raise SessionError(f"sha256 of tube {index}: expected 64 hexadecimal digits, found {tube.sha256!r}")
    return TUBE.pack(index, Axes[tube.axes], tube.scale, digest, len(path), path)


def read_refusal(view: memoryview) -> Refusal:
    """Read why a request was refused out of the pose segment."""
    code = read_i64(view, POSE["refusal_code"])
    return Refusal(
        read_text(view, POSE["refusal_field"]),
        read_text(view, POSE["refusal_expected"]),
        read_text(view, POSE["refusal_found"]),
        read_i64(view, POSE["refusal_lane"]),
        RefusalCode(code) if code in tuple(RefusalCode) else RefusalCode.PLANT,
    )


def fault_of_reply(number: int, rung: int, begin: int, end: int) -> str:
    """Say what is wrong with the numbers of a reply to request `number`."""
    if rung != number:
        return f"physics rang its doorbell with {rung} where {number} was due"
    return f"physics published a torn reply: begin {begin}, end {end} where {number} was due"
