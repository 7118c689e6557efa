"""Cross sections of a wall: rings of exact rays across an axis, and what they say of shape and centre."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshes.curves import arc_lengths
from meshes.embree import RayScene
from meshes.geometry import Floats
from meshes.swept import minimal_frame

RING = 48
"""Rays of a ring."""
WINDOW = 3.0
"""A ray is compared with its own like within so many radii along the axis, ahead and behind."""
SIDEWAYS = 1.5
"""A ray longer than so many times the median of its like looks into a side branch or out of a hole."""


@dataclass(frozen=True)
class Rings:
    """Wall distances around M points of an axis, in its rotation-minimising frame."""

    normals: Floats  # (M, 3)
    """Unit normals from which angles are measured."""
    binormals: Floats  # (M, 3)
    distances: Floats  # (M, RING)
    """To the first wall (m), infinite where there is none."""

    @property
    def hits(self) -> Floats:
        """Fraction of the rays that meet a wall, (M,)."""
        hits: Floats = np.isfinite(self.distances).mean(axis=1)
        return hits

    @property
    def mean(self) -> Floats:
        """Mean of the distances that meet a wall (m), (M,); NaN where none does."""
        met = np.isfinite(self.distances)
        total: Floats = np.where(met, self.distances, 0.0).sum(axis=1)
        with np.errstate(invalid="ignore"):
            mean: Floats = total / met.sum(axis=1)
        return mean

    @property
    def directions(self) -> Floats:
        """Unit vectors of all rays (M, RING, 3)."""
        return ring_directions(self.normals, self.binormals)


def ring_directions(normals: Floats, binormals: Floats) -> Floats:
    """Unit vectors (M, RING, 3) evenly around M axis points, from the normal towards the binormal."""
    angle = 2.0 * np.pi * np.arange(RING) / RING
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    directions: Floats = cos * normals[:, None] + sin * binormals[:, None]
    return directions


def measure_rings(scene: RayScene, points: Floats, tangents: Floats) -> Rings:
    """Cast a ring of rays across the axis at every point (M, 3) with unit tangent (M, 3)."""
    normals = minimal_frame(points, tangents)
    binormals = np.cross(tangents, normals)
    directions = ring_directions(normals, binormals).reshape(-1, 3)
    distances = scene.distances(np.repeat(points, RING, axis=0), directions, np.inf)
    return Rings(normals, binormals, distances.reshape(-1, RING))


def close_sideways(distances: Floats, step: float) -> Floats:
    """Distances (M, RING) with side branches and holes closed, all finite.

    A ray that is much longer than rays of the same angle nearby, or endless, takes the length at which it would
    no longer stand out: their median over `WINDOW` radii ahead and behind. Rings stand `step` radii apart.
    """
    reach = max(round(WINDOW / step), 1)
    padded = np.pad(distances, ((reach, reach), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=0)
    # A dozen rows of the window are enough for a median.
    typical = np.median(windows[:, :, :: max(reach // 6, 1)], axis=2)
    in_ring = np.median(distances, axis=1, keepdims=True)
    met = distances[np.isfinite(distances)]
    anywhere = np.median(met) if len(met) else 0.0
    typical = np.where(np.isfinite(typical), typical, np.where(np.isfinite(in_ring), in_ring, anywhere))
    closed: Floats = np.where(distances > SIDEWAYS * typical, typical, distances)
    return closed


def offsets_of_centres(rings: Rings, distances: Floats) -> Floats:
    """How far (m), (M, 3), the centre of each section lies from where its ring stands, to first order.

    The centre is where the wall distance (M, RING) has no first harmonic over the angle: for a round, elliptic or
    lobed section that is the axis it was drawn around. A ring that stands off it by d sees -d cos(angle) more.
    """
    first: Floats = 2.0 * (distances[:, :, None] * rings.directions).mean(axis=1)
    return first


def resample_evenly(points: Floats, step: float) -> Floats:
    """Points (M, 3), M >= 5, at even arc lengths along a polyline (P, 3), no further apart than `step` (m)."""
    along = arc_lengths(points)
    count = max(int(np.ceil(along[-1] / step)), 4)
    wanted = np.linspace(0.0, along[-1], count + 1)
    return np.stack([np.interp(wanted, along, points[:, k]) for k in range(3)], axis=1)


def mean_radius(scene: RayScene, axis: Floats, tangents: Floats) -> float:
    """Mean wall distance (m) over the sections of an evenly sampled axis (M, 3), side branches closed."""
    rings = measure_rings(scene, axis, tangents)
    met = rings.distances[np.isfinite(rings.distances)]
    step = float(np.linalg.norm(axis[1] - axis[0]) / np.median(met))
    return float(close_sideways(rings.distances, step).mean())
