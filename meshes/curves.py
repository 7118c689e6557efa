"""Curves in space that tubes are swept along."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

STEP = 0.2
"""Arc length between two points of a curve (m), at R = 1 m."""


@dataclass(frozen=True, eq=False)
class Curve:
    """A smooth curve, sampled at a uniform step of arc length."""

    points: Floats  # (M, 3)
    """Points (m), world frame, from the start to the end."""
    step: float
    """Arc length between two successive points (m)."""

    @property
    def length(self) -> float:
        """Arc length from the first to the last point (m)."""
        return self.step * (len(self.points) - 1)
