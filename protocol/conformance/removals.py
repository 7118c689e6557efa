"""In which order names are removed from a folder, as Linux tells it (inotify): a look at the folder may miss it."""

from __future__ import annotations

import ctypes
import os
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from protocol.conformance.rule import Skip

_DELETED: Final = 0x200
_EVENT: Final = struct.Struct("<iIII")  # watch, mask, cookie, bytes of the name behind it
_BUFFER_BYTES: Final = 1 << 16


@contextmanager
def removals(folder: Path) -> Iterator[int]:
    """Watch a folder; `removed` reads from the descriptor what was removed since then.

    Raises:
        Skip: this system has no inotify, or no more of it.
    """
    libc = ctypes.CDLL(None)
    descriptor = -1
    if sys.platform == "linux" and hasattr(libc, "inotify_init1"):
        descriptor = int(libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC))
    if descriptor < 0:
        raise Skip("this system does not tell in which order names are removed (inotify)")
    try:
        if libc.inotify_add_watch(descriptor, os.fsencode(folder), _DELETED) < 0:
            raise Skip(f"{folder} cannot be watched for names that are removed (inotify)")
        yield descriptor
    finally:
        os.close(descriptor)


def removed(descriptor: int) -> list[str]:
    """Names that were removed, in that order."""
    names: list[str] = []
    while True:
        try:
            events = os.read(descriptor, _BUFFER_BYTES)
        except BlockingIOError:
            return names
        at = 0
        while at < len(events):
            length = _EVENT.unpack_from(events, at)[3]
            at += _EVENT.size + length
            names.append(os.fsdecode(events[at - length : at].rstrip(b"\0")))
