"""What a user may say of a mesh's scale."""

from __future__ import annotations

import math
from dataclasses import dataclass

from meshes.errors import MeshError


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
