"""Compiled queries of one swept tube: where a point is along the axis, and how far the wall is.

A point belongs to the segment between the two normal planes of the axis that enclose it; planes of
neighbouring points meet only at the centre of curvature, outside of the wall, so that inside of the tube the
segment is unique and is found by walking along the axis. Between its two points the axis is the parabola that
has their tangents, which follows a circle to within 1e-5 of its radius.

What rays need of a round tube takes the axis alone: handing over a whole tube at every step halves their speed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from meshes.compiled import compiled
from meshes.geometry import Floats

OVERSTEP = 0.02
"""How far (over R) a ray walks past the sphere that is known to be free, to end up behind the wall."""
COARSE_ANGLES = 24
"""Directions in the section that are tried before the nearest wall point is refined."""
REFINEMENTS = 6
"""Rounds of that refinement; each narrows the search by REFINEMENT_SHRINK."""
REFINEMENT_SHRINK = 0.4

NOT_BEYOND, BEFORE_START, BEHIND_END = 0, -1, 1


class Swept(NamedTuple):
    """One swept tube as compiled code sees it: M axis points, M - 1 segments named by their first point."""

    axis: Floats  # (M, 8)
    """Point (3), tangent (3), point · tangent, mean radius: one cache line."""
    normals: Floats  # (M, 3)
    harmonics: Floats  # (M, H, 2)
    step: float
    uniform: bool
    """Round and of one radius: the distance to the wall is then R minus the radial distance, exactly."""
    swing: float
    """Greatest sum of the harmonics' amplitudes."""
    ripple: float
    """Greatest derivative of the wall distance by the angle (m)."""
    slope: float
    """Greatest derivative of the wall distance by the length along the wall."""


@compiled
def plane_gap(axis: Floats, row: int, x: float, y: float, z: float) -> float:
    """Signed distance (m) of a point from the normal plane of an axis point."""
    return float(x * axis[row, 3] + y * axis[row, 4] + z * axis[row, 5] - axis[row, 6])


@compiled
def locate(axis: Floats, row: int, x: float, y: float, z: float) -> tuple[int, float, int]:
    """Walks from the segment `row` to the one that holds the point.

    Returns:
        The segment, place in it (0 to 1), and whether the point lies beyond one of the end planes.
    """
    near = plane_gap(axis, row, x, y, z)
    if near < 0.0:
        far = near
        while near < 0.0:
            if row == 0:
                return row, 0.0, BEFORE_START
            row -= 1
            far = near
            near = plane_gap(axis, row, x, y, z)
    else:
        last = len(axis) - 2
        far = plane_gap(axis, row + 1, x, y, z)
        while far >= 0.0:
            if row == last:
                return row, 1.0, BEHIND_END if far > 0.0 else NOT_BEYOND
            row += 1
            near = far
            far = plane_gap(axis, row + 1, x, y, z)
    return row, near / (near - far), NOT_BEYOND


@compiled
def axis_point(axis: Floats, step: float, row: int, u: float) -> tuple[float, float, float]:
    """Axis point (m) at the place `u` of the segment `row`."""
    bulge = 0.5 * step * u * (1.0 - u)
    return (
        axis[row, 0] + u * (axis[row + 1, 0] - axis[row, 0]) - bulge * (axis[row + 1, 3] - axis[row, 3]),
        axis[row, 1] + u * (axis[row + 1, 1] - axis[row, 1]) - bulge * (axis[row + 1, 4] - axis[row, 4]),
        axis[row, 2] + u * (axis[row + 1, 2] - axis[row, 2]) - bulge * (axis[row + 1, 5] - axis[row, 5]),
    )


@compiled
def axis_tangent(axis: Floats, row: int, u: float) -> tuple[float, float, float]:
    """Unit tangent at the place `u` of the segment `row`."""
    x = axis[row, 3] + u * (axis[row + 1, 3] - axis[row, 3])
    y = axis[row, 4] + u * (axis[row + 1, 4] - axis[row, 4])
    z = axis[row, 5] + u * (axis[row + 1, 5] - axis[row, 5])
    norm = np.sqrt(x * x + y * y + z * z)
    return x / norm, y / norm, z / norm


@compiled
def mean_radius(axis: Floats, row: int, u: float) -> float:
    """Mean radius R (m) at the place `u` of the segment `row`."""
    return float(axis[row, 7] + u * (axis[row + 1, 7] - axis[row, 7]))


@compiled
def place(axis: Floats, step: float, s: float) -> tuple[int, float]:
    """Segment and place in it (0 to 1) at the arc length `s` (m), clipped to the ends."""
    segments = len(axis) - 1
    along = min(max(s / step, 0.0), float(segments))
    row = min(int(along), segments - 1)
    return row, along - row


@compiled
def radial_distance(axis: Floats, step: float, row: int, u: float, x: float, y: float, z: float) -> float:
    """Distance (m) of a point from the axis point at the place `u` of the segment `row`."""
    qx, qy, qz = axis_point(axis, step, row, u)
    return float(np.sqrt((x - qx) ** 2 + (y - qy) ** 2 + (z - qz) ** 2))


@compiled
def section_axes(tube: Swept, row: int, u: float) -> tuple[float, float, float, float, float, float]:
    """Normal and tangent x normal, unit vectors, from which the section's angle is measured."""
    n = tube.normals
    tx, ty, tz = axis_tangent(tube.axis, row, u)
    x = n[row, 0] + u * (n[row + 1, 0] - n[row, 0])
    y = n[row, 1] + u * (n[row + 1, 1] - n[row, 1])
    z = n[row, 2] + u * (n[row + 1, 2] - n[row, 2])
    norm = np.sqrt(x * x + y * y + z * z)
    x, y, z = x / norm, y / norm, z / norm
    return x, y, z, ty * z - tz * y, tz * x - tx * z, tx * y - ty * x


@compiled
def section_factor(tube: Swept, row: int, u: float, cosine: float, sine: float) -> float:
    """r(s, θ) / R(s), from the cosine and sine of θ."""
    harmonics = tube.harmonics
    factor = 1.0
    c, s = cosine, sine
    for k in range(harmonics.shape[1]):
        c, s = c * cosine - s * sine, s * cosine + c * sine
        a = harmonics[row, k, 0] + u * (harmonics[row + 1, k, 0] - harmonics[row, k, 0])
        b = harmonics[row, k, 1] + u * (harmonics[row + 1, k, 1] - harmonics[row, k, 1])
        factor += a * c + b * s
    return factor


@compiled
def wall_distance(tube: Swept, row: int, u: float, x: float, y: float, z: float) -> float:
    """r(s, θ) (m) in the direction of the vector (x, y, z), which is normal to the axis."""
    radius = mean_radius(tube.axis, row, u)
    d = np.sqrt(x * x + y * y + z * z)
    if tube.swing == 0.0 or d == 0.0:
        return radius
    nx, ny, nz, bx, by, bz = section_axes(tube, row, u)
    cosine = (x * nx + y * ny + z * nz) / d
    sine = (x * bx + y * by + z * bz) / d
    return radius * section_factor(tube, row, u, cosine, sine)


@compiled
def shaped_depth(tube: Swept, row: int, u: float, x: float, y: float, z: float) -> tuple[float, float]:
    """How deep a point lies in its section, and the radius of a sphere around it that no wall enters (m).

    The depth r(s, θ) - d is negative outside of the wall. It changes by at most `slope` along the axis and by
    `ripple` over d around it, which bounds the sphere.
    """
    qx, qy, qz = axis_point(tube.axis, tube.step, row, u)
    vx, vy, vz = x - qx, y - qy, z - qz
    d = np.sqrt(vx * vx + vy * vy + vz * vz)
    deep = wall_distance(tube, row, u, vx, vy, vz) - d
    along = 1.0 + tube.slope**2
    narrow = (mean_radius(tube.axis, row, u) * (1.0 - tube.swing) - d) / np.sqrt(along)
    if tube.swing == 0.0 or d == 0.0:
        return deep, narrow
    # Within half of d the angle changes the wall distance by at most ripple / (d / 2) a metre.
    free = min(deep / np.sqrt(along + (2.0 * tube.ripple / d) ** 2), 0.5 * d)
    return deep, max(narrow, free)


@compiled
def depth(tube: Swept, row: int, u: float, x: float, y: float, z: float) -> tuple[float, float]:
    """As `shaped_depth`, for any tube."""
    if tube.uniform:
        deep = tube.axis[row, 7] - radial_distance(tube.axis, tube.step, row, u, x, y, z)
        return deep, deep
    return shaped_depth(tube, row, u, x, y, z)


@compiled
def settle(axis: Floats, low: int, high: int, x: float, y: float, z: float) -> tuple[int, float, int]:
    """As `locate`, for a point anywhere: the segment beside the nearest of the axis points low ... high."""
    best, row = np.inf, low
    for i in range(low, high + 1):
        square = (x - axis[i, 0]) ** 2 + (y - axis[i, 1]) ** 2 + (z - axis[i, 2]) ** 2
        if square < best:
            best, row = square, i
    gap = plane_gap(axis, row, x, y, z)
    if gap < 0.0:
        if row == low:
            return row, 0.0, BEFORE_START if row == 0 else NOT_BEYOND
        row -= 1
        near, far = plane_gap(axis, row, x, y, z), gap
    else:
        if row == high:
            return row - 1, 1.0, BEHIND_END if row == len(axis) - 1 and gap > 0.0 else NOT_BEYOND
        near, far = gap, plane_gap(axis, row + 1, x, y, z)
    # Far outside, past the centre of curvature, the planes cross and enclose nothing.
    if near <= 0.0:
        return row, 0.0, NOT_BEYOND
    if far >= 0.0:
        return row, 1.0, NOT_BEYOND
    return row, near / (near - far), NOT_BEYOND


@compiled
def trace(
    tube: Swept, row: int, x: float, y: float, z: float, dx: float, dy: float, dz: float, reach: float
) -> float:
    """Distance to the wall along a ray from an inner point, by sphere tracing (m).

    The ray goes from free sphere to free sphere, each time a little past it, until it is behind the wall; the
    place where it passed is then interpolated in that last little stretch. A ray that leaves through an open
    end has no wall before it and reads `reach`.

    Args:
        tube: the tube.
        row: segment of the origin, from `locate`.
        x, y, z: origin (m), inside of the tube.
        dx, dy, dz: unit direction.
        reach: returned where no wall is nearer (m).
    """
    axis, step, uniform = tube.axis, tube.step, tube.uniform
    t = 0.0
    row, u, _ = locate(axis, row, x, y, z)
    _, free = depth(tube, row, u, x, y, z)
    while True:
        low = t + max(free, 0.0)
        if not low < reach:
            return reach if low >= reach else np.nan  # not a number in, not a number out
        t = min(low + OVERSTEP * axis[row, 7], reach)
        px, py, pz = x + t * dx, y + t * dy, z + t * dz
        row, u, beyond = locate(axis, row, px, py, pz)
        if beyond != NOT_BEYOND:
            return reach
        if uniform:
            deep = axis[row, 7] - radial_distance(axis, step, row, u, px, py, pz)
            free = deep
        else:
            deep, free = shaped_depth(tube, row, u, px, py, pz)
        if deep < 0.0:
            px, py, pz = x + low * dx, y + low * dy, z + low * dz
            row, u, _ = locate(axis, row, px, py, pz)
            before, _ = depth(tube, row, u, px, py, pz)
            if before <= 0.0:
                return low
            return float(low + (t - low) * before / (before - deep))
        if t >= reach:
            return reach


@compiled
def cast(
    tube: Swept, row: int, x: float, y: float, z: float, dx: float, dy: float, dz: float, reach: float
) -> tuple[float, int]:
    """As `trace`, from anywhere: also returns the segment of the origin, for the next ray from near by.

    An origin outside of the wall reads 0. One that lies beyond an end plane is in the open: it sees the
    inside of the tube where the ray enters it through its mouth, and nothing elsewhere.
    """
    axis = tube.axis
    row, u, beyond = locate(axis, row, x, y, z)
    if beyond != NOT_BEYOND or not depth(tube, row, u, x, y, z)[0] >= 0.0:
        # The walk may have begun far away and have ended in the wrong bend.
        row, u, beyond = settle(axis, 0, len(axis) - 1, x, y, z)
        if beyond == NOT_BEYOND and depth(tube, row, u, x, y, z)[0] < 0.0:
            return 0.0, row
    if beyond == NOT_BEYOND:
        return trace(tube, row, x, y, z, dx, dy, dz, reach), row
    end = row if beyond == BEFORE_START else row + 1
    gap = plane_gap(axis, end, x, y, z)
    rate = dx * axis[end, 3] + dy * axis[end, 4] + dz * axis[end, 5]
    if gap * rate >= 0.0 or -gap / rate >= reach:
        return reach, row
    t = -gap / rate
    px, py, pz = x + t * dx, y + t * dy, z + t * dz
    if depth(tube, row, u, px, py, pz)[0] < 0.0:
        return reach, row
    return t + trace(tube, row, px, py, pz, dx, dy, dz, reach - t), row


@compiled
def wall_gap(tube: Swept, s: float, angle: float, x: float, y: float, z: float) -> float:
    """Squared distance (m²) of a point from the wall point at arc length `s` and `angle`."""
    row, u = place(tube.axis, tube.step, s)
    qx, qy, qz = axis_point(tube.axis, tube.step, row, u)
    nx, ny, nz, bx, by, bz = section_axes(tube, row, u)
    c, b = np.cos(angle), np.sin(angle)
    r = mean_radius(tube.axis, row, u) * section_factor(tube, row, u, c, b)
    gx = x - qx - r * (c * nx + b * bx)
    gy = y - qy - r * (c * ny + b * by)
    gz = z - qz - r * (c * nz + b * bz)
    return float(gx * gx + gy * gy + gz * gz)


@compiled
def nearest_wall(tube: Swept, s: float, x: float, y: float, z: float) -> float:
    """Distance (m) from a point to the wall of a tube that is not uniform.

    The nearest of COARSE_ANGLES wall points in the point's own section is refined along the section and along
    the axis in turn, by parabolas through three points.
    """
    angle, best = 0.0, np.inf
    for i in range(COARSE_ANGLES):
        trial = 2.0 * np.pi * i / COARSE_ANGLES
        gap = wall_gap(tube, s, trial, x, y, z)
        if gap < best:
            best, angle = gap, trial
    row, u = place(tube.axis, tube.step, s)
    width = 2.0 * np.pi / COARSE_ANGLES
    length = 0.5 * mean_radius(tube.axis, row, u)
    for _ in range(REFINEMENTS):
        for ds, da in ((0.0, width), (length, 0.0)):
            left = wall_gap(tube, s - ds, angle - da, x, y, z)
            right = wall_gap(tube, s + ds, angle + da, x, y, z)
            bend = left + right - 2.0 * best
            shift = 0.5 * (left - right) / bend if bend > 0.0 else np.sign(left - right)
            shift = min(max(shift, -1.0), 1.0)
            gap = wall_gap(tube, s + shift * ds, angle + shift * da, x, y, z)
            if gap < best:
                best, s, angle = gap, s + shift * ds, angle + shift * da
        width *= REFINEMENT_SHRINK
        length *= REFINEMENT_SHRINK
    return float(np.sqrt(best))
