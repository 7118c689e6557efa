"""Swept tubes as triangle meshes and as .obj files, for engines and programs that want a mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from meshes.errors import MeshError
from meshes.geometry import Floats
from meshes.swept import SweptTube

MIN_SIDES = 8
"""Fewest sides of a section that is still taken for a tube."""


def sweep_wall(tube: SweptTube, sides: int = 48) -> tuple[Floats, NDArray[np.int32]]:
    """The wall of a tube as a mesh with open ends: one ring of vertices at each axis point.

    The vertices stand a little outside of the wall (0.07 % at 48 sides), so that the mean distance of the
    polygon's sides from the axis, over the angle, is the mean radius R of the section.

    Returns:
        Vertices (M sides, 3) in metres, ring by ring, and triangles (2 (M - 1) sides, 3) with their normals
        away from the axis.

    Raises:
        MeshError: fewer than 8 sides.
    """
    if sides < MIN_SIDES:
        raise MeshError(f"sides: expected at least {MIN_SIDES} but found {sides}")
    angles = 2.0 * np.pi * np.arange(sides) / sides
    # A polygon with corners at 1 has the mean distance cos(h) / h * asinh(tan(h)), h half of a side's angle.
    half = np.pi / sides
    distance = tube.section(angles) * half / (np.cos(half) * np.arcsinh(np.tan(half)))  # (M, sides)
    binormals = np.cross(tube.tangents, tube.normals)
    outward = (
        np.cos(angles)[None, :, None] * tube.normals[:, None, :]
        + np.sin(angles)[None, :, None] * binormals[:, None, :]
    )
    vertices = tube.points[:, None, :] + distance[:, :, None] * outward
    corner = np.arange(sides)
    ring = sides * np.arange(len(tube.points) - 1)[:, None]
    a, b = ring + corner, ring + (corner + 1) % sides
    c, d = a + sides, b + sides
    faces = np.stack([np.stack([a, b, d], axis=-1), np.stack([a, d, c], axis=-1)], axis=2)
    return vertices.reshape(-1, 3), faces.reshape(-1, 3).astype(np.int32)


def write_obj(path: Path | str, vertices: Floats, faces: NDArray[np.int32]) -> None:
    """Writes vertices (V, 3) and triangles (F, 3) as .obj, in metres, Z up, with 9 digits."""
    _write(Path(path), vertices, "f %d %d %d\n", faces)


def write_centreline_obj(path: Path | str, points: Floats, digits: int = 9) -> None:
    """Writes a centreline (M, 3) as .obj, one `l` element for each of its segments, as Blender does."""
    index = np.arange(len(points))
    _write(Path(path), points, "l %d %d\n", np.stack([index[:-1], index[1:]], axis=1), digits)


def _write(path: Path, vertices: Floats, element: str, indices: NDArray[np.integer], digits: int = 9) -> None:
    number = f"%.{digits}g"
    corners = f"v {number} {number} {number}\n" * len(vertices) % tuple(vertices.ravel().tolist())
    elements = element * len(indices) % tuple((indices + 1).ravel().tolist())
    path.write_text(f"o {path.stem}\n{corners}{elements}", encoding="utf-8")
