"""What stands under the names of sessions: which sessions live, and which segments a dead owner left behind.

Death is proved, never guessed: the owner's pid with its start time is gone and nobody holds the segment's lock. A
header that was never finished counts once it has stood for half a second and nobody holds its lock. Whatever is not
a segment of this protocol is left alone, and so is everything of a session of which either side may still live.
An empty file proves nothing and takes no memory: the next session of that name removes it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Final

from protocol import layout
from protocol.errors import SessionError
from protocol.handshake import magic, owner
from protocol.layout import COMMAND_MAGIC, POSE_MAGIC
from protocol.liveness import Life, life
from protocol.memory import (
    COMMAND_SUFFIX,
    POSE_SUFFIX,
    SHM_FOLDER,
    Rendezvous,
    Segment,
    is_ours,
    open_segment,
    parse_rendezvous,
    remove_empty,
    segment_path,
)
from protocol.opening import CREATION_GRACE_S
from protocol.read_only import ReadOnlySegment, open_read_only

_HEADER_BYTES: Final = 2048
_NOT_YET: Final = bytes(8)


class Standing(Enum):
    """What is known of the session behind a name."""

    LIVE = "live"
    """Its agent lives."""
    ORPHANED = "orphaned"
    """Its agent is dead and its physics process lives: that one removes the segments as soon as it looks."""
    UNFINISHED = "unfinished"
    """A header without its magic, or one segment without the other, that is too young to be given up."""
    DEAD = "dead"
    """Both sides are proved dead: it may be removed."""
    FOREIGN = "foreign"
    """Not a segment of this protocol, or one that may not be read."""


@dataclass(frozen=True)
class Found:
    """One name under which segments stand."""

    rendezvous: Rendezvous
    standing: Standing
    why: str
    """How that is known, with the processes, for people."""
    size: int
    """Bytes of its segments."""


def survey(folders: Sequence[Path] = ()) -> tuple[Found, ...]:
    """Look at every session's name in shared memory and, for `file:` rendezvous, in `folders`.

    Reads only: no lock is taken, no byte written. Windows shows no shared memory, and needs no such search there.
    """
    return tuple(found for place in _names(folders) if (found := _look(place)) is not None)


def leftovers(folders: Sequence[Path] = ()) -> tuple[Found, ...]:
    """Return what dead sessions left behind; all of it may be given to `remove`."""
    return tuple(found for found in survey(folders) if found.standing is Standing.DEAD)


def remove(rendezvous: Rendezvous) -> None:
    """Remove the segments of a session whose sides are both dead; none of its name is fine.

    Takes both locks first and looks again under them, so that nobody comes in between.

    Raises:
        SessionError: it is not proved dead (any more), or may not be removed.
    """
    found = _look(rendezvous)
    if found is None:
        return
    _demand_dead(found)
    with ExitStack() as opened:
        segments: list[Segment | None] = []
        for suffix in (COMMAND_SUFFIX, POSE_SUFFIX):
            segment = open_segment(rendezvous, suffix)
            segments.append(segment)
            if segment is not None:
                opened.callback(segment.close)
                if not segment.lock():
                    raise SessionError(f"{rendezvous}: {segment.name} was taken at this moment; left alone")
        command, pose = (
            _Side(segment.view, segment.path, False) if segment else None for segment in segments
        )
        if command is None and pose is None:
            return
        if any(segment is not None and not segment.stands() for segment in segments):
            raise SessionError(f"{rendezvous} was taken at this moment; left alone")
        _demand_dead(_judge(rendezvous, command, pose))
        # `.cmd` last: its lock is what a new agent asks for.
        for segment, suffix in ((segments[1], POSE_SUFFIX), (segments[0], COMMAND_SUFFIX)):
            if segment is not None:
                segment.unlink()
            else:  # the agent may have died before it had given it a size
                remove_empty(rendezvous, suffix)


@dataclass(frozen=True)
class _Side:
    """One segment, as it is judged."""

    view: memoryview
    path: Path | None
    locked: bool


def _demand_dead(found: Found) -> None:
    if found.standing is not Standing.DEAD:
        raise SessionError(
            f"{found.rendezvous}: expected a session that is proved dead, found {found.standing.value} "
            f"({found.why}); left alone"
        )


def _names(folders: Sequence[Path]) -> Iterator[Rendezvous]:
    """Every rendezvous of which a segment stands in shared memory or in one of the folders."""
    places = [("shm", SHM_FOLDER), *(("file", folder.absolute()) for folder in folders)]
    for kind, folder in places:
        if not folder.is_dir():
            continue
        names = [path for path in folder.iterdir() if path.suffix in (COMMAND_SUFFIX, POSE_SUFFIX)]
        stems = {path.stem for path in names if path.is_file() and not path.is_symlink()}
        for stem in sorted(stems):
            try:
                yield parse_rendezvous(f"{kind}:{stem if kind == 'shm' else folder / stem}")
            except SessionError:  # a name that no session can have
                continue


def _look(rendezvous: Rendezvous) -> Found | None:
    """Judge what stands under one name; None where nothing does (any more)."""
    suffixes = (COMMAND_SUFFIX, POSE_SUFFIX)
    if any(is_ours(segment_path(rendezvous, suffix)) for suffix in suffixes):
        return Found(rendezvous, Standing.LIVE, "it is of this process itself", 0)
    with ExitStack() as opened:
        sides: list[_Side | None] = []
        for suffix in suffixes:
            try:
                segment = open_read_only(rendezvous, suffix)
            except SessionError as error:
                return Found(rendezvous, Standing.FOREIGN, str(error), 0)
            sides.append(None if segment is None else _side(opened, segment))
        command, pose = sides
        return None if command is None and pose is None else _judge(rendezvous, command, pose)


def _side(opened: ExitStack, segment: ReadOnlySegment) -> _Side:
    opened.callback(segment.close)
    return _Side(segment.view, segment.path, segment.locked())


def _judge(rendezvous: Rendezvous, command: _Side | None, pose: _Side | None) -> Found:
    size = sum(len(side.view) for side in (command, pose) if side is not None)

    def found(standing: Standing, why: str) -> Found:
        return Found(rendezvous, standing, why, size)

    for side, suffix in ((command, COMMAND_SUFFIX), (pose, POSE_SUFFIX)):
        if side is not None and not _is_segment(side.view, suffix):
            return found(Standing.FOREIGN, f"{rendezvous.stem}{suffix} is no segment of a session")
    agent, physics = _sign_of_life(command), _sign_of_life(pose)
    if agent:
        return found(Standing.LIVE, f"its agent ({agent}) lives")
    if physics:
        return found(Standing.ORPHANED, f"its agent is dead, its physics process ({physics}) lives")
    # A dead pid is proof enough; without one only time tells.
    unproved = command is None or owner(command.view)[0] == 0
    if unproved and any(side is not None and _is_young(side) for side in (command, pose)):
        return found(Standing.UNFINISHED, "it is being created or removed at this moment")
    return found(Standing.DEAD, f"{_obituary('agent', command)}, {_obituary('physics', pose)}")


def _is_segment(view: memoryview, suffix: str) -> bool:
    """Tell whether a file is a segment, or one whose header is not finished: zeros of just the right size."""
    word, first, row = (
        (COMMAND_MAGIC, layout.command_bytes(0), layout.COMMAND_STRIDE + layout.RESET_STRIDE)
        if suffix == COMMAND_SUFFIX
        else (POSE_MAGIC, layout.pose_bytes(0), layout.POSE_STRIDE)
    )
    if len(view) < _HEADER_BYTES:
        return False
    lanes, rest = divmod(len(view) - first, row)
    return magic(view) == word or (magic(view) == _NOT_YET and lanes >= 1 and rest == 0)


def _sign_of_life(side: _Side | None) -> str:
    """Say what shows that a segment's writer lives; empty where nothing does."""
    if side is None:
        return ""
    pid, started = owner(side.view)
    if side.locked:
        return f"pid {pid}" if pid else "it holds the lock"
    if pid == 0:  # not known counts as living, once a header stands
        return "" if magic(side.view) == _NOT_YET else "pid not known"
    return f"pid {pid}" if life(pid, started) is not Life.DEAD else ""


def _is_young(side: _Side) -> bool:
    if side.path is None:
        return False
    try:
        return time.time() - side.path.stat().st_mtime < CREATION_GRACE_S
    except FileNotFoundError:
        return True


def _obituary(name: str, side: _Side | None) -> str:
    if side is None:
        return f"{name}'s segment is gone"
    pid, _ = owner(side.view)
    return f"{name} (pid {pid}) is dead" if pid else f"{name} never wrote its header and holds no lock"
