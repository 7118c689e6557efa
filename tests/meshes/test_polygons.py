"""Polygons in triangles: they cover the polygon, once, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from meshes.polygons import triangulate

Floats = NDArray[np.float64]

L_SHAPE = [(0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)]
STAR = [
    ((2.0 if k % 2 else 0.7) * np.cos(k * np.pi / 7), (2.0 if k % 2 else 0.7) * np.sin(k * np.pi / 7))
    for k in range(14)
]
RING = [(-2, -2), (2, -2), (2, 2), (-2, 2), (-2, -2), (-1, -1), (-1, 1), (1, 1), (1, -1), (-1, -1)]
"""A square with a square hole, joined to its rim by a cut: the end face of a thick-walled duct."""
STRAIGHT = [(0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2), (0, 1)]
"""With corners in the middle of its sides."""


def area(corners: Floats) -> float:
    """Of polygons in a plane, (..., n, 2): the sum of the signed areas."""
    x, y = np.moveaxis(corners, -1, 0)
    return float(0.5 * (x * np.roll(y, -1, axis=-1) - np.roll(x, -1, axis=-1) * y).sum())


@pytest.mark.parametrize("outline", [L_SHAPE, STAR, RING, STRAIGHT], ids=["L", "star", "ring", "straight"])
@pytest.mark.parametrize("first", [0, 3])
@pytest.mark.parametrize("turned", [False, True])
def test_a_polygon_with_dents_is_covered_once(
    outline: list[tuple[float, float]], first: int, turned: bool
) -> None:
    """Anywhere in space, from whichever corner, either way round: no triangle is turned over, and their areas sum up
    to the polygon's, so that none of them covers a dent."""
    flat = np.roll(np.array(outline, dtype=float), first, axis=0)[:: -1 if turned else 1]
    x, y = np.array([0.6, 0.8, 0.0]), np.array([0.0, 0.0, 1.0])
    triangles = triangulate(flat @ np.stack([x, y]) + 5.0, np.arange(len(flat))[None])[0]
    assert triangles.shape == (len(flat) - 2, 3)
    areas = np.array([area(flat[triangle]) for triangle in triangles])
    assert (areas * area(flat) > -1e-9).all()
    assert areas.sum() == pytest.approx(area(flat))


def test_what_has_no_dents_is_cut_into_a_fan() -> None:
    """Quads and hexagons from their first corner, however a quad is twisted a little."""
    angle = 2.0 * np.pi * np.arange(6) / 6
    vertices = np.stack([np.cos(angle), np.sin(angle), 0.05 * np.sin(2.0 * angle)], axis=1)
    assert triangulate(vertices, np.arange(6)[None]).tolist() == [
        [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    ]
    assert triangulate(vertices, np.array([[5, 0, 2, 3], [0, 1, 3, 4]])).shape == (2, 2, 3)
