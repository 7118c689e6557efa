"""Memory that two processes share: named segments and mapped files behind one small class.

The only importer of `multiprocessing.shared_memory`. A rendezvous is `shm:NAME` or `file:/absolute/stem`; either
stands for two segments, `.cmd` and `.pose`. On Linux `shm:NAME` is seen by others as `/dev/shm/NAME.cmd`.
"""

from __future__ import annotations

import errno
import logging
import mmap
import os
import platform
import re
import shutil
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from typing import Final

from protocol.errors import SessionError

COMMAND_SUFFIX: Final = ".cmd"
POSE_SUFFIX: Final = ".pose"

_log = logging.getLogger("protocol")
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
SHM_FOLDER: Final = Path("/dev/shm")
"""Where Linux shows shared memory as files."""
_NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

_claims: set[tuple[int, int, int]] = set()
"""Process, device and inode of every file that `Segment.lock` claimed; a process forked from ours has no claim."""


@dataclass(frozen=True)
class Rendezvous:
    """Where the two sides meet; `parse_rendezvous` makes one from its text."""

    kind: str  # "shm" or "file"
    stem: str  # name of the shared memory, or absolute path, both without suffix

    def __str__(self) -> str:
        return f"{self.kind}:{self.stem}"


def parse_rendezvous(text: str) -> Rendezvous:
    """Read `shm:NAME` or `file:/absolute/stem`.

    Raises:
        SessionError: the text is neither, or names what this system does not offer.
    """
    kind, _, stem = text.partition(":")
    if kind == "shm":
        if not _NAME.fullmatch(stem):
            raise SessionError(
                "rendezvous: expected shm:NAME with 1 to 64 letters, digits, dots, dashes or underscores, "
                f"the first a letter or digit, found {text!r}"
            )
        if sys.platform != "win32" and not SHM_FOLDER.is_dir():
            raise SessionError(f"rendezvous {text!r}: this system has no {SHM_FOLDER}; use file:/path/stem")
        return Rendezvous(kind, stem)
    if kind == "file":
        path = Path(stem)
        if not path.is_absolute() or not path.name or not _may_be_a_path(stem):
            raise SessionError(f"rendezvous: expected file: and an absolute path, found {text!r}")
        if not _is_folder(path.parent):
            raise SessionError(f"rendezvous {text!r}: there is no folder {path.parent}; make it first")
        return Rendezvous(kind, stem)
    raise SessionError(f"rendezvous: expected shm:NAME or file:/path/stem, found {text!r}")


def _may_be_a_path(text: str) -> bool:
    try:
        return b"\0" not in os.fsencode(text)
    except UnicodeEncodeError:
        return False


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except OSError:  # a name that is too long
        return False


def name_stands(descriptor: int, path: Path | None) -> bool:
    """Tell whether a path still stands for the file that a descriptor is open on."""
    if path is None:  # Windows keeps the name of shared memory for as long as anyone has it open
        return True
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


class Segment:
    """One mapped segment; made by `create_segment` and `open_segment`."""

    def __init__(
        self, name: str, view: memoryview, path: Path | None, descriptor: int, unmap: Callable[[], None]
    ) -> None:
        self.name = name
        self.view = view
        self.path = path
        """Where the file system shows the segment; None for Windows' shared memory."""
        self._descriptor = descriptor
        self._unmap = unmap
        self._lock: SharedMemory | None = None
        self._remove_when_closed = False
        self._claim: tuple[int, int, int] | None = None

    def lock(self) -> bool:
        """Claim the segment for its one writer, until this process closes it or dies; False where it is taken.

        A record lock on byte 0 (fcntl; LockFile for files of Windows, a segment NAME.lock for its shared memory):
        the system itself releases it, so that a dead owner leaves no claim behind.
        """
        if sys.platform == "win32":
            from protocol import windows

            return self._reserve_name() if self.path is None else windows.lock_file(self._descriptor)
        import fcntl

        try:
            fcntl.lockf(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB, 1)
        except (BlockingIOError, PermissionError):  # EAGAIN or EACCES, as the system likes
            return False
        status = os.fstat(self._descriptor)
        self._claim = (os.getpid(), status.st_dev, status.st_ino)
        _claims.add(self._claim)
        return True

    def _reserve_name(self) -> bool:
        """Claim Windows' shared memory, which has no file to lock, by a name that goes with its owner."""
        try:
            self._lock = _shared_memory(f"{self.name}.lock", create=True, size=1)
        except OSError:
            return False
        return True

    def stands(self) -> bool:
        """Tell whether the segment's name still stands for it, and not for a newer one or for nothing."""
        return name_stands(self._descriptor, self.path)

    def unlink(self) -> None:
        """Remove the segment's name, unless it is gone already or stands for a newer segment.

        Windows removes shared memory with its last user, and keeps the name of a file until it is closed.
        """
        if self.path is None or self._descriptor == _CLOSED or not self.stands():
            return
        if sys.platform == "win32":
            self._remove_when_closed = True
        else:
            self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Unmap; every view of it must have been released before. Idempotent."""
        if self._descriptor == _CLOSED:
            return
        self.view.release()
        self._unmap()
        if self._lock is not None:
            self._lock.close()
        if self._descriptor >= 0:
            os.close(self._descriptor)
        self._descriptor = _CLOSED
        if self._claim is not None:
            _claims.discard(self._claim)
        if sys.platform == "win32" and self._remove_when_closed:
            from protocol import windows

            assert self.path is not None
            if not windows.remove_file(self.path):
                _log.warning("%s stays behind: another process still maps it", self.path)


_NO_DESCRIPTOR: Final = -1
_CLOSED: Final = -2


@dataclass(frozen=True)
class Segments:
    """The two segments of a session."""

    command: Segment
    pose: Segment

    def unlink(self) -> None:
        """Remove both names, the command segment's last: it tells who left the other behind."""
        self.pose.unlink()
        self.command.unlink()

    def close(self) -> None:
        """Unmap both."""
        self.command.close()
        self.pose.close()


def create_segment(rendezvous: Rendezvous, suffix: str, size: int) -> Segment:
    """Create a segment of `size` zero bytes, with its memory reserved.

    Raises:
        FileExistsError: there is one of this name.
        SessionError: there is no room, or the folder cannot be written.
    """
    name = rendezvous.stem + suffix
    try:
        if rendezvous.kind == "file":
            path = Path(name)
            flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
            descriptor = os.open(path, flags, 0o600)
            try:
                _reserve(descriptor, size)
            except BaseException:
                os.close(descriptor)
                path.unlink()
                raise
            return _map_file(name, path, descriptor, size)
        segment = _wrap_shared(name, _shared_memory(name, create=True, size=size))
        try:
            if segment.path is not None:
                _reserve(segment._descriptor, size)
        except BaseException:
            segment.unlink()
            segment.close()
            raise
    except FileExistsError:
        raise
    except OSError as error:
        raise SessionError(_why_not_created(name, rendezvous, size, error)) from error
    return segment


def open_segment(rendezvous: Rendezvous, suffix: str) -> Segment | None:
    """Open a segment that another process created; None while it is not there or has no size yet.

    Raises:
        SessionError: it is there and may not be opened.
    """
    name = rendezvous.stem + suffix
    try:
        if rendezvous.kind == "file":
            descriptor = os.open(name, os.O_RDWR | getattr(os, "O_BINARY", 0))
            size = os.fstat(descriptor).st_size
            if size == 0:
                os.close(descriptor)
                return None
            return _map_file(name, Path(name), descriptor, size)
        return _wrap_shared(name, _shared_memory(name))
    except (FileNotFoundError, ValueError):  # ValueError: mmap of an empty segment, its creator is not so far
        return None
    except OSError as error:
        raise SessionError(f"cannot open segment {name}: {error}") from error


def is_ours(path: Path) -> bool:
    """Tell whether this very process holds the lock of the segment that `path` shows."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return False
    return (os.getpid(), status.st_dev, status.st_ino) in _claims


def segment_path(rendezvous: Rendezvous, suffix: str) -> Path:
    """Return where the file system shows a segment (Windows shows no shared memory)."""
    folder = SHM_FOLDER if rendezvous.kind == "shm" else Path()
    return folder / (rendezvous.stem + suffix)


def is_empty(rendezvous: Rendezvous, suffix: str) -> bool:
    """Tell whether a segment has a name and no size: its creator is just making it, or was killed over it."""
    try:
        return segment_path(rendezvous, suffix).stat().st_size == 0
    except FileNotFoundError:
        return False


def remove_empty(rendezvous: Rendezvous, suffix: str) -> bool:
    """Remove a segment that was never given a size, under its lock; False where none stands or it is taken."""
    path = segment_path(rendezvous, suffix)
    try:
        descriptor = os.open(path, os.O_RDWR)
    except FileNotFoundError:
        return False
    segment = Segment(str(path), memoryview(b""), path, descriptor, lambda: None)
    try:
        removable = os.fstat(descriptor).st_size == 0 and segment.lock()
        if removable:
            segment.unlink()
        return removable
    finally:
        segment.close()


def _map_file(name: str, path: Path, descriptor: int, size: int) -> Segment:
    mapping = mmap.mmap(descriptor, size)
    return Segment(name, _whole_words(mapping), path, descriptor, mapping.close)


def _whole_words(memory: mmap.mmap | memoryview) -> memoryview:
    """View memory without a rest of less than a word at its end, which no segment has."""
    with memoryview(memory) as view:
        return view[: len(view) // 8 * 8]


def _wrap_shared(name: str, shared: SharedMemory) -> Segment:
    """Put shared memory behind a Segment; its file, where the system shows one, serves locks and reservation."""
    assert shared.buf is not None  # it is None only after close()
    view = _whole_words(shared.buf)
    if sys.platform == "win32":
        return Segment(name, view, None, _NO_DESCRIPTOR, shared.close)
    path = SHM_FOLDER / name
    try:
        descriptor = os.open(path, os.O_RDWR)
    except BaseException:
        view.release()
        shared.close()
        raise
    return Segment(name, view, path, descriptor, shared.close)


def _shared_memory(name: str, *, create: bool = False, size: int = 0) -> SharedMemory:
    if sys.version_info >= (3, 13):
        return SharedMemory(name, create=create, size=size, track=False)
    with _untracked():
        return SharedMemory(name, create=create, size=size)


_tracker_patch = threading.Lock()


@contextmanager
def _untracked() -> Iterator[None]:
    """Keep shared memory out of multiprocessing's resource tracker, as `track=False` does from Python 3.13 on.

    The tracker removes, when *any* Python process that attached ends, a segment that others still use. Both
    sides unlink by rule here, whichever of them dies, and need no tracker.
    """
    with _tracker_patch:
        register = resource_tracker.register
        resource_tracker.register = lambda name, rtype: None
        try:
            yield
        finally:
            resource_tracker.register = register


def _reserve(descriptor: int, size: int) -> None:
    """Give a new segment its size and its memory at once, so that a full /dev/shm is an error and no bus error."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(descriptor, 0, size)
    else:
        rest = memoryview(bytes(size))
        while rest:  # a disk that is nearly full takes a part of it first
            rest = rest[os.write(descriptor, rest) :]


def _why_not_created(name: str, rendezvous: Rendezvous, size: int, error: OSError) -> str:
    if error.errno not in _NO_ROOM:
        return f"cannot create segment {name}: {error}"
    folder = SHM_FOLDER if rendezvous.kind == "shm" else Path(rendezvous.stem).parent
    free = shutil.disk_usage(folder).free if folder.is_dir() else 0
    advice = (
        "enlarge it (docker run --shm-size) or use file:/path/stem"
        if rendezvous.kind == "shm"
        else "make room"
    )
    return f"no room for segment {name}: expected {size} free bytes in {folder}, found {free}; {advice}"


def _find_fence() -> Callable[[], object] | None:
    """Return what keeps the processor from reordering stores, or None where it keeps their order by itself.

    Where it may reorder and the libraries of the system have no fence, opening a session raises a SessionError.
    """
    if platform.machine().lower() in ("x86_64", "amd64", "i686", "i386", "x86"):
        return None
    import ctypes

    sequentially_consistent = 5  # memory_order_seq_cst of C11
    library, name, arguments = {
        "darwin": ("libSystem.dylib", "OSMemoryBarrier", ()),
        "win32": ("kernel32.dll", "FlushProcessWriteBuffers", ()),
    }.get(sys.platform, ("libatomic.so.1", "atomic_thread_fence", (sequentially_consistent,)))
    try:
        return partial(getattr(ctypes.CDLL(library), name), *arguments)
    except (OSError, AttributeError):
        problem = (
            f"this processor ({platform.machine()}) reorders stores and needs a fence: expected {name} in {library}, "
            "found none; install that library (libatomic on Linux)"
        )

    def missing() -> None:
        raise SessionError(problem)

    return missing


FENCE: Final = _find_fence()
"""Called after a message's last word and before its doorbell, and after a doorbell was seen; None on x86."""
