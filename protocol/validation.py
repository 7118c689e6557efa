"""What the physics side checks of a request before anything is integrated.

Each check returns None, or the Refusal that names field, lane, expected and found.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Container
from functools import partial
from typing import Final

import numpy as np

from protocol.errors import Refusal, RefusalCode
from protocol.layout import COMMAND_STRIDE
from protocol.plant import NO_TUBE, PARAMETERS, CommandBatch, Floats, Parameter, ResetBatch

UNIT_TOLERANCE: Final = 1e-6
"""How far the squared length of a direction or a quaternion may be from 1."""
COMPENSATION_MAX: Final = 2.0

_FEW_LANES: Final = 20
_ROUNDING: Final = 1e-12
"""More than sums of three squares near 1 differ by, in whatever order they are added."""
_ROW: Final = struct.Struct("<5d3q")
assert _ROW.size == COMMAND_STRIDE

_STATE_WORDS: Final = 13
"""Words of position, quaternion and velocities at the beginning of a reset row; then come tube, seed, selected."""
_TUBE: Final = 13
_PARAMETERS: Final = slice(16, 16 + len(PARAMETERS))
_RESERVED: Final = slice(16 + len(PARAMETERS), None)
_LARGEST: Final = np.finfo(np.float64).max
_LOWEST: Final = np.array(
    [np.nextafter(p.lowest, math.inf) if p.above_lowest else max(p.lowest, -_LARGEST) for p in PARAMETERS]
)
_HIGHEST: Final = np.array([min(p.highest, _LARGEST) for p in PARAMETERS])
"""Smallest and largest numbers that a parameter may be, finite as they must be."""
_EITHER: Final = [i for i, p in enumerate(PARAMETERS) if p.either]


def command_check(commands: CommandBatch, speed_max: float) -> Callable[[], bool]:
    """Make the quick check of a session's one batch of commands: True only if all of it may be integrated.

    A few lanes are checked on scalars, for arrays of a few rows take as long as arrays of fifty. That of many is
    narrower than the true bounds by rounding, since arrays add up in another order; what it does not take is
    judged by `command_refusal`, row by row.
    """
    lanes = len(commands.raw)
    if lanes <= _FEW_LANES:
        return partial(commands_are_sound, commands.raw.data.cast("B"), speed_max)
    columns = np.empty((9, lanes))  # direction, its squared length, speed, compensation, reserved words
    direction, squared_length, bounded, reserved = columns[:3], columns[3], columns[3:6], columns[6:]
    sent_direction, sent_others = commands.raw.T[:3], commands.raw.T[3:]
    narrow = UNIT_TOLERANCE - _ROUNDING
    lowest = np.repeat([[1.0 - narrow], [0.0], [0.0]], lanes, axis=1)
    highest = np.repeat([[1.0 + narrow], [speed_max], [COMPENSATION_MAX]], lanes, axis=1)
    not_too_low, not_too_high = np.empty((2, 3, lanes), dtype=bool)
    all_true, all_zero = bytes([True]) * not_too_low.size, bytes(reserved.nbytes)

    def all_are_sound() -> bool:
        direction[...] = sent_direction
        columns[4:] = sent_others
        np.einsum("ij,ij->j", direction, direction, out=squared_length)
        np.greater_equal(bounded, lowest, out=not_too_low)
        np.less_equal(bounded, highest, out=not_too_high)
        # Bytes compare in a tenth of the time that numpy's reductions take.
        return (
            not_too_low.tobytes() == all_true
            and not_too_high.tobytes() == all_true
            and reserved.tobytes() == all_zero
        )

    return all_are_sound


def commands_are_sound(rows: memoryview, speed_max: float) -> bool:
    """Whether command rows may be integrated, exactly; NaN fails every comparison.

    Args:
        rows: bytes of whole command rows.
        speed_max: the plant's limit (m/s).
    """
    for x, y, z, speed, compensation, reserved, reserved_1, reserved_2 in _ROW.iter_unpack(rows):
        if not (
            -UNIT_TOLERANCE <= x * x + y * y + z * z - 1.0 <= UNIT_TOLERANCE
            and 0.0 <= speed <= speed_max
            and 0.0 <= compensation <= COMPENSATION_MAX
            and not (reserved | reserved_1 | reserved_2)
        ):
            return False
    return True


def command_refusal(commands: CommandBatch, speed_max: float) -> Refusal | None:
    """Return what is wrong with the first unsound command."""
    for lane, row in enumerate(commands.raw):
        if commands_are_sound(row.data.cast("B"), speed_max):
            continue
        return (
            _unit("direction", row[:3], lane)
            or _range("speed", float(row[3]), 0.0, speed_max, lane)
            or _range("compensation", float(row[4]), 0.0, COMPENSATION_MAX, lane)
            or _reserved("reserved command words", row[5:], lane)
        )
    return None


def reset_refusal(resets: ResetBatch, tubes: Container[int]) -> Refusal | None:
    """Return what is wrong with the first unsound row among the selected ones; `tubes` are the registered indices."""
    if resets_are_sound(resets, tubes):
        return None
    for lane, selected in enumerate(resets.selected.tolist()):
        if selected not in (0, 1):
            return Refusal("selected", "0 or 1", str(selected), lane, RefusalCode.OUT_OF_RANGE)
        refusal = _reset_row_refusal(resets, lane, tubes) if selected else None
        if refusal is not None:
            return refusal
    return None


def resets_are_sound(resets: ResetBatch, tubes: Container[int]) -> bool:
    """The quick check of all selected rows at once, which takes as long as that of one row by itself."""
    rows = resets.raw[resets.selected == 1]
    parameters, reserved = rows[:, _PARAMETERS], rows.view(np.int64)[:, _RESERVED]
    quaternion = rows[:, 3:7]
    squared = np.einsum("ij,ij->i", quaternion, quaternion)
    return bool(
        np.count_nonzero(resets.selected) == len(rows)
        and np.isfinite(rows[:, :_STATE_WORDS]).all()
        and ((squared >= 1.0 - UNIT_TOLERANCE) & (squared <= 1.0 + UNIT_TOLERANCE)).all()
        and ((parameters >= _LOWEST) & (parameters <= _HIGHEST)).all()
        and all(value in PARAMETERS[i].either for i in _EITHER for value in parameters[:, i].tolist())
        and not np.count_nonzero(reserved)
        and all(tube == NO_TUBE or tube in tubes for tube in rows.view(np.int64)[:, _TUBE].tolist())
    )


def _reset_row_refusal(resets: ResetBatch, lane: int, tubes: Container[int]) -> Refusal | None:
    for name in ("position", "quaternion", "linear_velocity", "angular_velocity"):
        values = getattr(resets, name)[lane]
        if not np.isfinite(values).all():
            return Refusal(name, "finite numbers", str(values.tolist()), lane, RefusalCode.NOT_FINITE)
    tube = int(resets.tube[lane])
    if tube != NO_TUBE and tube not in tubes:
        expected = f"a registered tube's index, or {NO_TUBE}"
        return Refusal("tube", expected, str(tube), lane, RefusalCode.UNKNOWN_TUBE)
    return _unit("quaternion", resets.quaternion[lane], lane) or _parameters_refusal(resets, lane)


def _parameters_refusal(resets: ResetBatch, lane: int) -> Refusal | None:
    values = resets.parameters[lane]
    for parameter, value in zip(PARAMETERS, values.tolist(), strict=False):
        refusal = _parameter_refusal(parameter, value, lane)
        if refusal is not None:
            return refusal
    return _reserved("reserved parameter words", values[len(PARAMETERS) :], lane)


def _parameter_refusal(parameter: Parameter, value: float, lane: int) -> Refusal | None:
    if not math.isfinite(value):
        return Refusal(parameter.name, "a finite number", repr(value), lane, RefusalCode.NOT_FINITE)
    taken = (
        value in parameter.either
        if parameter.either
        else parameter.lowest <= value <= parameter.highest
        and not (parameter.above_lowest and value == parameter.lowest)
    )
    if not taken:
        return Refusal(parameter.name, parameter.range, repr(value), lane, RefusalCode.OUT_OF_RANGE)
    return None


def _unit(name: str, values: Floats, lane: int) -> Refusal | None:
    if not np.isfinite(values).all():
        return Refusal(name, "finite numbers", str(values.tolist()), lane, RefusalCode.NOT_FINITE)
    squared = float(np.einsum("i,i->", values, values))
    if not abs(squared - 1.0) <= UNIT_TOLERANCE:
        expected = f"squared length 1 within {UNIT_TOLERANCE:g}"
        found = f"{values.tolist()} of squared length {squared:.9g}"
        return Refusal(name, expected, found, lane, RefusalCode.NOT_UNIT)
    return None


def _range(name: str, value: float, lowest: float, highest: float, lane: int) -> Refusal | None:
    if not math.isfinite(value):
        return Refusal(name, "a finite number", repr(value), lane, RefusalCode.NOT_FINITE)
    if not lowest <= value <= highest:
        return Refusal(name, f"{lowest:g} to {highest:g}", repr(value), lane, RefusalCode.OUT_OF_RANGE)
    return None


def _reserved(name: str, values: Floats, lane: int) -> Refusal | None:
    words = values.view(np.int64)
    if not words.any():
        return None
    return Refusal(name, "zero", f"integers {words.tolist()}", lane, RefusalCode.RESERVED)
