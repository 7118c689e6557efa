"""Geometry of swept tubes: a pool of them in contiguous arrays, queried by compiled code.

Changing a lane's tube is one number, so that every episode can have a tube of its own at no cost. The ends
are open: a ray that leaves through an end meets no wall, as with a mesh without caps.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from meshes.compiled import compiled
from meshes.errors import MeshError
from meshes.geometry import WINDOW, AxisPoints, Bools, Floats, Geometry
from meshes.swept import SweptTube, segment_curvature
from meshes.swept_kernels import (
    Swept,
    axis_point,
    axis_tangent,
    cast,
    mean_radius,
    nearest_wall,
    place,
    plane_gap,
    settle,
    wall_distance,
)

Integers = NDArray[np.int64]


class Pool(NamedTuple):
    """Tubes packed one behind the other, see `Swept`; tube t owns rows[t] rows from first[t] on."""

    axis: Floats  # (ΣM, 8)
    normals: Floats  # (ΣM, 3)
    harmonics: Floats  # (ΣM, H, 2)
    first: Integers  # (T,)
    rows: Integers  # (T,)
    step: Floats  # (T,)
    uniform: Bools  # (T,)
    swing: Floats  # (T,)
    ripple: Floats  # (T,)
    slope: Floats  # (T,)


class AxisRows(NamedTuple):
    """The arrays of `AxisPoints`, in a form that compiled code takes."""

    arc_length: Floats
    position: Floats
    tangent: Floats
    radial_distance: Floats
    radius: Floats


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
        self._anywhere = np.full(lanes, np.nan)
        self._row: Integers = np.zeros(lanes, dtype=np.int64)

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
        self._row[chosen] = 0

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
            self._row[self.assigned == slot] = 0

    @property
    def length(self) -> Floats:
        """See `Geometry.length`."""
        lengths: Floats = (self._pool.rows - 1)[self.assigned] * self._pool.step[self.assigned]
        return lengths

    def rays(self, origins: Floats, directions: Floats, reach: float, active: Bools | None = None) -> Floats:
        """See `Geometry.rays`; origins in the open, beyond an end plane, see the tube's inside or nothing."""
        distances = np.zeros(origins.shape[:2])
        wanted = self._all if active is None else active
        origins, directions = _contiguous(origins), _contiguous(directions)
        _rays(self._pool, self.assigned, self._row, wanted, origins, directions, float(reach), distances)
        return distances

    def project(self, points: Floats, near: Floats | None = None) -> AxisPoints:
        """See `Geometry.project`."""
        n = self.lanes
        found = AxisRows(np.empty(n), np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty(n))
        guess = self._anywhere if near is None else _contiguous(near)
        _project(self._pool, self.assigned, self._row, _contiguous(points), guess, found)
        return AxisPoints(*found)

    def axis(self, arc_length: Floats) -> tuple[Floats, Floats]:
        """See `Geometry.axis`."""
        positions, tangents = np.empty((self.lanes, 3)), np.empty((self.lanes, 3))
        _axis(self._pool, self.assigned, _contiguous(arc_length), positions, tangents)
        return positions, tangents

    def visible(self, points: Floats, targets: Floats) -> Bools:
        """See `Geometry.visible`."""
        seen = np.empty(self.lanes, dtype=np.bool_)
        _visible(self._pool, self.assigned, self._row, _contiguous(points), _contiguous(targets), seen)
        return seen

    def inside(self, points: Floats, axis_points: AxisPoints) -> Bools:
        """See `Geometry.inside`."""
        within = np.empty(self.lanes, dtype=np.bool_)
        arc, foot = _contiguous(axis_points.arc_length), _contiguous(axis_points.position)
        _inside(self._pool, self.assigned, _contiguous(points), arc, foot, within)
        return within

    def clearance(self, points: Floats, axis_points: AxisPoints) -> Floats:
        """See `Geometry.clearance`.

        In a round tube of one radius this is R minus the radial distance, which is exact in bends too.
        Elsewhere the nearest wall point is searched for (`swept_kernels.nearest_wall`). Beyond an end plane
        it is the negative distance to the rim.
        """
        gaps = np.empty(self.lanes)
        arc, foot = _contiguous(axis_points.arc_length), _contiguous(axis_points.position)
        _clearance(self._pool, self.assigned, _contiguous(points), arc, foot, gaps)
        return gaps


def _contiguous(array: Floats) -> Floats:
    # Each other layout of an argument would be compiled anew.
    return np.ascontiguousarray(array, dtype=np.float64)


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
def _tube(pool: Pool, slot: int) -> Swept:
    """The tube in a slot, as views into the pool."""
    start = pool.first[slot]
    stop = start + pool.rows[slot]
    return Swept(
        pool.axis[start:stop],
        pool.normals[start:stop],
        pool.harmonics[start:stop],
        pool.step[slot],
        pool.uniform[slot],
        pool.swing[slot],
        pool.ripple[slot],
        pool.slope[slot],
    )


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
        tube, row = _tube(pool, assigned[lane]), rows[lane]
        for k in range(origins.shape[1]):
            x, y, z = origins[lane, k, 0], origins[lane, k, 1], origins[lane, k, 2]
            dx, dy, dz = directions[lane, k, 0], directions[lane, k, 1], directions[lane, k, 2]
            out[lane, k], row = cast(tube, row, x, y, z, dx, dy, dz, reach)


@compiled
def _project(
    pool: Pool,
    assigned: Integers,
    rows: Integers,
    points: Floats,
    near: Floats,
    found: AxisRows,
) -> None:
    for lane in range(points.shape[0]):
        tube = _tube(pool, assigned[lane])
        axis, step, last = tube.axis, tube.step, len(tube.axis) - 1
        x, y, z = points[lane, 0], points[lane, 1], points[lane, 2]
        low, high = 0, last
        if not np.isnan(near[lane]):
            low = int(min(np.ceil(max(near[lane] - WINDOW, 0.0) / step), last - 1.0))
            high = max(int(min((near[lane] + WINDOW) / step, float(last))), low + 1)
        row, u, _ = settle(axis, low, high, x, y, z)
        rows[lane] = row
        qx, qy, qz = axis_point(axis, step, row, u)
        found.arc_length[lane] = (row + u) * step
        found.position[lane, 0], found.position[lane, 1], found.position[lane, 2] = qx, qy, qz
        tx, ty, tz = axis_tangent(axis, row, u)
        found.tangent[lane, 0], found.tangent[lane, 1], found.tangent[lane, 2] = tx, ty, tz
        found.radial_distance[lane] = np.sqrt((x - qx) ** 2 + (y - qy) ** 2 + (z - qz) ** 2)
        found.radius[lane] = mean_radius(axis, row, u)


@compiled
def _axis(pool: Pool, assigned: Integers, arc: Floats, position: Floats, tangent: Floats) -> None:
    for lane in range(arc.shape[0]):
        tube = _tube(pool, assigned[lane])
        row, u = place(tube.axis, tube.step, arc[lane])
        position[lane, 0], position[lane, 1], position[lane, 2] = axis_point(tube.axis, tube.step, row, u)
        tangent[lane, 0], tangent[lane, 1], tangent[lane, 2] = axis_tangent(tube.axis, row, u)


@compiled
def _visible(
    pool: Pool, assigned: Integers, rows: Integers, points: Floats, targets: Floats, out: Bools
) -> None:
    for lane in range(points.shape[0]):
        x, y, z = points[lane, 0], points[lane, 1], points[lane, 2]
        dx, dy, dz = targets[lane, 0] - x, targets[lane, 1] - y, targets[lane, 2] - z
        reach = np.sqrt(dx * dx + dy * dy + dz * dz)
        out[lane] = True
        if reach > 0.0:
            dx, dy, dz = dx / reach, dy / reach, dz / reach
            tube = _tube(pool, assigned[lane])
            out[lane] = cast(tube, rows[lane], x, y, z, dx, dy, dz, reach)[0] >= reach


@compiled
def _depth(
    tube: Swept, x: float, y: float, z: float, arc: float, fx: float, fy: float, fz: float
) -> tuple[float, float]:
    """How far a point is beyond an end plane, and how deep it lies in the section of its axis point (m)."""
    axis = tube.axis
    row, u = place(axis, tube.step, arc)
    vx, vy, vz = x - fx, y - fy, z - fz
    ahead = 0.0
    if row == 0 and u <= 0.0:
        ahead = max(-plane_gap(axis, 0, x, y, z), 0.0)
    elif row == len(axis) - 2 and u >= 1.0:
        ahead = max(plane_gap(axis, row + 1, x, y, z), 0.0)
    if ahead > 0.0:
        tx, ty, tz = axis_tangent(axis, row, u)
        along = vx * tx + vy * ty + vz * tz
        vx, vy, vz = vx - along * tx, vy - along * ty, vz - along * tz
    return ahead, wall_distance(tube, row, u, vx, vy, vz) - np.sqrt(vx * vx + vy * vy + vz * vz)


@compiled
def _inside(pool: Pool, assigned: Integers, points: Floats, arc: Floats, foot: Floats, out: Bools) -> None:
    for lane in range(points.shape[0]):
        tube = _tube(pool, assigned[lane])
        x, y, z = points[lane, 0], points[lane, 1], points[lane, 2]
        fx, fy, fz = foot[lane, 0], foot[lane, 1], foot[lane, 2]
        ahead, deep = _depth(tube, x, y, z, arc[lane], fx, fy, fz)
        out[lane] = ahead == 0.0 and deep > 0.0


@compiled
def _clearance(
    pool: Pool, assigned: Integers, points: Floats, arc: Floats, foot: Floats, out: Floats
) -> None:
    for lane in range(points.shape[0]):
        tube = _tube(pool, assigned[lane])
        x, y, z = points[lane, 0], points[lane, 1], points[lane, 2]
        fx, fy, fz = foot[lane, 0], foot[lane, 1], foot[lane, 2]
        ahead, deep = _depth(tube, x, y, z, arc[lane], fx, fy, fz)
        if ahead > 0.0:
            out[lane] = -np.sqrt(ahead * ahead + deep * deep)
        elif tube.uniform:
            out[lane] = deep
        else:
            distance = nearest_wall(tube, arc[lane], x, y, z)
            out[lane] = distance if deep > 0.0 else -distance
