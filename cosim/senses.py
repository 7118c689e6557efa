"""What a drone senses at its poses, as points and lines in the world frame: for every picture of a flight.

Rays are placed by `agent_client.lidar`, as they are in flight; only their ends are computed here.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from agent_client.episodes import constants, episode_dtype
from agent_client.frames import take_poses
from agent_client.lidar import LINES, SPOKES, place_rays, ring_circle
from agent_client.settings import LidarSettings, Settings
from protocol.plant import POSE_WORDS

Floats = NDArray[np.float64]

WIDEST: Final = 1.4
"""Largest half-angle of a camera that is drawn (rad): a pyramid of a right angle would have no end."""


@dataclass(frozen=True)
class Sensors:
    """How LiDAR and camera stand on the body."""

    rays: int
    """Of one ring."""
    offset: float
    """Of each ring's plane from the centre (m)."""
    reach: float
    """Range of the LiDAR (m)."""
    half_width: float
    half_height: float
    """Half-angles of the camera's field of view (rad), the flight's own."""
    depth: float
    """How far along the axis the camera looks for its target (m)."""

    @classmethod
    def of_manifest(cls, manifest: dict[str, Any]) -> Self:
        """The sensors of a recorded run."""
        settings, drawn = manifest["settings"], manifest["conditions"]["drawn"]
        return cls.of(settings["lidar"], settings["camera"], drawn["field_of_view"])

    @classmethod
    def of_settings(cls, settings: Settings, field_of_view: float) -> Self:
        """The sensors of a flight under these settings.

        Args:
            settings: of the task.
            field_of_view: the flight's condition: factor of the camera's half-angles.
        """
        return cls.of(asdict(settings.lidar), asdict(settings.camera), field_of_view)

    @classmethod
    def of(cls, lidar: dict[str, Any], camera: dict[str, Any], field_of_view: float) -> Self:
        """The sensors that these settings describe, by the names of their fields."""
        return cls(
            rays=lidar["rays"],
            offset=lidar["offset"],
            reach=lidar["reach"],
            half_width=camera["half_width"] * field_of_view,
            half_height=camera["half_height"] * field_of_view,
            depth=camera["target_distance"],
        )


def local_frames(positions: Floats, quaternions: Floats) -> Floats:
    """Local frames (T, 3, 3), rows f, u, r, of poses: positions (T, 3) in metres, quaternions (T, 4) x y z w."""
    episodes = _episodes(positions, quaternions, 4)
    return np.array(episodes["frame"])


def lidar_rays(sensors: Sensors, positions: Floats, quaternions: Floats) -> tuple[Floats, Floats]:
    """Origins and unit directions of all rays, each (T, 2 rays, 3): the front ring, then the rear ring.

    A ray that reads d ends at origin + d direction.

    Args:
        sensors: of the drone.
        positions: (T, 3) its centre (m).
        quaternions: (T, 4) x y z w, body to world.
    """
    count, rays = len(positions), sensors.rays
    task = Settings(lidar=LidarSettings(rays, sensors.offset, sensors.reach))
    known = constants(task, 1.0, clearance_contact=False, on_contact="end")
    episodes = _episodes(positions, quaternions, rays)
    origins = np.empty((count, SPOKES + 2 * rays + LINES, 3))
    directions = np.empty_like(origins)
    lanes = np.arange(count)
    # The lines of sight behind the rings, of which nothing is wanted, go from the centre to itself.
    place_rays(lanes, episodes, known, ring_circle(rays), positions, positions, origins, directions)
    rings = slice(SPOKES, SPOKES + 2 * rays)
    return origins[:, rings], directions[:, rings]


def view_border(sensors: Sensors, positions: Floats, quaternions: Floats, sides: int = 6) -> Floats:
    """Unit directions (T, 4 sides, 3) around the edge of the camera's field of view, from the drone's centre.

    Args:
        sensors: of the drone.
        positions: (T, 3) its centre (m).
        quaternions: (T, 4) x y z w, body to world.
        sides: directions on each of the four edges.
    """
    width, height = (np.tan(min(angle, WIDEST)) for angle in (sensors.half_width, sensors.half_height))
    along = np.linspace(-1.0, 1.0, sides, endpoint=False)
    one = np.ones(sides)
    right = width * np.concatenate([along, one, -along, -one])
    up = height * np.concatenate([-one, along, one, -along])
    frames = local_frames(positions, quaternions)
    directions = frames[:, None, 0] + up[:, None] * frames[:, None, 1] + right[:, None] * frames[:, None, 2]
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)  # type: ignore[no-any-return]


def _episodes(positions: Floats, quaternions: Floats, rays: int) -> NDArray[Any]:
    """Episodes that know where they are, and nothing else."""
    poses = np.zeros((len(positions), POSE_WORDS))
    poses[:, :3], poses[:, 3:7] = positions, quaternions
    episodes = np.zeros(len(poses), episode_dtype(rays))
    take_poses(np.arange(len(poses)), episodes, poses)
    return episodes
