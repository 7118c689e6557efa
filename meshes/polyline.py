"""Compiled queries of centrelines: polylines of even step, many in one table, one for each lane.

A table is (S, 7): position (3), unit tangent (3) and local radius of every point, polyline after polyline.
Lane i uses the `count[i]` rows from `first[i]` on, `step[i]` metres of arc length apart.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from meshes.compiled import compiled
from meshes.geometry import WINDOW, Floats

Indices = NDArray[np.int64]


def axis_table(axis: Floats, tangent: Floats, radius: Floats) -> Floats:
    """One polyline's rows (M, 7) of a table: axis (M, 3), unit tangents (M, 3), radius (M,)."""
    return np.concatenate([axis, tangent, radius[:, None]], axis=1)


@compiled
def project(
    points: Floats,
    near: Floats,
    table: Floats,
    first: Indices,
    count: Indices,
    step: Floats,
    arc_length: Floats,
    position: Floats,
    tangent: Floats,
    radial_distance: Floats,
    radius: Floats,
) -> None:
    """Nearest point of each lane's polyline to its point (N, 3); writes the fields of `AxisPoints`.

    Segments within `WINDOW` of `near` (N,) are searched, all where it is NaN. Between two rows, tangent and
    radius are interpolated.
    """
    for lane in range(len(points)):
        px, py, pz = points[lane, 0], points[lane, 1], points[lane, 2]
        base = first[lane]
        start, stop = 0, count[lane] - 1
        if not math.isnan(near[lane]):
            start = min(max(int((near[lane] - WINDOW) / step[lane]), 0), stop - 1)
            stop = min(max(int((near[lane] + WINDOW) / step[lane]) + 1, start + 1), stop)
        best = np.inf
        segment, along = start, 0.0
        for i in range(start, stop):
            a, b = table[base + i], table[base + i + 1]
            ex, ey, ez = b[0] - a[0], b[1] - a[1], b[2] - a[2]
            wx, wy, wz = px - a[0], py - a[1], pz - a[2]
            t = (wx * ex + wy * ey + wz * ez) / (ex * ex + ey * ey + ez * ez)
            t = min(max(t, 0.0), 1.0)
            dx, dy, dz = wx - t * ex, wy - t * ey, wz - t * ez
            squared = dx * dx + dy * dy + dz * dz
            if squared < best:
                best, segment, along = squared, i, t
        a, b = table[base + segment], table[base + segment + 1]
        arc_length[lane] = (segment + along) * step[lane]
        for k in range(3):
            position[lane, k] = a[k] + along * (b[k] - a[k])
        _blend_tangent(a, b, along, tangent[lane])
        radial_distance[lane] = math.sqrt(best)
        radius[lane] = a[6] + along * (b[6] - a[6])


@compiled
def sample(
    arc_length: Floats,
    table: Floats,
    first: Indices,
    count: Indices,
    step: Floats,
    position: Floats,
    tangent: Floats,
) -> None:
    """Writes points and unit tangents of each lane's polyline at arc lengths (N,), clipped to its ends."""
    for lane in range(len(arc_length)):
        last = count[lane] - 1
        at = min(max(arc_length[lane] / step[lane], 0.0), float(last))
        segment = min(int(at), last - 1)
        along = at - segment
        a, b = table[first[lane] + segment], table[first[lane] + segment + 1]
        for k in range(3):
            position[lane, k] = a[k] + along * (b[k] - a[k])
        _blend_tangent(a, b, along, tangent[lane])


@compiled
def between_ends(
    points: Floats, arc_length: Floats, table: Floats, first: Indices, count: Indices, step: Floats
) -> NDArray[np.bool_]:
    """Whether each point (N, 3) lies between the planes of its polyline's two ends, (N,).

    Only a point whose nearest point of the axis, at `arc_length` (N,), is an end can lie beyond that end.
    """
    between = np.empty(len(points), dtype=np.bool_)
    for lane in range(len(points)):
        last = count[lane] - 1
        between[lane] = True
        if arc_length[lane] <= 0.0:
            between[lane] = _ahead(points[lane], table[first[lane]]) >= 0.0
        elif arc_length[lane] >= last * step[lane]:
            between[lane] = _ahead(points[lane], table[first[lane] + last]) <= 0.0
    return between


@compiled
def _ahead(point: Floats, row: Floats) -> float:
    """How far (m) a point (3,) lies along the tangent of a row of the table (7,)."""
    x, y, z = point[0] - row[0], point[1] - row[1], point[2] - row[2]
    return float(x * row[3] + y * row[4] + z * row[5])


@compiled
def _blend_tangent(a: Floats, b: Floats, along: float, tangent: Floats) -> None:
    """Writes the unit tangent a fraction `along` of the way between two rows of the table (7,)."""
    squared = 0.0
    for k in range(3):
        tangent[k] = a[3 + k] + along * (b[3 + k] - a[3 + k])
        squared += tangent[k] * tangent[k]
    scale = 1.0 / math.sqrt(squared)
    for k in range(3):
        tangent[k] *= scale
