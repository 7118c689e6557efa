"""Compiled queries of swept tubes: where a point is along the axis, and how far the wall is.

A point belongs to the segment between the two normal planes of the axis that enclose it; planes of
neighbouring points meet only at the centre of curvature, outside of the wall, so that inside of the tube the
segment is unique and is found by walking along the axis. Between its two points the axis is the parabola that
has their tangents, which follows a circle to within 1e-5 of its radius.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from meshes.compiled import compiled
from meshes.geometry import Floats

Integers = NDArray[np.int64]

WINDOW = 2.0
"""How far from the arc length that is given the nearest axis point is searched (m)."""
OVERSTEP = 0.02
"""How far (over R) a ray walks past the sphere that is known to be free, to end up behind the wall."""
COARSE_ANGLES = 24
"""Directions in the section that are tried before the nearest wall point is refined."""
REFINEMENTS = 6
"""Rounds of that refinement; each narrows the search by REFINEMENT_SHRINK."""
REFINEMENT_SHRINK = 0.4

NOT_BEYOND, BEFORE_START, BEHIND_END = 0, -1, 1


class Pool(NamedTuple):
    """Tubes packed one behind the other; tube t owns rows[t] rows from first[t] on."""

    axis: Floats  # (ΣM, 8)
    """Point (3), tangent (3), point · tangent, mean radius: one cache line."""
    normals: Floats  # (ΣM, 3)
    harmonics: Floats  # (ΣM, H, 2)
    first: Integers  # (T,)
    rows: Integers  # (T,)
    step: Floats  # (T,)
    uniform: NDArray[np.bool_]  # (T,)
    """Round and of one radius: distances to the wall are then R minus the radial distance, exactly."""
    swing: Floats  # (T,)
    """Greatest sum of the harmonics' amplitudes."""
    ripple: Floats  # (T,)
    """Greatest derivative of the wall distance by the angle (m)."""
    slope: Floats  # (T,)
    """Greatest derivative of the wall distance by the length along the wall."""


@compiled
def plane_gap(axis: Floats, row: int, x: float, y: float, z: float) -> float:
    """Signed distance (m) of a point from the normal plane of an axis point."""
    return float(x * axis[row, 3] + y * axis[row, 4] + z * axis[row, 5] - axis[row, 6])


@compiled
def locate(pool: Pool, tube: int, row: int, x: float, y: float, z: float) -> tuple[int, float, int]:
    """Walks from `row` to the segment that holds the point.

    Returns:
        Row of the segment, place in it (0 to 1), and whether the point lies beyond one of the end planes.
    """
    axis = pool.axis
    first = int(pool.first[tube])
    last = first + pool.rows[tube] - 2
    near = plane_gap(axis, row, x, y, z)
    if near < 0.0:
        far = near
        while near < 0.0:
            if row == first:
                return row, 0.0, BEFORE_START
            row -= 1
            far = near
            near = plane_gap(axis, row, x, y, z)
    else:
        far = plane_gap(axis, row + 1, x, y, z)
        while far >= 0.0:
            if row == last:
                return row, 1.0, BEHIND_END if far > 0.0 else NOT_BEYOND
            row += 1
            near = far
            far = plane_gap(axis, row + 1, x, y, z)
    return row, near / (near - far), NOT_BEYOND


@compiled
def axis_point(pool: Pool, tube: int, row: int, u: float) -> tuple[float, float, float]:
    """Axis point (m) at the place `u` of the segment `row`."""
    a = pool.axis
    bulge = 0.5 * pool.step[tube] * u * (1.0 - u)
    return (
        a[row, 0] + u * (a[row + 1, 0] - a[row, 0]) - bulge * (a[row + 1, 3] - a[row, 3]),
        a[row, 1] + u * (a[row + 1, 1] - a[row, 1]) - bulge * (a[row + 1, 4] - a[row, 4]),
        a[row, 2] + u * (a[row + 1, 2] - a[row, 2]) - bulge * (a[row + 1, 5] - a[row, 5]),
    )


@compiled
def mean_radius(pool: Pool, row: int, u: float) -> float:
    """Mean radius R (m) at the place `u` of the segment `row`."""
    return float(pool.axis[row, 7] + u * (pool.axis[row + 1, 7] - pool.axis[row, 7]))


@compiled
def axis_tangent(pool: Pool, row: int, u: float) -> tuple[float, float, float]:
    """Unit tangent at the place `u` of the segment `row`."""
    a = pool.axis
    x = a[row, 3] + u * (a[row + 1, 3] - a[row, 3])
    y = a[row, 4] + u * (a[row + 1, 4] - a[row, 4])
    z = a[row, 5] + u * (a[row + 1, 5] - a[row, 5])
    norm = np.sqrt(x * x + y * y + z * z)
    return x / norm, y / norm, z / norm


@compiled
def section_axes(pool: Pool, row: int, u: float) -> tuple[float, float, float, float, float, float]:
    """Normal and tangent x normal, unit vectors, from which the section's angle is measured."""
    n = pool.normals
    tx, ty, tz = axis_tangent(pool, row, u)
    x = n[row, 0] + u * (n[row + 1, 0] - n[row, 0])
    y = n[row, 1] + u * (n[row + 1, 1] - n[row, 1])
    z = n[row, 2] + u * (n[row + 1, 2] - n[row, 2])
    norm = np.sqrt(x * x + y * y + z * z)
    x, y, z = x / norm, y / norm, z / norm
    return x, y, z, ty * z - tz * y, tz * x - tx * z, tx * y - ty * x


@compiled
def section_factor(pool: Pool, row: int, u: float, cosine: float, sine: float) -> float:
    """r(s, θ) / R(s), from the cosine and sine of θ."""
    harmonics = pool.harmonics
    factor = 1.0
    c, s = cosine, sine
    for k in range(harmonics.shape[1]):
        c, s = c * cosine - s * sine, s * cosine + c * sine
        a = harmonics[row, k, 0] + u * (harmonics[row + 1, k, 0] - harmonics[row, k, 0])
        b = harmonics[row, k, 1] + u * (harmonics[row + 1, k, 1] - harmonics[row, k, 1])
        factor += a * c + b * s
    return factor


@compiled
def wall_distance(pool: Pool, tube: int, row: int, u: float, x: float, y: float, z: float) -> float:
    """r(s, θ) (m) in the direction of the vector (x, y, z), which is normal to the axis."""
    radius = mean_radius(pool, row, u)
    d = np.sqrt(x * x + y * y + z * z)
    if pool.swing[tube] == 0.0 or d == 0.0:
        return radius
    nx, ny, nz, bx, by, bz = section_axes(pool, row, u)
    cosine = (x * nx + y * ny + z * nz) / d
    sine = (x * bx + y * by + z * bz) / d
    return radius * section_factor(pool, row, u, cosine, sine)


@compiled
def depth(pool: Pool, tube: int, row: int, u: float, x: float, y: float, z: float) -> tuple[float, float]:
    """How deep a point lies in its section, and the radius of a sphere around it that no wall enters (m).

    The depth r(s, θ) - d is negative outside of the wall. In a tube that is not uniform it changes by at most
    `slope` along the axis and by `ripple` over d around it, which bounds the sphere.
    """
    qx, qy, qz = axis_point(pool, tube, row, u)
    vx, vy, vz = x - qx, y - qy, z - qz
    d = np.sqrt(vx * vx + vy * vy + vz * vz)
    if pool.uniform[tube]:
        deep = float(pool.axis[row, 7] - d)
        return deep, deep
    deep = wall_distance(pool, tube, row, u, vx, vy, vz) - d
    steepness = np.sqrt(1.0 + pool.slope[tube] ** 2)
    narrow = (mean_radius(pool, row, u) * (1.0 - pool.swing[tube]) - d) / steepness
    if pool.swing[tube] == 0.0 or d == 0.0:
        return deep, narrow
    # Within half of d the angle changes the wall distance by at most ripple / (d / 2) a metre.
    around = 2.0 * pool.ripple[tube] / d
    free = min(deep / np.sqrt(1.0 + pool.slope[tube] ** 2 + around**2), 0.5 * d)
    return deep, max(narrow, free)


@compiled
def nearest_row(pool: Pool, tube: int, low: int, high: int, x: float, y: float, z: float) -> int:
    """Row of the nearest axis point among the rows low ... high."""
    axis = pool.axis
    best, row = np.inf, low
    for i in range(low, high + 1):
        dx, dy, dz = x - axis[i, 0], y - axis[i, 1], z - axis[i, 2]
        square = dx * dx + dy * dy + dz * dz
        if square < best:
            best, row = square, i
    return row


@compiled
def settle(
    pool: Pool, tube: int, low: int, high: int, x: float, y: float, z: float
) -> tuple[int, float, int]:
    """As `locate`, for a point that may be anywhere: the segment beside the nearest row of low ... high."""
    row = nearest_row(pool, tube, low, high, x, y, z)
    gap = plane_gap(pool.axis, row, x, y, z)
    first = pool.first[tube]
    last = first + pool.rows[tube] - 1
    if gap < 0.0:
        if row == first:
            return row, 0.0, BEFORE_START
        if row == low:
            return row, 0.0, NOT_BEYOND
        row -= 1
        near, far = plane_gap(pool.axis, row, x, y, z), gap
    else:
        if row == last:
            return row - 1, 1.0, BEHIND_END if gap > 0.0 else NOT_BEYOND
        if row == high:
            return row - 1, 1.0, NOT_BEYOND
        near, far = gap, plane_gap(pool.axis, row + 1, x, y, z)
    # Far outside, past the centre of curvature, the planes cross and enclose nothing.
    if near < 0.0:
        return row, 0.0, NOT_BEYOND
    if far > 0.0:
        return row, 1.0, NOT_BEYOND
    return row, near / (near - far) if near > far else 0.0, NOT_BEYOND


@compiled
def settle_anywhere(pool: Pool, tube: int, x: float, y: float, z: float) -> tuple[int, float, int]:
    """As `settle`, over the whole axis."""
    first = pool.first[tube]
    return settle(pool, tube, first, first + pool.rows[tube] - 1, x, y, z)


@compiled
def trace(
    pool: Pool,
    tube: int,
    row: int,
    x: float,
    y: float,
    z: float,
    dx: float,
    dy: float,
    dz: float,
    reach: float,
) -> float:
    """Distance to the wall along a ray from an inner point, by sphere tracing (m).

    The ray goes from free sphere to free sphere, each time a little past it, until it is behind the wall; the
    place where it passed is then interpolated in that last little stretch. A ray that leaves through an open
    end has no wall before it and reads `reach`.

    Args:
        pool: the tubes.
        tube: index in the pool.
        row: segment of the origin, from `locate`.
        x, y, z: origin (m), inside of the tube.
        dx, dy, dz: unit direction.
        reach: returned where no wall is nearer (m).
    """
    t = 0.0
    row, u, _ = locate(pool, tube, row, x, y, z)
    deep, free = depth(pool, tube, row, u, x, y, z)
    while True:
        low = t + max(free, 0.0)
        if not low < reach:
            return reach if low >= reach else np.nan  # not a number in, not a number out
        t = min(low + OVERSTEP * pool.axis[row, 7], reach)
        px, py, pz = x + t * dx, y + t * dy, z + t * dz
        row, u, beyond = locate(pool, tube, row, px, py, pz)
        if beyond != NOT_BEYOND:
            return reach
        deep, free = depth(pool, tube, row, u, px, py, pz)
        if deep < 0.0:
            px, py, pz = x + low * dx, y + low * dy, z + low * dz
            row, u, _ = locate(pool, tube, row, px, py, pz)
            before, _ = depth(pool, tube, row, u, px, py, pz)
            if before <= 0.0:
                return low
            return float(low + (t - low) * before / (before - deep))
        if t >= reach:
            return reach


@compiled
def cast(
    pool: Pool,
    tube: int,
    row: int,
    x: float,
    y: float,
    z: float,
    dx: float,
    dy: float,
    dz: float,
    reach: float,
) -> tuple[float, int]:
    """As `trace`, from anywhere: also returns the row of the origin's segment, for the next ray from near by.

    An origin outside of the wall reads 0. One that lies beyond an end plane is in the open: it sees the
    inside of the tube where the ray enters it through its mouth, and nothing elsewhere.
    """
    row, u, beyond = locate(pool, tube, row, x, y, z)
    if beyond == NOT_BEYOND and depth(pool, tube, row, u, x, y, z)[0] >= 0.0:
        return trace(pool, tube, row, x, y, z, dx, dy, dz, reach), row
    # The walk may have begun far away and have ended in the wrong bend.
    row, u, beyond = settle_anywhere(pool, tube, x, y, z)
    if beyond == NOT_BEYOND:
        if depth(pool, tube, row, u, x, y, z)[0] < 0.0:
            return 0.0, row
        return trace(pool, tube, row, x, y, z, dx, dy, dz, reach), row
    end = row if beyond == BEFORE_START else row + 1
    a = pool.axis
    gap = plane_gap(a, end, x, y, z)
    rate = dx * a[end, 3] + dy * a[end, 4] + dz * a[end, 5]
    if gap * rate >= 0.0 or -gap / rate >= reach:
        return reach, row
    t = -gap / rate
    px, py, pz = x + t * dx, y + t * dy, z + t * dz
    if depth(pool, tube, row, u, px, py, pz)[0] < 0.0:
        return reach, row
    return t + trace(pool, tube, row, px, py, pz, dx, dy, dz, reach - t), row


@compiled
def wall_gap(pool: Pool, tube: int, s: float, angle: float, x: float, y: float, z: float) -> float:
    """Squared distance (m²) of a point from the wall point at arc length `s` and `angle`."""
    row, u = place(pool, tube, s)
    qx, qy, qz = axis_point(pool, tube, row, u)
    nx, ny, nz, bx, by, bz = section_axes(pool, row, u)
    c, b = np.cos(angle), np.sin(angle)
    r = mean_radius(pool, row, u) * section_factor(pool, row, u, c, b)
    gx = x - qx - r * (c * nx + b * bx)
    gy = y - qy - r * (c * ny + b * by)
    gz = z - qz - r * (c * nz + b * bz)
    return float(gx * gx + gy * gy + gz * gz)


@compiled
def place(pool: Pool, tube: int, s: float) -> tuple[int, float]:
    """Row of the segment and place in it (0 to 1) at the arc length `s` (m), clipped to the ends."""
    segments = int(pool.rows[tube]) - 1
    along = min(max(s / pool.step[tube], 0.0), float(segments))
    index = min(int(along), segments - 1)
    return int(pool.first[tube]) + index, along - index


@compiled
def nearest_wall(pool: Pool, tube: int, s: float, x: float, y: float, z: float) -> float:
    """Distance (m) from a point to the wall of a tube that is not uniform.

    The nearest of COARSE_ANGLES wall points in the point's own section is refined along the section and along
    the axis in turn, by parabolas through three points, until it moves no more.
    """
    angle, best = 0.0, np.inf
    for i in range(COARSE_ANGLES):
        trial = 2.0 * np.pi * i / COARSE_ANGLES
        gap = wall_gap(pool, tube, s, trial, x, y, z)
        if gap < best:
            best, angle = gap, trial
    row, u = place(pool, tube, s)
    wide = 2.0 * np.pi / COARSE_ANGLES
    long = 0.5 * mean_radius(pool, row, u)
    for _ in range(REFINEMENTS):
        for along in range(2):
            ds, da = (long, 0.0) if along else (0.0, wide)
            left = wall_gap(pool, tube, s - ds, angle - da, x, y, z)
            right = wall_gap(pool, tube, s + ds, angle + da, x, y, z)
            bend = left + right - 2.0 * best
            shift = 0.5 * (left - right) / bend if bend > 0.0 else np.sign(left - right)
            shift = min(max(shift, -1.0), 1.0)
            gap = wall_gap(pool, tube, s + shift * ds, angle + shift * da, x, y, z)
            if gap < best:
                best, s, angle = gap, s + shift * ds, angle + shift * da
        wide *= REFINEMENT_SHRINK
        long *= REFINEMENT_SHRINK
    return float(np.sqrt(best))
