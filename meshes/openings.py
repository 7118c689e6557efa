"""Where the space inside of a wall meets the space outside."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.sparse import csr_array  # type: ignore[import-untyped]
from scipy.sparse.csgraph import connected_components  # type: ignore[import-untyped]
from scipy.spatial import cKDTree  # type: ignore[import-untyped]

from meshes.embree import RayScene
from meshes.geometry import Floats
from meshes.lumen import FEW_LOOKS, MOUTH, REACH, Balls, Ints, Lumen, enclosure, look_around, sphere

LOOKS: Final = 128
"""Looks out of each ball that are asked whether they leave the tube."""
BALLS: Final = 400
"""Balls that look around."""
FOLLOWED: Final = 2000
"""Looks that are followed until they leave."""
LEAST_LOOKS: Final = 5
"""Looks that leave through an opening at least; fewer leave through a crack."""
APART: Final = 1.5
"""Looks that leave within so many radii of each other, with no wall between them one radius before, leave through
the same opening."""
GOES_ON: Final = 5
"""Balls of the same space in sight in front of an opening that make it none; a few may lie in a corner there."""
NARROW: Final = 0.5
"""An opening narrower than so many radii of the tube is a hole in its wall."""
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
    """Root mean square distance of its points from its centre, times the square root of 2 (m): that of a disc."""

    def scaled(self, factor: float) -> Opening:
        """The same in a wall that is `factor` times as large, about the origin."""
        return Opening(self.centre * factor, self.outward, self.radius * factor)


def find_openings(scene: RayScene, lumen: Lumen) -> tuple[list[Opening], list[Opening]]:
    """The openings of a space, and the holes and slits in its wall; both the nearest to the origin first."""
    count = len(lumen.balls)
    few = np.unique(np.linspace(0, count - 1, min(count, BALLS)).astype(np.int64))
    # The ends of the space see most of the openings: they are always asked.
    few = np.union1d(few, lumen.way[[0, -1]])
    points, ways, radii = _leave(scene, lumen.balls.take(few))
    if not len(points):
        return [], []
    i, j = cKDTree(points).query_pairs(APART * float(radii.max()), output_type="ndarray").T
    close = np.linalg.norm(points[i] - points[j], axis=1) < APART * np.maximum(radii[i], radii[j])
    before = points - radii[:, None] * ways
    close[close] = ~scene.blocked(before[i[close]], before[j[close]])
    i, j = i[close], j[close]
    near = csr_array((np.ones(len(i)), (i, j)), shape=(len(points), len(points)))
    labels = connected_components(near, directed=False)[1]
    sizes = np.bincount(labels)
    openings: list[Opening] = []
    holes: list[Opening] = []
    for label in range(len(sizes)):
        if sizes[label] < LEAST_LOOKS:
            continue
        at = labels == label
        outward = ways[at].mean(axis=0)
        outward /= np.linalg.norm(outward)
        centre = points[at].mean(axis=0)
        across = points[at] - centre
        across -= (across @ outward)[:, None] * outward
        opening = Opening(centre, outward, float(np.sqrt(2.0 * (across**2).sum(axis=1).mean())))
        radius = float(np.median(radii[at]))
        if _within(scene, lumen, opening, radius):
            continue
        fits = NARROW * radius < opening.radius < SLIT * radius
        (openings if fits else holes).append(opening)
    for found in (openings, holes):
        found.sort(key=lambda opening: float(np.linalg.norm(opening.centre)))
    return openings, holes


def _within(scene: RayScene, lumen: Lumen, opening: Opening, radius: float) -> bool:
    """Whether the same space goes on in front of an opening: a hall is so wide that its middle looks open."""
    ways = lumen.balls.centres - opening.centre
    before = (ways @ opening.outward > radius) & (np.linalg.norm(ways, axis=1) < REACH * radius)
    targets = lumen.balls.centres[before]
    seen = ~scene.blocked(np.tile(opening.centre, (len(targets), 1)), targets)
    return int(seen.sum()) >= GOES_ON


def _leave(scene: RayScene, balls: Balls) -> tuple[Floats, Floats, Floats]:
    """Where looks out of balls leave their tube, (K, 3), their directions (K, 3), and the radii of the balls (K,).

    A look that meets no wall within `REACH` radii is followed until half of the sky is open.
    """
    looks = look_around(scene, balls.centres, LOOKS)
    ball, look = np.nonzero(looks >= REACH * balls.radii[:, None])
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
    points = balls.centres[ball[left]] + (left_after[left] * reach[left])[:, None] * way[left]
    return points, way[left], reach[left]
