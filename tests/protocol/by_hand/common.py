"""What both hand-written peers need: segments, locks, words and processes, by the specification alone.

The peers import nothing but the standard library, so that one starts in 20 ms. They are started as
`PEER RULE RENDEZVOUS`: a peer breaks the rule that is named, and keeps all others; `none` breaks none.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import struct
import sys
from pathlib import Path
from typing import Final

BROKEN: Final = sys.argv[1]
"""The rule that this peer breaks."""
RENDEZVOUS: Final = sys.argv[2]

HEADER_BYTES: Final = 2048
VERSION_MAJOR, VERSION_MINOR, SEGMENT_BYTES, SESSION, PID, START_TIME, LANES = 8, 16, 24, 32, 48, 56, 64
DT, PHYSICS_DT, INNER_STEPS, TUBE_SLOTS, COMMAND_STRIDE, POSE_STRIDE, RESET_STRIDE = range(72, 128, 8)
FAREWELL, FAREWELL_TEXT, TEXT_BYTES = 1024, 1032, 1016
STOPPED, FAILED, VIOLATION, HANDSHAKE = 1, 2, 3, 4
STEP, RESET, REGISTER_TUBE, RELEASE_TUBE, GOODBYE = 1, 2, 3, 4, 5
COMMAND_MAGIC, POSE_MAGIC, NO_MAGIC = b"TUBE.CMD", b"TUBE.POS", bytes(8)
LOOK_S: Final = 0.03


def keeps(rule: str) -> bool:
    """Whether a rule is kept."""
    return rule != BROKEN


def path(suffix: str) -> str:
    """The file of a segment."""
    kind, stem = RENDEZVOUS.split(":", 1)
    return ("/dev/shm/" + stem if kind == "shm" else stem) + suffix


class Segment:
    """A mapped segment, by words."""

    def __init__(self, name: str, descriptor: int) -> None:
        self.name, self.descriptor = name, descriptor
        self.size = os.fstat(descriptor).st_size
        self.map = mmap.mmap(descriptor, self.size)

    def __getitem__(self, offset: int) -> int:
        return int(struct.unpack_from("<q", self.map, offset)[0])

    def __setitem__(self, offset: int, value: int) -> None:
        struct.pack_into("<q", self.map, offset, value)

    def number(self, offset: int) -> float:
        """A float word."""
        return float(struct.unpack_from("<d", self.map, offset)[0])

    def lock(self) -> bool:
        """Take the lock."""
        try:
            fcntl.lockf(self.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB, 1)
        except OSError:
            return False
        return True

    def farewell(self, kind: int, text: str) -> None:
        """Say why we leave."""
        if self[FAREWELL] == 0:
            self.map[FAREWELL_TEXT : FAREWELL_TEXT + TEXT_BYTES] = text.encode()[:TEXT_BYTES].ljust(
                TEXT_BYTES, b"\0"
            )
            self[FAREWELL] = kind

    def unlink(self, *, whatever_stands_there: bool = False) -> None:
        """Remove the name, if it still stands for this segment."""
        try:
            ours, there = os.fstat(self.descriptor), Path(self.name).stat()
            if whatever_stands_there or (ours.st_dev, ours.st_ino) == (there.st_dev, there.st_ino):
                Path(self.name).unlink()
        except FileNotFoundError:
            pass


def start_time(pid: int) -> tuple[str, int]:
    """State and start time of a process; ("", 0) where there is none."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except (FileNotFoundError, ProcessLookupError):
        return "", 0
    fields = text.rsplit(")", 1)[1].split()
    return fields[0], int(fields[19])


def lives(pid: int, started: int, *, zombie: str, reused: str, stopped: str) -> bool:
    """Whether a process lives; the names are of the rules about zombies, reused pids and stopped processes."""
    if pid <= 0:
        return True
    state, found = start_time(pid)
    if not state or (state in "ZX" and keeps(zombie)):
        return False
    if state in "Tt" and not keeps(stopped):
        return False
    return found == started or not keeps(reused)


class Left(Exception):  # noqa: N818  not an error of this program
    """This side leaves with a farewell of a kind."""

    def __init__(self, kind: int, text: str) -> None:
        self.kind, self.text = kind, text
        super().__init__(text)


def told_to_stop(number: int, frame: object) -> None:
    """Take a signal."""
    raise Left(STOPPED, f"signal {number}")
