"""Segments mapped for reading alone: what observers and the search for leftovers look through."""

from __future__ import annotations

import mmap
import os
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

from protocol.errors import SessionError
from protocol.memory import Rendezvous, is_ours, name_stands, open_segment, segment_path

_NO_DESCRIPTOR: Final = -1
_CLOSED: Final = -2


class ReadOnlySegment:
    """One segment that this process cannot write to; made by `open_read_only`."""

    def __init__(
        self, name: str, view: memoryview, path: Path | None, descriptor: int, unmap: Callable[[], None]
    ) -> None:
        self.name = name
        self.view = view
        self.path = path
        """Where the file system shows the segment; None for Windows' shared memory."""
        self._descriptor = descriptor
        self._unmap = unmap

    def locked(self) -> bool:
        """Tell whether another process holds the segment's lock; nothing is touched. False where nobody can tell.

        Linux and macOS can: it proves life also where the owner's pid is of another container.
        """
        if self._descriptor < 0 or sys.platform not in ("linux", "darwin"):
            return False
        import fcntl

        # struct flock on 64 bits, in each system's own order: type, whence, start, length, pid.
        layout, at, fields = (
            ("qqihh", 3, (0, 1, 0, fcntl.F_WRLCK, os.SEEK_SET))
            if sys.platform == "darwin"
            else ("hhqqi0q", 0, (fcntl.F_WRLCK, os.SEEK_SET, 0, 1, 0))
        )
        answer = fcntl.fcntl(self._descriptor, fcntl.F_GETLK, struct.pack(layout, *fields))
        return bool(struct.unpack(layout, answer)[at] != fcntl.F_UNLCK)

    def stands(self) -> bool:
        """Tell whether the segment's name still stands for it, and not for nothing or for a newer one."""
        return name_stands(self._descriptor, self.path)

    def close(self) -> None:
        """Unmap; every view of it must have been released before. Idempotent."""
        if self._descriptor == _CLOSED:
            return
        self.view.release()
        self._unmap()
        if self._descriptor >= 0:
            os.close(self._descriptor)
        self._descriptor = _CLOSED


def open_read_only(rendezvous: Rendezvous, suffix: str) -> ReadOnlySegment | None:
    """Map a segment for reading; None while it is not there or has no size yet.

    Raises:
        SessionError: it may not be read, or this process holds its lock: POSIX would release the lock as soon as
            this second descriptor is closed.
    """
    name, path = rendezvous.stem + suffix, segment_path(rendezvous, suffix)
    if sys.platform == "win32" and rendezvous.kind == "shm":
        segment = open_segment(
            rendezvous, suffix
        )  # Python has no other way to a mapping that has only a name
        if segment is None:
            return None
        return ReadOnlySegment(name, segment.view.toreadonly(), None, _NO_DESCRIPTOR, segment.close)
    if is_ours(path):
        raise SessionError(
            f"{rendezvous}: expected a session of another process, found one of our own (pid {os.getpid()}), "
            "whose lock POSIX would release when we stop looking; observe it from another process"
        )
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0))
        try:
            mapping = mmap.mmap(descriptor, os.fstat(descriptor).st_size, access=mmap.ACCESS_READ)
        except BaseException:
            os.close(descriptor)
            raise
    except (FileNotFoundError, ValueError):  # ValueError: mmap of an empty segment, its creator is not so far
        return None
    except OSError as error:
        raise SessionError(f"cannot read segment {name}: {error}") from error
    return ReadOnlySegment(name, memoryview(mapping), path, descriptor, mapping.close)
