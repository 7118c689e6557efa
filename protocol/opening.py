"""How the segments of a session come to be: the agent creates them, the physics side finds and claims them.

Each segment has one writer, who holds its lock (`Segment.lock`) for as long as it lives.
"""

from __future__ import annotations

import logging
import time
from typing import Final

from protocol import layout
from protocol.errors import HandshakeError, PeerLost, SessionError, Verdict
from protocol.handshake import magic, owner, read_farewell
from protocol.layout import COMMAND_MAGIC, POSE_MAGIC, Farewell
from protocol.liveness import Life, life
from protocol.memory import (
    COMMAND_SUFFIX,
    POSE_SUFFIX,
    Rendezvous,
    Segment,
    Segments,
    create_segment,
    open_segment,
)

_log = logging.getLogger("protocol")

CREATION_GRACE_S: Final = 0.5
"""How long a header without its magic is taken for one that is just being written."""
LOOK_AGAIN_S: Final = 0.005
_NOT_YET: Final = bytes(8)
_HEADER_BYTES: Final = 2048


def create_segments(rendezvous: Rendezvous, lanes: int) -> Segments:
    """Create and lock the two segments; those of a dead agent are replaced, which is logged as a warning.

    Raises:
        SessionError: a live agent holds the rendezvous, something else has its name, or there is no room.
    """
    command = _create_over_stale(rendezvous, COMMAND_SUFFIX, layout.command_bytes(lanes), COMMAND_MAGIC)
    try:
        if not command.lock():
            raise SessionError(f"{rendezvous} was taken by another agent at this moment; use another name")
        pose = _create_over_stale(rendezvous, POSE_SUFFIX, layout.pose_bytes(lanes), POSE_MAGIC)
    except BaseException:
        command.unlink()
        command.close()
        raise
    return Segments(command, pose)


def _create_over_stale(rendezvous: Rendezvous, suffix: str, size: int, word: bytes) -> Segment:
    try:
        return create_segment(rendezvous, suffix, size)
    except FileExistsError:
        _remove_stale(rendezvous, suffix, word)
    try:
        return create_segment(rendezvous, suffix, size)
    except FileExistsError:
        raise SessionError(
            f"{rendezvous} was taken by another agent at this moment; use another name"
        ) from None


def _remove_stale(rendezvous: Rendezvous, suffix: str, word: bytes) -> None:
    """Remove a segment whose writer is dead; a pose segment is removed by the agent that holds the command's lock."""
    segment = open_segment(rendezvous, suffix)
    patience = time.monotonic() + CREATION_GRACE_S
    while suffix == COMMAND_SUFFIX and time.monotonic() < patience:
        if segment is not None and magic(segment.view) != _NOT_YET:
            break
        time.sleep(LOOK_AGAIN_S)
        if segment is None:
            segment = open_segment(rendezvous, suffix)
    name = rendezvous.stem + suffix
    if segment is None or len(segment.view) < _HEADER_BYTES or magic(segment.view) not in (word, _NOT_YET):
        if segment is not None:
            segment.close()
        raise SessionError(f"{name} exists and is no session's segment; remove it or use another name")
    try:
        pid, started = owner(segment.view)
        is_agent = suffix == COMMAND_SUFFIX
        if is_agent and ((pid and life(pid, started) is not Life.DEAD) or not segment.lock()):
            raise SessionError(
                f"{rendezvous} belongs to a session whose agent (pid {pid}) is alive; "
                "end that one or use another name"
            )
        _log.warning("replacing the stale segment %s; its writer (pid %d) did not remove it", name, pid)
        segment.unlink()
    finally:
        segment.close()


def attach_segments(rendezvous: Rendezvous, timeout: float) -> Segments:
    """Wait until an agent offers a session, then open its segments and claim the physics side.

    Segments of an agent that is dead or has said farewell are passed over: a new agent may replace them.

    Raises:
        PeerLost: no session was offered within `timeout` seconds.
        SessionError: another physics process serves the session or has served it.
        HandshakeError: a segment is too small to be one.
    """
    began = time.monotonic()
    found = "nothing of that name"
    while True:
        segments, news = _try_attach(rendezvous)
        if segments is not None:
            return segments
        found = news or found
        if time.monotonic() - began > timeout:
            how = f"no session at {rendezvous} within {timeout} s, found {found}; is the agent running?"
            raise PeerLost("agent", how, Verdict.TOO_SLOW, 0, "attach")
        time.sleep(LOOK_AGAIN_S)


def _try_attach(rendezvous: Rendezvous) -> tuple[Segments | None, str]:
    """Open both segments if a session is on offer now; else say what was found."""
    command = open_segment(rendezvous, COMMAND_SUFFIX)
    if command is None:
        return None, ""
    pose = None
    try:
        news = _not_on_offer(command)
        if not news:
            pose = open_segment(rendezvous, POSE_SUFFIX)
            news = "a command segment without its pose segment"
        if pose is None:
            return None, news
        _claim(rendezvous, pose)
        segments = Segments(command, pose)
        command = pose = None
        return segments, ""
    finally:
        for segment in (command, pose):
            if segment is not None:
                segment.close()


def _not_on_offer(command: Segment) -> str:
    """Say why the session behind a command segment cannot be attached to; empty where it can."""
    _check_header_fits(command)
    word = magic(command.view)
    if word == _NOT_YET:
        return "a header that is not finished"
    if word != COMMAND_MAGIC:  # left to the handshake, which names what it found
        return ""
    pid, started = owner(command.view)
    if life(pid, started) is Life.DEAD:
        return f"stale segments of a dead agent (pid {pid})"
    if read_farewell(command.view)[0] != Farewell.NONE:
        return f"a session that its agent (pid {pid}) has left"
    return ""


def _claim(rendezvous: Rendezvous, pose: Segment) -> None:
    _check_header_fits(pose)
    pid, _ = owner(pose.view)
    if not pose.lock():
        raise SessionError(f"{rendezvous}: another physics process (pid {pid}) serves this session")
    if magic(pose.view) != _NOT_YET or read_farewell(pose.view)[0] != Farewell.NONE:
        raise SessionError(
            f"{rendezvous}: a physics process (pid {pid}) has served this session already; open a new session"
        )


def _check_header_fits(segment: Segment) -> None:
    if len(segment.view) < _HEADER_BYTES:
        raise HandshakeError(
            f"size of {segment.name}", f"at least {_HEADER_BYTES} bytes", str(len(segment.view))
        )
