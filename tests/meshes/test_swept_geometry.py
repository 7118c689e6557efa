"""Swept tubes against closed forms, against dense samples of their wall, and against the mesh of the same tube."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from meshes.curves import Curve, generate_curve
from meshes.errors import CurveError, MeshError
from meshes.mesh_geometry import MeshGeometry
from meshes.sweep import sweep_wall, write_centreline_obj, write_obj
from meshes.swept import SweptTube, circular, sweep_section
from meshes.swept_geometry import SweptGeometry
from meshes.tube import read_tube

Floats = NDArray[np.float64]

BEND = 3.0
"""Radius of the torus's axis (m)."""


def straight(length: float = 10.0, step: float = 0.2) -> Curve:
    """From the origin along x."""
    x = step * np.arange(round(length / step) + 1)
    return Curve(np.stack([x, 0.0 * x, 0.0 * x], axis=1), step)


def circle(angle: float = 5.0, bend: float = BEND) -> Curve:
    """From (bend, 0, 0) anticlockwise about z."""
    count = round(angle * bend / 0.2) + 1
    turn = np.linspace(0.0, angle, count)
    points = bend * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
    return Curve(points, angle * bend / (count - 1))


def torus_points(turn: Floats, distance: Floats, angle: Floats, bend: float = BEND) -> Floats:
    """Points at a distance from the torus's axis, towards `angle` from outwards to up."""
    ring = bend + distance * np.cos(angle)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), distance * np.sin(angle)], axis=-1)


def torus_distance(points: Floats, bend: float = BEND) -> Floats:
    """Distance from the torus's axis."""
    return np.hypot(np.hypot(points[..., 0], points[..., 1]) - bend, points[..., 2])


def unit(vectors: Floats) -> Floats:
    """Vectors of length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def shaped_tube(level: int = 1, seed: int = 5) -> SweptTube:
    """A generated curve with a radius and a section that both change along it."""
    curve = generate_curve(level, [seed])
    s = np.linspace(0.0, 1.0, len(curve.points))
    radius = 0.9 + 0.15 * np.sin(2.0 * np.pi * s)
    harmonics = np.zeros((len(s), 2, 2))
    harmonics[:, 0, 0] = 0.15 * np.cos(3.0 * s)
    harmonics[:, 0, 1] = 0.1 * s
    harmonics[:, 1, 1] = 0.04
    return sweep_section(curve, radius, harmonics)


def axis_ring(geometry: SweptGeometry | MeshGeometry, s: Floats, rng: np.random.Generator) -> Floats:
    """A point in each lane at arc length s, up to half a metre off the axis."""
    foot, tangent = geometry.axis(s)
    side = unit(np.cross(tangent, rng.normal(size=foot.shape)))
    points: Floats = foot + rng.uniform(0.0, 0.5, (len(s), 1)) * side
    return points


@settings(max_examples=60, deadline=None)
@given(
    st.floats(0.0, 0.9),
    st.floats(0.0, 6.3),
    st.floats(0.05, 3.1),
    st.floats(0.0, 6.3),
)
def test_rays_in_a_cylinder(distance: float, angle: float, tilt: float, turn: float) -> None:
    """A ray in a straight round tube ends where its distance from the axis is R, or at its reach."""
    geometry = SweptGeometry([circular(straight(), 0.95)])
    origin = np.array([5.0, distance * np.cos(angle), distance * np.sin(angle)])
    direction = np.array([np.cos(tilt), np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn)])
    a, b = np.sin(tilt) ** 2, origin[1:] @ direction[1:]
    expected = (-b + np.sqrt(b * b + a * (0.95**2 - distance**2))) / a
    found = geometry.rays(origin[None, None], direction[None, None], 3.0)
    np.testing.assert_allclose(found, min(expected, 3.0), atol=5e-4)


def test_rays_in_a_torus() -> None:
    """Rays in a torus end on its wall, and stay inside until there."""
    rng = np.random.default_rng(1)
    geometry = SweptGeometry([circular(circle())], lanes=100)
    origins = torus_points(rng.uniform(1.2, 3.8, 100), rng.uniform(0.0, 0.9, 100), rng.uniform(0, 7, 100))
    directions = unit(rng.normal(size=(100, 30, 3)))
    distances = geometry.rays(np.repeat(origins[:, None], 30, axis=1), directions, 3.0)
    ways = np.linspace(0.0, 1.0, 200)[:, None, None] * distances
    walls = torus_distance(origins[:, None] + ways[..., None] * directions)
    assert (walls < 1.0 + 1e-4).all()
    ends = walls[-1][distances < 3.0]
    assert len(ends) > 2000
    np.testing.assert_allclose(ends, 1.0, atol=1e-4)


def test_axis_queries_in_a_torus() -> None:
    """Nearest axis point, its arc length, tangent and distance, clearance and inside are those of a torus."""
    rng = np.random.default_rng(2)
    n = 500
    turn, distance, angle = rng.uniform(0.2, 4.8, n), rng.uniform(0.0, 1.3, n), rng.uniform(0.0, 7.0, n)
    points = torus_points(turn, distance, angle)
    geometry = SweptGeometry([circular(circle())], lanes=n)
    found = geometry.project(points)
    np.testing.assert_allclose(found.arc_length, BEND * turn, atol=1e-4)
    np.testing.assert_allclose(found.position, torus_points(turn, 0.0 * turn, angle), atol=1e-4)
    tangent = np.stack([-np.sin(turn), np.cos(turn), 0.0 * turn], axis=1)
    np.testing.assert_allclose(found.tangent, tangent, atol=1e-4)
    np.testing.assert_allclose(found.radial_distance, distance, atol=1e-5)
    np.testing.assert_allclose(found.radius, 1.0)
    np.testing.assert_allclose(geometry.clearance(points, found), 1.0 - distance, atol=1e-5)
    np.testing.assert_array_equal(geometry.inside(points, found), distance < 1.0)
    position, along = geometry.axis(found.arc_length)
    np.testing.assert_allclose(position, found.position, atol=1e-9)
    np.testing.assert_allclose(along, found.tangent, atol=1e-9)
    np.testing.assert_allclose(geometry.length, 5.0 * BEND)


def test_axis_is_clipped_to_its_ends() -> None:
    """Arc lengths before the start and behind the end give the ends."""
    geometry = SweptGeometry([circular(straight())], lanes=2)
    position, tangent = geometry.axis(np.array([-3.0, 40.0]))
    np.testing.assert_allclose(position, [[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(tangent, [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]], atol=1e-12)


def test_line_of_sight_in_a_torus() -> None:
    """Two axis points of a torus see each other as long as their chord keeps within the inner wall."""
    limit = 2.0 * np.arccos((BEND - 1.0) / BEND)
    apart = limit + np.array([-1.0, -0.3, -0.01, 0.01, 0.3, 1.0])
    zero = np.zeros(6)
    start, end = torus_points(zero + 0.5, zero, zero), torus_points(zero + 0.5 + apart, zero, zero)
    geometry = SweptGeometry([circular(circle())], lanes=6)
    assert geometry.visible(start, end).tolist() == [True, True, True, False, False, False]
    assert geometry.visible(end, start).tolist() == [True, True, True, False, False, False]
    assert geometry.visible(start, start).all()


def test_open_ends() -> None:
    """Rays leave through the mouths; a point before a mouth sees the inside through it, and nothing else."""
    geometry = SweptGeometry([circular(straight())])
    origins = np.array(
        [
            [9.5, 0, 0],
            [0.5, 0, 0],
            [-0.5, 0, 0],
            [-0.5, 0, 0],
            [-0.5, 0, 0],
            [10.5, 0, 0],
            [-0.5, 1.5, 0],
            [5, 1.2, 0],
        ],
        dtype=float,
    )
    directions = unit(
        np.array(
            [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [-1, 0, 0], [1, 1, 0], [-1, 0, 1], [1, 0, 0], [0, 1, 0]], float
        )
    )
    found = geometry.rays(origins[None], directions[None], 3.0)[0]
    expected = [3.0, 3.0, 3.0, 3.0, np.sqrt(2.0), np.sqrt(2.0), 3.0, 0.0]
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_beyond_the_ends() -> None:
    """A point beyond an end plane is outside, at the negative distance of the rim."""
    points = np.array([[-0.3, 0.6, 0.0], [10.4, 0.0, 1.3], [0.0, 0.5, 0.0], [10.0, 0.5, 0.0]])
    geometry = SweptGeometry([circular(straight())], lanes=4)
    found = geometry.project(points)
    np.testing.assert_allclose(found.arc_length, [0.0, 10.0, 0.0, 10.0], atol=1e-12)
    assert geometry.inside(points, found).tolist() == [False, False, True, True]
    np.testing.assert_allclose(geometry.clearance(points, found), [-0.5, -0.5, 0.5, 0.5], atol=1e-9)


def test_search_near_an_arc_length() -> None:
    """A search near an arc length keeps to that part of a tube which comes back to itself."""
    geometry = SweptGeometry([circular(circle(6.1))], lanes=3)
    points = torus_points(np.full(3, 6.2), np.zeros(3), np.zeros(3))
    found = geometry.project(points, np.array([0.5, 17.9, np.nan]))
    np.testing.assert_allclose(found.arc_length, [0.0, 6.1 * BEND, 0.0], atol=1e-6)


def test_window_does_not_jump() -> None:
    """The arc length that is found stays within 2 m of the one that was given, give or take one point."""
    geometry = SweptGeometry([circular(straight())], lanes=2)
    found = geometry.project(np.array([[8.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), np.array([2.0, 8.0]))
    np.testing.assert_allclose(found.arc_length, [4.0, 6.0], atol=0.2)


def test_rays_in_an_elliptic_tube() -> None:
    """Rays in a straight tube with an elliptic section end where the section's formula says."""
    harmonics = np.array([[0.2, 0.1], [0.05, 0.0]])
    tube = sweep_section(straight(), 0.9, harmonics)
    geometry = SweptGeometry([tube])
    rng = np.random.default_rng(3)
    directions = unit(rng.normal(size=(1, 400, 3)))
    origins = np.tile([5.0, 0.2, -0.3], (1, 400, 1))
    found = geometry.rays(origins, directions, 3.0)
    ends = (origins + found[..., None] * directions)[found < 3.0]
    assert len(ends) > 300
    binormal = np.cross(tube.tangents[0], tube.normals[0])
    angle = np.arctan2(ends @ binormal, ends @ tube.normals[0])
    section = 0.9 * (1.0 + 0.2 * np.cos(2 * angle) + 0.1 * np.sin(2 * angle) + 0.05 * np.cos(3 * angle))
    np.testing.assert_allclose(np.hypot(ends[:, 1], ends[:, 2]), section, atol=5e-4)
    np.testing.assert_allclose(tube.section(angle)[0], section, atol=1e-12)


def test_clearance_in_a_cone() -> None:
    """In a straight tube that widens, the wall is nearer than in the section, by the cosine of its slope."""
    curve = straight()
    radius = 0.8 + 0.06 * curve.points[:, 0]
    points = np.array([[5.0, 0.0, 0.0], [5.0, 0.4, 0.3], [3.0, 0.0, -0.8], [5.0, 0.0, 1.3]])
    geometry = SweptGeometry([circular(curve, radius)], lanes=4)
    found = geometry.project(points)
    np.testing.assert_allclose(found.radius, [1.1, 1.1, 0.98, 1.1], atol=1e-12)
    expected = (found.radius - found.radial_distance) / np.hypot(1.0, 0.06)
    np.testing.assert_allclose(geometry.clearance(points, found), expected, atol=2e-3)


def test_clearance_against_a_dense_wall() -> None:
    """With a changing, lobed section the clearance is the distance to the nearest of very many wall points."""
    tube = shaped_tube()
    rings = sweep_wall(tube, sides=240)[0].reshape(-1, 240, 3)
    wall = np.concatenate([(1.0 - u) * rings[:-1] + u * rings[1:] for u in np.arange(0.0, 1.0, 0.1)])
    wall = wall.reshape(-1, 3)
    geometry = SweptGeometry([tube], lanes=80)
    rng = np.random.default_rng(4)
    points = axis_ring(geometry, rng.uniform(2.0, 18.0, 80), rng)
    found = geometry.clearance(points, geometry.project(points))
    nearest = np.array([np.sqrt(((wall - point) ** 2).sum(axis=1).min()) for point in points])
    np.testing.assert_allclose(found, nearest, atol=5e-3)
    assert np.median(np.abs(found - nearest)) < 1e-3


def test_rays_end_on_a_shaped_wall() -> None:
    """In a tube that changes in every way, rays end on the wall and do not pass through it before."""
    tube = shaped_tube()
    geometry = SweptGeometry([tube], lanes=60)
    rng = np.random.default_rng(5)
    points = axis_ring(geometry, rng.uniform(4.0, 16.0, 60), rng)
    directions = unit(rng.normal(size=(60, 20, 3)))
    distances = geometry.rays(np.repeat(points[:, None], 20, axis=1), directions, 3.0)
    for k in range(20):
        for part in (0.25, 0.5, 0.75, 1.0):
            way = points + (part * distances[:, k, None]) * directions[:, k]
            clearance = geometry.clearance(way, geometry.project(way))
            assert (clearance > -1e-3).all()
        np.testing.assert_allclose(clearance[distances[:, k] < 3.0], 0.0, atol=1e-3)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.floats(-100.0, 100.0), st.booleans())
def test_rigid_motion(seed: int, shift: float, shaped: bool) -> None:
    """Moving tube and drone together changes no distance."""
    rng = np.random.default_rng(seed)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    offset = shift * rng.normal(size=3)
    tube = shaped_tube() if shaped else circular(generate_curve(2, [11]))
    moved = SweptTube(
        tube.points @ rotation.T + offset,
        tube.step,
        tube.tangents @ rotation.T,
        tube.normals @ rotation.T,
        tube.radius,
        tube.harmonics,
    )
    here, there = SweptGeometry([tube], lanes=5), SweptGeometry([moved], lanes=5)
    points = axis_ring(here, rng.uniform(1.0, 19.0, 5), rng)
    directions = unit(rng.normal(size=(5, 8, 3)))
    origins = np.repeat(points[:, None], 8, axis=1)
    expected = here.rays(origins, directions, 3.0)
    found = there.rays(origins @ rotation.T + offset, directions @ rotation.T, 3.0)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    points = points @ rotation.T + offset
    away = there.clearance(points, there.project(points))
    back = (points - offset) @ rotation
    np.testing.assert_allclose(away, here.clearance(back, here.project(back)), atol=1e-6)


def test_answers_do_not_depend_on_earlier_questions() -> None:
    """A lane whose last known place is far away gets the same answers as a fresh one."""
    tube = circular(generate_curve(2, [8]))
    used, fresh = SweptGeometry([tube], lanes=4), SweptGeometry([tube], lanes=4)
    used.project(used.axis(np.array([19.0, 0.0, 10.0, 19.9]))[0])
    rng = np.random.default_rng(6)
    points = axis_ring(used, np.array([1.0, 19.0, 2.0, 10.0]), rng)
    origins, directions = np.repeat(points[:, None], 50, axis=1), unit(rng.normal(size=(4, 50, 3)))
    np.testing.assert_array_equal(used.rays(origins, directions, 3.0), fresh.rays(origins, directions, 3.0))
    target = used.axis(np.array([3.0, 17.0, 4.0, 12.0]))[0]
    np.testing.assert_array_equal(used.visible(points, target), fresh.visible(points, target))


def test_lanes_have_tubes_of_their_own() -> None:
    """Each lane is asked in its own tube, and changes it without disturbing the others."""
    tubes = [circular(straight(), radius) for radius in (0.5, 1.0, 1.5)] + [circular(straight(4.0), 2.0)]
    geometry = SweptGeometry(tubes, lanes=3)
    points = np.tile([2.0, 0.0, 0.0], (3, 1))
    up = np.tile([0.0, 0.0, 1.0], (3, 1, 1))
    np.testing.assert_allclose(geometry.rays(points[:, None], up, 3.0)[:, 0], [0.5, 1.0, 1.5], atol=1e-6)
    geometry.assign([1], [3])
    np.testing.assert_allclose(geometry.rays(points[:, None], up, 3.0)[:, 0], [0.5, 2.0, 1.5], atol=1e-6)
    np.testing.assert_allclose(geometry.length, [10.0, 4.0, 10.0])
    np.testing.assert_array_equal(geometry.assigned, [0, 3, 2])
    with pytest.raises(MeshError, match=r"expected 0 to 3 but found \[4\]"):
        geometry.assign([0], [4])


def test_rays_of_active_lanes_only() -> None:
    """Lanes that are not active need not be in any tube; the others are answered as ever."""
    geometry = SweptGeometry([circular(straight())], lanes=2)
    origins = np.array([[[5.0, 0.0, 0.0]], [[np.nan, 0.0, 0.0]]])
    directions = np.tile([0.0, 1.0, 0.0], (2, 1, 1))
    found = geometry.rays(origins, directions, 3.0, np.array([True, False]))
    np.testing.assert_allclose(found[0], 1.0, atol=1e-6)


def test_not_a_number_is_answered_by_not_a_number() -> None:
    """A broken pose neither hangs a ray nor turns into a distance."""
    geometry = SweptGeometry([circular(straight())])
    nowhere = np.full((1, 1, 3), np.nan)
    assert np.isnan(geometry.rays(nowhere, np.array([[[0.0, 0.0, 1.0]]]), 3.0)).all()
    assert np.isnan(geometry.project(nowhere[0]).radial_distance).all()


def test_refilling_a_slot() -> None:
    """A slot takes a new tube of at most its size; a longer one is refused."""
    geometry = SweptGeometry([circular(straight(), 0.5), circular(circle())], lanes=2)
    geometry.replace([0], [circular(straight(6.0), 0.7)])
    points, up = np.tile([3.0, 0.0, 0.0], (2, 1)), np.tile([0.0, 0.0, 1.0], (2, 1, 1))
    np.testing.assert_allclose(geometry.rays(points[:, None], up, 3.0)[:, 0], [0.7, 1.0], atol=1e-4)
    assert geometry.length[0] == pytest.approx(6.0)
    geometry.replace([0], [circular(straight(10.0), 0.6)])
    assert geometry.length[0] == pytest.approx(10.0)
    with pytest.raises(MeshError, match="slot 0: expected at most 51 points"):
        geometry.replace([0], [circular(straight(10.4))])


def test_a_tube_of_two_kilometres() -> None:
    """Queries work at the far end of a very long tube as at its start."""
    tube = circular(generate_curve(1, [3], length=2000.0))
    geometry = SweptGeometry([tube], lanes=2)
    s = np.array([5.0, 1995.0])
    foot, tangent = geometry.axis(s)
    side = unit(np.cross(tangent, [0.3, 0.5, 0.8]))
    points = foot + 0.25 * side
    for near in (None, s + 1.0):
        found = geometry.project(points, near)
        np.testing.assert_allclose(found.arc_length, s, atol=1e-3)
        np.testing.assert_allclose(found.radial_distance, 0.25, atol=1e-4)
    np.testing.assert_allclose(geometry.rays(points[:, None], side[:, None], 3.0)[:, 0], 0.75, atol=1e-3)


def test_a_pool_needs_tubes_and_lanes() -> None:
    """No tube, or no lane, is refused."""
    with pytest.raises(MeshError, match="at least one tube and one lane"):
        SweptGeometry([], lanes=1)
    with pytest.raises(MeshError, match="at least one tube and one lane"):
        SweptGeometry([circular(straight())], lanes=0)


def test_frame_does_not_twist() -> None:
    """The frame is orthonormal, and its normal turns only with the tangent: in a plane curve, not at all."""
    tube = circular(circle())
    np.testing.assert_allclose(np.linalg.norm(tube.normals, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose((tube.normals * tube.tangents).sum(axis=1), 0.0, atol=1e-12)
    np.testing.assert_allclose(tube.normals[:, 2], tube.normals[0, 2], atol=1e-9)
    generated = circular(generate_curve(2, [1]))
    change = np.diff(generated.normals, axis=0)
    middle = unit(generated.tangents[1:] + generated.tangents[:-1])
    binormal = np.cross(middle, generated.normals[1:])
    assert np.abs((change * binormal).sum(axis=1)).max() < 2e-3


@pytest.mark.parametrize(
    ("radius", "harmonics", "message"),
    [
        (3.2, np.zeros((0, 2)), "the wall folds"),
        (2.5, np.array([[0.3, 0.0]]), "the wall folds"),
        (0.0, np.zeros((0, 2)), "would be closed"),
        (1.0, np.array([[0.8, 0.0], [0.3, 0.0]]), "would be closed"),
        (np.ones(7), np.zeros((0, 2)), "one for each of 76 points"),
        (1.0, np.zeros((2, 3)), "harmonics"),
    ],
)
def test_impossible_sections(radius: float | Floats, harmonics: Floats, message: str) -> None:
    """A section that closes, folds inside of a bend, or has the wrong shape is refused."""
    with pytest.raises(CurveError, match=message):
        sweep_section(circle(), radius, harmonics)


def test_uneven_points() -> None:
    """A curve whose points are not a step apart is refused."""
    points = np.array([[0.0, 0, 0], [0.2, 0, 0], [0.9, 0, 0]])
    with pytest.raises(CurveError, match="resample"):
        circular(Curve(points, 0.2))
    with pytest.raises(CurveError, match=r"expected \(M, 3\)"):
        circular(Curve(np.zeros((1, 3)), 0.2))


@pytest.mark.parametrize("shaped", [False, True], ids=["round", "shaped"])
def test_swept_curve_agrees_with_its_mesh(shaped: bool, tmp_path: Path) -> None:
    """Rays, radius, clearance, inside and line of sight are the same from a swept curve and from its mesh."""
    tube = shaped_tube() if shaped else circular(generate_curve(2, [21]))
    write_obj(tmp_path / "tube.obj", *sweep_wall(tube))
    write_centreline_obj(tmp_path / "tube_centerline.obj", tube.points)
    n = 200
    swept, mesh = SweptGeometry([tube], n), MeshGeometry([read_tube(tmp_path / "tube.obj")], n)
    rng = np.random.default_rng(7)
    points = axis_ring(swept, rng.uniform(0.3, 19.7, n), rng)
    one, other = swept.project(points), mesh.project(points)
    assert np.median(np.abs(one.arc_length - other.arc_length)) < 0.01
    assert np.abs(one.radial_distance - other.radial_distance).max() < 0.01
    assert np.median(np.abs(one.radius - other.radius)) < 0.01
    origins, directions = np.repeat(points[:, None], 72, axis=1), unit(rng.normal(size=(n, 72, 3)))
    rays = np.abs(swept.rays(origins, directions, 3.0) - mesh.rays(origins, directions, 3.0))
    assert np.median(rays) < 0.003
    assert np.quantile(rays, 0.99) < 0.05
    clearance = np.abs(swept.clearance(points, one) - mesh.clearance(points, other))
    assert np.median(clearance) < 0.005
    assert clearance.max() < 0.02
    outwards = one.position + unit(points - one.position) * rng.uniform(0.5, 1.6, (n, 1))
    sides = [geometry.inside(outwards, geometry.project(outwards)) for geometry in (swept, mesh)]
    assert 0.2 < sides[0].mean() < 0.8
    assert (sides[0] == sides[1]).mean() > 0.98
    targets = swept.axis(one.arc_length + rng.uniform(1.0, 5.0, n))[0]
    seen = [geometry.visible(points, targets) for geometry in (swept, mesh)]
    assert seen[0].any()
    assert (seen[0] == seen[1]).mean() > 0.97
