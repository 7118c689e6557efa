"""The questions that perception asks of a tube, batched over lanes, whatever the tube is made of."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

WINDOW = 2.0
"""A search of the axis near a known arc length keeps within this distance of it (m)."""


@dataclass(frozen=True)
class AxisPoints:
    """The nearest points of the axis, one a lane."""

    arc_length: Floats  # (N,)
    """Arc length from the start of the axis (m), 0 to the tube's length."""
    position: Floats  # (N, 3)
    """Nearest point of the axis (m), world frame."""
    tangent: Floats  # (N, 3)
    """Unit tangent of the axis there, towards the end."""
    radial_distance: Floats  # (N,)
    """Distance from the axis (m)."""
    radius: Floats  # (N,)
    """Local radius R (m): mean wall distance from the axis in the local section."""


class Geometry(ABC):
    """Tubes as N drones see them, lane i in the tube that is assigned to it.

    All arrays are float64 in the world frame, in metres. A returned array may be overwritten by the next call
    of the same method; copy what must be kept. Directions are unit vectors.
    """

    lanes: int
    """Number of lanes N."""

    @property
    @abstractmethod
    def length(self) -> Floats:
        """Length of each lane's axis (m), (N,)."""

    @abstractmethod
    def rays(self, origins: Floats, directions: Floats, reach: float, active: Bools | None = None) -> Floats:
        """Distance to the wall along rays, (N, K), at most `reach` (m).

        Args:
            origins: (N, K, 3). A ray that starts outside of the tube reads 0 on a swept curve; on a mesh it
                reads the next wall, so that sensors check the way to the origin first.
            directions: (N, K, 3), unit vectors.
            reach: range of the sensor (m).
            active: (N,) lanes whose rays are wanted, None for all; the rows of the others mean nothing. Rays
                are most of an environment's time, and a reset needs those of the lanes that were reset alone.
        """

    @abstractmethod
    def project(self, points: Floats, near: Floats | None = None) -> AxisPoints:
        """Nearest point of the axis to each lane's point.

        Args:
            points: (N, 3).
            near: (N,) arc lengths (m); the search then keeps within WINDOW of them, so that a tube that passes
                close to itself cannot make progress jump. NaN, or None for all, searches the whole axis.
        """

    @abstractmethod
    def axis(self, arc_length: Floats) -> tuple[Floats, Floats]:
        """Points (N, 3) and unit tangents (N, 3) of the axis at arc lengths (N,), clipped to the ends."""

    @abstractmethod
    def visible(self, points: Floats, targets: Floats) -> Bools:
        """Whether the straight line from each lane's point (N, 3) to its target (N, 3) meets no wall, (N,)."""

    @abstractmethod
    def inside(self, points: Floats, axis_points: AxisPoints) -> Bools:
        """Whether each point (N, 3) is inside its tube, (N,).

        That is: no wall lies between it and its nearest axis point, and it lies between the planes of the ends.
        """

    @abstractmethod
    def clearance(self, points: Floats, axis_points: AxisPoints) -> Floats:
        """Distance to the wall (m), (N,), negative outside of the tube."""
