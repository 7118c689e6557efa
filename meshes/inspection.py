"""What a tube is like along its axis, and what is odd about its mesh."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from meshes.centring import wall_ahead
from meshes.closest import distances_to_wall
from meshes.curves import arc_lengths
from meshes.errors import CentrelineError
from meshes.geometry import Floats
from meshes.lumen import draw_balls
from meshes.openings import Opening
from meshes.sections import Rings, close_sideways, measure_rings, resample_evenly
from meshes.smoothing import fit_locally
from meshes.swept import unit_tangents
from meshes.tube import Tube
from meshes.tube_ends import choose_lumen
from meshes.wall import Wall

SPACING: Final = 0.2
"""Distance between sections, over the mean radius."""
MOST_SECTIONS: Final = 2000
BEND_WINDOW: Final = 1.5
"""Curvature and torsion are those of a quartic through the axis within so many radii ahead and behind."""
STRAIGHT: Final = 0.02
"""A curvature (1/R) below which the torsion means nothing."""
HARMONICS: Final = 8
"""Highest harmonic of a section."""
ROUND: Final = 0.03
"""Amplitudes (R) up to this leave a section round: a polygon of 12 sides has less."""
CAP: Final = 1.5
"""A wall so many radii ahead of an end of the axis is a cap."""
SECOND_WALL: Final = 1.0
"""A second wall within so many radii behind the first belongs to the same tube."""
MOST_FLIPPED: Final = 0.05
"""Share of the faces seen from inside whose normals may differ from the others'."""


@dataclass(frozen=True)
class Profile:
    """A tube by arc length: M sections across its axis, side branches closed."""

    arc_length: Floats  # (M,)
    """From the start (m)."""
    points: Floats  # (M, 3)
    """Of the axis (m), world frame."""
    radius: Floats  # (M,)
    """Mean wall distance from the axis in the section (m)."""
    least: Floats  # (M,)
    """Least wall distance in the section (m)."""
    greatest: Floats  # (M,)
    """Greatest wall distance in the section (m)."""
    clearance: Floats  # (M,)
    """Distance from the axis to the nearest wall (m); within a radius of the ends, of the section alone, so that a
    cap is no narrow place."""
    curvature: Floats  # (M,)
    """Of the axis (1/m)."""
    torsion: Floats  # (M,)
    """Of the axis (1/m); NaN where it is as good as straight."""
    harmonics: Floats  # (M, HARMONICS)
    """Amplitudes of the section over its mean radius: off-axis, elliptic, three lobes, ..."""
    opened: Floats  # (M,)
    """Fraction of the section that has no wall."""

    @property
    def bend(self) -> Floats:
        """Curvature times radius, (M,): 1 where the wall folds inside of the bend."""
        bend: Floats = self.curvature * self.radius
        return bend

    @property
    def narrowest(self) -> int:
        """Index of the section with the least clearance."""
        return int(np.argmin(self.clearance))

    @property
    def tightest(self) -> int:
        """Index of the section with the tightest bend."""
        return int(np.argmax(self.bend))

    @property
    def shape(self) -> str:
        """What the sections are like, in words, by their median harmonics."""
        amplitudes = np.median(self.harmonics[:, 1:], axis=0)
        strongest = int(np.argmax(amplitudes)) + 2
        if amplitudes.max() <= ROUND:
            return "round"
        return "elliptic" if strongest == 2 else f"{strongest} lobes"


@dataclass(frozen=True)
class Construction:
    """What a mesh is made of, and what is odd about it."""

    vertices: int
    faces: int
    duplicate_faces: int
    """Dropped, since others have the same corners."""
    thickness: float | None
    """Median distance from the inner to an outer wall (m), None for a single wall."""
    normals: str
    """Which way the normals of the faces point that are seen from inside: inward, outward or mixed."""
    flipped: float
    """Share of these faces whose normals point the other way than most."""
    capped: tuple[bool, bool]
    """Whether a wall stands before the start and behind the end of the axis."""
    openings: tuple[Opening, ...]
    holes: int
    """Holes and slits in the wall that are no openings."""


def measure_profile(tube: Tube) -> Profile:
    """Cut a tube across its axis, every `SPACING` radii."""
    radius = float(tube.radius.mean())
    points = resample_evenly(tube.axis, max(SPACING * radius, tube.length / MOST_SECTIONS))
    step = tube.length / (len(points) - 1)
    tangents = unit_tangents(points)
    rings = measure_rings(tube.wall.scene, _inside(points, tangents, step), tangents)
    closed = close_sideways(rings.distances, step / radius)
    mean = closed.mean(axis=1)
    along = arc_lengths(points)
    at_ends = np.minimum(along, along[-1] - along) < radius
    curvature, torsion = curvature_and_torsion(points, step, radius)
    waves = np.abs(np.fft.rfft(closed, axis=1))[:, 1 : HARMONICS + 1] * (2.0 / closed.shape[1])
    return Profile(
        arc_length=along,
        points=points,
        radius=mean,
        least=closed.min(axis=1),
        greatest=closed.max(axis=1),
        clearance=np.where(at_ends, closed.min(axis=1), clearance_of(tube.wall, points)),
        curvature=curvature,
        torsion=torsion,
        harmonics=waves / mean[:, None],
        opened=1.0 - rings.hits,
    )


def clearance_of(wall: Wall, points: Floats) -> Floats:
    """Distance from points (M, 3) to the nearest wall (m), (M,)."""
    return distances_to_wall(points, wall.vertices, wall.faces)


def curvature_and_torsion(points: Floats, step: float, radius: float) -> tuple[Floats, Floats]:
    """Curvature and torsion (1/m), (M,), of points (M, 3) at an even step (m), smoothed over a radius (m).

    Nearer to the ends than half of the smoothing both keep the last value.
    """
    window = min(2 * max(round(BEND_WINDOW * radius / step), 3) + 1, (len(points) - 1) // 2 * 2 + 1)
    if window < 5:
        return np.zeros(len(points)), np.full(len(points), np.nan)
    first, second, third = (fit_locally(points, window, 4, order, step) for order in (1, 2, 3))
    cross = np.cross(first, second)
    size = np.linalg.norm(cross, axis=1)
    curvature: Floats = size / np.linalg.norm(first, axis=1) ** 3
    bent = curvature * radius > STRAIGHT
    torsion = np.full(len(points), np.nan)
    torsion[bent] = (cross[bent] * third[bent]).sum(axis=1) / size[bent] ** 2
    half = window // 2
    for values in (curvature, torsion):
        values[:half], values[-half:] = values[half], values[-half - 1]
    return curvature, torsion


def examine(tube: Tube) -> Construction:
    """Look at the mesh of a tube: walls, normals, ends, openings."""
    wall, radius = tube.wall, float(tube.radius.mean())
    points = resample_evenly(tube.axis, max(SPACING * radius, tube.length / MOST_SECTIONS))
    tangents = unit_tangents(points)
    rings = measure_rings(wall.scene, _inside(points, tangents, tube.length / (len(points) - 1)), tangents)
    inward = _inward_share(wall, points, rings)
    flipped = min(inward, 1.0 - inward)
    openings, holes = find_all_openings(tube)
    ends = wall_ahead(wall.scene, tube.axis[[0, -1]], np.stack([-tube.tangent[0], tube.tangent[-1]]))
    capped = ends < CAP * radius
    return Construction(
        vertices=len(wall.vertices),
        faces=len(wall.faces),
        duplicate_faces=wall.duplicate_faces,
        thickness=_thickness(wall, points, rings, radius),
        normals="mixed" if flipped > MOST_FLIPPED else "inward" if inward > 0.5 else "outward",
        flipped=flipped,
        capped=(bool(capped[0]), bool(capped[1])),
        openings=tuple(openings),
        holes=len(holes),
    )


def find_all_openings(tube: Tube) -> tuple[list[Opening], list[Opening]]:
    """The openings of the space that a tube's axis runs through, and the holes and slits in its wall."""
    middle = tube.axis[len(tube.axis) // 2]
    try:
        choice = choose_lumen(
            tube.wall, draw_balls(tube.wall.scene, tube.wall.vertices, tube.wall.faces), [middle]
        )
    except CentrelineError:  # a centreline that a user drew through what is no tube by itself
        return [], []
    return choice[2], choice[3]


def _inside(points: Floats, tangents: Floats, step: float) -> Floats:
    """The points (M, 3), the first and last moved half a step (m) inside, where no rim is passed."""
    moved = points.copy()
    moved[0] += 0.5 * step * tangents[0]
    moved[-1] -= 0.5 * step * tangents[-1]
    return moved


def _inward_share(wall: Wall, points: Floats, rings: Rings) -> float:
    """Share of the rays whose face has its normal (by winding) against them."""
    directions = rings.directions.reshape(-1, 3)
    faces = wall.scene.faces_hit(np.repeat(points, rings.distances.shape[1], axis=0), directions)
    met = faces >= 0
    a, b, c = (wall.vertices[wall.faces[faces[met], k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    against = (normals * directions[met]).sum(axis=1) < 0.0
    return float(against.mean()) if met.any() else 0.0


def _thickness(wall: Wall, points: Floats, rings: Rings, radius: float) -> float | None:
    """Median way from the first wall to a second one right behind it (m), where most rays find one."""
    directions = rings.directions.reshape(-1, 3)
    first = rings.distances.ravel()
    met = np.isfinite(first)
    beyond = np.repeat(points, rings.distances.shape[1], axis=0)[met] + (
        (first[met] + 1e-3 * radius)[:, None] * directions[met]
    )
    second = wall.scene.distances(beyond, directions[met], np.inf)
    near = second < SECOND_WALL * radius
    return float(np.median(second[near])) + 1e-3 * radius if near.mean() > 0.5 else None
