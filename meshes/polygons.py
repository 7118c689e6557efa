"""Polygons cut into triangles."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from meshes.geometry import Bools, Floats

Indices = NDArray[np.int64]

DENT: Final = 1e-6
"""A corner that turns back by less than this, over the polygon's area, is as good as straight."""


def triangulate(vertices: Floats, polygons: Indices) -> Indices:
    """Triangles (P, n - 2, 3) of polygons (P, n), as indices of vertices (V, 3).

    A fan from the first corner where no corner turns back. Where one does, as where another pipe was cut out of a
    wall, a fan would cover what the polygon leaves open: there ear after ear is cut off.
    """
    size = polygons.shape[1]
    triangles: Indices = polygons[:, [[0, i, i + 1] for i in range(1, size - 1)]]
    if size == 3:
        return triangles
    corners = vertices[polygons] - vertices[polygons[:, :1]]  # (P, n, 3)
    normals = np.cross(corners, np.roll(corners, -1, axis=1)).sum(axis=1)  # (P, 3), twice the area long
    for i in np.flatnonzero(_dented(corners, normals)):
        triangles[i] = polygons[i][_cut_ears(_flat(corners[i], normals[i]))]
    return triangles


def _dented(corners: Floats, normals: Floats) -> Bools:
    """Which of the polygons have a corner that turns back, (P,)."""
    ahead = np.roll(corners, -1, axis=1) - corners
    turns = np.einsum("pni,pi->pn", np.cross(np.roll(ahead, 1, axis=1), ahead), normals)
    dented: Bools = (turns < -DENT * (normals**2).sum(axis=1)[:, None]).any(axis=1)
    return dented


def _flat(corners: Floats, normal: Floats) -> Floats:
    """Corners (n, 3) in their plane, (n, 2), counter-clockwise."""
    normal = normal / np.linalg.norm(normal)
    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    across /= np.linalg.norm(across)
    flat: Floats = corners @ np.stack([across, np.cross(normal, across)], axis=1)
    return flat


def _cut_ears(corners: Floats) -> list[tuple[int, int, int]]:
    """Triangles, as indices of corners (n, 2) of a simple polygon, counter-clockwise."""
    left = list(range(len(corners)))
    triangles = []
    at = refused = 0
    while len(left) > 3:
        ear = left[at - 1], left[at], left[(at + 1) % len(left)]
        if refused < len(left) and not _is_ear(corners, left, ear):
            refused += 1
            at = (at + 1) % len(left)
            continue
        triangles.append(ear)  # also where nothing but slivers is left
        del left[at]
        at, refused = at % len(left), 0
    triangles.append((left[0], left[1], left[2]))
    return triangles


def _is_ear(corners: Floats, left: list[int], ear: tuple[int, int, int]) -> bool:
    """Whether a corner points outward and no other corner that is left lies in its triangle."""
    a, b, c = corners[list(ear)]
    least = 1e-12 * float(np.ptp(corners, axis=0).max()) ** 2
    if _turn(a, b, c) <= least:
        return False
    others = corners[left]
    inside = np.minimum(_turn(a, b, others), np.minimum(_turn(b, c, others), _turn(c, a, others))) > least
    return not inside.any()


def _turn(a: Floats, b: Floats, points: Floats) -> Floats:
    """Twice the area of the triangles from a to b to each point (..., 2): positive to the left."""
    ahead, aside = b - a, points - a
    return ahead[0] * aside[..., 1] - ahead[1] * aside[..., 0]  # type: ignore[no-any-return]
