"""What the physics side checks of a request before anything is integrated.

Each check returns None, or the Refusal that names field, lane, expected and found.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Container
from typing import Final

import numpy as np

from protocol.errors import Refusal, RefusalCode
from protocol.layout import COMMAND_STRIDE
from protocol.plant import NO_TUBE, PARAMETERS, CommandBatch, Parameter, ResetBatch

UNIT_TOLERANCE: Final = 1e-6
"""How far the squared length of a direction or a quaternion may be from 1."""
COMPENSATION_MAX: Final = 2.0

_ROW: Final = struct.Struct("<5d3q")
assert _ROW.size == COMMAND_STRIDE


def one_command_is_sound(row: memoryview, speed_max: float) -> bool:
    """Whether a single command row may be integrated; NaN fails every comparison."""
    x, y, z, speed, compensation, reserved, reserved_1, reserved_2 = _ROW.unpack(row)
    return (
        -UNIT_TOLERANCE <= x * x + y * y + z * z - 1.0 <= UNIT_TOLERANCE
        and 0.0 <= speed <= speed_max
        and 0.0 <= compensation <= COMPENSATION_MAX
        and not (reserved | reserved_1 | reserved_2)
    )


def commands_are_sound(commands: CommandBatch, speed_max: float) -> bool:
    """Whether all command rows may be integrated."""
    d, speed, compensation = commands.direction, commands.speed, commands.compensation
    with np.errstate(over="ignore", invalid="ignore"):
        unit = np.abs(np.einsum("ij,ij->i", d, d) - 1.0) <= UNIT_TOLERANCE
    in_range = (
        (speed >= 0.0) & (speed <= speed_max) & (compensation >= 0.0) & (compensation <= COMPENSATION_MAX)
    )
    return bool((unit & in_range).all()) and not commands.raw.view(np.int64)[:, 5:].any()


def command_refusal(commands: CommandBatch, speed_max: float) -> Refusal | None:
    """Return what is wrong with the first unsound command."""
    for lane, row in enumerate(commands.raw):
        if one_command_is_sound(memoryview(row.tobytes()), speed_max):
            continue
        x, y, z, speed, compensation = row[:5].tolist()
        return (
            _unit(f"direction={_list(row[:3])}", (x, y, z), lane)
            or _range("speed", speed, 0.0, speed_max, lane)
            or _range("compensation", compensation, 0.0, COMPENSATION_MAX, lane)
            or Refusal("reserved command word", "0", _list(row[5:]), lane, RefusalCode.RESERVED)
        )
    return None


def reset_refusal(resets: ResetBatch, tubes: Container[int]) -> Refusal | None:
    """Return what is wrong with the first unsound row among the selected ones; `tubes` are the registered indices."""
    for lane, selected in enumerate(resets.selected.tolist()):
        if selected not in (0, 1):
            return Refusal("selected", "0 or 1", str(selected), lane, RefusalCode.OUT_OF_RANGE)
        refusal = _reset_row_refusal(resets, lane, tubes) if selected else None
        if refusal is not None:
            return refusal
    return None


def _reset_row_refusal(resets: ResetBatch, lane: int, tubes: Container[int]) -> Refusal | None:
    for name in ("position", "quaternion", "linear_velocity", "angular_velocity"):
        values = getattr(resets, name)[lane]
        if not np.isfinite(values).all():
            return Refusal(name, "finite numbers", _list(values), lane, RefusalCode.NOT_FINITE)
    quaternion = resets.quaternion[lane].tolist()
    tube = int(resets.tube[lane])
    if tube != NO_TUBE and tube not in tubes:
        return Refusal(
            "tube", f"a registered tube's index, or {NO_TUBE}", str(tube), lane, RefusalCode.UNKNOWN_TUBE
        )
    return _unit(f"quaternion={quaternion}", quaternion, lane) or _parameters_refusal(resets, lane)


def _parameters_refusal(resets: ResetBatch, lane: int) -> Refusal | None:
    values = resets.parameters[lane]
    for parameter, value in zip(PARAMETERS, values.tolist(), strict=False):
        refusal = _parameter_refusal(parameter, value, lane)
        if refusal is not None:
            return refusal
    if values.view(np.int64)[len(PARAMETERS) :].any():
        return Refusal(
            "reserved parameter word", "0", _list(values[len(PARAMETERS) :]), lane, RefusalCode.RESERVED
        )
    return None


def _parameter_refusal(parameter: Parameter, value: float, lane: int) -> Refusal | None:
    if parameter.either and value not in parameter.either:
        choices = " or ".join(f"{choice:g}" for choice in parameter.either)
        return Refusal(parameter.name, choices, repr(value), lane, RefusalCode.OUT_OF_RANGE)
    if parameter.above_lowest and value == parameter.lowest:
        return Refusal(parameter.name, f"> {parameter.lowest:g}", repr(value), lane, RefusalCode.OUT_OF_RANGE)
    return _range(parameter.name, value, parameter.lowest, parameter.highest, lane)


def _unit(what: str, values: tuple[float, ...] | list[float], lane: int) -> Refusal | None:
    name, _, shown = what.partition("=")
    if not all(map(math.isfinite, values)):
        return Refusal(name, "finite numbers", shown, lane, RefusalCode.NOT_FINITE)
    squared = sum(value * value for value in values)
    if not abs(squared - 1.0) <= UNIT_TOLERANCE:
        found = f"{shown} of squared length {squared:.9g}"
        return Refusal(name, f"squared length 1 within {UNIT_TOLERANCE:g}", found, lane, RefusalCode.NOT_UNIT)
    return None


def _range(name: str, value: float, lowest: float, highest: float, lane: int) -> Refusal | None:
    if not math.isfinite(value):
        return Refusal(name, "a finite number", repr(value), lane, RefusalCode.NOT_FINITE)
    if not lowest <= value <= highest:
        return Refusal(name, f"{lowest:g} to {highest:g}", repr(value), lane, RefusalCode.OUT_OF_RANGE)
    return None


def _list(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> str:
    return str(values.tolist())
