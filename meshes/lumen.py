"""The free space inside of a wall, as balls that hold no wall and the ways between them.

Points of the wall are drawn, a ray goes from each to both sides, and the middle of every chord that
ends at a wall again is the centre of a ball: its radius is the distance to the nearest wall. Balls whose
surroundings are mostly wall are enclosed: they lie in a tube, not beside it. Two balls are joined where they touch
and the way between them is free and enclosed. No grid is laid, so that neither the unit nor the length of a tube
matters, and triangles may be as long as the tube.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array  # type: ignore[import-untyped]
from scipy.sparse.csgraph import connected_components, dijkstra  # type: ignore[import-untyped]
from scipy.spatial import cKDTree  # type: ignore[import-untyped]

from meshes.embree import RayScene
from meshes.geometry import Floats

Ints = NDArray[np.int64]

CHORDS: Final = 20_000
"""Points of the wall from which chords are cast, to both sides."""
SLANTED: Final = 0.5
"""Share of the chords that leave the wall in any direction, and not along its normal: the normals of a star's
corners all miss its middle."""
LOOKS: Final = 42
"""Directions in which a ball looks around."""
FEW_LOOKS: Final = 26
"""The same where many places look around."""
REACH: Final = 6.5
"""A wall further away than so many radii does not enclose a ball."""
ENCLOSED: Final = 0.7
"""Fraction of the looks that an enclosed ball has walls in. In a trough half of them leave; at the mouth of a tube
half, one radius inside of it 15 %."""
MOUTH: Final = 0.5
"""The same where a tube ends: half of the sky."""
SPACING: Final = 0.5
"""Side of the cells that hold one ball each, over the power of 2 at or below the radius."""
NEIGHBOURS: Final = 16
"""Balls that each is joined with at most, of its own choice."""
LARGER: Final = 2
"""Larger ones that each is joined with at most."""
TOUCH: Final = 1.2
"""Balls are joined up to this distance, over the sum of their radii."""
BAND: Final = 0.2
"""Balls smaller than this share of the large ones are cracks and corners, and wait until the large ones have
turned out to be no tube."""
BANDS: Final = 4
"""Sizes of space that are tried, from the largest on."""
MOST_BALLS: Final = 20_000

ELONGATED: Final = 2.5
"""A space whose length is less than so many of its largest radii is a hollow, not a tube: a cube has 2.3."""
FLAT: Final = 6.0
"""In a flat space, as between two surfaces, half of the balls lie further than so many radii from the way."""
SEALED: Final = 0.9
"""Median enclosure of a tube without gaps; between the turns of a coil it is less."""
COMPARABLE: Final = 0.5
"""Of several spaces only those that are at least so long, over the longest, are likely to be meant."""
END: Final = 2.0
"""The end of a space is what lies within so many radii of its last ball, along the way there."""
CROSSINGS: Final = 8
"""Walls that are counted along a look at most."""
DEPTH_SAMPLES: Final = 32


@dataclass(frozen=True)
class Balls:
    """N balls of free space."""

    centres: Floats  # (N, 3)
    """Metres, world frame."""
    radii: Floats  # (N,)
    """Distance to the nearest wall (m), by rays: a little too long where the wall is rough."""
    enclosure: Floats  # (N,)
    """Fraction of the looks that meet a wall within `REACH` radii."""

    def __len__(self) -> int:
        return len(self.radii)

    def take(self, kept: Ints) -> Balls:
        """Some of the balls."""
        return Balls(self.centres[kept], self.radii[kept], self.enclosure[kept])


@dataclass(frozen=True)
class Lumen:
    """Enclosed space in one piece: N balls, and the ways between those that touch."""

    balls: Balls
    lengths: csr_array
    """(N, N), upper triangle: distance between joined balls (m)."""
    clearances: csr_array
    """(N, N), upper triangle: radius that is free on the way between them (m)."""
    way: Ints
    """The balls on the way between the two that are furthest apart."""
    length: float
    """Of this way (m)."""
    radius: float
    """Median radius of the balls on it (m)."""
    depth: float
    """Walls between it and the outside."""

    @property
    def sealed(self) -> bool:
        """Whether it has walls all around."""
        return bool(np.median(self.balls.enclosure[self.way]) >= SEALED)


def sphere(count: int) -> Floats:
    """Unit vectors (count, 3) evenly over the sphere, on a spiral."""
    i = np.arange(count) + 0.5
    z = 1.0 - 2.0 * i / count
    turn = np.pi * (1.0 + 5.0**0.5) * i
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)


def look_around(scene: RayScene, points: Floats, count: int = LOOKS) -> Floats:
    """Distance to the wall (N, count) in directions evenly over the sphere, infinite where there is none."""
    directions = np.tile(sphere(count), (len(points), 1))
    return scene.distances(np.repeat(points, count, axis=0), directions, np.inf).reshape(-1, count)


def enclosure(looks: Floats, radii: Floats) -> Floats:
    """Fraction (N,) of the looks (N, K) that meet a wall within `REACH` radii (N,)."""
    fraction: Floats = (looks < REACH * radii[:, None]).mean(axis=1)
    return fraction


def draw_balls(scene: RayScene, vertices: Floats, faces: NDArray[np.int32]) -> Balls:
    """Balls around the middles of chords of a wall (V, 3), (F, 3), enclosed or not; there may be none."""
    centres = _middles_of_chords(scene, vertices, faces)
    looks = look_around(scene, centres)
    radii = looks.min(axis=1, initial=np.inf)
    balls = Balls(centres, radii, enclosure(looks, radii))
    return balls.take(np.flatnonzero(np.isfinite(radii) & (radii > 0.0)))


def find_lumens(scene: RayScene, balls: Balls, band: int) -> list[Lumen]:
    """The elongated spaces among the balls of one size, 0 for the largest, the most likely tube first.

    Long ones come before short ones, sealed ones before the core of a coil, and those behind more walls before
    others: the pipe before the gap between pipe and jacket.
    """
    kept = balls.take(np.flatnonzero(balls.enclosure >= ENCLOSED))
    for _ in range(band):
        if len(kept):
            large, kept = _split(kept)
            kept = kept.take(_apart_from(scene, kept, large))
    if not len(kept):
        return []
    balls = _split(kept)[0]
    lengths, clearances = _join(scene, balls)
    _, labels = connected_components(lengths, directed=False)
    lumens = []
    for label in np.flatnonzero(np.bincount(labels) > 2):
        piece = np.flatnonzero(labels == label)
        rows = lengths[piece][:, piece], clearances[piece][:, piece]
        lumen = _measure(scene, balls.take(piece), *rows)
        if lumen is not None:
            lumens.append(lumen)
    long = COMPARABLE * max((lumen.length for lumen in lumens), default=0.0)
    return sorted(
        lumens, key=lambda lumen: (lumen.length < long, not lumen.sealed, -lumen.depth, -lumen.length)
    )


def furthest_ball(lumen: Lumen, ball: int) -> int:
    """The ball in the middle of the end of the space that is the longest way from one ball."""
    reached = dijkstra(lumen.lengths, directed=False, indices=ball)
    end = np.flatnonzero(reached >= reached.max() - END * lumen.radius)
    aside = np.linalg.norm(lumen.balls.centres[end] - lumen.balls.centres[end].mean(axis=0), axis=1)
    return int(end[np.argmin(aside)])


def shortest_way(lumen: Lumen, start: int, end: int) -> Ints:
    """Balls along the way from one to another that is short and keeps clear of the wall."""
    return _way(lumen.lengths, lumen.clearances, start, end)


def _middles_of_chords(scene: RayScene, vertices: Floats, faces: NDArray[np.int32]) -> Floats:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    doubled = np.linalg.norm(across, axis=1)
    solid = doubled > 0.0
    if not solid.any():
        return np.empty((0, 3))
    # Half by area and half by number: a pipe in a hall has little area, and small triangles.
    shares = 0.5 * doubled / doubled.sum() + 0.5 * solid / solid.sum()
    rng = np.random.default_rng(0)  # the same centreline whenever it is asked for
    drawn = np.searchsorted(np.cumsum(shares), (np.arange(CHORDS) + rng.random(CHORDS)) / CHORDS)
    drawn = np.minimum(drawn, np.flatnonzero(solid)[-1])
    u, v = rng.random((2, CHORDS, 1))
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    points = a[drawn] + u * (b - a)[drawn] + v * (c - a)[drawn]
    normals = across[drawn] / doubled[drawn, None]

    off = 3e-6 * float(np.linalg.norm(np.ptp(vertices, axis=0)))  # beyond what single precision confuses
    origins = np.concatenate([points + off * normals, points - off * normals])
    directions = np.concatenate([normals, -normals])
    aside = rng.normal(size=directions.shape)
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    slanted = rng.random(len(directions)) < SLANTED
    directions[slanted] += aside[slanted]  # by Lambert's law
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    chords = scene.distances(origins, directions, np.inf)
    ended = np.isfinite(chords) & (chords > 10.0 * off)
    middles: Floats = origins[ended] + 0.5 * chords[ended, None] * directions[ended]
    return middles


def _split(balls: Balls) -> tuple[Balls, Balls]:
    """The large balls, thinned out, and the small ones."""
    large = balls.radii >= BAND * np.quantile(balls.radii, 0.95)
    return _thin(balls.take(np.flatnonzero(large))), balls.take(np.flatnonzero(~large))


def _apart_from(scene: RayScene, small: Balls, large: Balls) -> Ints:
    """Indices of the small balls that are not in the corners of the space that the large ones fill."""
    if not len(small):
        return np.empty(0, dtype=np.int64)
    # A small tube in a hall is missed by most looks of a large ball, but the wall around a small ball is near.
    distance, nearest = cKDTree(small.centres).query(large.centres, k=min(4, len(small)))
    distance, nearest = distance.reshape(len(large), -1), nearest.reshape(len(large), -1)
    radii = np.minimum(large.radii, (distance + small.radii[nearest]).min(axis=1))
    distance, nearest = cKDTree(large.centres).query(small.centres, k=min(4, len(large)))
    distance, nearest = distance.reshape(len(small), -1), nearest.reshape(len(small), -1)
    beside = distance < small.radii[:, None] + radii[nearest]
    ball, k = np.nonzero(beside)
    beside[ball, k] = ~scene.blocked(small.centres[ball], large.centres[nearest[ball, k]])
    return np.flatnonzero(~beside.any(axis=1))


def _thin(balls: Balls) -> Balls:
    """The largest ball in every cell; cells grow with the balls in them."""
    largest_first = np.argsort(-balls.radii, kind="stable")
    level = np.floor(np.log2(balls.radii[largest_first]))
    cells = np.floor(balls.centres[largest_first] / (SPACING * 2.0 ** level[:, None]))
    _, first = np.unique(np.column_stack([level, cells]), axis=0, return_index=True)
    return balls.take(np.sort(largest_first[np.sort(first)[:MOST_BALLS]]))


def _join(scene: RayScene, balls: Balls) -> tuple[csr_array, csr_array]:
    """Lengths and clearances of the ways between balls that touch, (N, N), upper triangle."""
    count, centres, radii = len(balls), balls.centres, balls.radii
    other = cKDTree(centres).query(centres, k=min(NEIGHBOURS + 1, count))[1]
    pairs = np.sort(np.stack([np.repeat(np.arange(count), other.shape[-1]), other.ravel()], axis=1), axis=1)
    pairs = np.concatenate([pairs, _with_larger(balls)])
    distance = np.linalg.norm(centres[pairs[:, 0]] - centres[pairs[:, 1]], axis=1)
    near = (pairs[:, 0] != pairs[:, 1]) & (distance < TOUCH * radii[pairs].sum(axis=1))
    i, j = np.unique(pairs[near], axis=0).T
    seen = ~scene.blocked(centres[i], centres[j])
    i, j = i[seen], j[seen]
    looks = look_around(scene, 0.5 * (centres[i] + centres[j]), FEW_LOOKS)
    smaller = np.minimum(radii[i], radii[j])
    inside = enclosure(looks, smaller) >= MOUTH
    i, j, clear = i[inside], j[inside], np.minimum(looks.min(axis=1, initial=np.inf), smaller)[inside]
    length = np.linalg.norm(centres[j] - centres[i], axis=1)
    return (
        csr_array((length, (i, j)), shape=(count, count)),
        csr_array((clear, (i, j)), shape=(count, count)),
    )


def _with_larger(balls: Balls) -> Ints:
    """Pairs (K, 2) of balls with the nearest of those larger by a level of cells, which their like may hide."""
    level = np.floor(np.log2(balls.radii))
    pairs = [np.empty((0, 2), dtype=np.int64)]
    for lower in np.unique(level)[:-1]:
        small, large = np.flatnonzero(level == lower), np.flatnonzero(level > lower)
        nearest = cKDTree(balls.centres[large]).query(balls.centres[small], k=min(LARGER, len(large)))[1]
        nearest = nearest.reshape(len(small), -1)
        pairs.append(np.stack([np.repeat(small, nearest.shape[1]), large[nearest.ravel()]], axis=1))
    return np.sort(np.concatenate(pairs), axis=1)


def _measure(scene: RayScene, balls: Balls, lengths: csr_array, clearances: csr_array) -> Lumen | None:
    """A space in one piece, or None where it is no tube: a hollow, or flat."""
    end = _furthest(lengths, _furthest(lengths, 0))
    way = _way(lengths, clearances, end, _furthest(lengths, end))
    radius = float(np.median(balls.radii[way]))
    length = float(np.linalg.norm(np.diff(balls.centres[way], axis=0), axis=1).sum())
    if length < ELONGATED * balls.radii.max():
        return None
    aside, nearest = cKDTree(balls.centres[way]).query(balls.centres)
    if np.median(aside / balls.radii[way][nearest]) > FLAT:
        return None
    few = way[:: max(len(way) // DEPTH_SAMPLES, 1)]
    return Lumen(balls, lengths, clearances, way, length, radius, _depth(scene, balls.centres[few], radius))


def _furthest(lengths: csr_array, ball: int) -> int:
    reached = dijkstra(lengths, directed=False, indices=ball)
    return int(np.argmax(np.where(np.isfinite(reached), reached, -1.0)))


def _way(lengths: csr_array, clearances: csr_array, start: int, end: int) -> Ints:
    costs = lengths.copy()
    # As long again where only the usual clearance is free: a detour of a tenth is taken to keep off the wall.
    usual = float(np.median(clearances.data)) if clearances.nnz else 1.0
    costs.data = lengths.data * (1.0 + usual / clearances.data)
    before = dijkstra(costs, directed=False, indices=start, return_predecessors=True)[1]
    way = [end]
    while way[-1] != start:
        way.append(int(before[way[-1]]))
    return np.array(way[::-1])


def _depth(scene: RayScene, points: Floats, radius: float) -> float:
    """Walls between points (P, 3) and the outside: as many on a quarter of the looks, as some leave by mouths.

    Walls closer to each other than a thousandth of the radius (m) count as one.
    """
    count = len(points)
    directions = np.tile(sphere(FEW_LOOKS), (count, 1))
    origins = np.repeat(points, FEW_LOOKS, axis=0)
    walls = np.zeros(len(origins))
    on = np.arange(len(origins))
    for _ in range(CROSSINGS):
        distances = scene.distances(origins[on], directions[on], np.inf)
        met = np.isfinite(distances)
        on = on[met]
        walls[on] += 1
        origins[on] += (distances[met, None] + 1e-3 * radius) * directions[on]
    return float(np.median(np.quantile(walls.reshape(count, -1), 0.25, axis=1)))
