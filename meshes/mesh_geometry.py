"""Tubes of triangles, queried by lanes: rays by Embree, the rest by compiled code."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from meshes import polyline
from meshes.closest import build_tree, wall_distance
from meshes.embree import RayScene
from meshes.errors import MeshError
from meshes.geometry import AxisPoints, Bools, Floats, Geometry
from meshes.tube import Tube


class MeshGeometry(Geometry):
    """N lanes in T mesh tubes, lane i in the tube `assigned[i]`, at first tube i modulo T."""

    def __init__(self, tubes: Sequence[Tube], lanes: int = 1) -> None:
        """Prepare the tubes: a few tens of milliseconds each.

        Raises:
            MeshError: no tube or no lane.
        """
        if not tubes or lanes < 1:
            raise MeshError(f"expected at least one tube and one lane, found {len(tubes)} and {lanes}")
        self.lanes = lanes
        self._scenes: list[RayScene] = [tube.wall.scene for tube in tubes]
        self._trees = [build_tree(tube.wall.vertices, tube.wall.faces) for tube in tubes]
        self._table = np.concatenate(
            [polyline.axis_table(tube.axis, tube.tangent, tube.radius) for tube in tubes]
        )
        self._counts = np.array([len(tube.axis) for tube in tubes], dtype=np.int64)
        self._firsts = np.cumsum(self._counts) - self._counts
        self._steps = np.array([tube.step for tube in tubes])
        self._lengths = np.array([tube.length for tube in tubes])

        self._anywhere = np.full(lanes, np.nan)
        self._nearest = AxisPoints(
            arc_length=np.empty(lanes),
            position=np.empty((lanes, 3)),
            tangent=np.empty((lanes, 3)),
            radial_distance=np.empty(lanes),
            radius=np.empty(lanes),
        )
        self._axis_position = np.empty((lanes, 3))
        self._axis_tangent = np.empty((lanes, 3))
        self._clearance = np.empty(lanes)
        self._nearest_triangle = np.full(lanes, -1)
        self.assigned = np.arange(lanes, dtype=np.int64) % len(tubes)
        self.assign(np.arange(lanes), self.assigned)

    def assign(self, lanes: ArrayLike, tube_indices: ArrayLike) -> None:
        """Put lanes (K,) into tubes (K,), by index into the tubes given at the start.

        Raises:
            MeshError: an index of no tube.
        """
        indices = np.asarray(tube_indices)
        if np.any(indices < 0) or np.any(indices >= len(self._scenes)):
            raise MeshError(
                f"expected tube indices from 0 to {len(self._scenes) - 1}, found {indices.tolist()}"
            )
        self.assigned[np.asarray(lanes)] = indices
        self._nearest_triangle[np.asarray(lanes)] = -1
        self._first = self._firsts[self.assigned]
        self._count = self._counts[self.assigned]
        self._step = self._steps[self.assigned]
        self._length = self._lengths[self.assigned]
        self._groups = [
            (int(tube), np.flatnonzero(self.assigned == tube)) for tube in np.unique(self.assigned)
        ]

    @property
    def length(self) -> Floats:
        """Length of each lane's axis (m), (N,)."""
        return self._length

    def rays(self, origins: Floats, directions: Floats, reach: float, active: Bools | None = None) -> Floats:
        """Distance to the wall along rays; see `Geometry.rays`."""
        shape = origins.shape[:2]
        if len(self._groups) == 1 and active is None:
            scene = self._scenes[self._groups[0][0]]
            return scene.distances(origins.reshape(-1, 3), directions.reshape(-1, 3), reach).reshape(shape)
        distances = np.empty(shape)
        for tube, lanes in self._groups:
            if active is not None:
                lanes = lanes[active[lanes]]
            distances[lanes] = (
                self._scenes[tube]
                .distances(origins[lanes].reshape(-1, 3), directions[lanes].reshape(-1, 3), reach)
                .reshape(-1, shape[1])
            )
        return distances

    def project(self, points: Floats, near: Floats | None = None) -> AxisPoints:
        """Nearest point of the axis; see `Geometry.project`."""
        found = self._nearest
        polyline.project(
            _contiguous(points),
            self._anywhere if near is None else _contiguous(near),
            self._table,
            self._first,
            self._count,
            self._step,
            found.arc_length,
            found.position,
            found.tangent,
            found.radial_distance,
            found.radius,
        )
        return found

    def axis(self, arc_length: Floats) -> tuple[Floats, Floats]:
        """Points and tangents of the axis; see `Geometry.axis`."""
        polyline.sample(
            _contiguous(arc_length),
            self._table,
            self._first,
            self._count,
            self._step,
            self._axis_position,
            self._axis_tangent,
        )
        return self._axis_position, self._axis_tangent

    def visible(self, points: Floats, targets: Floats) -> Bools:
        """Whether the way from point to target is free; see `Geometry.visible`."""
        return ~self._blocked(points, targets)

    def inside(self, points: Floats, axis_points: AxisPoints) -> Bools:
        """Whether each point is inside its tube; see `Geometry.inside`."""
        between = self._between_ends(points, axis_points)
        return between & ~self._blocked(axis_points.position, points)

    def clearance(self, points: Floats, axis_points: AxisPoints) -> Floats:
        """Exact distance to the nearest triangle, negative outside of the tube; see `Geometry.clearance`."""
        clearance = self._clearance
        if len(self._groups) == 1:
            tree = self._trees[self._groups[0][0]]
            wall_distance(_contiguous(points), tree.boxes, tree.triangles, self._nearest_triangle, clearance)
        else:
            for tube, lanes in self._groups:
                tree, distances = self._trees[tube], np.empty(len(lanes))
                nearest = self._nearest_triangle[lanes]
                wall_distance(points[lanes], tree.boxes, tree.triangles, nearest, distances)
                clearance[lanes], self._nearest_triangle[lanes] = distances, nearest
        free = self._between_ends(points, axis_points)
        # A wall farther away than the axis point cannot lie between: most points need no ray.
        if not (axis_points.radial_distance < clearance).all():
            free &= ~self._blocked(axis_points.position, points)
        np.negative(clearance, out=clearance, where=~free)
        return clearance

    def _between_ends(self, points: Floats, axis_points: AxisPoints) -> Bools:
        return polyline.between_ends(
            _contiguous(points),
            _contiguous(axis_points.arc_length),
            self._table,
            self._first,
            self._count,
            self._step,
        )

    def _blocked(self, origins: Floats, targets: Floats) -> Bools:
        """Whether each lane's wall lies between two points (N, 3), (N,)."""
        if len(self._groups) == 1:
            return self._scenes[self._groups[0][0]].blocked(origins, targets)
        blocked = np.empty(len(origins), dtype=np.bool_)
        for tube, lanes in self._groups:
            blocked[lanes] = self._scenes[tube].blocked(origins[lanes], targets[lanes])
        return blocked


def _contiguous(array: Floats) -> Floats:
    """The array as the compiled queries take it: without this, another layout would compile them again."""
    return np.ascontiguousarray(array, dtype=np.float64)
