"""Geometry of swept tubes: a pool of them in contiguous arrays, queried by compiled code.

Changing a lane's tube is one number, so that every episode can have a tube of its own at no cost. The ends
are open: a ray that leaves through an end meets no wall, as with a mesh without caps.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from meshes.compiled import compiled
from meshes.errors import MeshError
from meshes.geometry import AxisPoints, Bools, Floats, Geometry
from meshes.swept import SweptTube, segment_curvature
from meshes.swept_kernels import (
    BEFORE_START,
    NOT_BEYOND,
    WINDOW,
    Integers,
    Pool,
    axis_point,
    axis_tangent,
    cast,
    mean_radius,
    nearest_wall,
    place,
    plane_gap,
    settle,
    settle_anywhere,
    wall_distance,
)


class SweptGeometry(Geometry):
    """N lanes in a pool of T swept tubes, lane i in the tube `assigned[i]`, at first tube i modulo T.

    Results do not depend on what was asked before: the last known segment of a lane only says where a search
    begins.
    """

    def __init__(self, tubes: Sequence[SweptTube], lanes: int = 1) -> None:
        """Packs the tubes.

        Raises:
            MeshError: no tube or no lane.
        """
        if not tubes or lanes < 1:
            raise MeshError(f"expected at least one tube and one lane but found {len(tubes)} and {lanes}")
        self.lanes = lanes
        self._pool = _pack(tubes)
        self._capacity = self._pool.rows.copy()
        self.assigned: Integers = np.arange(lanes, dtype=np.int64) % len(tubes)
        self._all = np.ones(lanes, dtype=np.bool_)
        self._row: Integers = self._pool.first[self.assigned].copy()

    def assign(self, lanes: ArrayLike, tube_indices: ArrayLike) -> None:
        """Puts the lanes (K,) into the tubes (K,) of the pool.

        Raises:
            MeshError: an index that is not in the pool.
        """
        indices = np.asarray(tube_indices, dtype=np.int64)
        size = len(self._pool.first)
        if np.any((indices < 0) | (indices >= size)):
            raise MeshError(f"tube_indices: expected 0 to {size - 1} but found {indices.tolist()}")
        chosen = np.asarray(lanes, dtype=np.int64)
        self.assigned[chosen] = indices
        self._row[chosen] = self._pool.first[indices]

    def replace(self, slots: Sequence[int], tubes: Sequence[SweptTube]) -> None:
        """Refills slots of the pool; lanes that fly in them must begin a new episode.

        Raises:
            MeshError: a tube with more points than the slot was made for, or more harmonics than the pool.
        """
        for slot, tube in zip(slots, tubes, strict=True):
            if (
                len(tube.points) > self._capacity[slot]
                or tube.harmonics.shape[1] > self._pool.harmonics.shape[1]
            ):
                raise MeshError(
                    f"slot {slot}: expected at most {self._capacity[slot]} points and "
                    f"{self._pool.harmonics.shape[1]} harmonics but found {len(tube.points)} and "
                    f"{tube.harmonics.shape[1]}; make the pool from tubes at least as long"
                )
            _store(self._pool, slot, tube)
            lanes = self.assigned == slot
            self._row[lanes] = self._pool.first[slot]

    @property
    def length(self) -> Floats:
        """See `Geometry.length`."""
        lengths: Floats = (self._pool.rows - 1)[self.assigned] * self._pool.step[self.assigned]
        return lengths

    def rays(self, origins: Floats, directions: Floats, reach: float, active: Bools | None = None) -> Floats:
        """See `Geometry.rays`; origins in the open, beyond an end plane, see the tube's inside or nothing."""
        distances = np.zeros(origins.shape[:2])
        wanted = self._all if active is None else active
        _rays(self._pool, self.assigned, self._row, wanted, origins, directions, float(reach), distances)
        return distances

    def project(self, points: Floats, near: Floats | None = None) -> AxisPoints:
        """See `Geometry.project`."""
        found = AxisPoints(*(np.empty(shape) for shape in _axis_shapes(self.lanes)))
        guess = np.full(self.lanes, np.nan) if near is None else near
        _project(
            self._pool, self.assigned, self._row, points, guess,
            found.arc_length, found.position, found.tangent, found.radial_distance, found.radius,
        )  # fmt: skip
        return found

    def axis(self, arc_length: Floats) -> tuple[Floats, Floats]:
        """See `Geometry.axis`."""
        positions, tangents = np.empty((self.lanes, 3)), np.empty((self.lanes, 3))
        _axis(self._pool, self.assigned, arc_length, positions, tangents)
        return positions, tangents

    def visible(self, points: Floats, targets: Floats) -> Bools:
        """See `Geometry.visible`."""
        seen = np.empty(self.lanes, dtype=np.bool_)
        _visible(self._pool, self.assigned, self._row, points, targets, seen)
        return seen

    def inside(self, points: Floats, axis_points: AxisPoints) -> Bools:
        """See `Geometry.inside`."""
        return self.clearance(points, axis_points) > 0.0

    def clearance(self, points: Floats, axis_points: AxisPoints) -> Floats:
        """See `Geometry.clearance`.

        In a round tube of one radius this is R minus the radial distance, which is exact in bends too.
        Elsewhere the nearest wall point is searched for (`swept_kernels.nearest_wall`). Beyond an end plane
        it is the negative distance to the rim.
        """
        gaps = np.empty(self.lanes)
        _clearance(self._pool, self.assigned, points, axis_points.arc_length, axis_points.position, gaps)
        return gaps


def _axis_shapes(lanes: int) -> tuple[tuple[int, ...], ...]:
    return (lanes,), (lanes, 3), (lanes, 3), (lanes,), (lanes,)


def _pack(tubes: Sequence[SweptTube]) -> Pool:
    counts: NDArray[np.int64] = np.array([len(tube.points) for tube in tubes], dtype=np.int64)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
    rows, size = int(counts.sum()), len(tubes)
    waves = max(tube.harmonics.shape[1] for tube in tubes)
    pool = Pool(
        axis=np.empty((rows, 8)),
        normals=np.empty((rows, 3)),
        harmonics=np.zeros((rows, waves, 2)),
        first=starts,
        rows=counts,
        step=np.empty(size),
        uniform=np.empty(size, dtype=np.bool_),
        swing=np.empty(size),
        ripple=np.empty(size),
        slope=np.empty(size),
    )
    for slot, tube in enumerate(tubes):
        _store(pool, slot, tube)
    return pool


def _store(pool: Pool, slot: int, tube: SweptTube) -> None:
    """Writes a tube into its slot, with the bounds that sphere tracing needs."""
    count = len(tube.points)
    rows = slice(pool.first[slot], pool.first[slot] + count)
    axis = pool.axis[rows]
    axis[:, 0:3], axis[:, 3:6], axis[:, 7] = tube.points, tube.tangents, tube.radius
    axis[:, 6] = np.einsum("ij,ij->i", tube.points, tube.tangents)
    pool.normals[rows] = tube.normals
    waves = tube.harmonics.shape[1]
    pool.harmonics[rows] = 0.0
    pool.harmonics[rows, :waves] = tube.harmonics
    pool.rows[slot], pool.step[slot] = count, tube.step
    amplitude = np.hypot(tube.harmonics[:, :, 0], tube.harmonics[:, :, 1])  # (M, H)
    orders = np.arange(2, waves + 2)
    widest = tube.radius * (1.0 + amplitude.sum(axis=1))
    pool.swing[slot] = amplitude.sum(axis=1).max(initial=0.0)
    pool.ripple[slot] = (tube.radius * (amplitude @ orders)).max(initial=0.0)
    shape_change = np.diff(tube.radius[:, None, None] * tube.harmonics, axis=0)
    change = np.abs(np.diff(tube.radius)) + np.hypot(shape_change[..., 0], shape_change[..., 1]).sum(axis=1)
    # On the inner side of a bend the wall is shorter than the axis, hence steeper.
    shorter = 1.0 - segment_curvature(tube.tangents, tube.step) * np.maximum(widest[:-1], widest[1:])
    pool.slope[slot] = (change / (tube.step * shorter)).max()
    pool.uniform[slot] = pool.swing[slot] == 0.0 and pool.slope[slot] == 0.0


@compiled
def _rays(
    pool: Pool,
    assigned: Integers,
    rows: Integers,
    active: Bools,
    origins: Floats,
    directions: Floats,
    reach: float,
    out: Floats,
) -> None:
    for lane in range(origins.shape[0]):
        if not active[lane]:
            continue
        tube, row = assigned[lane], rows[lane]
        for k in range(origins.shape[1]):
            x, y, z = origins[lane, k, 0], origins[lane, k, 1], origins[lane, k, 2]
            dx, dy, dz = directions[lane, k, 0], directions[lane, k, 1], directions[lane, k, 2]
            out[lane, k], row = cast(pool, tube, row, x, y, z, dx, dy, dz, reach)


@compiled
def _project(
    pool: Pool, assigned: Integers, rows: Integers, points: Floats, near: Floats,
    arc: Floats, position: Floats, tangent: Floats, radial: Floats, radius: Floats,
) -> None:  # fmt: skip
    for lane in range(points.shape[0]):
        tube = assigned[lane]
        x, y, z = points[lane, 0], points[lane, 1], points[lane, 2]
        first, step = pool.first[tube], pool.step[tube]
        last = first + pool.rows[tube] - 1
        if np.isnan(near[lane]):
            row, u, _ = settle_anywhere(pool, tube, x, y, z)
        else:
            low = first + int(np.ceil(max(near[lane] - WINDOW, 0.0) / step))
            high = first + int((near[lane] + WINDOW) / step)
            low, high = min(low, last - 1), min(high, last)
            row, u, _ = settle(pool, tube, low, max(high, low + 1), x, y, z)
        rows[lane] = row
        qx, qy, qz = axis_point(pool, tube, row, u)
        arc[lane] = (row - first + u) * step
        position[lane, 0], position[lane, 1], position[lane, 2] = qx, qy, qz
        tangent[lane, 0], tangent[lane, 1], tangent[lane, 2] = axis_tangent(pool, row, u)
        radial[lane] = np.sqrt((x - qx) ** 2 + (y - qy) ** 2 + (z - qz) ** 2)
        radius[lane] = mean_radius(pool, row, u)


@compiled
def _axis(pool: Pool, assigned: Integers, arc: Floats, position: Floats, tangent: Floats) -> None:
    for lane in range(arc.shape[0]):
        tube = assigned[lane]
        row, u = place(pool, tube, arc[lane])
        position[lane, 0], position[lane, 1], position[lane, 2] = axis_point(pool, tube, row, u)
        tangent[lane, 0], tangent[lane, 1], tangent[lane, 2] = axis_tangent(pool, row, u)


@compiled
def _visible(
    pool: Pool, assigned: Integers, rows: Integers, points: Floats, targets: Floats, out: NDArray[np.bool_]
) -> None:
    for lane in range(points.shape[0]):
        x, y, z = points[lane, 0], points[lane, 1], points[lane, 2]
        dx, dy, dz = targets[lane, 0] - x, targets[lane, 1] - y, targets[lane, 2] - z
        reach = np.sqrt(dx * dx + dy * dy + dz * dz)
        out[lane] = True
        if reach > 0.0:
            scale = 1.0 / reach
            distance, _ = cast(
                pool, assigned[lane], rows[lane], x, y, z, dx * scale, dy * scale, dz * scale, reach
            )
            out[lane] = distance >= reach


@compiled
def _clearance(
    pool: Pool, assigned: Integers, points: Floats, arc: Floats, foot: Floats, out: Floats
) -> None:
    for lane in range(points.shape[0]):
        tube = assigned[lane]
        x, y, z = points[lane, 0], points[lane, 1], points[lane, 2]
        row, u = place(pool, tube, arc[lane])
        vx, vy, vz = x - foot[lane, 0], y - foot[lane, 1], z - foot[lane, 2]
        gap, beyond = 0.0, NOT_BEYOND
        if arc[lane] <= 0.0:
            gap = plane_gap(pool.axis, row, x, y, z)
            beyond = BEFORE_START if gap < 0.0 else NOT_BEYOND
        elif u == 1.0 and row == pool.first[tube] + pool.rows[tube] - 2:
            gap = plane_gap(pool.axis, row + 1, x, y, z)
            beyond = 1 if gap > 0.0 else NOT_BEYOND
        if beyond != NOT_BEYOND:
            end = row if beyond == BEFORE_START else row + 1
            vx, vy, vz = (
                vx - gap * pool.axis[end, 3],
                vy - gap * pool.axis[end, 4],
                vz - gap * pool.axis[end, 5],
            )
        radial = np.sqrt(vx * vx + vy * vy + vz * vz)
        deep = wall_distance(pool, tube, row, u, vx, vy, vz) - radial
        if beyond != NOT_BEYOND:
            out[lane] = -np.sqrt(gap * gap + deep * deep)
        elif pool.uniform[tube]:
            out[lane] = deep
        else:
            distance = nearest_wall(pool, tube, arc[lane], x, y, z)
            out[lane] = distance if deep >= 0.0 else -distance
