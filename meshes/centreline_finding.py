"""The centreline of a wall that comes without one.

Three steps: balls of free space in the wall and the ways between them (`meshes.lumen`), the shortest way between
the two ends (`meshes.openings`), and its points moved into the centres of their sections by rings of exact rays
(`meshes.centring`). The centre of a section is where the distance of the wall, over the angle, has no first
harmonic: the axis of a round, elliptic or lobed section.

Libraries that were considered: vmtk takes the same way with the Voronoi balls of the *vertices*, brings VTK
with it and asks for Python 3.12; skeletor contracts or slices the graph of the vertices, which a tube of 60 vertices
and a double wall defeat; scikit-image's minimal paths and scipy's distance transform need a grid of voxels, whose
memory grows with the volume of the bounding box and whose step limits the accuracy. Taken from scipy are the k-d
tree, the shortest path and the connected components, from Embree the rays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree  # type: ignore[import-untyped]

from meshes.centring import centre_path, to_the_end
from meshes.closest import distances_to_wall
from meshes.curves import arc_lengths
from meshes.errors import CentrelineError
from meshes.geometry import Bools, Floats
from meshes.lumen import Balls, draw_balls, look_around, shortest_way, sphere
from meshes.openings import Opening
from meshes.sections import measure_rings, resample_evenly
from meshes.swept import unit_tangents
from meshes.tube_ends import NEAR, Place, choose_ends, choose_lumen, refuse_more_tubes
from meshes.wall import Wall, in_units, place

AT_THE_END: Final = 2.0
"""A point that is named so many radii before the end of the tube stands for the end."""
EVEN_STEP: Final = 0.2
"""Step of a found centreline at most, over the radius where the tube is narrow."""
OBSTRUCTED: Final = 0.35
"""Where less than this share of the usual room is left, the way of the balls may be better."""
DETOUR: Final = 1.5
"""It is left and reached again so many radii before and behind."""
AVOIDING: Final = 30
"""Times that it is moved off what stands in the way."""
LEAST_CLEARANCE: Final = 0.15
"""A place with less room than this share of the usual is pinched."""
MOST_OPEN: Final = 1.0 / 6.0
"""Fraction of a section that may be open, for longer than `LONGEST_OPEN` radii."""
LONGEST_OPEN: Final = 2.0
BARE: Final = 0.5
"""Fraction of a section from which on it has no wall: there the parts of a tube do not meet."""
WIDEST_JOINT: Final = 0.5
"""Parts of a tube that are so many radii apart are none: drones leave between them."""
LEAST_AT_ENDS: Final = 0.55
"""Fraction of a section at an end that must have a wall."""
BARE_ENDS: Final = 0.2
"""Share of a centreline that may be cut off since it has too few walls around it."""


@dataclass(frozen=True)
class FoundCentreline:
    """A centreline that was found, and between what."""

    points: Floats  # (P, 3)
    """From the start to the end (m), world frame, evenly spaced."""
    radius: float
    """Median distance of the wall from the centreline (m)."""
    openings: tuple[Opening, ...]
    """All that were found, used or not, by their numbers from 1: the nearest to the origin first."""
    used: tuple[int | None, int | None]
    """Numbers of the openings at which it starts and ends; None at a cap, or inside of the tube."""
    capped: tuple[bool, bool]
    """Whether a wall stands before its start and behind its end."""
    notes: tuple[str, ...]
    """What a user should know."""

    def scaled(self, factor: float) -> FoundCentreline:
        """The same in a wall that is `factor` times as large, about the origin."""
        openings = tuple(opening.scaled(factor) for opening in self.openings)
        return replace(self, points=self.points * factor, radius=self.radius * factor, openings=openings)


def find_centreline(wall: Wall, entry: Place | None = None, exit: Place | None = None) -> FoundCentreline:
    """Find the centreline of a wall: between two openings, two caps, or two places that are named.

    Args:
        wall: the wall of a tube.
        entry: where the centreline starts: a point in the tube or before an opening, or an opening's number.
        exit: where it ends.

    Raises:
        CentrelineError: there is nothing that can be flown, or it is not clear what; says why and where, in the
            coordinates of the file.
    """
    balls = draw_balls(wall.scene, wall.vertices, wall.faces)
    named = [place for place in (entry, exit) if place is not None and not isinstance(place, int)]
    choice = choose_lumen(wall, balls, [np.asarray(point, dtype=np.float64) for point in named])
    lumen, others, openings, holes = choice
    if entry is None or exit is None:
        refuse_more_tubes(wall, lumen, others, openings, holes)
    ends = choose_ends(wall, lumen, openings, entry, exit)
    way = lumen.balls.take(shortest_way(lumen, *ends))
    middle, capped = _centre(wall, way, openings, (entry, exit))
    points = _past_obstacles(wall, middle, way)
    dense, distances = _clearances(wall, points)
    radius = float(np.median(distances))
    notes = _open_places(wall, points, radius) + _notes(wall, openings, holes, capped)
    _refuse_pinched(wall, dense, distances)
    if points is not middle:
        at = place(wall, dense[int(np.argmin(distances))])
        notes += (f"something stands in the tube near {at}: the centreline leaves the middle to pass it",)
    used = _used(openings, points, radius, capped)
    return FoundCentreline(points, radius, tuple(openings), used, capped, notes)


def _centre(
    wall: Wall, way: Balls, openings: list[Opening], named: tuple[Place | None, Place | None]
) -> tuple[Floats, tuple[bool, bool]]:
    """The centreline along some balls, in even steps, from end to end, and at which of its ends there is a cap.

    It stops at a point that is named and lies well before the end of the tube.
    """
    near = [
        [o for o in openings if np.linalg.norm(o.centre - way.centres[end]) < NEAR * way.radii[end]]
        for end in (0, -1)
    ]
    mouths = (-near[0][0].outward if near[0] else None, near[1][0].outward if near[1] else None)
    points = centre_path(wall.scene, way.centres, way.radii, mouths)
    capped = [False, False]
    for end in (1, 0):  # the end, then, turned round, the start
        mouth = mouths[end]
        outward = mouth if end or mouth is None else -mouth
        longer, capped[end] = to_the_end(wall.scene, points, outward)
        at = named[end]
        if at is not None and not isinstance(at, int):
            before = float(np.linalg.norm(longer[-1] - np.asarray(at, dtype=np.float64)))
            if before > AT_THE_END * way.radii[-end]:
                longer, capped[end] = points, False
        points = longer[::-1]
    points = resample_evenly(_within_walls(wall, points), EVEN_STEP * float(np.quantile(way.radii, 0.2)))
    return points, (capped[0], capped[1])


def _within_walls(wall: Wall, points: Floats) -> Floats:
    """Points (P, 3) without those at either end that have too few walls around them, as in a gutter behind a tube."""
    between = 0.5 * (points[1:] + points[:-1])  # the very ends may pass the rim
    enough = np.flatnonzero(measure_rings(wall.scene, between, unit_tangents(between)).hits >= LEAST_AT_ENDS)
    if len(between) - len(enough) > BARE_ENDS * len(between):
        return points
    return points[enough[0] : enough[-1] + 2]


def _clearances(wall: Wall, points: Floats) -> tuple[Floats, Floats]:
    """Points (M, 3) densely along a centreline (P, 3), and their distances to the wall (m), (M,)."""
    spacing = float(np.linalg.norm(points[1] - points[0]))
    dense = resample_evenly(points, spacing / 4.0)
    return dense, distances_to_wall(dense, wall.vertices, wall.faces)


def _past_obstacles(wall: Wall, points: Floats, way: Balls) -> Floats:
    """Evenly spaced points (P, 3); where something stands in the middle of the tube, past it by the way of the balls.

    The middle of a section says nothing of a thin plate between two sections.
    """
    dense, distances = _clearances(wall, points)
    usual = float(np.median(distances))
    ends = np.linalg.norm(dense[:, None] - points[[0, -1]], axis=2).min(axis=1) < usual
    narrow = dense[(distances < OBSTRUCTED * usual) & ~ends]
    if not len(narrow):
        return points
    moved, tree = points.copy(), cKDTree(way.centres)
    near = cKDTree(narrow).query(points)[0] < DETOUR * usual
    for first, stop in _runs(near):
        balls = tree.query(points[[first, stop - 1]])[1]
        if stop - first > 2 and balls[1] > balls[0] + 1:
            part = way.centres[balls[0] : balls[1] + 1]
            along = arc_lengths(part)
            wanted = np.linspace(0.0, along[-1], stop - first)
            moved[first:stop] = np.stack([np.interp(wanted, along, part[:, k]) for k in range(3)], axis=1)
    changed = np.flatnonzero(near)
    changed = changed[(changed > 0) & (changed < len(points) - 1)]
    for _ in range(AVOIDING):
        looks = look_around(wall.scene, moved[changed])
        least = looks.min(axis=1)
        away = -sphere(looks.shape[1])[np.argmin(looks, axis=1)]
        along = unit_tangents(moved)[changed]
        away -= (away * along).sum(axis=1, keepdims=True) * along
        push = np.clip(0.5 * usual - least, 0.0, 0.1 * usual)[:, None] * away
        smooth = 0.5 * (moved[changed - 1] + moved[changed + 1]) - moved[changed]
        moved[changed] += push + 0.5 * smooth
    if (
        _clearances(wall, moved)[1].min() <= distances.min()
        or wall.scene.blocked(moved[:-1], moved[1:]).any()
    ):
        return points
    return resample_evenly(moved, float(np.linalg.norm(points[1] - points[0])))


def _refuse_pinched(wall: Wall, dense: Floats, distances: Floats) -> None:
    """Refuse a place with much less room than is usual; points (M, 3) with their distances to the wall (m), (M,)."""
    usual = float(np.median(distances))
    i = int(np.argmin(distances))
    if distances[i] < LEAST_CLEARANCE * usual:
        raise CentrelineError(
            f"{wall.path}: expected a free way, found the tube pinched at {place(wall, dense[i])}: "
            f"{in_units(wall, distances[i])} to the wall, where {in_units(wall, usual)} are usual"
        )


def _open_places(wall: Wall, points: Floats, radius: float) -> tuple[str, ...]:
    """Refuse a tube that is open along its side; say where a section is open."""
    rings = measure_rings(wall.scene, points, unit_tangents(points))
    along = arc_lengths(points)
    inner = (along > radius) & (along < along[-1] - radius)
    is_open = inner & (1.0 - rings.hits > MOST_OPEN)
    if not is_open.any():
        return ()
    first, stop = _longest(is_open, along)
    where = f"from {place(wall, points[first])} to {place(wall, points[stop - 1])}"
    if along[stop - 1] - along[first] > LONGEST_OPEN * radius:
        raise CentrelineError(
            f"{wall.path}: expected walls all around, found the tube open along its side {where}, as a half-pipe is"
        )
    bare = inner & (1.0 - rings.hits > BARE)
    if not bare.any():
        return (f"the wall is open to the side {where}",)
    first, stop = _longest(bare, along)
    at = place(wall, points[(first + stop - 1) // 2])
    gap = float(along[stop - 1] - along[first] + along[1])
    if gap > WIDEST_JOINT * radius:
        raise CentrelineError(
            f"{wall.path}: expected one tube, found parts of it that do not meet near {at}, where nothing is around "
            f"for {in_units(wall, gap)}; close the gap, or name an entry and an exit in one of them (--entry, --exit)"
        )
    joints = int((np.diff(bare.astype(np.int8)) > 0).sum())
    others = f", and in {joints - 1} other places" if joints > 1 else ""
    return (f"the wall is open all around at {at}{others}: parts of the tube do not meet",)


def _longest(chosen: Bools, along: Floats) -> tuple[int, int]:
    """First point of the longest run of chosen ones (M,), and the one behind its last, by arc length (M,)."""
    runs = _runs(chosen)
    first, stop = runs[np.argmax(along[runs[:, 1] - 1] - along[runs[:, 0]])]
    return int(first), int(stop)


def _runs(chosen: Bools) -> NDArray[np.int64]:
    """First point of each run of chosen ones (M,), and the one behind its last, (R, 2)."""
    return np.flatnonzero(np.diff(np.concatenate([[0], chosen.astype(np.int8), [0]]))).reshape(-1, 2)


def _used(
    openings: list[Opening], points: Floats, radius: float, capped: tuple[bool, bool]
) -> tuple[int | None, int | None]:
    """Numbers of the openings at the ends of a centreline (M, 3)."""
    used: list[int | None] = []
    for end, cap in zip(points[[0, -1]], capped, strict=True):
        distances = [float(np.linalg.norm(opening.centre - end)) for opening in openings]
        nearest = int(np.argmin(distances)) if distances else 0
        near = not cap and bool(distances) and distances[nearest] < NEAR * radius
        used.append(nearest + 1 if near else None)
    return used[0], used[1]


def _notes(
    wall: Wall, openings: list[Opening], holes: list[Opening], capped: tuple[bool, bool]
) -> tuple[str, ...]:
    notes = []
    if all(capped) and not openings:
        notes.append("closed all around: read as a tube with two caps, which a solid bar looks like too")
    if holes:
        notes.append(f"{len(holes)} holes or slits in the wall, one near {place(wall, holes[0].centre)}")
    return tuple(notes)
