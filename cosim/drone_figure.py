"""The drone on a stage: body, LiDAR rays, camera, the target that it sees and the direction that it remembers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from cosim.scene import Surface, drone_surface
from cosim.senses import Sensors, lidar_rays, local_frames, view_border
from meshes.embree import RayScene

if TYPE_CHECKING:
    from cosim.vedo_scene import Stage

Floats = NDArray[np.float64]

CAMERA_COLOUR: Final = "#f2b705"
TARGET_COLOUR: Final = "#12a150"
MEMORY_COLOUR: Final = "#8e44ad"
LIDAR_COLOUR: Final = "#2678c8"
KEY: Final = (
    ("LiDAR, red near the wall", LIDAR_COLOUR),
    ("camera's field of view", CAMERA_COLOUR),
    ("target in view", TARGET_COLOUR),
    ("remembered direction", MEMORY_COLOUR),
)
"""What the colours of a drone's senses mean."""

_NEAR: Final = np.array([214.0, 40.0, 40.0])
_FAR: Final = np.array([38.0, 120.0, 200.0])
"""Colours of rays that read 0 and half of their range or more."""
_SIDES: Final = 8
"""Lines of sight along each edge of the camera's field that are drawn."""


@dataclass(frozen=True)
class Sighting:
    """What the camera had of its target at one step."""

    target: Floats | None
    """(3,) where it is (m); None while it is not seen."""
    memory: Floats | None
    """(3,) unit direction in which it was seen last; None without memory."""


class DroneFigure:
    """A drone whose pose and senses are shown step by step.

    Args:
        stage: where.
        sensors: how LiDAR and camera stand on it.
        walls: what ends its lines of sight.
        body_radius: of its body (m).
        colour: of its body.
    """

    def __init__(
        self,
        stage: Stage,
        sensors: Sensors,
        walls: RayScene,
        *,
        body_radius: float,
        colour: str,
    ) -> None:
        self._sensors, self._walls, self._radius = sensors, walls, body_radius
        self._body = stage.surface(drone_surface(body_radius, rings=16, sides=32), colour)
        self._dot = stage.dot(colour, 10.0)
        rays, border = 2 * sensors.rays, 4 * _SIDES
        nowhere = np.zeros((2, 3))
        self._rays = stage.lines([nowhere] * rays, LIDAR_COLOUR, 1.3)
        around = np.arange(border)
        fan = np.stack([np.zeros_like(around), 1 + around, 1 + (around + 1) % border], axis=1)
        self._fan = stage.surface(
            Surface(np.zeros((1 + border, 3)), fan.astype(np.int32)), CAMERA_COLOUR, alpha=0.13, flat=True
        )
        loop = np.zeros((border + 1, 3))
        self._edge = stage.lines([loop, *[nowhere] * 4], CAMERA_COLOUR, 1.6)
        self._target = stage.surface(_ball(0.5 * body_radius), TARGET_COLOUR)
        self._sight = stage.lines([nowhere], TARGET_COLOUR, 2.0)
        self._memory = stage.surface(arrow(), MEMORY_COLOUR)

    def show(self, position: Floats, quaternion: Floats, readings: Floats | None, sighting: Sighting) -> None:
        """Show it at a pose.

        Args:
            position: (3,) of its centre (m).
            quaternion: (4,) x y z w, body to world.
            readings: (2 rays,) of its LiDAR (m); None for the exact distances of the walls.
            sighting: what its camera has.
        """
        places, turns = position[None], quaternion[None]
        forward, up, right = local_frames(places, turns)[0]
        self._body.place(position, np.stack([forward, -right, up], axis=1))
        self._dot.move(places)
        self._show_rays(places, turns, readings)
        self._show_camera(places, turns)
        self._target.show(sighting.target is not None)
        self._sight.show(sighting.target is not None)
        if sighting.target is not None:
            self._target.place(sighting.target, np.eye(3))
            self._sight.move(np.stack([position, sighting.target]))
        self._memory.show(sighting.memory is not None)
        if sighting.memory is not None:
            length = 6.0 * self._radius
            self._memory.place(position, length * frame_along(sighting.memory))

    def _show_rays(self, places: Floats, turns: Floats, readings: Floats | None) -> None:
        origins, directions = (found[0] for found in lidar_rays(self._sensors, places, turns))
        if readings is None:
            readings = self._distances(origins, directions, self._sensors.reach)
        ends = origins + readings[:, None] * directions
        self._rays.move(np.stack([origins, ends], axis=1).reshape(-1, 3))
        share = np.clip(2.0 * readings / self._sensors.reach, 0.0, 1.0)[:, None]
        opacity = np.full((len(share), 1), 210.0)
        colours = np.hstack([(1.0 - share) * _NEAR + share * _FAR, opacity])
        self._rays.paint(np.repeat(colours, 2, axis=0).astype(np.uint8))

    def _show_camera(self, places: Floats, turns: Floats) -> None:
        apex = places[0]
        directions = view_border(self._sensors, places, turns, _SIDES)[0]
        reach = self._distances(np.repeat(places, len(directions), axis=0), directions, self._sensors.depth)
        ends = apex + reach[:, None] * directions
        self._fan.move(np.concatenate([places, ends]))
        corners = np.stack([np.repeat(places, 4, axis=0), ends[::_SIDES]], axis=1)
        self._edge.move(np.concatenate([ends, ends[:1], corners.reshape(-1, 3)]))

    def _distances(self, origins: Floats, directions: Floats, reach: float) -> Floats:
        return self._walls.distances(np.ascontiguousarray(origins), np.ascontiguousarray(directions), reach)


def _ball(radius: float) -> Surface:
    surface = drone_surface(radius)
    vertices = surface.vertices.copy()
    vertices[0, 0] = radius  # without the nose
    return Surface(vertices, surface.faces)


def arrow(sides: int = 12) -> Surface:
    """An arrow from the origin along x, of length 1."""
    around = 2.0 * np.pi * np.arange(sides) / sides
    circle = np.stack([np.zeros(sides), np.cos(around), np.sin(around)], axis=1)
    rings = [(0.0, 0.035), (0.72, 0.035), (0.72, 0.1), (1.0, 0.0)]
    vertices = np.concatenate([np.array([x, 0.0, 0.0]) + radius * circle for x, radius in rings])
    corner, after = np.arange(sides), (np.arange(sides) + 1) % sides
    faces = []
    for ring in range(len(rings) - 1):
        a, b = ring * sides + corner, ring * sides + after
        faces += [np.stack([a, b, a + sides], axis=1), np.stack([b, b + sides, a + sides], axis=1)]
    return Surface(vertices, np.concatenate(faces).astype(np.int32))


def frame_along(direction: Floats) -> Floats:
    """A rotation (3, 3) whose first column is a unit direction (3,)."""
    least = np.eye(3)[int(np.argmin(np.abs(direction)))]
    side = np.cross(direction, least)
    side /= np.linalg.norm(side)
    return np.stack([direction, side, np.cross(direction, side)], axis=1)
