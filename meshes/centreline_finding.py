"""The centreline of a wall that comes without one.

Three steps: balls of free space in the wall and the ways between them (`meshes.lumen`), the shortest way between
the two ends (`meshes.openings`), and its points moved into the centres of their sections by rings of exact rays
(`meshes.centring`). The centre of a section is where the distance of the wall, over the angle, has no first
harmonic: the axis of a round, elliptic or lobed section.

Libraries that were considered: vmtk takes the same way with the Voronoi balls of the *vertices*, brings VTK with it
and is not on PyPI; skeletor contracts or slices the graph of the vertices, which a tube of 60 vertices and a double
wall defeat; scikit-image's minimal paths and scipy's distance transform need a grid of voxels, whose memory grows
with the volume of the bounding box and whose step limits the accuracy. Taken from scipy are the k-d tree, the
shortest path, the connected components and the smoothing filter, from Embree the rays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree  # type: ignore[import-untyped]

from meshes.centring import centre_path, to_the_end
from meshes.closest import build_tree, wall_distance
from meshes.curves import arc_lengths
from meshes.errors import CentrelineError
from meshes.geometry import Floats
from meshes.lumen import BANDS, Balls, Lumen, draw_balls, find_lumens, furthest_ball, shortest_way
from meshes.openings import Opening, find_openings
from meshes.sections import measure_rings, resample_evenly
from meshes.swept import unit_tangents
from meshes.wall import Wall

Place = ArrayLike | int
"""A point (3,), metres, world frame, or the number of an opening, from 1."""

COMPARABLE: Final = 0.25
"""A second tube at least so long, over the first, and half as wide, makes it unclear which is meant."""
NEAR: Final = 3.0
"""A point that is named may lie so many radii from the nearest ball, and an end so many from its opening."""
AT_THE_END: Final = 2.0
"""A point that is named so many radii before the end of the tube stands for the end."""
EVEN_STEP: Final = 0.2
"""Step of a found centreline at most, over the least radius."""
HOLLOW: Final = 4.5
"""A closed space whose length is less than so many of its largest radii is no tube."""
LEAST_CLEARANCE: Final = 0.15
"""A place with less room than this share of the usual is pinched."""
MOST_OPEN: Final = 1.0 / 6.0
"""Fraction of a section that may be open, for longer than `LONGEST_OPEN` radii."""
LONGEST_OPEN: Final = 2.0
LOOP: Final = 1.5
"""A second way between the ends no longer than so many times the first makes a loop of a space without openings."""


@dataclass(frozen=True)
class FoundCentreline:
    """A centreline that was found, and between what."""

    points: Floats  # (P, 3)
    """From the start to the end (m), world frame, evenly spaced."""
    radius: float
    """Median distance of the wall from the centreline (m)."""
    openings: tuple[Opening, ...]
    """All that were found, used or not; the first has the number 1."""
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
    choice = _choose_lumen(wall, balls, [np.asarray(point, dtype=np.float64) for point in named])
    lumen, others, openings, holes = choice
    if entry is None or exit is None:
        _refuse_more_tubes(wall, lumen, others, openings)
    ends = _choose_ends(wall, lumen, openings, entry, exit)
    way = shortest_way(lumen, *ends)
    points, capped = _centre(wall, lumen.balls.centres[way], lumen.balls.radii[way], (entry, exit))
    radius = _check_room(wall, points)
    notes = _open_places(wall, points, radius) + _notes(wall, holes)
    used = _used(openings, points, radius, capped)
    return FoundCentreline(points, radius, tuple(openings), used, capped, notes)


def _choose_lumen(
    wall: Wall, balls: Balls, named: list[Floats]
) -> tuple[Lumen, list[Lumen], list[Opening], list[Opening]]:
    """The space to fly through, the other tubes of its size, and its openings and holes.

    The named points lie in it; without any it is no closed hollow.
    """
    largest: list[Lumen] = []
    for band in range(BANDS):
        lumens = find_lumens(wall.scene, balls, band)
        largest = largest or lumens
        for lumen in lumens:
            if not all(_ball_at(wall, lumen, point) is not None for point in named):
                continue
            openings, holes = find_openings(wall.scene, lumen)
            if named or openings or lumen.length > HOLLOW * lumen.balls.radii.max():
                return lumen, [other for other in lumens if other is not lumen], openings, holes
    if not (largest and named):
        raise CentrelineError(_no_tube(wall, balls))
    raise CentrelineError(_not_between(wall, largest, named))


def _no_tube(wall: Wall, balls: Balls) -> str:
    if not len(balls):
        return f"{wall.path}: expected a tube, found no two walls that face each other: an open surface"
    i = int(np.argmax(balls.enclosure))
    at = place(wall, balls.centres[i])
    if balls.enclosure[i] < 0.7:
        return (
            f"{wall.path}: expected a tube, found no place with walls around it: the most enclosed, at {at}, has "
            f"them in {100 * balls.enclosure[i]:.0f} % of the directions, as in a half-pipe"
        )
    i = int(np.argmax(np.where(balls.enclosure >= 0.7, balls.radii, 0.0)))
    return (
        f"{wall.path}: expected a tube, found hollows that are no longer than wide, or flat, the largest around "
        f"{place(wall, balls.centres[i])}, {_length(wall, balls.radii[i])} from its walls"
    )


def _not_between(wall: Wall, lumens: list[Lumen], named: list[Floats]) -> str:
    """Why no space holds all named points: one of them lies in none, or each in another."""
    for point in named:
        if all(_ball_at(wall, lumen, point) is None for lumen in lumens):
            nearest = min((_nearest(lumen, point) for lumen in lumens), key=lambda found: found[1])
            return (
                f"{wall.path}: expected entry and exit inside of the tube, found {place(wall, point)} outside of "
                f"it: the nearest place inside is {place(wall, nearest[0])}, {_length(wall, nearest[1])} away"
            )
    homes = [[lumen for lumen in lumens if _ball_at(wall, lumen, point) is not None] for point in named]
    a, b = homes[0][0].balls, homes[-1][0].balls
    apart, j = cKDTree(b.centres).query(a.centres)
    i = int(np.argmin(apart))
    return (
        f"{wall.path}: expected a way from {place(wall, named[0])} to {place(wall, named[-1])}, found none: it is "
        f"blocked or pinched near {place(wall, 0.5 * (a.centres[i] + b.centres[j[i]]))}"
    )


def _refuse_more_tubes(wall: Wall, lumen: Lumen, others: list[Lumen], openings: list[Opening]) -> None:
    """Refuse where another space is as likely to be meant, or is the other half of a blocked tube."""
    for other in others:
        if other.depth < lumen.depth or other.length < COMPARABLE * lumen.length:
            continue
        if not 0.5 < other.radius / lumen.radius < 2.0:
            continue
        apart, j = cKDTree(other.balls.centres).query(lumen.balls.centres)
        i = int(np.argmin(apart))
        between = place(wall, 0.5 * (lumen.balls.centres[i] + other.balls.centres[j[i]]))
        if apart[i] < 2.0 * NEAR * lumen.radius and len(openings) < 2:
            raise CentrelineError(
                f"{wall.path}: expected one free way through the tube, found it blocked or pinched near {between}; "
                "name an entry and an exit on one side to fly that part"
            )
        raise CentrelineError(
            f"{wall.path}: expected one tube, found another of its size beside it, nearest at {between}; name an "
            "entry and an exit in one of them (--entry, --exit)"
        )


def _choose_ends(
    wall: Wall, lumen: Lumen, openings: list[Opening], entry: Place | None, exit: Place | None
) -> tuple[int, int]:
    """The balls between which the centreline runs."""
    named = [None if at is None else _end(wall, lumen, openings, at) for at in (entry, exit)]
    start, end = named
    if start is None or end is None:
        if len(openings) > 2:
            raise CentrelineError(
                f"{wall.path}: expected two openings, or an entry and an exit, found {len(openings)} openings: "
                f"{list_openings(wall, openings)}; name two (--entry 1 --exit 2, or coordinates)"
            )
        ends = [_inside_of(wall, lumen, opening) for opening in openings]
        if start is None and end is None:
            start = ends[0] if ends else furthest_ball(lumen, int(lumen.way[0]))
            end = ends[1] if len(ends) == 2 else furthest_ball(lumen, start)
            if not openings:
                _refuse_loop(wall, lumen, start, end)
        elif end is None:
            assert start is not None
            end = _other_end(lumen, ends, start)
        else:
            start = _other_end(lumen, ends, end)
    if start == end:
        raise CentrelineError(
            f"{wall.path}: expected an entry and an exit apart from each other, found both at "
            f"{place(wall, lumen.balls.centres[start])}"
        )
    return start, end


def _other_end(lumen: Lumen, ends: list[int], named: int) -> int:
    """Of the ends of the tube, or its furthest place, the one with the longest way from a named one."""
    ways = [(_way_length(lumen, named, end), end) for end in [*ends, furthest_ball(lumen, named)] if end != named]
    return ways and max(ways[: len(ends)] or ways)[1] or named


def _way_length(lumen: Lumen, start: int, end: int) -> float:
    way = shortest_way(lumen, start, end)
    return float(arc_lengths(lumen.balls.centres[way])[-1])


def _end(wall: Wall, lumen: Lumen, openings: list[Opening], at: Place) -> int:
    if isinstance(at, int):
        if not 1 <= at <= len(openings):
            raise CentrelineError(
                f"{wall.path}: expected the number of one of {len(openings)} openings "
                f"({list_openings(wall, openings)}), found {at}"
            )
        return _inside_of(wall, lumen, openings[at - 1])
    ball = _ball_at(wall, lumen, np.asarray(at, dtype=np.float64))
    assert ball is not None  # or the space would not have been chosen
    return ball


def _inside_of(wall: Wall, lumen: Lumen, opening: Opening) -> int:
    """The ball behind an opening."""
    point = opening.centre - 0.5 * lumen.radius * opening.outward
    ball = _ball_at(wall, lumen, point)
    return int(np.argmin(np.linalg.norm(lumen.balls.centres - point, axis=1))) if ball is None else ball


def _ball_at(wall: Wall, lumen: Lumen, point: Floats) -> int | None:
    """The ball of a space that a point (3,) lies in, or close to without a wall between; None if there is none."""
    distance = np.linalg.norm(lumen.balls.centres - point, axis=1) / lumen.balls.radii
    for ball in np.argsort(distance)[:20]:
        if distance[ball] > NEAR:
            return None
        if not wall.scene.blocked(point[None], lumen.balls.centres[ball : ball + 1])[0]:
            return int(ball)
    return None


def _nearest(lumen: Lumen, point: Floats) -> tuple[Floats, float]:
    distance = np.linalg.norm(lumen.balls.centres - point, axis=1)
    i = int(np.argmin(distance))
    return lumen.balls.centres[i], float(distance[i])


def _refuse_loop(wall: Wall, lumen: Lumen, start: int, end: int) -> None:
    """Refuse a space without openings in which two ways of like length join the ends."""
    way = shortest_way(lumen, start, end)
    third = len(way) // 3
    if third < 1:
        return
    middle = way[third:-third]
    aside, _ = cKDTree(lumen.balls.centres[middle]).query(lumen.balls.centres)
    kept = aside > 1.5 * lumen.radius
    kept[[start, end]] = True
    around = _way_among(lumen, kept, start, end)
    if around < LOOP * _way_length(lumen, start, end):
        raise CentrelineError(
            f"{wall.path}: expected a tube with two ends, found a closed loop through {place(wall, lumen.balls.centres[start])} "
            f"and {place(wall, lumen.balls.centres[end])}; name an entry and an exit (--entry, --exit)"
        )


def _way_among(lumen: Lumen, kept: np.ndarray[tuple[int], np.dtype[np.bool_]], start: int, end: int) -> float:
    """Length (m) of the way between two balls by way of some balls alone, infinite where there is none."""
    from scipy.sparse.csgraph import dijkstra  # type: ignore[import-untyped]

    numbers = np.flatnonzero(kept)
    lengths = lumen.lengths[numbers][:, numbers]
    reached = dijkstra(lengths, directed=False, indices=int(np.searchsorted(numbers, start)))
    return float(reached[np.searchsorted(numbers, end)])


def _centre(
    wall: Wall, path: Floats, radii: Floats, named: tuple[Place | None, Place | None]
) -> tuple[Floats, tuple[bool, bool]]:
    """A rough path as an even centreline, from end to end, and at which of its ends there is a cap."""
    points, capped = _to_the_ends(wall, centre_path(wall.scene, path, radii), named)
    return resample_evenly(points, EVEN_STEP * float(radii.min())), capped


def _to_the_ends(
    wall: Wall, points: Floats, named: tuple[Place | None, Place | None]
) -> tuple[Floats, tuple[bool, bool]]:
    """Prolong a centreline to the tube's ends, but not past a point that is named and lies well before them."""
    capped = []
    for at in named[::-1]:  # the end, then, turned round, the start
        longer, cap = to_the_end(wall.scene, points)
        if at is not None and not isinstance(at, int):
            before = float(np.linalg.norm(longer[-1] - np.asarray(at, dtype=np.float64)))
            radius = float(measure_rings(wall.scene, points[-5:], unit_tangents(points[-5:])).mean[0])
            if before > AT_THE_END * radius:
                longer, cap = points, False
        capped.append(cap)
        points = longer[::-1]
    return points, (capped[1], capped[0])


def _check_room(wall: Wall, points: Floats) -> float:
    """The median distance of the wall (m); refuses a place that has much less."""
    tree = build_tree(wall.vertices, wall.faces)
    spacing = float(np.linalg.norm(points[1] - points[0]))
    dense = np.ascontiguousarray(resample_evenly(points, spacing / 4.0))
    distances = np.empty(len(dense))
    wall_distance(dense, tree.boxes, tree.triangles, np.full(len(dense), -1, dtype=np.int64), distances)
    usual = float(np.median(distances))
    i = int(np.argmin(distances))
    if distances[i] < LEAST_CLEARANCE * usual:
        raise CentrelineError(
            f"{wall.path}: expected a free way, found the tube pinched at {place(wall, dense[i])}: "
            f"{_length(wall, distances[i])} to the wall, where {_length(wall, usual)} are usual"
        )
    return usual


def _open_places(wall: Wall, points: Floats, radius: float) -> tuple[str, ...]:
    """Refuse a tube that is open along its side; say where a section is open."""
    rings = measure_rings(wall.scene, points, unit_tangents(points))
    along = arc_lengths(points)
    inner = (along > radius) & (along < along[-1] - radius)
    is_open = inner & (1.0 - rings.hits > MOST_OPEN)
    if not is_open.any():
        return ()
    edges = np.flatnonzero(np.diff(np.concatenate([[0], is_open.astype(np.int8), [0]])))
    runs = edges.reshape(-1, 2)
    first, stop = runs[np.argmax(along[runs[:, 1] - 1] - along[runs[:, 0]])]
    where = f"from {place(wall, points[first])} to {place(wall, points[stop - 1])}"
    if along[stop - 1] - along[first] > LONGEST_OPEN * radius:
        raise CentrelineError(
            f"{wall.path}: expected walls all around, found the tube open along its side {where}, as a half-pipe is"
        )
    return (f"the wall is open to the side {where}",)


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


def _notes(wall: Wall, holes: list[Opening]) -> tuple[str, ...]:
    if not holes:
        return ()
    return (f"{len(holes)} holes or slits in the wall, the largest near {place(wall, holes[0].centre)}",)


def list_openings(wall: Wall, openings: list[Opening] | tuple[Opening, ...]) -> str:
    """The openings with their numbers, in the coordinates of the file."""
    return "; ".join(
        f"{number} at {place(wall, opening.centre)}" for number, opening in enumerate(openings, start=1)
    )


def place(wall: Wall, point: Floats) -> str:
    """A point (3,), world frame, in the coordinates of the file, for people."""
    return "({:.4g}, {:.4g}, {:.4g})".format(*wall.to_file(point[None])[0])


def _length(wall: Wall, metres: float) -> str:
    return f"{metres / wall.scale:.3g}"
