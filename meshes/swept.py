"""A tube swept along a curve: its axis, a frame that does not twist, and its section along it.

The wall at arc length s and angle θ stands at the distance

    r(s, θ) = R(s) (1 + Σ_k a_k(s) cos kθ + b_k(s) sin kθ),  k = 2, 3, ...

from the axis, with θ measured from the frame's normal towards tangent x normal. The harmonics have no mean,
so that R(s) is the mean wall distance; k = 2 makes the section elliptic, 3 and above give it lobes (k = 1
would move the section off its axis). The paper's tubes are round; the harmonics go beyond it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshes.compiled import compiled
from meshes.curves import Curve
from meshes.errors import CurveError
from meshes.geometry import Floats


@dataclass(frozen=True, eq=False)
class SweptTube:
    """A tube as perception sees it, sampled at a uniform step of arc length and linear in between."""

    points: Floats  # (M, 3)
    """Points of the axis (m), world frame."""
    step: float
    """Arc length between two successive points (m)."""
    tangents: Floats  # (M, 3)
    """Unit tangents of the axis, towards the end."""
    normals: Floats  # (M, 3)
    """Unit normals of the rotation-minimising frame, from which angles are measured."""
    radius: Floats  # (M,)
    """Mean radius R (m)."""
    harmonics: Floats  # (M, H, 2)
    """Amplitudes (a_k, b_k) of the section over R, k = 2 ... H + 1; H = 0 for a round tube."""

    @property
    def length(self) -> float:
        """Arc length of the axis (m)."""
        return self.step * (len(self.points) - 1)

    @property
    def arc_length(self) -> Floats:
        """Arc length of each axis point (m), (M,)."""
        return self.step * np.arange(len(self.points), dtype=np.float64)

    def section(self, angles: Floats) -> Floats:
        """Wall distance r (m) at every axis point, (M, K), for angles (K,) in radians."""
        order = np.arange(2, self.harmonics.shape[1] + 2)[:, None]
        waves = np.stack([np.cos(order * angles), np.sin(order * angles)], axis=1)  # (H, 2, K)
        shape: Floats = 1.0 + np.tensordot(self.harmonics, waves, axes=([1, 2], [0, 1]))
        return self.radius[:, None] * shape


def circular(curve: Curve, radius: float | Floats = 1.0) -> SweptTube:
    """A round tube along `curve`; `radius` (m) is one number, or one a point, (M,).

    Raises:
        CurveError: see `sweep_section`.
    """
    return sweep_section(curve, radius, np.zeros((len(curve.points), 0, 2)))


def sweep_section(curve: Curve, radius: float | Floats, harmonics: Floats) -> SweptTube:
    """A tube along `curve` with a section of its own.

    Args:
        curve: the axis.
        radius: mean radius R (m), one number or (M,).
        harmonics: amplitudes over R, (M, H, 2), or (H, 2) for the same section all along.

    Raises:
        CurveError: the section closes (R or 1 minus the amplitudes is not positive), or the wall folds inside
            of a bend (curvature times the widest wall distance reaches 1).
    """
    count = len(curve.points)
    if curve.points.ndim != 2 or curve.points.shape[1] != 3 or count < 2:
        raise CurveError(f"curve.points: expected (M, 3) with M >= 2 but found {curve.points.shape}")
    points = np.ascontiguousarray(curve.points, dtype=np.float64)
    chords = np.linalg.norm(np.diff(points, axis=0), axis=1)
    if not np.all((chords > 0.6 * curve.step) & (chords < 1.001 * curve.step)):
        raise CurveError(
            f"curve: expected points at a uniform arc length of {curve.step:g} m but found distances from "
            f"{chords.min():g} to {chords.max():g} m; resample it"
        )
    try:
        radii = np.broadcast_to(np.asarray(radius, dtype=np.float64), (count,)).copy()
        shape = np.broadcast_to(harmonics, (count, *np.shape(harmonics)[-2:])).astype(np.float64)
    except ValueError as error:
        raise CurveError(
            f"radius, harmonics: expected one value, or one for each of {count} points"
        ) from error
    if shape.ndim != 3 or shape.shape[2] != 2:
        raise CurveError(f"harmonics: expected (M, H, 2) or (H, 2) but found {np.shape(harmonics)}")
    swing = np.hypot(shape[:, :, 0], shape[:, :, 1]).sum(axis=1)
    if not (np.all(radii > 0.0) and np.all(np.isfinite(radii)) and np.all(swing < 1.0)):
        raise CurveError(
            f"section: expected radii above 0 and amplitudes that sum to less than 1 but found radius "
            f"{radii.min():g} m and amplitudes {swing.max():g}; the tube would be closed"
        )
    tangents = unit_tangents(points)
    fold = segment_curvature(tangents, curve.step) * np.maximum(*_neighbours(radii * (1.0 + swing)))
    if np.any(fold >= 1.0):
        raise CurveError(
            f"axis: expected curvature times wall distance below 1 but found {fold.max():.3f} at "
            f"{curve.step * int(fold.argmax()):.2f} m; the wall folds inside of the bend: widen it or use a "
            "smaller radius"
        )
    return SweptTube(points, float(curve.step), tangents, minimal_frame(points, tangents), radii, shape)


def unit_tangents(points: Floats) -> Floats:
    """Unit tangents (M, 3) of a uniformly sampled curve (M, 3), exact for straight lines and circles."""
    chords = np.diff(points, axis=0)
    chords /= np.linalg.norm(chords, axis=1, keepdims=True)
    tangents = np.empty_like(points)
    tangents[1:-1] = chords[:-1] + chords[1:]
    tangents[1:-1] /= np.linalg.norm(tangents[1:-1], axis=1, keepdims=True)
    # The ends mirror their neighbour's tangent about the chord, as on a circle.
    for end, inner, chord in ((0, 1, 0), (-1, -2, -1)):
        if len(points) == 2:
            tangents[end] = chords[0]
        else:
            along = chords[chord]
            tangents[end] = 2.0 * (along @ tangents[inner]) * along - tangents[inner]
    return tangents


def segment_curvature(tangents: Floats, step: float) -> Floats:
    """Curvature (1/m) of each of the M - 1 segments: the turn of its tangent over its arc length."""
    half_chord = 0.5 * np.linalg.norm(np.diff(tangents, axis=0), axis=1)
    curvature: Floats = 2.0 * np.arcsin(np.minimum(half_chord, 1.0)) / step
    return curvature


def _neighbours(values: Floats) -> tuple[Floats, Floats]:
    return values[:-1], values[1:]


def minimal_frame(points: Floats, tangents: Floats) -> Floats:
    """Normals (M, 3) of a rotation-minimising frame, by double reflection.

    Source: Wang, Jüttler, Zheng, Liu, "Computation of rotation minimizing frames", ACM TOG 27 (2008).
    """
    normals = np.zeros_like(points)
    normals[0, np.argmin(np.abs(tangents[0]))] = 1.0
    _carry_normal(points, tangents, normals)
    return normals


@compiled
def _carry_normal(points: Floats, tangents: Floats, normals: Floats) -> None:
    """Carries the first row of `normals`, any vector across the first tangent, along the curve."""
    _make_normal(normals[0], tangents[0])
    tangent, mirror = np.empty(3), np.empty(3)
    for i in range(len(points) - 1):
        for k in range(3):
            normals[i + 1, k], tangent[k] = normals[i, k], tangents[i, k]
            mirror[k] = points[i + 1, k] - points[i, k]
        _reflect(normals[i + 1], mirror)
        _reflect(tangent, mirror)
        for k in range(3):
            mirror[k] = tangents[i + 1, k] - tangent[k]
        _reflect(normals[i + 1], mirror)
        _make_normal(normals[i + 1], tangents[i + 1])


@compiled
def _reflect(vector: Floats, mirror: Floats) -> None:
    """Reflects a vector in the plane normal to `mirror`."""
    scale = 2.0 * _dot(vector, mirror) / _dot(mirror, mirror)
    for k in range(3):
        vector[k] -= scale * mirror[k]


@compiled
def _make_normal(vector: Floats, tangent: Floats) -> None:
    """Makes a vector normal to a tangent, and of length 1."""
    along = _dot(vector, tangent)
    for k in range(3):
        vector[k] -= along * tangent[k]
    length = np.sqrt(_dot(vector, vector))
    for k in range(3):
        vector[k] /= length


@compiled
def _dot(a: Floats, b: Floats) -> float:
    # numba's own dot product would need scipy.
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
