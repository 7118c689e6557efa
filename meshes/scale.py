"""The scale of a mesh: what a user may say of it, and what its size says of its unit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from meshes.errors import MeshError

if TYPE_CHECKING:
    from meshes.formats import Stated  # with numpy, which a command line that is only read does not need

LARGEST_IN_METRES: Final = 10.0
"""Radius of tubes in metres at most: beyond it, millimetres are likelier, the unit of most CAD programs."""


@dataclass(frozen=True)
class MeanRadius:
    """A scale that makes a tube so wide: the mean, along the axis, of the wall's mean distance in each section."""

    metres: float


def parse_scale(text: str) -> float | MeanRadius:
    """Read `0.001`, metres in one unit of the file, or `radius=1`, the mean radius in metres.

    Raises:
        MeshError: neither, or no positive number.
    """
    name, named, number = text.rpartition("=")
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not (0.0 < value < math.inf) or (named and name.strip() != "radius"):
        raise MeshError(f"scale: expected metres a unit such as 0.001, or radius=METRES, found {text!r}")
    return MeanRadius(value) if named else value


@dataclass(frozen=True)
class UnitGuess:
    """What the unit of a file is likely to be."""

    metres: float
    """In one unit."""
    reason: str
    advice: str = ""
    """What to do where the file is not read in this unit."""


def guess_unit(radius: float, stated: Stated) -> UnitGuess:
    """What one unit of a file is likely to be, from the mean radius of its tube in this unit and what it states."""
    metres = radius * (stated.unit or 1.0)
    told = "without a unit" if stated.unit is None else f"in the unit that is stated ({metres:.3g} m)"
    if metres <= LARGEST_IN_METRES:
        reason = f"R {radius:.3g} {told} looks like metres" if stated.unit is None else stated.where
        return UnitGuess(stated.unit or 1.0, reason)
    return UnitGuess(
        0.001,
        f"R {radius:.3g} {told} looks like millimetres: {radius:.3g} mm",
        "say --scale 0.001 (0.01 for centimetres, 0.0254 for inches), or make it as wide as suits the drone with "
        "--scale radius=1",
    )
