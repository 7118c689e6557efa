"""What the specification says of headers and requests, written from `protocol/README.md` alone.

Takes nothing from the code that it judges: offsets, codes and ranges stand here once more.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, field
from fractions import Fraction

HEADER_AT = {
    "version_major": 8,
    "segment_bytes": 24,
    "lanes": 64,
    "dt": 72,
    "inner_steps": 88,
    "tube_slots": 96,
    "command_stride": 104,
    "pose_stride": 112,
    "reset_stride": 120,
}
"""Offsets of the words that are judged."""
SPEED_MAX = 10.0
"""Of the toy plant."""


def common_is_sound(view: memoryview, word: bytes, size: int) -> bool | None:
    """Whether the specification takes the common part of a header; None where rounding decides."""

    def number(name: str) -> int:
        return int(struct.unpack_from("<q", view, HEADER_AT[name])[0])

    dt, inner = struct.unpack_from("<2d", view, HEADER_AT["dt"])
    if not (bytes(view[:8]) == word and number("version_major") == 1 and 1 <= number("lanes") <= 65536):
        return False
    if not (0.0 < dt < math.inf and 0.0 < inner < math.inf and 1 <= number("inner_steps") <= 1_000_000):
        return False
    off = abs(number("inner_steps") * Fraction(inner) - Fraction(dt)) / Fraction(dt)
    strides = [number(f"{name}_stride") for name in ("command", "pose", "reset")] == [64, 128, 384]
    if not (strides and 1 <= number("tube_slots") <= 65536 and number("segment_bytes") == size):
        return False
    return None if abs(off - Fraction(1, 10**9)) < Fraction(1, 10**11) else off < Fraction(1, 10**9)


def command_fault(row: bytes) -> int:
    """Code of the first fault of a command row, 0 where there is none."""
    x, y, z, speed, compensation = struct.unpack_from("<5d", row)
    if not all(map(math.isfinite, (x, y, z))):
        return 1
    if abs(x * x + y * y + z * z - 1.0) > 1e-6:
        return 3
    for value, most in ((speed, SPEED_MAX), (compensation, 2.0)):
        if not math.isfinite(value):
            return 1
        if not 0.0 <= value <= most:
            return 2
    return 4 if any(row[40:]) else 0


POSITIVE, NOT_NEGATIVE = {0, 1, 2, 3, 4}, {5, 7, 8, 9, 10, 13, 17}


def parameters_fault(values: tuple[float, ...], reserved: bytes) -> int:
    """Code of the first fault of a reset's parameters, by the table of section 3."""
    for word, value in enumerate(values):
        if not math.isfinite(value):
            return 1
        low = value <= 0.0 if word in POSITIVE else value < 0.0 if word in NOT_NEGATIVE else False
        if low or (word == 6 and value not in (0.0, 1.0)) or (word == 12 and not 0.0 <= value <= 1.0):
            return 2
    return 4 if any(reserved) else 0


def reset_fault(row: bytes, tubes: set[int]) -> int:
    """Code of the first fault of a reset row that is selected."""
    state, (tube,) = struct.unpack_from("<13d", row), struct.unpack_from("<q", row, 104)
    if not all(map(math.isfinite, state)):
        return 1
    if tube != -1 and tube not in tubes:
        return 6
    if not abs(sum(x * x for x in state[3:7]) - 1.0) <= 1e-6:
        return 3
    return parameters_fault(struct.unpack_from("<18d", row, 128), row[128 + 18 * 8 :])


@dataclass
class Oracle:
    """What the specification says of a session so far."""

    lanes: int
    tube_slots: int
    tubes: set[int] = field(default_factory=set)
    lane_tubes: list[int | None] = field(default_factory=list)
    """Tube of every lane's last reset, None before the first."""
    steps: int = 0

    def __post_init__(self) -> None:
        self.lane_tubes = [None] * self.lanes

    def answer(self, op: int, command: memoryview) -> tuple[int, int]:
        """Code (0 done) and lane of the answer that is due to a request whose words are in order."""
        if op == 5:
            return 0, -1
        code, lane = {1: self._step, 2: self._reset, 3: self._register, 4: self._release}[op](command)
        if code == 0:
            self.steps += op == 1
        return code, lane

    def _step(self, command: memoryview) -> tuple[int, int]:
        if None in self.lane_tubes:
            return 5, self.lane_tubes.index(None)
        rows = bytes(command[6464 : 6464 + 64 * self.lanes])
        faults = [command_fault(rows[64 * lane :][:64]) for lane in range(self.lanes)]
        return next(((code, lane) for lane, code in enumerate(faults) if code), (0, -1))

    def _reset(self, command: memoryview) -> tuple[int, int]:
        rows = bytes(command[6464 + 64 * self.lanes :])
        chosen = {}
        for lane in range(self.lanes):
            row = rows[384 * lane :][:384]
            (selected,) = struct.unpack_from("<q", row, 120)
            code = 0 if selected == 0 else 2 if selected != 1 else reset_fault(row, self.tubes)
            if code:
                return code, lane
            if selected:
                chosen[lane] = struct.unpack_from("<q", row, 104)[0]
        for lane, tube in chosen.items():
            self.lane_tubes[lane] = tube
        return 0, -1

    def _register(self, command: memoryview) -> tuple[int, int]:
        index, axes, scale = struct.unpack_from("<2qd", command, 2048)
        (size,) = struct.unpack_from("<q", command, 2104)
        if not 0 <= index < self.tube_slots:
            return 7, -1
        if axes not in (0, 1):
            return 9, -1
        if not 0.0 < scale < math.inf:
            return 2, -1
        path = bytes(command[2112 : 2112 + size]) if 1 <= size <= 4096 else b"\0"
        try:
            path.decode()
        except UnicodeDecodeError:
            return 9, -1
        if b"\0" in path:
            return 9, -1
        if index in self.tubes:
            return 7, -1
        self.tubes.add(index)
        return 0, -1

    def _release(self, command: memoryview) -> tuple[int, int]:
        (index,) = struct.unpack_from("<q", command, 2048)
        if not 0 <= index < self.tube_slots:
            return 7, -1
        if index not in self.tubes:
            return 6, -1
        if index in self.lane_tubes:
            return 8, self.lane_tubes.index(index)
        self.tubes.discard(index)
        return 0, -1
