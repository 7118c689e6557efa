"""Triangles of a tube's wall wound so that all of them face outwards, whatever their file says."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.scene import Surface

Floats = NDArray[np.float64]

AGREED: Final = 0.8
"""Share of a wall's area that must agree for its own winding to be believed; else each triangle is judged alone."""
ACROSS: Final = 0.1
"""Cosine to the way out from the axis below which a triangle stands across the tube, as the face of a flange does:
its side is not known, and it keeps its winding."""
AXIS_POINTS: Final = 400
_CHUNK: Final = 20_000


def face_outwards(surface: Surface, axis: Floats) -> Surface:
    """Wind a wall so that its triangles face away from the axis (M, 3).

    A wall that is wound one way throughout is turned as a whole, so that folds that look back at the axis stay
    right; one that is not is turned triangle by triangle.
    """
    axis = axis[:: max(1, len(axis) // AXIS_POINTS)]
    corners = surface.vertices[surface.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    centres = corners.mean(axis=1)
    away = centres - axis[_nearest(centres, axis)]
    outward = np.einsum("ij,ij->i", normals, away)
    area = np.linalg.norm(normals, axis=1)
    share = float(area[outward > 0.0].sum() / max(area.sum(), 1e-300))
    if share >= AGREED:
        return surface
    if share <= 1.0 - AGREED:
        turned = np.ones(len(area), dtype=bool)
    else:
        turned = outward < -ACROSS * area * np.linalg.norm(away, axis=1)
    faces = surface.faces.copy()
    faces[turned] = faces[turned][:, ::-1]
    return replace(surface, faces=faces)


def _nearest(points: Floats, axis: Floats) -> NDArray[np.intp]:
    """Index of the nearest axis point to each point, (P,)."""
    square = np.einsum("ij,ij->i", axis, axis)
    found = [
        np.argmin(square - 2.0 * points[i : i + _CHUNK] @ axis.T, axis=1)
        for i in range(0, len(points), _CHUNK)
    ]
    return np.concatenate(found)
