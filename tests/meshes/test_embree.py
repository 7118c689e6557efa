"""Rays against walls whose distances are known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from meshes.embree import RayScene

SIDES = 96
SAGITTA = 1 - np.cos(np.pi / SIDES)
"""How far the flat sides of the cylinder lie inside of the round one."""


@pytest.fixture(scope="module")
def scene(shapes: Any) -> RayScene:
    """A cylinder along x, radius 1 m, 200 m long."""
    shape = shapes.straight(length=200.0, sides=SIDES, rings=401)
    return RayScene(shape.vertices, shape.faces)


def rays_from_inside(count: int, off_axis: float) -> tuple[Any, Any, Any]:
    """Origins, directions that reach the wall within the cylinder, and exact distances to the round wall."""
    rng = np.random.default_rng(5)
    turn, distance = rng.uniform(0, 2 * np.pi, count), off_axis * np.sqrt(rng.uniform(size=count))
    origins = np.stack([np.full(count, 100.0), distance * np.cos(turn), distance * np.sin(turn)], axis=1)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    a = (directions[:, 1:] ** 2).sum(axis=1)
    b = (directions[:, 1:] * origins[:, 1:]).sum(axis=1)
    exact = (-b + np.sqrt(b * b + a * (1 - distance**2))) / a
    within = exact < 90.0
    return origins[within], directions[within], exact[within]


def test_distances_of_a_cylinder(scene: RayScene) -> None:
    """Rays read the round wall within the sagitta of its flat sides, magnified by their slant."""
    origins, directions, exact = rays_from_inside(20_000, off_axis=0.8)
    found = scene.distances(origins, directions, np.inf)
    hit = origins + found[:, None] * directions
    radius = np.hypot(hit[:, 1], hit[:, 2])
    assert np.all(radius <= 1 + 1e-4)
    assert np.all(radius >= 1 - SAGITTA - 1e-4)
    assert np.median(np.abs(found - exact)) < 2 * SAGITTA


def test_no_ray_slips_through_an_edge(scene: RayScene) -> None:
    """Not one of many rays from inside, most of them grazing, leaves through a closed wall."""
    origins, directions, _ = rays_from_inside(300_000, off_axis=0.99)
    assert np.all(scene.distances(origins, directions, np.inf) < 200.0)


def test_rays_along_edges_meet_the_wall(scene: RayScene) -> None:
    """A ray aimed exactly at a vertex, or at the seam of two faces, meets it."""
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    directions = np.stack([np.zeros(SIDES), np.cos(angle), np.sin(angle)], axis=1)
    for x in (100.0, 100.25):
        found = scene.distances(np.tile([x, 0.0, 0.0], (SIDES, 1)), directions, 3.0)
        np.testing.assert_allclose(found, 1.0, atol=1e-5)


def test_reach_limits_and_marks_a_miss(scene: RayScene) -> None:
    """A wall beyond the reach reads exactly the reach, as does no wall at all; without a limit that is infinity."""
    origins = np.array([[100.0, 0.0, 0.0]] * 3)
    directions = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [np.sqrt(0.99), 0.1, 0.0]])
    np.testing.assert_allclose(scene.distances(origins, directions, 3.3), [1.0, 3.3, 3.3], atol=1e-3)
    assert scene.distances(origins, directions, 3.3)[1] == 3.3
    assert scene.distances(origins, directions, np.inf)[1] == np.inf


def test_both_sides_of_a_face_count(shapes: Any) -> None:
    """Turning every face round changes no distance."""
    shape = shapes.straight()
    origins, directions = np.array([[5.0, 0.2, 0.1]]), np.array([[0.0, 0.6, 0.8]])
    one = RayScene(shape.vertices, shape.faces).distances(origins, directions, 3.0)
    other = RayScene(shape.vertices, shape.faces[:, ::-1]).distances(origins, directions, 3.0)
    np.testing.assert_array_equal(one, other)


def test_blocked_by_a_wall_between(scene: RayScene) -> None:
    """The way is blocked exactly where a wall lies between, and a way of no length is free."""
    origins = np.array([[100.0, 0.0, 0.0]] * 4)
    targets = np.array([[100.0, 0.99, 0.0], [100.0, 1.01, 0.0], [190.0, 0.5, 0.0], [100.0, 0.0, 0.0]])
    assert scene.blocked(origins, targets).tolist() == [False, True, False, False]


def test_a_scene_far_away_is_as_exact(shapes: Any) -> None:
    """A wall 1,000 km from the origin reads the same distances to 1e-6 m."""
    shape = shapes.straight()
    origins, directions = np.array([[5.0, 0.2, 0.1]]), np.array([[0.0, 0.6, 0.8]])
    near = RayScene(shape.vertices, shape.faces).distances(origins, directions, 3.0)
    far = RayScene(shape.vertices + 1e6, shape.faces).distances(origins + 1e6, directions, 3.0)
    np.testing.assert_allclose(far, near, atol=1e-6)
