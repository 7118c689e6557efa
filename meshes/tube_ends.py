"""Which space of a wall is flown through, and between which of its ends; or why none can be."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cmp_to_key
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse.csgraph import dijkstra  # type: ignore[import-untyped]
from scipy.spatial import cKDTree  # type: ignore[import-untyped]

from meshes.curves import arc_lengths
from meshes.errors import CentrelineError, EndsError
from meshes.geometry import Bools, Floats
from meshes.lumen import BANDS, ENCLOSED, Balls, Ints, Lumen, find_lumens, furthest_ball, shortest_way
from meshes.openings import Opening, find_openings
from meshes.wall import Wall, in_units, place

Place = ArrayLike | int
"""A point (3,), metres, world frame, or the number of an opening, from 1."""

COMPARABLE: Final = 0.25
"""A second tube at least so long, over the first, and half as wide, makes it unclear which is meant."""
NEAR: Final = 3.0
"""A point that is named may lie so many radii from the nearest ball, and an end so many from its opening."""
SAME_PLACE: Final = 0.5
"""Coordinates of openings that differ by less than so many radii are the same."""
BEHIND_WALL: Final = 0.5
"""A point that is named may lie behind a wall so many radii from the nearest ball."""
FACING: Final = 0.7
"""Cosine of the angle up to which an opening faces another tube."""
HOLLOW: Final = 4.5
"""A space with one opening or none whose length is less than so many of its largest radii is no tube."""
LOOP: Final = 1.5
"""A second way between the ends no longer than so many times the first makes a loop of a space without openings."""
FAR: Final = 3.0
WIDE: Final = 0.2
"""A space is wide where such a share of its balls lies more than so many radii from a way through it, in sight."""
TWIN: Final = 1.5
"""A second way keeps so many radii from the middle of the first."""


_Choice = tuple[Lumen, list[Lumen], list[Opening], list[Opening]]


def choose_lumen(wall: Wall, balls: Balls, named: list[Floats]) -> _Choice:
    """The space to fly through, the other tubes of its size, and its openings and holes.

    The named points lie in it; without any it is no closed hollow, and no hall around a tube that opens into it.
    """
    largest: list[Lumen] = []
    closed: _Choice | None = None
    for band in range(BANDS):
        lumens = find_lumens(wall.scene, balls, band)
        largest = largest or lumens
        for lumen in lumens:
            if not all(_ball_at(wall, lumen, point) is not None for point in named):
                continue
            if largest is not lumens and not named and not _is_tube_in(lumen, largest):
                continue
            openings, holes = find_openings(wall.scene, lumen)
            openings = _numbered(wall, openings, lumen.radius)
            choice = lumen, [other for other in lumens if other is not lumen], openings, holes
            long = lumen.length > HOLLOW * lumen.balls.radii.max()
            if named or len(openings) > 1 or (openings and long):
                return choice
            closed = closed or (choice if long else None)
    if closed is not None:
        return closed
    if not (largest and named):
        raise CentrelineError(_no_tube(wall, balls))
    raise CentrelineError(_not_between(wall, largest, named))


def _numbered(wall: Wall, openings: list[Opening], radius: float) -> list[Opening]:
    """Openings of a tube of some radius (m) in the order of their numbers: by their distance from the origin.

    Those that are as far count by their places in the file, which no choice of axes changes.
    """
    keys = [
        (float(np.linalg.norm(opening.centre)), *wall.to_file(opening.centre[None])[0] * wall.scale)
        for opening in openings
    ]

    def compare(i: int, j: int) -> int:
        for a, b in zip(keys[i], keys[j], strict=True):
            if abs(a - b) > SAME_PLACE * radius:
                return -1 if a < b else 1
        return 0

    return [openings[i] for i in sorted(range(len(openings)), key=cmp_to_key(compare))]


def _is_tube_in(lumen: Lumen, larger: list[Lumen]) -> bool:
    """Whether a space is more than a crevice of larger ones: long, or a tube in a hall."""
    hall = max(larger, key=lambda hall: hall.length)
    return lumen.length >= COMPARABLE * hall.length or (lumen.sealed and lumen.depth > hall.depth)


def _no_tube(wall: Wall, balls: Balls) -> str:
    if not len(balls):
        return f"{wall.path}: expected a tube, found no two walls that face each other: an open surface"
    i = int(np.argmax(balls.enclosure))
    at = place(wall, balls.centres[i])
    if balls.enclosure[i] < ENCLOSED:
        return (
            f"{wall.path}: expected a tube, found no place with walls around it: the most enclosed, at {at}, has "
            f"them in {100 * balls.enclosure[i]:.0f} % of the directions, as in a half-pipe"
        )
    i = int(np.argmax(np.where(balls.enclosure >= ENCLOSED, balls.radii, 0.0)))
    return (
        f"{wall.path}: expected a tube, found hollows that are no longer than wide, or flat, the largest around "
        f"{place(wall, balls.centres[i])}, {in_units(wall, balls.radii[i])} from its walls"
    )


def _not_between(wall: Wall, lumens: list[Lumen], named: list[Floats]) -> str:
    """Why no space holds all named points: one of them lies in none, or each in another."""
    for point in named:
        if all(_ball_at(wall, lumen, point) is None for lumen in lumens):
            nearest = min((_nearest(lumen, point) for lumen in lumens), key=lambda found: found[1])
            return (
                f"{wall.path}: expected entry and exit inside of the tube, found {place(wall, point)} outside of "
                f"it: the nearest place inside is {place(wall, nearest[0])}, {in_units(wall, nearest[1])} away"
            )
    homes = [[lumen for lumen in lumens if _ball_at(wall, lumen, point) is not None] for point in named]
    a, b = homes[0][0].balls, homes[-1][0].balls
    apart, j = cKDTree(b.centres).query(a.centres)
    i = int(np.argmin(apart))
    return (
        f"{wall.path}: expected a way from {place(wall, named[0])} to {place(wall, named[-1])}, found none: it is "
        f"blocked or pinched near {place(wall, 0.5 * (a.centres[i] + b.centres[j[i]]))}"
    )


def refuse_more_tubes(
    wall: Wall, lumen: Lumen, others: list[Lumen], openings: list[Opening], holes: list[Opening]
) -> None:
    """Refuse where another space is as likely to be meant, or is the other half of a blocked tube."""
    likely = [
        other
        for other in others
        if other.depth >= lumen.depth
        and other.length >= COMPARABLE * lumen.length
        and 0.5 < other.radius / lumen.radius < 2.0
    ]
    if not likely:
        return
    ways = [cKDTree(other.balls.centres).query(lumen.balls.centres) for other in likely]
    nearest = int(np.argmin([apart.min() for apart, _ in ways]))
    apart, j = ways[nearest]
    i = int(np.argmin(apart))
    here, there = lumen.balls.centres[i], likely[nearest].balls.centres[j[i]]
    between = place(wall, 0.5 * (here + there))
    if apart[i] < 2.0 * NEAR * lumen.radius:
        if any(_faces(opening, here, there, lumen.radius) for opening in (*openings, *holes)):
            raise CentrelineError(
                f"{wall.path}: expected one tube, found parts of it that do not meet near {between}; close the "
                "gap, or name an entry and an exit in one of them (--entry, --exit)"
            )
        if len(openings) < 2:
            raise CentrelineError(
                f"{wall.path}: expected one free way through the tube, found it blocked or pinched near {between}; "
                "name an entry and an exit on one side to fly that part"
            )
    raise CentrelineError(
        f"{wall.path}: expected one tube, found another of its size beside it, nearest at {between}; name an entry "
        "and an exit in one of them (--entry, --exit)"
    )


def _faces(opening: Opening, here: Floats, there: Floats, radius: float) -> bool:
    """Whether an opening near a point (3,) faces another, in a tube of some radius (m)."""
    way = there - opening.centre
    near = float(np.linalg.norm(opening.centre - here)) < NEAR * radius
    return near and float(way @ opening.outward) > FACING * float(np.linalg.norm(way))


def choose_ends(
    wall: Wall, lumen: Lumen, openings: list[Opening], entry: Place | None, exit: Place | None
) -> tuple[int, int]:
    """The balls between which the centreline runs."""
    named = [None if at is None else _end(wall, lumen, openings, at) for at in (entry, exit)]
    start, end = named
    if start is None or end is None:
        if len(openings) > 2:
            raise EndsError(
                f"{wall.path}: expected two openings, or an entry and an exit, found {len(openings)} openings: "
                f"{list_openings(wall, openings)}; name two (--entry 1 --exit 2, or coordinates)",
                tuple(openings),
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
    """The end of the tube with the longest way from one that is named: an opening, or a cap where one is missing."""
    if len(ends) < 2:
        ends = [*ends, furthest_ball(lumen, named)]
    return max(ends, key=lambda end: _way_length(lumen, named, end))


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
    """The ball of a space that a point (3,) lies deepest in, or is nearest to; None where none is near and in sight.

    A point in or just behind a wall counts as in the tube: so exactly does nobody know where a cap is.
    """
    distance = np.linalg.norm(lumen.balls.centres - point, axis=1)
    for ball in np.argsort(distance - lumen.balls.radii)[:20]:
        if distance[ball] < NEAR * lumen.balls.radii[ball] and not wall.scene.blocked(
            point[None], lumen.balls.centres[ball : ball + 1]
        ):
            return int(ball)
    nearest = int(np.argmin(distance))
    return nearest if distance[nearest] < BEHIND_WALL * lumen.radius else None


def _nearest(lumen: Lumen, point: Floats) -> tuple[Floats, float]:
    distance = np.linalg.norm(lumen.balls.centres - point, axis=1)
    i = int(np.argmin(distance))
    return lumen.balls.centres[i], float(distance[i])


def _refuse_loop(wall: Wall, lumen: Lumen, start: int, end: int) -> None:
    """Refuse a space without openings in which two ways of like length join the ends, or that is wide."""
    way = shortest_way(lumen, start, end)
    third = len(way) // 3
    if third < 1:
        return
    middle = way[third:-third]
    _refuse_wide(wall, lumen, way)
    aside, _ = cKDTree(lumen.balls.centres[middle]).query(lumen.balls.centres)
    kept = aside > TWIN * lumen.radius
    kept[[start, end]] = True
    around = _way_among(lumen, kept, start, end)
    if around < LOOP * _way_length(lumen, start, end):
        raise CentrelineError(
            f"{wall.path}: expected a tube with two ends, found a closed loop through "
            f"{place(wall, lumen.balls.centres[start])} and {place(wall, lumen.balls.centres[end])}; name an entry "
            "and an exit (--entry, --exit)"
        )


def _refuse_wide(wall: Wall, lumen: Lumen, way: Ints) -> None:
    """Refuse a space much of which lies far from a way through it, and in sight of it: no wall is gone round."""
    centres = lumen.balls.centres
    aside, nearest = cKDTree(centres[way]).query(centres)
    far = np.flatnonzero(aside > FAR * lumen.radius)
    if len(far) < WIDE * len(centres):
        return
    seen = ~wall.scene.blocked(centres[far], centres[way[nearest[far]]])
    if seen.mean() > 0.5:
        at = place(wall, centres[way[len(way) // 2]])
        raise CentrelineError(
            f"{wall.path}: expected a tube, found a wide or flat space without openings around {at}"
        )


def _way_among(lumen: Lumen, kept: Bools, start: int, end: int) -> float:
    """Length (m) of the way between two balls by way of some balls alone, infinite where there is none."""
    numbers = np.flatnonzero(kept)
    lengths = lumen.lengths[numbers][:, numbers]
    reached = dijkstra(lengths, directed=False, indices=int(np.searchsorted(numbers, start)))
    return float(reached[np.searchsorted(numbers, end)])


def list_openings(wall: Wall, openings: Sequence[Opening]) -> str:
    """The openings with their numbers, in the coordinates of the file."""
    return "; ".join(
        f"{number} at {place(wall, opening.centre)}" for number, opening in enumerate(openings, start=1)
    )
