"""Fewer triangles for a picture: vertices of one cell of a grid become one."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from meshes.geometry import Floats

Ints = NDArray[np.int32]

GROWTH: Final = 1.2
"""From one try's cell to the next one's."""


def thin_surface(vertices: Floats, faces: Ints, most: int) -> tuple[Floats, Ints]:
    """The same surface with at most so many triangles, by the same length coarser everywhere; itself if it has few.

    Args:
        vertices: (V, 3).
        faces: (F, 3), indices of vertices.
        most: triangles to keep, at least 1.

    Returns:
        Vertices (W, 3), each the mean of those of its cell, and faces (G, 3) with G <= most.
    """
    if len(faces) <= most:
        return vertices, faces
    corners = vertices[faces]
    sides = corners[:, 1:] - corners[:, :1]
    area = 0.5 * float(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum())
    # A plane has two triangles a cell; start finer, since a grid cuts most surfaces aslant.
    cell = 0.5 * (2.0 * area / most) ** 0.5 or 1e-9
    while True:
        thinned = _merge(vertices, faces, cell)
        if len(thinned[1]) <= most:
            return thinned
        cell *= GROWTH


def _merge(vertices: Floats, faces: Ints, cell: float) -> tuple[Floats, Ints]:
    """Make one vertex of all in a cell, and drop the triangles that collapse or come twice."""
    grid = np.floor((vertices - vertices.min(axis=0)) / cell).astype(np.int64)
    spans = grid.max(axis=0) + 1
    _, cells = np.unique((grid[:, 0] * spans[1] + grid[:, 1]) * spans[2] + grid[:, 2], return_inverse=True)
    members = np.bincount(cells)
    means = np.stack([np.bincount(cells, vertices[:, c]) / members for c in range(3)], axis=1)
    merged = cells[faces]
    a, b, c = merged.T
    merged = merged[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(merged, axis=1), axis=0, return_index=True)
    merged = merged[np.sort(first)]
    used, renumbered = np.unique(merged, return_inverse=True)
    return means[used], renumbered.reshape(merged.shape).astype(np.int32)
