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
from protocol.liveness import UNKNOWN, Life, life, start_time
from protocol.memory import (
    COMMAND_SUFFIX,
    POSE_SUFFIX,
    Rendezvous,
    Segment,
    Segments,
    create_segment,
    is_empty,
    open_segment,
    remove_empty,
)

_log = logging.getLogger("protocol")

CREATION_GRACE_S: Final = 0.5
"""How long a header without its magic is taken for one that is just being written."""
LOOK_AGAIN_S: Final = 0.005
_NOT_YET: Final = bytes(8)
_HEADER_BYTES: Final = 2048
_DEAD_AGENT: Final = "stale segments of a dead agent"
_UNFINISHED: Final = "a header that is not finished"
_TOO_SHORT: Final = "a file too short for a segment"
_LEFT_BEHIND: Final = (_DEAD_AGENT, _UNFINISHED)
"""What a dead agent leaves: it goes as soon as its lock does, which may outlive it for a moment."""


def create_segments(rendezvous: Rendezvous, lanes: int) -> Segments:
    """Create and lock the two segments; those of a dead agent are replaced, which is logged as a warning.

    Raises:
        SessionError: a live agent holds the rendezvous, something else has its name, or there is no room.
    """
    command = _create_over_stale(rendezvous, COMMAND_SUFFIX, layout.command_bytes(lanes), COMMAND_MAGIC)
    try:
        # Until it was locked, anyone could take it for one that was left unfinished, and replace it.
        if not (command.lock() and command.stands()):
            raise SessionError(
                f"{rendezvous} was taken by another at this moment; try again or use another name"
            )
        pose = _create_over_stale(rendezvous, POSE_SUFFIX, layout.pose_bytes(lanes), POSE_MAGIC)
    except BaseException:
        _remove_names(command, None)
        command.close()
        raise
    return Segments(command, pose)


def _create_over_stale(rendezvous: Rendezvous, suffix: str, size: int, word: bytes) -> Segment:
    """Create a segment, in place of a stale one if need be."""
    patience = time.monotonic() + CREATION_GRACE_S
    while True:
        try:
            return create_segment(rendezvous, suffix, size)
        except FileExistsError:
            patient = time.monotonic() < patience
            obstacle = _remove_stale(rendezvous, suffix, word, patient)
        if obstacle and not patient:
            raise SessionError(obstacle)
        time.sleep(LOOK_AGAIN_S)


def _remove_stale(rendezvous: Rendezvous, suffix: str, word: bytes, patient: bool) -> str:
    """Remove a segment whose writer is dead, or return what stands against it for now.

    A pose segment needs no proof of its own: who asks holds the lock of the command segment.

    Raises:
        SessionError: its writer is alive, or it is no session's segment.
    """
    name = rendezvous.stem + suffix
    foreign = f"{name} exists and is no session's segment; remove it or use another name"
    segment = open_segment(rendezvous, suffix)
    if segment is None:  # just being created, or just removed by another
        return foreign if patient or not remove_empty(rendezvous, suffix) else ""
    try:
        found = magic(segment.view)
        if len(segment.view) < _HEADER_BYTES or found not in (word, _NOT_YET):
            raise SessionError(foreign)
        pid, started = owner(segment.view)
        in_use = f"{rendezvous} belongs to a session whose agent (pid {pid}) is alive; use another name"
        if suffix == COMMAND_SUFFIX:
            if pid and life(pid, started) is not Life.DEAD:
                raise SessionError(in_use)
            if (found == _NOT_YET and patient) or not segment.lock():
                return in_use
            if not segment.stands():
                return ""
            _remove_stale(
                rendezvous, POSE_SUFFIX, POSE_MAGIC, patient=False
            )  # first, as `_remove_names` does
        _log.warning("replacing the stale segment %s; its writer (pid %d) did not remove it", name, pid)
        segment.unlink()
    finally:
        segment.close()
    return ""


def attach_segments(rendezvous: Rendezvous, timeout: float, launcher: int | None = None) -> Segments:
    """Wait until an agent offers a session, then open its segments and claim the physics side.

    Segments of an agent that is dead are removed, those of one that has said farewell passed over: a new agent
    may come.

    Raises:
        PeerLost: no session was offered within `timeout` seconds, or before the process `launcher` ended.
        SessionError: another physics process serves the session or has served it.
        HandshakeError: the pose segment is too small to be one.
    """
    launched = UNKNOWN if launcher is None else start_time(launcher)
    began = whole = time.monotonic()
    orphaned: float | None = None
    found = "nothing of that name"
    while True:
        now = time.monotonic()
        if orphaned is None and launcher is not None and life(launcher, launched) is Life.DEAD:
            orphaned = now
        patient = orphaned is None and now - whole < CREATION_GRACE_S
        segments, news = _try_attach(rendezvous, patient)
        if segments is not None:
            return segments
        if news != _UNFINISHED:
            whole = now  # the last moment without a half-written header
        found = news or found
        if orphaned is not None and (news not in _LEFT_BEHIND or now - orphaned > CREATION_GRACE_S):
            how = f"ended before a session was offered at {rendezvous}"
            raise PeerLost(f"launcher (pid {launcher})", how, Verdict.EXITED, 0, "attach")
        if now - began > timeout:
            how = f"no session at {rendezvous} within {timeout} s, found {found}; is the agent running?"
            raise PeerLost("agent", how, Verdict.TOO_SLOW, 0, "attach")
        time.sleep(LOOK_AGAIN_S)


def remove_if_dead(segments: Segments) -> None:
    """Remove the segments of an agent that is dead by now, for whatever reason its physics side leaves.

    The dead agent's lock may outlive it for a moment, while the system clears up its threads.
    """
    if _not_on_offer(segments.command) != _DEAD_AGENT:
        return
    patience = time.monotonic() + CREATION_GRACE_S
    while not _remove_names(segments.command, segments.pose):
        if time.monotonic() > patience:
            _log.warning("%s is left to the process that holds its lock", segments.command.name)
            return
        time.sleep(LOOK_AGAIN_S)


def _remove_names(command: Segment, pose: Segment | None, rendezvous: Rendezvous | None = None) -> bool:
    """Remove a session's names, which no living agent needs; False where another holds the lock of `command`.

    Under that lock, so that no newer names take their place in the meantime, and `command` last, so that nobody
    finds a `.pose` without one and thinks it his to replace. A pose segment that was not given a size before its
    agent died cannot be opened: it is found by `rendezvous`.
    """
    if not command.lock():
        return False
    if command.stands():
        if pose is not None:
            pose.unlink()
        elif rendezvous is not None:
            remove_empty(rendezvous, POSE_SUFFIX)
        command.unlink()
    return True


def _try_attach(rendezvous: Rendezvous, patient: bool) -> tuple[Segments | None, str]:
    """Open both segments if a session is on offer now; else say what was found.

    Removes what a dead agent left, and a header that stays unfinished once the patience with it is over; an
    agent that is writing one holds its lock.
    """
    command = open_segment(rendezvous, COMMAND_SUFFIX)
    if command is None:
        if not is_empty(rendezvous, COMMAND_SUFFIX):
            return None, ""
        if not patient:
            remove_empty(rendezvous, COMMAND_SUFFIX)
        return None, _UNFINISHED
    pose: Segment | None = None
    try:
        news = _not_on_offer(command)
        pose = open_segment(rendezvous, POSE_SUFFIX)  # after the magic: before it, this may be a dead agent's
        if news == _DEAD_AGENT or (news == _UNFINISHED and not patient):
            _remove_names(command, pose, rendezvous)
        if news:
            return None, news
        if pose is None or not command.stands():  # or a newer agent's
            return None, "a command segment without its pose segment"
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
    if len(command.view) < _HEADER_BYTES:  # not ours; or one that grows, on a file system that cannot reserve
        return _TOO_SHORT
    word = magic(command.view)
    if word == _NOT_YET:
        return _UNFINISHED
    if word != COMMAND_MAGIC:  # left to the handshake, which names what it found
        return ""
    pid, started = owner(command.view)
    if life(pid, started) is Life.DEAD:
        return _DEAD_AGENT
    if read_farewell(command.view)[0] != Farewell.NONE:
        return "a session that its agent has left"
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
