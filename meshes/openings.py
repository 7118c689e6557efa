"""Where the space inside of a wall meets the space outside."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.sparse import csr_array  # type: ignore[import-untyped]
from scipy.sparse.csgraph import connected_components, dijkstra  # type: ignore[import-untyped]
from scipy.spatial import cKDTree  # type: ignore[import-untyped]

from meshes.embree import RayScene
from meshes.geometry import Bools, Floats
from meshes.lumen import FEW_LOOKS, MOUTH, REACH, Balls, Ints, Lumen, enclosure, look_around, sphere
from meshes.sections import close_sideways, measure_rings, offsets_of_centres

LOOKS: Final = 256
"""Looks out of each ball that are asked whether they leave the tube."""
BALLS: Final = 400
"""Balls that look around."""
AT_ENDS: Final = 50
"""The same near either end of the space, the largest there."""
CROWDED: Final = 0.5
FURTHEST: Final = 2.5
"""No ball looks around that is nearer to a larger one than so many of its radii, over the ratio of both, and at most
so many: one beside the wall sees a small hole as large."""
FOLLOWED: Final = 2000
"""Looks that are followed until they leave."""
LEAST_LOOKS: Final = 5
"""Looks that leave through an opening at least; fewer leave through a crack."""
BESIDE: Final = 0.4
PENCIL: Final = 6
BEYOND: Final = 0.5
"""A look leaves through a wide place where so many others, so many radii beside it, go so many radii further; else
through a crack, a joint or a small hole."""
APART: Final = 1.5
"""Looks that leave within so many radii of each other, with no wall between them one radius before, leave through
the same opening."""
GOES_ON: Final = 5
"""Balls of the same space in sight in front of an opening that make it none; a few may lie in a corner there."""
NARROW: Final = 0.35
"""An opening narrower than so many radii of the tube, by the looks that leave through it, is a hole in its wall."""
INSIDE: Final = 0.5
"""So many radii inside of an opening its section is measured."""
CENTRED: Final = 8
"""Times that it is moved to the centre of its section."""
SLIT: Final = 9.0
"""An opening longer than so many radii is a slit along the tube."""


@dataclass(frozen=True)
class Opening:
    """An opening of a tube."""

    centre: Floats  # (3,)
    """Metres, world frame."""
    outward: Floats  # (3,)
    """Unit vector."""
    radius: float
    """Mean distance of the wall from the centre (m), just inside; of a hole, about half of its width."""

    def scaled(self, factor: float) -> Opening:
        """The same in a wall that is `factor` times as large, about the origin."""
        return Opening(self.centre * factor, self.outward, self.radius * factor)


def find_openings(scene: RayScene, lumen: Lumen) -> tuple[list[Opening], list[Opening]]:
    """The openings of a space, and the holes and slits in its wall."""
    points, ways, radii, wide = _leave(scene, _large(lumen))
    openings, holes = [], []
    for opening, radius in _bundles(scene, points[wide], ways[wide], radii[wide]):
        if _within(scene, lumen, opening, max(radius, opening.radius)):
            continue
        if NARROW * radius < opening.radius < SLIT * radius:
            openings.append(_in_section(scene, opening, radius))
        else:
            holes.append(opening)
    for hole, radius in _bundles(scene, points[~wide], ways[~wide], radii[~wide]):
        apart = [float(np.linalg.norm(hole.centre - o.centre)) - o.radius for o in (*openings, *holes)]
        if min(apart, default=np.inf) > radius and not _within(scene, lumen, hole, radius):
            holes.append(hole)
    return openings, holes


def _large(lumen: Lumen) -> Balls:
    """Balls that fill their places in a space: some of all, and all near its ends, which see most of the openings."""
    centres, radii = lumen.balls.centres, lumen.balls.radii
    tree, left, kept = cKDTree(centres), np.ones(len(radii), dtype=np.bool_), []
    for ball in np.argsort(-radii, kind="stable"):
        if left[ball]:
            kept.append(ball)
            within = np.array(tree.query_ball_point(centres[ball], FURTHEST * radii[ball]))
            apart = np.linalg.norm(centres[within] - centres[ball], axis=1)
            left[within[apart * radii[within] < CROWDED * radii[ball] ** 2]] = False
    few = np.array(kept)  # the largest first
    ends = cKDTree(centres[few]).query(centres[lumen.way[[0, -1]]], k=min(len(few), BALLS))[1]
    some = np.linspace(0, len(few) - 1, min(len(few), BALLS)).astype(np.int64)
    at_ends = np.sort(ends.reshape(2, -1), axis=1)[:, :AT_ENDS]
    return lumen.balls.take(few[np.union1d(some, at_ends)])


def _bundles(scene: RayScene, points: Floats, ways: Floats, radii: Floats) -> list[tuple[Opening, float]]:
    """Bundles of looks that leave at like places, and the radius of the larger of their balls (m); see `_leave`."""
    if not len(points):
        return []
    i, j = cKDTree(points).query_pairs(APART * float(radii.max()), output_type="ndarray").T
    close = np.linalg.norm(points[i] - points[j], axis=1) < APART * np.maximum(radii[i], radii[j])
    before = points - radii[:, None] * ways
    close[close] = ~scene.blocked(before[i[close]], before[j[close]])
    i, j = i[close], j[close]
    near = csr_array((np.ones(len(i)), (i, j)), shape=(len(points), len(points)))
    labels = connected_components(near, directed=False)[1]
    bundles = []
    for label in np.flatnonzero(np.bincount(labels) >= LEAST_LOOKS):
        at = labels == label
        outward = ways[at].mean(axis=0)
        outward /= np.linalg.norm(outward)
        centre = points[at].mean(axis=0)
        across = points[at] - centre
        across -= (across @ outward)[:, None] * outward
        radius = float(np.sqrt(2.0 * (across**2).sum(axis=1).mean()))
        bundles.append((Opening(centre, outward, radius), float(np.quantile(radii[at], 0.9))))
    return bundles


def _in_section(scene: RayScene, opening: Opening, radius: float) -> Opening:
    """An opening of a space of some radius (m) moved into the centre of the section just inside, with its radius."""
    centre = opening.centre
    for _ in range(CENTRED):
        inside = (centre - INSIDE * radius * opening.outward)[None]
        rings = measure_rings(scene, inside, opening.outward[None])
        if rings.hits[0] < MOUTH:
            return opening
        closed = close_sideways(rings.distances, INSIDE)
        move = offsets_of_centres(rings, closed)
        if scene.blocked(inside, inside + move)[0]:
            return opening
        centre = centre + move[0]
    return Opening(centre, opening.outward, float(closed.mean()))


def _within(scene: RayScene, lumen: Lumen, opening: Opening, radius: float) -> bool:
    """Whether the same space goes on in front of an opening: a hall is so wide that its middle looks open."""
    centres = lumen.balls.centres
    behind = int(np.argmin(np.linalg.norm(centres - opening.centre + radius * opening.outward, axis=1)))
    # Near by way of the space itself: a tube may turn and come back to its own mouth.
    reached = dijkstra(lumen.lengths, directed=False, indices=behind, limit=2.0 * REACH * radius)
    ways = centres - opening.centre
    before = (ways @ opening.outward > radius) & (np.linalg.norm(ways, axis=1) < REACH * radius)
    before &= np.isfinite(reached)
    targets = centres[before]
    seen = ~scene.blocked(np.tile(opening.centre, (len(targets), 1)), targets)
    return int(seen.sum()) >= GOES_ON


def _leave(scene: RayScene, balls: Balls) -> tuple[Floats, Floats, Floats, Bools]:
    """Where looks out of balls leave their space, (L, 3), and their directions (L, 3).

    Looks that meet no wall within `REACH` radii are followed until half of the sky is open. Told with them are the
    radii of their balls (L,) and whether they leave through a wide place, see `BESIDE` (L,).
    """
    ball, look = np.nonzero(look_around(scene, balls.centres, LOOKS) >= REACH * balls.radii[:, None])
    chosen: Ints = np.unique(np.linspace(0, len(ball) - 1, min(FOLLOWED, len(ball))).astype(np.int64))
    ball, look = ball[chosen], look[chosen]
    way, reach = sphere(LOOKS)[look], balls.radii[ball]
    left_after = np.full(len(ball), np.inf)
    for t in np.arange(0.0, REACH, 0.25):
        on = np.flatnonzero(np.isinf(left_after))
        points = balls.centres[ball[on]] + (t * reach[on])[:, None] * way[on]
        around = look_around(scene, points, FEW_LOOKS)
        left_after[on[enclosure(around, reach[on]) < MOUTH]] = t
    left = np.isfinite(left_after)
    origins, way, reach, left_after = balls.centres[ball[left]], way[left], reach[left], left_after[left]
    wide = _width(scene, origins, way, BESIDE * reach) >= (left_after + BEYOND) * reach
    return origins + (left_after * reach)[:, None] * way, way, reach, wide


def _width(scene: RayScene, origins: Floats, ways: Floats, aside: Floats) -> Floats:
    """How far (m), (L,), pencils of rays around looks (L, 3), (L, 3), so wide (m), (L,), go until one is stopped."""
    side = np.cross(ways, np.eye(3)[np.argmin(np.abs(ways), axis=1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    turn = 2.0 * np.pi * np.arange(PENCIL)[:, None] / PENCIL
    around = np.cos(turn) * side[:, None] + np.sin(turn) * np.cross(ways, side)[:, None]
    starts = (origins[:, None] + aside[:, None, None] * around).reshape(-1, 3)
    distances = scene.distances(starts, np.repeat(ways, PENCIL, axis=0), np.inf)
    shortest: Floats = distances.reshape(-1, PENCIL).min(axis=1)
    return shortest
