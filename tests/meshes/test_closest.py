"""Distance to a wall, against another implementation and against closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from trimesh.triangles import closest_point

from meshes.closest import build_tree, wall_distance

Floats = NDArray[np.float64]


def distances(vertices: Floats, faces: Any, points: Floats) -> Floats:
    """Through a tree."""
    tree = build_tree(vertices, np.asarray(faces, dtype=np.int32))
    found = np.empty(len(points))
    wall_distance(points, tree.boxes, tree.triangles, np.full(len(points), -1), found)
    return found


def brute_force(vertices: Floats, faces: Any, points: Floats) -> Floats:
    """By trying every triangle with trimesh's nearest point."""
    triangles = vertices[faces]
    return np.array(
        [
            np.linalg.norm(
                closest_point(triangles, np.tile(point, (len(triangles), 1))) - point, axis=1
            ).min()
            for point in points
        ]
    )


@pytest.mark.parametrize("faces", [1, 2, 3, 5, 64, 257, 1000])
def test_soup_agrees_with_brute_force(faces: int) -> None:
    """Random triangles of very different sizes, any number of them, from points inside and far outside."""
    rng = np.random.default_rng(faces)
    size = rng.lognormal(-1.0, 1.0, (faces, 1, 1))
    corners = rng.normal(size=(faces, 1, 3)) * 3 + size * rng.normal(size=(faces, 3, 3))
    points = np.concatenate([rng.normal(size=(20, 3)) * 3, rng.normal(size=(5, 3)) * 100])
    indices = np.arange(3 * faces).reshape(-1, 3)
    vertices = corners.reshape(-1, 3)
    np.testing.assert_allclose(
        distances(vertices, indices, points), brute_force(vertices, indices, points), rtol=1e-9, atol=1e-9
    )


def test_the_triangle_that_it_begins_with_changes_nothing() -> None:
    """From whichever triangle a search begins, it ends with the same bits, and at a nearest triangle."""
    rng = np.random.default_rng(7)
    vertices, faces = rng.normal(size=(120, 3)), np.arange(120, dtype=np.int32).reshape(-1, 3)
    tree = build_tree(vertices, faces)
    points = np.tile(rng.normal(size=3), (41, 1))
    nearest, found = np.arange(-1, 40), np.empty(41)
    wall_distance(points, tree.boxes, tree.triangles, nearest, found)
    assert len(set(found.tolist())) == 1
    again = np.empty(41)
    wall_distance(points, tree.boxes, tree.triangles, nearest, again)
    assert np.array_equal(found, again)


@given(st.lists(st.tuples(*[st.integers(-3, 3)] * 3), min_size=4, max_size=4))
def test_one_triangle_of_any_form_agrees_with_sampling(corners: list[tuple[int, int, int]]) -> None:
    """Also lines and single places, which are triangles of no area: compared with the nearest of dense samples."""
    a, b, c, point = np.array(corners, dtype=np.float64)
    s, t = np.meshgrid(np.linspace(0, 1, 61), np.linspace(0, 1, 61))
    inside = s + t <= 1 + 1e-12
    samples = a + s[inside][:, None] * (b - a) + t[inside][:, None] * (c - a)
    nearest = np.linalg.norm(samples - point, axis=1).min()
    found = distances(np.array([a, b, c]), [[0, 1, 2]], point[None])[0]
    assert found <= nearest + 1e-9
    # No sample is farther from the nearest place than the cells are wide.
    assert found >= nearest - 0.25


def test_cylinder_from_everywhere(shapes: Any) -> None:
    """Inside of a cylinder the distance is radius less offset, within the sagitta of its flat sides."""
    shape = shapes.straight(rings=201)
    rng = np.random.default_rng(1)
    offset, turn = rng.uniform(0, 2, 500), rng.uniform(0, 2 * np.pi, 500)
    points = np.stack([rng.uniform(2, 8, 500), offset * np.cos(turn), offset * np.sin(turn)], axis=1)
    np.testing.assert_allclose(
        distances(shape.vertices, shape.faces, points), np.abs(1 - offset), atol=1 - np.cos(np.pi / 96) + 1e-9
    )


def test_long_triangles_are_no_trouble(shapes: Any) -> None:
    """A cylinder of triangles as long as itself has the same distances."""
    shape = shapes.straight(rings=2)
    points = np.array([[5.0, 0.3, 0.4], [1.0, 0.0, 0.0], [9.0, 0.0, -0.9]])
    np.testing.assert_allclose(distances(shape.vertices, shape.faces, points), [0.5, 1.0, 0.1], atol=1e-3)
