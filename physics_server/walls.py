"""The walls of registered tubes: read once, checked against what the agent read, shared by all lanes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, cast

import numpy as np
from numpy.typing import NDArray

from meshes.errors import MeshError
from meshes.geometry import Floats
from meshes.wall import Wall, read_wall
from protocol.errors import Refusal
from protocol.plant import TubeReference

RING: Final = 16
"""Rays of the ring on which the engine and perception are compared."""

AGREEMENT: Final = 0.01
"""Largest difference between the two medians of the ring, as a fraction of perception's.

Both cast rays at the same triangles: they differ by single precision's rounding, some 1e-6, or by far."""


@dataclass(frozen=True)
class Piece:
    """A part of a wall, small enough for one collision shape, as the lists that an engine takes fastest."""

    vertices: list[list[float]]  # (V, 3), metres
    indices: list[int]  # (3 F,)


@dataclass(frozen=True)
class RegisteredWall:
    """A wall, ready for any number of lanes."""

    wall: Wall
    pieces: list[Piece]
    reach: float
    """Diagonal of the wall's bounding box (m): from inside of it no ray meets a wall farther away."""


def read_registered(tube: TubeReference, vertices_max: int, indices_max: int) -> RegisteredWall:
    """Read the wall of a tube that the agent names, in pieces of at most so many vertices and indices.

    Raises:
        Refusal: the file cannot be read as a mesh, or is not the one that the agent read.
    """
    try:
        wall = read_wall(tube.path, cast(Literal["zup", "yup"], tube.axes), tube.scale)
    except (MeshError, OSError) as error:
        raise Refusal("tube.path", f"a readable mesh at {tube.path}", str(error)) from error
    if wall.sha256 != tube.sha256:
        raise Refusal("tube.sha256", f"{tube.sha256}, as the agent read {tube.path}", wall.sha256)
    reach = float(np.linalg.norm(np.ptp(wall.vertices, axis=0)))
    return RegisteredWall(wall, split(wall.vertices, wall.faces, vertices_max, indices_max), reach)


def split(vertices: Floats, faces: NDArray[np.int32], vertices_max: int, indices_max: int) -> list[Piece]:
    """Cut a wall (V, 3), (F, 3) in halves of its faces until each piece is within an engine's limits."""
    used, corners = np.unique(faces, return_inverse=True)
    if len(used) > vertices_max or faces.size > indices_max:
        half = len(faces) // 2
        return [
            piece
            for part in (faces[:half], faces[half:])
            for piece in split(vertices, part, vertices_max, indices_max)
        ]
    return [Piece(vertices[used].tolist(), corners.ravel().tolist())]


def ring_around(quaternion: Floats) -> Floats:
    """Unit directions (RING, 3), world frame, evenly around the x axis of a body of this attitude (4,)."""
    x, y, z, w = quaternion / np.linalg.norm(quaternion)
    left = np.array([2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)])
    up = np.array([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)])
    angle = np.arange(RING)[:, None] * (2 * np.pi / RING)
    ring: Floats = np.cos(angle) * left + np.sin(angle) * up
    return ring
