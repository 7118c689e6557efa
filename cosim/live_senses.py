"""What the live viewer works out of a drone's senses at the poses that it sees: gap to the wall, target and memory.

It is computed from the mesh and the centreline, without the sensors' noise, and nothing of it comes from the agent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cosim.drone_figure import Sighting
from cosim.senses import Sensors, local_frames
from meshes.mesh_geometry import MeshGeometry
from meshes.tube import Tube

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Sensed:
    """What a drone senses at a pose."""

    along: float
    """Arc length of the nearest point of the axis (m)."""
    gap: float
    """Between body and wall (m)."""
    sighting: Sighting


class LiveSenses:
    """The senses of one drone, pose after pose.

    Args:
        tube: that is flown through, its axis in the direction of the flight.
        sensors: of the drone.
        memory_steps: control steps for which a direction that is no longer seen is remembered.
        body_radius: (m).
    """

    def __init__(self, tube: Tube, sensors: Sensors, memory_steps: int, body_radius: float) -> None:
        self._geometry = MeshGeometry([tube])
        self._sensors, self._memory_steps, self._body_radius = sensors, memory_steps, body_radius
        self._direction: Floats | None = None
        """In which the target was seen last, if it was."""
        self._seen_at = 0

    def sense(self, step: int, position: Floats, quaternion: Floats) -> Sensed:
        """What is sensed at a control step: position (3,) in metres, quaternion (4,) x y z w, body to world."""
        point = position[None]
        axis = self._geometry.project(point)
        target = self._geometry.axis(axis.arc_length + self._sensors.depth)[0].copy()
        away = target[0] - position
        ahead, up, right = local_frames(point, quaternion[None])[0] @ away
        seen = (
            abs(np.arctan2(right, ahead)) <= self._sensors.half_width
            and abs(np.arctan2(up, ahead)) <= self._sensors.half_height
            and bool(self._geometry.visible(point, target)[0])
        )
        if seen:
            self._direction, self._seen_at = away / max(float(np.linalg.norm(away)), 1e-9), step
        elif not 0 <= step - self._seen_at <= self._memory_steps:
            self._direction = None
        return Sensed(
            along=float(axis.arc_length[0]),
            gap=float(self._geometry.clearance(point, axis)[0]) - self._body_radius,
            sighting=Sighting(target[0] if seen else None, None if seen else self._direction),
        )
