"""Shared by the tests of agent_client: a tube whose every answer is a formula."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshes.geometry import AxisPoints, Bools, Floats, Geometry
from protocol.plant import PoseBatch


class CylinderGeometry(Geometry):
    """Straight open tubes along world x from the origin, lane i of radius `radius[i]`; closed forms in numpy.

    `wall_at` puts an opaque sheet across the tube at that x: it stands for whatever may come between a camera
    and its target.
    """

    def __init__(self, lanes: int = 1, radius: float = 1.0, length: float = 20.0) -> None:
        self.lanes = lanes
        self.radius: Floats = np.full(lanes, radius)
        self.wall_at = np.inf
        self._length: Floats = np.full(lanes, length)

    @property
    def length(self) -> Floats:
        """Length of each lane's tube (m)."""
        return self._length

    def rays(self, origins: Floats, directions: Floats, reach: float, active: Bools | None = None) -> Floats:
        """Solve |o + t d| = R across the axis; a hit beyond an open end is no hit."""
        o, d, radius = origins[..., 1:], directions[..., 1:], self.radius[:, None]
        a, b, c = (d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - radius**2
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (-b + np.sqrt(np.maximum(b * b - a * c, 0.0))) / a
        x = origins[..., 0] + t * directions[..., 0]
        hit = (a > 1e-18) & (x >= 0.0) & (x <= self._length[:, None])
        distance = np.where(c > 0.0, 0.0, np.where(hit, np.minimum(t, reach), reach))
        if np.isfinite(self.wall_at):
            with np.errstate(divide="ignore"):
                sheet = (self.wall_at - origins[..., 0]) / directions[..., 0]
            distance = np.where((sheet > 0.0) & (sheet < distance), sheet, distance)
        return distance if active is None else np.where(active[:, None], distance, np.nan)

    def project(self, points: Floats, near: Floats | None = None) -> AxisPoints:
        """Drop a perpendicular on the x axis."""
        s = np.clip(points[:, 0], 0.0, self._length)
        position, tangent = self.axis(s)
        return AxisPoints(s, position, tangent, np.linalg.norm(points - position, axis=1), self.radius.copy())

    def axis(self, arc_length: Floats) -> tuple[Floats, Floats]:
        """(s, 0, 0) and (1, 0, 0)."""
        s = np.clip(arc_length, 0.0, self._length)
        zero = np.zeros_like(s)
        return np.stack([s, zero, zero], axis=1), np.tile([1.0, 0.0, 0.0], (self.lanes, 1))

    def visible(self, points: Floats, targets: Floats) -> Bools:
        """A cylinder is convex: only the sheet at `wall_at` is ever in the way."""
        seen: Bools = (points[:, 0] < self.wall_at) == (targets[:, 0] < self.wall_at)
        return seen

    def inside(self, points: Floats, axis_points: AxisPoints) -> Bools:
        """Within the radius and between the end planes."""
        return self.clearance(points, axis_points) > 0.0

    def clearance(self, points: Floats, axis_points: AxisPoints) -> Floats:
        """Radius less the distance from the axis; beyond an end, the negative distance to its rim."""
        deep = self.radius - np.linalg.norm(points[:, 1:], axis=1)
        beyond = points[:, 0] - np.clip(points[:, 0], 0.0, self._length)
        return np.where(beyond == 0.0, deep, -np.hypot(beyond, deep))


class BendGeometry(Geometry):
    """Circular bends in the plane z = 0 from the origin along +x, turning left; radius of the bend `bend` (m).

    The LiDAR sees nothing and sight is never blocked: for tests of flight along an axis.
    """

    def __init__(self, lanes: int = 1, bend: float = 3.0, length: float = 9.0, radius: float = 1.0) -> None:
        self.lanes = lanes
        self.bend, self.radius = bend, radius
        self._length: Floats = np.full(lanes, length)

    @property
    def length(self) -> Floats:
        """Length of each lane's axis (m)."""
        return self._length

    def rays(self, origins: Floats, directions: Floats, reach: float, active: Bools | None = None) -> Floats:
        """No echo."""
        return np.full(origins.shape[:2], reach)

    def project(self, points: Floats, near: Floats | None = None) -> AxisPoints:
        """The polar angle about the bend's centre (0, bend, 0)."""
        angle = np.arctan2(points[:, 0], self.bend - points[:, 1]) % (2.0 * np.pi)
        s = np.clip(self.bend * angle, 0.0, self._length)
        position, tangent = self.axis(s)
        radial = np.linalg.norm(points - position, axis=1)
        return AxisPoints(s, position, tangent, radial, np.full(self.lanes, self.radius))

    def axis(self, arc_length: Floats) -> tuple[Floats, Floats]:
        """Points and tangents of the circle."""
        angle = np.clip(arc_length, 0.0, self._length) / self.bend
        zero = np.zeros_like(angle)
        position = np.stack([self.bend * np.sin(angle), self.bend * (1.0 - np.cos(angle)), zero], axis=1)
        return position, np.stack([np.cos(angle), np.sin(angle), zero], axis=1)

    def visible(self, points: Floats, targets: Floats) -> Bools:
        """Always."""
        return np.ones(self.lanes, dtype=np.bool_)

    def inside(self, points: Floats, axis_points: AxisPoints) -> Bools:
        """Within the radius."""
        return self.clearance(points, axis_points) > 0.0

    def clearance(self, points: Floats, axis_points: AxisPoints) -> Floats:
        """Radius less the distance from the axis."""
        return self.radius - axis_points.radial_distance


def poses_at(
    position: object, direction: object = (1.0, 0.0, 0.0), speed: float = 0.0, roll: float = 0.0
) -> PoseBatch:
    """Poses (N,) that look along `direction`, level but for `roll` (rad), and move ahead at `speed` (m/s)."""
    p = np.atleast_2d(np.asarray(position, dtype=np.float64))
    f = np.broadcast_to(np.asarray(direction, dtype=np.float64), p.shape)
    f = f / np.linalg.norm(f, axis=1, keepdims=True)
    left = np.cross([0.0, 0.0, 1.0], f)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    matrices = np.stack([f, left, np.cross(f, left)], axis=2)
    poses = PoseBatch.zeros(len(p))
    poses.position[:] = p
    poses.quaternion[:] = (Rotation.from_matrix(matrices) * Rotation.from_euler("x", roll)).as_quat()
    poses.linear_velocity[:] = speed * f
    return poses


@pytest.fixture(autouse=True)
def logs_of_stable_baselines3(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """Keeps folders that stable-baselines3's loggers make out of the temporary directory that all share."""
    folder: Path = tmp_path_factory.getbasetemp() / "stable_baselines3"
    monkeypatch.setenv("SB3_LOGDIR", str(folder))
    return folder


@pytest.fixture
def cylinder() -> Callable[..., CylinderGeometry]:
    """Maker of straight tubes."""
    return CylinderGeometry


@pytest.fixture
def bend() -> Callable[..., BendGeometry]:
    """Maker of circular bends."""
    return BendGeometry


@pytest.fixture(name="poses_at")
def poses_at_fixture() -> Callable[..., PoseBatch]:
    """Maker of poses."""
    return poses_at
