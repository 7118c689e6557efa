"""The free space inside of a wall, as a graph of balls that hold no wall.

Points of the wall are drawn evenly by area, a ray goes from each into both half spaces, and the middle of every
chord that ends at a wall again is the centre of a ball: its radius is the distance to the nearest wall. Balls
whose surroundings are mostly wall are enclosed: they lie in a tube, not beside it. Two balls are joined where
they touch and the way between them is free. No grid is laid, so that neither the unit nor the length of a tube
matters, and triangles may be as long as the tube.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array  # type: ignore[import-untyped]
from scipy.spatial import cKDTree  # type: ignore[import-untyped]

from meshes.embree import RayScene
from meshes.geometry import Floats

Ints = NDArray[np.int64]

CHORDS = 20_000
"""Points of the wall from which chords are cast, to both sides."""
LOOKS = 42
"""Directions in which a ball looks around."""
REACH = 8.0
"""A wall further away than so many radii does not enclose a ball."""
ENCLOSED = 0.7
"""Fraction of the looks that an enclosed ball has walls in."""
MOUTH = 0.5
"""The same where a tube ends: half of the sky."""
SPACING = 0.5
"""Cells that hold one ball each, over the radius (a power of 2 at or below it)."""
NEIGHBOURS = 16
FEW_LOOKS = 26
"""Directions of a look around where many are wanted."""
LEAVING = 128
"""Looks out of each ball that are asked whether they leave the tube."""
MOST_LEAVING = 1500
"""Looks that are followed at most."""
LEAST_SHARE = 0.2
"""Balls smaller than this share of the large ones are cracks and corners."""
MOST_BALLS = 20_000


@dataclass(frozen=True)
class Balls:
    """N balls of free space inside of the wall, and which of them are joined."""

    centres: Floats  # (N, 3)
    """Metres, world frame."""
    radii: Floats  # (N,)
    """Distance to the nearest wall (m), by rays: a little too long where the wall is rough."""
    enclosure: Floats  # (N,)
    """Fraction of the looks that meet a wall within `REACH` radii."""
    ways: csr_array
    """(N, N), symmetric: cost of the way between joined balls, its length over the narrowest radius on it."""
    lengths: csr_array
    """(N, N), symmetric: length of the same ways (m)."""


def sphere(count: int) -> Floats:
    """Unit vectors (count, 3) evenly over the sphere, on a spiral."""
    i = np.arange(count) + 0.5
    z = 1.0 - 2.0 * i / count
    turn = np.pi * (1.0 + 5.0**0.5) * i
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)


def look_around(scene: RayScene, points: Floats, count: int = LOOKS) -> Floats:
    """Distance to the wall (N, count) in directions evenly over the sphere, infinite where there is none."""
    directions = sphere(count)
    distances = scene.distances(
        np.repeat(points, count, axis=0), np.tile(directions, (len(points), 1)), np.inf
    )
    return distances.reshape(-1, count)


def enclosure(looks: Floats, radii: Floats) -> Floats:
    """Fraction (N,) of the looks (N, K) that meet a wall within `REACH` radii (N,)."""
    fraction: Floats = (looks < REACH * radii[:, None]).mean(axis=1)
    return fraction


def find_balls(scene: RayScene, vertices: Floats, faces: NDArray[np.int32]) -> Balls:
    """Fill the enclosed space of a wall (V, 3), (F, 3) with balls; there may be none."""
    centres = _middles_of_chords(scene, vertices, faces)
    looks = look_around(scene, centres)
    radii = looks.min(axis=1, initial=np.inf)
    enclosed = enclosure(looks, radii)
    kept = np.flatnonzero((enclosed >= ENCLOSED) & np.isfinite(radii) & (radii > 0.0))
    if len(kept):
        kept = kept[radii[kept] >= LEAST_SHARE * np.quantile(radii[kept], 0.95)]
    kept = kept[_thin(centres[kept], radii[kept])]
    centres, radii, enclosed = centres[kept], radii[kept], enclosed[kept]
    ways, lengths = _join(scene, centres, radii)
    return Balls(centres, radii, enclosed, ways, lengths)


def _middles_of_chords(scene: RayScene, vertices: Floats, faces: NDArray[np.int32]) -> Floats:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    doubled = np.linalg.norm(across, axis=1)
    total = doubled.sum()
    if not total > 0.0:
        return np.empty((0, 3))
    rng = np.random.default_rng(0)  # the same centreline whenever it is asked for
    drawn = np.searchsorted(np.cumsum(doubled) / total, (np.arange(CHORDS) + rng.random(CHORDS)) / CHORDS)
    drawn = np.minimum(drawn, len(faces) - 1)
    u, v = rng.random((2, CHORDS, 1))
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    points = a[drawn] + u * (b - a)[drawn] + v * (c - a)[drawn]
    normals = across[drawn] / np.maximum(doubled[drawn], 1e-300)[:, None]

    off = 3e-6 * float(np.linalg.norm(np.ptp(vertices, axis=0)))  # beyond what single precision confuses
    origins = np.concatenate([points + off * normals, points - off * normals])
    directions = np.concatenate([normals, -normals])
    chords = scene.distances(origins, directions, np.inf)
    ended = np.isfinite(chords) & (chords > 10.0 * off)
    middles: Floats = origins[ended] + 0.5 * chords[ended, None] * directions[ended]
    return middles


def _thin(centres: Floats, radii: Floats) -> Ints:
    """Indices of the largest ball in every cell; cells grow with the balls in them."""
    largest_first = np.argsort(-radii, kind="stable")
    level = np.floor(np.log2(radii[largest_first]))
    cells = np.floor(centres[largest_first] / (SPACING * 2.0 ** level[:, None]))
    _, first = np.unique(np.column_stack([level, cells]), axis=0, return_index=True)
    kept = np.sort(largest_first[np.sort(first)[:MOST_BALLS]])
    return kept.astype(np.int64)


def _join(scene: RayScene, centres: Floats, radii: Floats) -> tuple[csr_array, csr_array]:
    count = len(centres)
    if count < 2:
        return csr_array((count, count)), csr_array((count, count))
    distance, other = cKDTree(centres).query(centres, k=min(NEIGHBOURS + 1, count))
    i = np.repeat(np.arange(count), other.shape[1])
    j, length = other.ravel(), distance.ravel()
    near = (i < j) | ~(other[j] == i[:, None]).any(axis=1)
    near &= (i != j) & (length < 1.2 * (radii[i] + radii[j]))
    i, j, length = i[near], j[near], length[near]
    seen = ~scene.blocked(centres[i], centres[j])
    i, j, length = i[seen], j[seen], length[seen]
    looks = look_around(scene, 0.5 * (centres[i] + centres[j]), FEW_LOOKS)
    clear = np.minimum(looks.min(axis=1), np.minimum(radii[i], radii[j]))
    inside = enclosure(looks, np.minimum(radii[i], radii[j])) >= MOUTH
    i, j, length, clear = i[inside], j[inside], length[inside], clear[inside]
    ways = csr_array((length / clear, (i, j)), shape=(count, count))
    lengths = csr_array((length, (i, j)), shape=(count, count))
    return (ways + ways.T).tocsr(), (lengths + lengths.T).tocsr()


def leave(scene: RayScene, centres: Floats, radii: Floats) -> tuple[Floats, Floats, Ints]:
    """Where looks out of balls leave their tube, (K, 3), their directions (K, 3), and their balls (K,).

    A look that meets no wall within `REACH` radii is followed until half of the sky is open.
    """
    looks = look_around(scene, centres, LEAVING)
    ball, look = np.nonzero(looks >= REACH * radii[:, None])
    chosen = np.unique(np.linspace(0, len(ball) - 1, min(MOST_LEAVING, len(ball))).astype(np.int64))
    ball, look = ball[chosen], look[chosen]
    way, reach = sphere(LEAVING)[look], radii[ball]
    left_after = np.full(len(ball), np.inf)
    for t in np.arange(0.0, REACH, 0.25):
        on = np.flatnonzero(np.isinf(left_after))
        points = centres[ball[on]] + (t * reach[on])[:, None] * way[on]
        around = look_around(scene, points, FEW_LOOKS)
        left_after[on[enclosure(around, reach[on]) < MOUTH]] = t
    left = np.isfinite(left_after)
    points = centres[ball[left]] + (left_after[left] * reach[left])[:, None] * way[left]
    return points, way[left], ball[left]
