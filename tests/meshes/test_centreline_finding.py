"""Centrelines found from walls alone: as near to the known axis as promised, and refused where there is no way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from tubular import (
    Mesh,
    circle,
    cut,
    extrude,
    helix,
    in_tube,
    join,
    junction,
    line,
    rectangle,
    s_bend,
    trefoil,
    wall_of,
)

from meshes.centreline_finding import FoundCentreline, find_centreline
from meshes.curves import arc_lengths, generate_curve
from meshes.errors import CentrelineError, EndsError
from meshes.sections import resample_evenly
from meshes.sweep import sweep_wall
from meshes.swept import sweep_section
from meshes.tube import INDUSTRIAL, MeanRadius, read_tube
from meshes.wall import read_wall

Floats = NDArray[np.float64]
ELSEWHERE = Path(__file__).parents[3] / "shared" / "meshes"
"""Meshes that others made, where they lie beside this repository."""

STRAIGHT = line([0.0, 0.0, 0.0], [20.0, 0.0, 0.0], 81)
BAR = 0.05
"""A found centreline is at most so many radii off, but for the last radius at either end."""


def deviation(found: Floats, axis: Floats, radius: float) -> float:
    """Greatest distance between two polylines, either way, over the radius, the last radius at each end apart."""
    worst = 0.0
    found, axis = (resample_evenly(points, 0.02 * radius) for points in (found, axis))
    for points, other in ((found, axis), (axis, found)):
        along = arc_lengths(points)
        inner = points[(along > radius) & (along < along[-1] - radius)]
        worst = max(worst, float(cKDTree(other).query(inner)[0].max()))
    return worst / radius


def length_of(found: FoundCentreline) -> float:
    """Arc length of a found centreline."""
    return float(arc_lengths(found.points)[-1])


def swept(
    shape: str, level: int, seed: int, sides: int, harmonics: Sequence[tuple[int, float]], swing: float
) -> tuple[Mesh, Floats]:
    """A generated tube of mean radius 1 m, and its axis."""
    curve = generate_curve(level, (seed,), 16.0, domain="tune", shape=shape, widest=1.3)
    count = len(curve.points)
    waves = np.zeros((count, 4, 2))
    for order, amplitude in harmonics:
        waves[:, order - 2, 0] = amplitude
    radius = 1.0 + swing * np.sin(2.0 * np.pi * np.arange(count) / count * 2.0)
    tube = sweep_section(curve, radius, waves)
    vertices, faces = sweep_wall(tube, sides)
    return (vertices, faces.astype(np.int64)), tube.points


# ---------------------------------------------------------------- accuracy


@pytest.mark.parametrize(
    ("shape", "level", "sides", "harmonics", "swing"),
    [
        ("curriculum", 0, 8, [], 0.0),
        ("curriculum", 1, 12, [], 0.2),
        ("curriculum", 2, 48, [(2, 0.15)], 0.0),
        ("helix", 2, 16, [], 0.2),
        ("s-bend", 2, 24, [(2, 0.1), (3, 0.08)], 0.0),
        ("elbow", 2, 32, [(3, 0.08), (5, 0.05)], 0.1),
    ],
)
def test_axis_of_a_swept_tube_is_found(
    shape: str, level: int, sides: int, harmonics: list[tuple[int, float]], swing: float
) -> None:
    """Whatever the curve, the section and the number of sides: within 0.05 R of the axis, from mouth to mouth."""
    mesh, axis = swept(shape, level, 3, sides, harmonics, swing)
    found = find_centreline(wall_of(mesh))
    assert deviation(found.points, axis, 1.0) < BAR
    assert found.used in ((1, 2), (2, 1))
    assert found.capped == (False, False)
    ends = found.points[[0, -1]]
    assert max(np.linalg.norm(axis[[0, -1]] - end, axis=1).min() for end in ends) < 0.25


def test_centreline_of_the_shipped_conduit_is_found() -> None:
    """Of 75 m through seven bends and three radii nothing but the last metres is more than 0.05 R off."""
    tube = read_tube(INDUSTRIAL)
    found = find_centreline(tube.wall)
    assert deviation(found.points, tube.axis, 1.0) < BAR
    assert length_of(found) == pytest.approx(tube.length, rel=0.005)


def test_same_mesh_has_the_same_centreline_at_every_size_and_place() -> None:
    """Found twice it is the same to the last bit; in millimetres, turned and far away it is the same tube."""
    vertices, faces = extrude(s_bend(), circle())
    found = find_centreline(wall_of((vertices, faces)))
    assert np.array_equal(find_centreline(wall_of((vertices, faces))).points, found.points)
    turn = np.array([[0.0, -1.0, 0.0], [0.6, 0.0, -0.8], [0.8, 0.0, 0.6]])
    there = find_centreline(wall_of((1000.0 * vertices @ turn.T + 1e5, faces)))
    back = (there.points - 1e5) @ turn / 1000.0
    assert deviation(back, found.points, 1.0) < 0.02


@pytest.mark.parametrize("kind", ["noisy", "flipped", "duplicated", "jacket", "solid"])
def test_sloppy_meshes_have_the_axis_of_clean_ones(kind: str) -> None:
    """Rough vertices, normals any way, faces twice, a jacket around, rims between both: the lumen is the same."""
    rng = np.random.default_rng(5)
    axis = s_bend()
    vertices, faces = extrude(axis, circle(32))
    if kind == "noisy":
        vertices = vertices + rng.normal(0.0, 0.04, vertices.shape)
    elif kind == "flipped":
        turned = rng.random(len(faces)) < 0.5
        faces[turned] = faces[turned][:, ::-1]
    elif kind == "duplicated":
        faces = np.concatenate([faces, faces[:, [1, 2, 0]], faces[::-1]])
    else:
        outer, outer_faces = extrude(axis, circle(32, 1.3))
        vertices, faces = join((vertices, faces), (outer, outer_faces))
        if kind == "solid":
            rim = np.arange(32)
            for first in (0, len(outer) - 32):
                a, b = first + rim, first + (rim + 1) % 32
                rims = np.concatenate(
                    [
                        np.stack([a, b, b + len(outer)], 1),
                        np.stack([a, b + len(outer), a + len(outer)], 1),
                    ]
                )
                faces = np.concatenate([faces, rims])
    found = find_centreline(wall_of((vertices, faces)))
    assert deviation(found.points, axis, 1.0) < BAR
    assert found.radius == pytest.approx(1.0, abs=0.12)


@pytest.mark.parametrize(
    ("width", "height"), [(2.0, 2.0), (4.0, 1.0)], ids=["square duct", "duct four times as wide as high"]
)
def test_ducts_of_four_triangles_a_side_are_centred(width: float, height: float) -> None:
    """A duct of eight triangles as long as itself: its centre, though no vertex is near."""
    axis = line([0.0, 0.0, 0.0], [20.0, 3.0, 1.0])
    found = find_centreline(wall_of(extrude(axis, rectangle(width, height))))
    assert deviation(found.points, axis, 1.0) < BAR


def test_narrow_and_wide_places_are_passed_in_the_middle() -> None:
    """A cone, a narrowing to a third, a chamber four times as wide: the path stays on the axis."""
    s = STRAIGHT[:, 0]
    for radii in (
        np.linspace(0.5, 1.5, 81),
        1.0 - 0.65 * np.exp(-(((s - 10.0) / 1.5) ** 2)),
        1.0 + 3.0 * np.exp(-(((s - 10.0) / 2.0) ** 2)),
    ):
        found = find_centreline(wall_of(extrude(STRAIGHT, [circle(24, r) for r in radii])))
        assert deviation(found.points, STRAIGHT, 1.0) < BAR


def test_section_of_a_star_is_one_tube() -> None:
    """Corners that see the middle of no other: one tube with two openings, on its axis."""
    angle = 2.0 * np.pi * np.arange(10) / 10
    spikes = np.where(np.arange(10) % 2, 0.5, 1.4)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    found = find_centreline(wall_of(extrude(s_bend(31), spikes)))
    assert deviation(found.points, s_bend(), 0.8) < BAR
    assert len(found.openings) == 2


def test_section_of_an_l_is_one_tube() -> None:
    """Two legs with a corner between them: one tube, from mouth to mouth."""
    corners = np.array([[-1, -1], [3, -1], [3, 1], [1, 1], [1, 3], [-1, 3]], dtype=float)
    found = find_centreline(wall_of(extrude(STRAIGHT[[0, -1]], corners)))
    assert sorted(found.points[[0, -1], 0]) == pytest.approx([0.0, 20.0], abs=0.1)


@pytest.mark.parametrize("kind", ["holes", "joints"])
def test_gaps_in_the_wall_are_noted_and_flown(kind: str) -> None:
    """A scan with holes, a pipe of segments that do not quite meet: the axis of the whole one, and a note."""
    vertices, faces = extrude(STRAIGHT, circle(32))
    middle = vertices[faces].mean(axis=1)
    if kind == "holes":
        centres = np.random.default_rng(3).choice(middle, 20)
        kept = np.linalg.norm(middle[:, None] - centres, axis=2).min(axis=1) > 0.3
    else:
        kept = (middle[:, 0] < 0.3) | (middle[:, 0] % 5.0 > 0.25)
    found = find_centreline(wall_of((vertices, faces[kept])))
    assert deviation(found.points, STRAIGHT, 1.0) < BAR
    assert (found.used, len(found.openings)) == ((1, 2), 2)
    assert any("do not meet" in note if kind == "joints" else "hole" in note for note in found.notes)


# ---------------------------------------------------------------- ends


def test_caps_are_found_and_kept_off() -> None:
    """Both ends closed: from half a radius behind one cap to half a radius before the other, without openings."""
    found = find_centreline(wall_of(extrude(s_bend(), circle(), caps=True)))
    assert (found.capped, found.openings, found.used) == ((True, True), (), (None, None))
    assert length_of(found) == pytest.approx(4.0 * np.pi - 1.0, abs=0.5)


def test_one_open_end_is_where_it_starts() -> None:
    """A plate across a tube near its end: from the opening to half a radius before the plate."""
    plate = extrude(line([19.0, 0, 0], [19.001, 0, 0]), circle(), caps=True)
    found = find_centreline(wall_of(join(extrude(STRAIGHT, circle()), plate)))
    assert (found.used, found.capped) == ((1, None), (False, True))
    assert found.points[-1, 0] == pytest.approx(18.5, abs=0.3)


def test_junction_without_a_choice_is_refused_with_its_openings() -> None:
    """Three ways out: all are listed with numbers, and the error carries them for whoever draws them."""
    with pytest.raises(
        EndsError, match=r"found 3 openings: 1 at .*; 2 at .*; 3 at .*--entry 1 --exit 2"
    ) as refusal:
        find_centreline(wall_of(junction([-8, 0, 0], [8, 0, 0], [0, 8, 0])))
    centres = np.array([opening.centre for opening in refusal.value.openings])
    for end in ([-8, 0, 0], [8, 0, 0], [0, 8, 0]):
        assert np.linalg.norm(centres - end, axis=1).min() < 0.3


@pytest.mark.parametrize(
    ("ends", "length"), [(((-7.9, 0, 0), (7.9, 0, 0)), 16.0), (((-7.9, 0, 0), (0, 7.9, 0)), 15.5)]
)
def test_named_ends_are_joined_through_a_junction(ends: Any, length: float) -> None:
    """Straight across and around the corner: from one named mouth to the other."""
    found = find_centreline(wall_of(junction([-8, 0, 0], [8, 0, 0], [0, 8, 0])), *ends)
    for end, named in zip(found.points[[0, -1]], ends, strict=True):
        assert np.linalg.norm(end - named) < 0.3
    assert length_of(found) == pytest.approx(length, abs=0.6)


def test_ends_are_named_by_the_numbers_of_openings() -> None:
    """Opening 1 is the one nearest to the origin, of two as far the one further back in x, then y, then z of the
    file, whatever its axes; from 3 to 1 is the way from the first to the last of them."""
    ends = np.array([[6, -5, 1], [6, 5, 0], [-12, 0, 0]], dtype=float)
    wall = wall_of(junction(*ends))
    found = find_centreline(wall, 3, 1)
    assert found.used == (3, 1)
    assert np.linalg.norm(found.points[0] - ends[2]) < 0.3
    turned = replace(wall, vertices=wall.vertices[:, [0, 2, 1]] * [1.0, -1.0, 1.0], axes="yup")
    for openings, places in ((found.openings, wall), (find_centreline(turned, 1, 2).openings, turned)):
        centres = places.to_file(np.array([opening.centre for opening in openings]))
        assert np.linalg.norm(centres - ends, axis=1).max() < 0.3
    with pytest.raises(CentrelineError, match="expected the number of one of 3 openings"):
        find_centreline(wall, 4, 1)


def test_the_shorter_of_two_ways_is_taken() -> None:
    """A ring with two mouths: the way around the near side, not the far one."""
    turn = 2.0 * np.pi * np.arange(200) / 200
    ring = 6.0 * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
    spokes = [
        line([5.0 * np.cos(a), 5.0 * np.sin(a), 0], [12 * np.cos(a), 12 * np.sin(a), 0], 29)
        for a in (0.0, 1.5)
    ]

    def in_ring(points: Floats) -> NDArray[np.bool_]:
        inside: NDArray[np.bool_] = np.hypot(np.hypot(points[:, 0], points[:, 1]) - 6.0, points[:, 2]) < 0.95
        return inside

    body = extrude(ring, circle(24), closed=True)
    for spoke in spokes:
        outside = np.stack([spoke[4], spoke[-1]])
        body = cut(body, in_tube(outside, 0.95), rounds=1 if spoke is spokes[0] else 0)
    tubes = [cut(extrude(spoke, circle(24)), in_ring, rounds=1) for spoke in spokes]
    tubes = [cut(tube, lambda points: np.hypot(points[:, 0], points[:, 1]) < 6.0, rounds=0) for tube in tubes]
    found = find_centreline(wall_of(join(body, *tubes)), spokes[0][-1], spokes[1][-1])
    assert length_of(found) == pytest.approx(2 * 6.0 + 1.5 * 6.0, abs=2.0)


def test_a_start_inside_begins_there_and_an_end_alone_is_enough() -> None:
    """Named in the middle of the tube it starts in that section; the other end is the one furthest away."""
    wall = wall_of(extrude(STRAIGHT, circle()))
    found = find_centreline(wall, (5.0, 0.2, 0.0))
    assert found.points[0, 0] == pytest.approx(5.0, abs=0.3)
    assert (found.points[-1, 0], found.used) == (pytest.approx(20.0, abs=0.1), (None, 2))
    assert find_centreline(wall, exit=(0.0, 0.0, 0.0)).points[0, 0] == pytest.approx(20.0, abs=0.1)


# ---------------------------------------------------------------- which space


@pytest.mark.parametrize("around", ["wider tube", "hall", "room"])
def test_inner_tube_is_flown_and_not_what_is_around_it(around: str) -> None:
    """A tube in a tube, in a closed hall sixty radii wide, or in a low room: the tube that is behind most walls."""
    other = {
        "wider tube": extrude(STRAIGHT, circle(24, 2.2)),
        "hall": box(60.0, 60.0, 60.0),
        "room": box(60.0, 30.0, 20.0),
    }[around]
    found = find_centreline(wall_of(join(extrude(STRAIGHT, circle()), other)))
    assert deviation(found.points, STRAIGHT, 1.0) < BAR
    assert found.used == (1, 2)


@pytest.mark.parametrize("pitch", [2.2, 4.0])
def test_coil_is_flown_around_and_not_through_its_core(pitch: float) -> None:
    """Turns that nearly touch, and turns a tube apart: the tube and not the space that it winds around."""
    axis = helix(4, 4.0, pitch, 320)
    found = find_centreline(wall_of(extrude(axis, circle(24))))
    assert deviation(found.points, axis, 1.0) < BAR


def test_spiral_duct_is_flown_from_foot_to_head() -> None:
    """A staircase: a duct higher than wide that winds upright around its core."""
    axis = helix(2.5, 3.0, 5.0, 150)
    found = find_centreline(wall_of(extrude(axis, rectangle(2.0, 3.0), upright=True)))
    assert deviation(found.points, axis, 1.0) < 0.1
    assert found.used == (1, 2)


# ---------------------------------------------------------------- refusals


def channel(opening: float) -> Mesh:
    """A tube along x without the part of its wall that stands within half an angle (degrees) of +z."""
    vertices, faces = extrude(STRAIGHT, circle(48))
    middle = vertices[faces].mean(axis=1)
    angle = np.degrees(np.arctan2(middle[:, 2], middle[:, 1]))
    return vertices, faces[np.abs(angle - 90.0) > opening / 2.0]


def pinched(least: float) -> Mesh:
    """A tube that narrows to a radius at x = 10."""
    radii = 1.0 - (1.0 - least) * np.exp(-((STRAIGHT[:, 0] - 10.0) ** 2))
    return extrude(STRAIGHT, [circle(24, max(r, 1e-6)) for r in radii])


def crossing() -> Mesh:
    """A loop that runs through its own wall."""
    t = np.linspace(-2.2, 2.2, 200)
    return extrude(4.0 * np.stack([t**3 - 3.0 * t, 1.5 * t**2, 0.0 * t], axis=1), circle())


def ball() -> Mesh:
    """A sphere."""
    body = trimesh.creation.icosphere(subdivisions=3)
    return np.asarray(body.vertices, dtype=float), np.asarray(body.faces, dtype=np.int64)


def box(*extents: float) -> Mesh:
    """A closed box about the origin."""
    body = trimesh.creation.box(extents)
    return np.asarray(body.vertices, dtype=float), np.asarray(body.faces, dtype=np.int64)


def bowl() -> Mesh:
    """Half of a sphere."""
    vertices, faces = ball()
    return vertices, faces[vertices[faces].mean(axis=1)[:, 2] < 0.0]


def plane() -> Mesh:
    """Two triangles."""
    return np.array([[0, 0, 0], [9, 0, 0], [9, 9, 0], [0, 9, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (plane, "no two walls that face each other: an open surface"),
        (partial(channel, 180.0), "an open surface|as in a half-pipe"),
        (partial(channel, 90.0), r"open along its side from \(.*\) to \(.*\), as a half-pipe is"),
        (ball, "no longer than wide"),
        (partial(box, 2.0, 2.0, 2.0), "no longer than wide"),
        (partial(pinched, 0.0), r"blocked or pinched near \((9\.|10)"),
        (partial(pinched, 0.08), r"pinched (near|at) \((9\.|10)"),
        (lambda: extrude(trefoil(), circle(16, 0.8), closed=True), "a closed loop through"),
        (crossing, "blocked or pinched near"),
        (lambda: box(20.0, 20.0, 2.0), r"wide or flat space without openings around \(-?0\."),
        (bowl, "no longer than wide"),
        (
            lambda: join(extrude(STRAIGHT, circle()), extrude(STRAIGHT + np.array([21.5, 0.0, 0.0]), circle())),
            r"parts of it that do not meet near \(20\.",
        ),
        (
            lambda: join(extrude(STRAIGHT, circle()), extrude(STRAIGHT + np.array([0.0, 5.0, 0.0]), circle())),
            r"another of its size beside it, nearest at \(.*2\.[45]",
        ),
    ],
    ids=[
        "plane", "half-pipe", "channel", "sphere", "cube", "pinched shut", "pinched", "closed knot",
        "self-crossing", "flat box", "bowl", "tubes in a row", "two tubes",
    ],
)  # fmt: skip
def test_what_cannot_be_flown_is_refused_with_reason_and_place(make: Callable[[], Mesh], why: str) -> None:
    """No enclosure, no length, no free way, no ends, no single tube: each has its own sentence."""
    with pytest.raises(CentrelineError, match=why):
        find_centreline(wall_of(make()))


def test_what_stands_in_the_middle_is_passed() -> None:
    """A plate across the lower half of a tube: over it, with room, and along the axis elsewhere."""
    plate = np.array([[10, -1, -1], [10, 1, -1], [10, 1, 0], [10, -1, 0]], dtype=float), plane()[1]
    mesh = join(extrude(STRAIGHT, circle()), plate)
    found = find_centreline(wall_of(mesh))
    over = found.points[np.argmin(np.abs(found.points[:, 0] - 10.0))]
    assert over[2] > 0.25
    assert any("stands in the tube near (9.9" in note or "near (10" in note for note in found.notes)
    assert np.abs(found.points[np.abs(found.points[:, 0] - 10.0) > 3.0][:, 1:]).max() < BAR


def test_narrow_slit_is_noted_and_flown() -> None:
    """A twelfth of the wall is missing all along: the tube still guides, and the note says where it is open."""
    found = find_centreline(wall_of(channel(30.0)))
    assert deviation(found.points, STRAIGHT, 1.0) < 0.1
    assert any("slit" in note for note in found.notes)


def test_blocked_junction_is_refused_with_the_place() -> None:
    """A branch that is welded on without a hole: no way from the entry to the exit, and where it ends."""
    mesh = join(
        extrude(line([-8, 0, 0], [8, 0, 0], 41), circle()),
        extrude(line([0, 0.9, 0], [0, 8, 0], 21), circle()),
    )
    with pytest.raises(CentrelineError, match=r"expected a way from .* found none: .* near \(.*\)"):
        find_centreline(wall_of(mesh), (-7.9, 0, 0), (0, 7.9, 0))


def test_ends_outside_of_the_tube_are_refused_with_the_nearest_place() -> None:
    """A point beside the tube lies in no space: the message says how far it is and where to go."""
    with pytest.raises(CentrelineError, match=r"found \(5, 4, 0\) outside of it: the nearest place inside"):
        find_centreline(wall_of(extrude(STRAIGHT, circle())), (5.0, 4.0, 0.0), (19.0, 0.0, 0.0))
    with pytest.raises(CentrelineError, match="apart from each other"):
        find_centreline(wall_of(extrude(STRAIGHT, circle())), (5.0, 0.0, 0.0), (5.0, 0.0, 0.0))


# ---------------------------------------------------------------- meshes that others made


def mesh_of(name: str) -> Path:
    """A mesh that another made, or a skip that says where it is expected."""
    path = ELSEWHERE / name
    if not path.exists():
        pytest.skip(f"{path} is not there: meshes that others made are no part of this repository")
    return path


@pytest.mark.parametrize(
    ("name", "length", "radius", "capped"),
    [
        ("inpipe22/pipes22.obj", 10.1, 0.2, False),
        ("tile_ramp2/cave_tile_ramp2.obj", 22.2, 2.36, False),
        ("colon/Colon.stl", 216.0, 43.9, False),
        ("cal_coil/coil.stl", 85.8, 0.304, True),
        ("trimesh_tube/tube.obj", 11.84, 0.678, False),
    ],
)
def test_tubes_that_others_made_are_found(name: str, length: float, radius: float, capped: bool) -> None:
    """Double walls, horseshoes, haustra, a capped coil, a pipe of 60 vertices: length and radius as measured."""
    tube = read_tube(mesh_of(name))
    assert tube.found is not None
    assert tube.length == pytest.approx(length, rel=0.05)
    assert float(tube.radius.mean()) == pytest.approx(radius, rel=0.05)
    assert tube.found.capped == (capped, capped)


@pytest.mark.parametrize("exit", [(0, 2, -10), (10, 2, 0), (-10, 2, 0)])
def test_tile_with_four_openings_needs_a_choice(exit: tuple[float, float, float]) -> None:
    """From the entry to each of the others there is a way; without a choice the four are listed."""
    wall = read_wall(mesh_of("tile_5/cave_tile_5.obj"))
    with pytest.raises(EndsError, match="found 4 openings"):
        find_centreline(wall)
    found = find_centreline(wall, (0, 2.2, 9.99), exit)
    assert np.linalg.norm(found.points[0] - [0, 2.2, 9.99]) < 1.0
    assert np.linalg.norm(found.points[-1] - exit) < 1.0


def test_scale_by_radius_makes_the_mean_radius_so_wide(tmp_path: Path) -> None:
    """A tube of R 44 without a unit, made 1 m wide: wall, found centreline and openings shrink together."""
    vertices, faces = extrude(44.0 * s_bend(), circle(48, 44.0))
    path = tmp_path / "millimetres.stl"
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    tube = read_tube(path, scale=MeanRadius(1.0))
    assert tube.found is not None
    assert float(tube.radius.mean()) == pytest.approx(1.0, rel=0.01)
    assert tube.scale == pytest.approx(1.0 / 44.0, rel=0.01)
    assert tube.found.openings[0].radius == pytest.approx(1.0, abs=0.15)
