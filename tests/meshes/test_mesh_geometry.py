"""The geometry of mesh tubes against closed forms of cylinder and torus."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from meshes.errors import MeshError
from meshes.geometry import AxisPoints
from meshes.mesh_geometry import MeshGeometry
from meshes.tube import Tube, read_tube

Floats = NDArray[np.float64]
WriteTube = Callable[..., Path]

BEND = 4.0
"""Bend radius of the half torus (m); its tube has a radius of 1 m."""


def torus_points(count: int, off_axis: float = 0.8) -> tuple[Floats, Floats, Floats]:
    """Random points inside of the half torus: position, angle along it, offset from the axis."""
    rng = np.random.default_rng(3)
    angle = rng.uniform(0.2, np.pi - 0.2, count)
    offset, turn = off_axis * np.sqrt(rng.uniform(size=count)), rng.uniform(0, 2 * np.pi, count)
    across = BEND + offset * np.cos(turn)
    return (
        np.stack([across * np.cos(angle), across * np.sin(angle), offset * np.sin(turn)], axis=1),
        angle,
        offset,
    )


# ---------------------------------------------------------------- axis


def test_project_onto_a_bend(half_torus: Tube) -> None:
    """Arc length, position, tangent, radial distance and radius are those of the circle.

    Off the axis, a point of the polyline stands for a little piece of the bend: up to 8 mm here.
    """
    points, angle, offset = torus_points(200)
    found = MeshGeometry([half_torus], lanes=200).project(points)
    np.testing.assert_allclose(found.arc_length, BEND * angle, atol=8e-3)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(200)], axis=1)
    np.testing.assert_allclose(found.position, BEND * circle, atol=8e-3)
    np.testing.assert_allclose(
        found.tangent, np.stack([-circle[:, 1], circle[:, 0], circle[:, 2]], axis=1), atol=8e-3
    )
    np.testing.assert_allclose(found.radial_distance, offset, atol=2e-3)
    np.testing.assert_allclose(found.radius, 1.0, atol=2e-3)


def test_project_beyond_the_ends_is_clipped(cylinder: Tube) -> None:
    """The nearest point of the axis is then its end, and the radial distance runs to that."""
    found = MeshGeometry([cylinder], lanes=2).project(np.array([[-3.0, 0.0, 4.0], [13.0, 4.0, 0.0]]))
    np.testing.assert_allclose(found.arc_length, [0.0, 10.0])
    np.testing.assert_allclose(found.position, [[0, 0, 0], [10, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(found.radial_distance, [5.0, 5.0])


def test_project_near_keeps_to_its_branch(write_tube: WriteTube, shapes: Any) -> None:
    """Where a tube passes close to itself, the search keeps within 2 m of the arc length that it is told."""
    tube = read_tube(write_tube(shapes.bend(bend_radius=1.2, angle=1.9 * np.pi, radius=0.5)))
    geometry = MeshGeometry([tube], lanes=3)
    point = np.array([1.2, -0.15, 0.0])  # off the start, nearly touched by the end
    near = np.array([0.0, tube.length, np.nan])
    found = geometry.project(np.tile(point, (3, 1)), near).arc_length
    assert found[0] == 0.0
    assert found[1] > tube.length - 0.3
    assert found[2] == found[0]


def test_project_near_agrees_with_a_full_search(half_torus: Tube) -> None:
    """With a true arc length within a metre, the window changes nothing."""
    points, angle, _ = torus_points(200)
    geometry = MeshGeometry([half_torus], lanes=200)
    full = geometry.project(points).arc_length.copy()
    shift = np.random.default_rng(0).uniform(-1, 1, 200)
    np.testing.assert_array_equal(geometry.project(points, BEND * angle + shift).arc_length, full)


@pytest.mark.parametrize("near", [-50.0, 50.0])
def test_project_near_nowhere_stays_on_the_axis(near: float, cylinder: Tube) -> None:
    """An arc length outside of the tube searches at the end next to it."""
    found = MeshGeometry([cylinder]).project(np.array([[5.0, 0.0, 0.0]]), np.array([near]))
    assert 0.0 <= found.arc_length[0] <= 10.0


def test_axis_at_arc_lengths(half_torus: Tube) -> None:
    """Points and tangents of the circle, clipped at both ends."""
    wanted = np.array([-1.0, 0.0, 1.0, 7.77, 4 * np.pi, 20.0])
    angle = np.clip(wanted, 0.0, half_torus.length) / BEND
    points, tangents = MeshGeometry([half_torus], lanes=6).axis(wanted)
    np.testing.assert_allclose(
        points, BEND * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1), atol=2e-3
    )
    np.testing.assert_allclose(
        tangents, np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1), atol=3e-3
    )
    np.testing.assert_allclose(np.linalg.norm(tangents, axis=1), 1.0)


def test_project_and_axis_agree(half_torus: Tube) -> None:
    """The projection of a point of the axis is that point, at that arc length."""
    wanted = np.linspace(0.0, half_torus.length, 50)
    geometry = MeshGeometry([half_torus], lanes=50)
    points = geometry.axis(wanted)[0].copy()
    found = geometry.project(points)
    np.testing.assert_allclose(found.arc_length, wanted, atol=1e-9)
    np.testing.assert_allclose(found.radial_distance, 0.0, atol=1e-7)


# ---------------------------------------------------------------- walls


def test_rays_in_a_bend(half_torus: Tube) -> None:
    """Rays in the plane of a bend read the intersections with its inner and outer circle."""
    geometry = MeshGeometry([half_torus], lanes=1)
    origins = np.tile([[[0.0, BEND, 0.0]]], (1, 3, 1))
    directions = np.array([[[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]])
    np.testing.assert_allclose(geometry.rays(origins, directions, 9.0), [[1.0, 1.0, 3.0]], atol=2e-3)
    np.testing.assert_allclose(geometry.rays(origins, directions, 2.0), [[1.0, 1.0, 2.0]], atol=2e-3)


def test_line_of_sight_round_a_bend(half_torus: Tube) -> None:
    """A chord of the axis is free until it touches the inner wall: up to 2 acos(3/4) of the turn."""
    limit = 2 * np.arccos((BEND - 1) / BEND)
    angles = np.array([0.5 * limit, 0.97 * limit, 1.03 * limit, 1.5 * limit])
    geometry = MeshGeometry([half_torus], lanes=4)
    start = BEND * np.tile([[np.cos(0.2), np.sin(0.2), 0.0]], (4, 1))
    targets = BEND * np.stack([np.cos(angles + 0.2), np.sin(angles + 0.2), 0 * angles], axis=1)
    assert geometry.visible(start, targets).tolist() == [True, True, False, False]
    assert geometry.visible(targets, start).tolist() == [True, True, False, False]


def test_clearance_in_a_bend(half_torus: Tube) -> None:
    """The clearance is radius less offset, and negative outside of the wall."""
    for off_axis, count in ((0.98, 300), (0.05, 20)):
        points, _, offset = torus_points(count, off_axis)
        geometry = MeshGeometry([half_torus], lanes=count)
        found = geometry.clearance(points, geometry.project(points))
        np.testing.assert_allclose(found, 1 - offset, atol=3e-3)
    geometry = MeshGeometry([half_torus], lanes=2)
    points = np.array([[0.0, BEND + 1.4, 0.0], [0.0, BEND - 1.4, 0.0]])
    np.testing.assert_allclose(geometry.clearance(points, geometry.project(points)), -0.4, atol=3e-3)


def test_inside_and_outside(cylinder: Tube) -> None:
    """Inside is within the wall and between the planes of the ends."""
    points = np.array(
        [
            [5.0, 0.0, 0.0],
            [5.0, 0.7, 0.7],
            [5.0, 0.72, 0.72],
            [0.01, 0.5, 0.0],
            [-0.01, 0.5, 0.0],
            [9.99, 0.0, 0.5],
            [10.01, 0.0, 0.5],
            [5.0, 5.0, 5.0],
        ]
    )
    expected = [True, True, False, True, False, True, False, False]
    geometry = MeshGeometry([cylinder], lanes=len(points))
    nearest = geometry.project(points)
    assert geometry.inside(points, nearest).tolist() == expected
    assert (geometry.clearance(points, nearest) > 0).tolist() == expected


def test_between_the_walls_of_a_pipe_is_outside(write_tube: WriteTube, shapes: Any) -> None:
    """In a double wall the inner surface bounds the tube: within the steel is outside, as is beyond it."""
    tube = read_tube(write_tube(shapes.join(shapes.straight(), shapes.straight(radius=1.1))))
    points = np.array([[5.0, 0.9, 0.0], [5.0, 1.04, 0.0], [5.0, 1.2, 0.0]])
    geometry = MeshGeometry([tube], lanes=3)
    nearest = geometry.project(points)
    assert geometry.inside(points, nearest).tolist() == [True, False, False]
    np.testing.assert_allclose(geometry.clearance(points, nearest), [0.1, -0.04, -0.1], atol=2e-3)
    origins = np.tile([[5.0, 0.0, 0.0]], (3, 1, 1))
    directions = np.tile([[0.0, 0.6, 0.8]], (3, 1, 1))
    np.testing.assert_allclose(geometry.rays(origins, directions, 3.0), 1.0, atol=1e-3)


# ---------------------------------------------------------------- lanes


def test_lanes_see_their_own_tubes(cylinder: Tube, half_torus: Tube) -> None:
    """A batch over two tubes is, lane for lane, what each tube alone answers."""
    rng = np.random.default_rng(9)
    tubes, lanes = [cylinder, half_torus], 6
    both = MeshGeometry(tubes, lanes)
    assert both.assigned.tolist() == [0, 1, 0, 1, 0, 1]
    both.assign([0, 1], [1, 0])
    order = [1, 0, 0, 1, 0, 1]
    alone = [MeshGeometry([tubes[tube]]) for tube in order]
    points = np.stack([geometry.axis(np.array([4.0 + i]))[0][0] for i, geometry in enumerate(alone)])
    points += rng.uniform(-0.4, 0.4, (lanes, 3))
    targets = points + rng.normal(size=(lanes, 3))
    origins = np.repeat(points[:, None], 7, axis=1)
    directions = rng.normal(size=(lanes, 7, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)

    nearest = both.project(points)
    rays = both.rays(origins, directions, 3.0)
    for i, geometry in enumerate(alone):
        row = slice(i, i + 1)
        own = geometry.project(points[row])
        for name in AxisPoints.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(nearest, name)[row], getattr(own, name))
        np.testing.assert_array_equal(rays[row], geometry.rays(origins[row], directions[row], 3.0))
        assert both.length[i] == geometry.length[0]
        assert both.visible(points, targets)[i] == geometry.visible(points[row], targets[row])[0]
        assert both.inside(points, nearest)[i] == geometry.inside(points[row], own)[0]
        assert both.clearance(points, nearest)[i] == geometry.clearance(points[row], own)[0]


@pytest.mark.parametrize("assigned", [[0, 0, 0, 0], [0, 1, 1, 0]])
def test_rays_of_active_lanes_alone(assigned: list[int], cylinder: Tube, half_torus: Tube) -> None:
    """Rows of active lanes are the same as without a mask."""
    geometry = MeshGeometry([cylinder, half_torus], lanes=4)
    geometry.assign(np.arange(4), assigned)
    origins = np.stack([[[5.0, 0, 0]] * 2 if tube == 0 else [[0, BEND, 0]] * 2 for tube in assigned]).astype(
        float
    )
    directions = np.tile([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], (4, 1, 1))
    active = np.array([True, False, True, False])
    np.testing.assert_array_equal(
        geometry.rays(origins, directions, 3.0, active)[active],
        geometry.rays(origins, directions, 3.0)[active],
    )
    geometry.rays(origins, directions, 3.0, np.zeros(4, dtype=bool))


def test_any_layout_of_arrays_is_taken(half_torus: Tube) -> None:
    """Transposed and strided points give what contiguous ones give."""
    points, _, _ = torus_points(5)
    geometry = MeshGeometry([half_torus], lanes=5)
    expected = geometry.project(points).arc_length.copy()
    np.testing.assert_array_equal(geometry.project(np.asfortranarray(points)).arc_length, expected)
    np.testing.assert_array_equal(geometry.project(np.repeat(points, 2, axis=0)[::2]).arc_length, expected)


def test_impossible_makings_are_refused(cylinder: Tube) -> None:
    """No tube, no lane, and a tube index of no tube."""
    with pytest.raises(MeshError, match="expected at least one tube and one lane, found 0 and 1"):
        MeshGeometry([])
    with pytest.raises(MeshError, match="found 1 and 0"):
        MeshGeometry([cylinder], lanes=0)
    with pytest.raises(MeshError, match=r"expected tube indices from 0 to 0, found \[1\]"):
        MeshGeometry([cylinder]).assign([0], [1])
