"""Tubes of known shape, as arrays and as files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from meshes.tube import Tube, read_tube

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Shape:
    """A swept circle: rings of vertices along a path, and the path."""

    vertices: Floats
    faces: Ints
    axis: Floats


def sweep(axis: Floats, tangent: Floats, radius: Floats | float, sides: int) -> Shape:
    """Rings around a path whose tangents are never along z."""
    side = np.cross(tangent, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, tangent)
    angle = 2 * np.pi * np.arange(sides) / sides
    outward = np.cos(angle)[:, None] * side[:, None] + np.sin(angle)[:, None] * up[:, None]
    rings = axis[:, None] + np.broadcast_to(radius, len(axis))[:, None, None] * outward
    i, j = np.meshgrid(np.arange(len(axis) - 1), np.arange(sides), indexing="ij")
    here, beside = i * sides + j, i * sides + (j + 1) % sides
    quads = np.stack([here, beside, beside + sides, here + sides], axis=-1).reshape(-1, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return Shape(rings.reshape(-1, 3), faces, axis)


def straight(length: float = 10.0, radius: Floats | float = 1.0, sides: int = 96, rings: int = 11) -> Shape:
    """A cylinder, or what `radius` (rings,) makes of it, from the origin along x."""
    axis = np.stack([np.linspace(0.0, length, rings), np.zeros(rings), np.zeros(rings)], axis=1)
    return sweep(axis, np.tile([1.0, 0.0, 0.0], (rings, 1)), radius, sides)


def bend(bend_radius: float = 4.0, angle: float = np.pi, radius: float = 1.0, sides: int = 96) -> Shape:
    """Part of a torus around z: from (bend radius, 0, 0) anticlockwise through `angle`."""
    turn = np.linspace(0.0, angle, 361)
    out = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)
    along = np.stack([-np.sin(turn), np.cos(turn), np.zeros_like(turn)], axis=1)
    return sweep(bend_radius * out, along, radius, sides)


def join(*shapes: Shape) -> Shape:
    """All walls in one, with the path of the first."""
    offsets = np.cumsum([0, *(len(shape.vertices) for shape in shapes[:-1])])
    return Shape(
        np.concatenate([shape.vertices for shape in shapes]),
        np.concatenate([shape.faces + offset for shape, offset in zip(shapes, offsets, strict=True)]),
        shapes[0].axis,
    )


def obj_text(vertices: Floats, faces: Ints | None = None, lines: Ints | None = None) -> str:
    """An .obj file; indices count from 0."""
    rows = ["v {:.9f} {:.9f} {:.9f}".format(*vertex) for vertex in vertices]
    for keyword, elements in (("f", faces), ("l", lines)):
        rows += [
            f"{keyword} " + " ".join(str(i + 1) for i in row)
            for row in (() if elements is None else elements)
        ]
    return "\n".join(rows) + "\n"


@dataclass(frozen=True)
class Shapes:
    """The makers above, for tests, which cannot import this file."""

    straight: Callable[..., Shape] = straight
    bend: Callable[..., Shape] = bend
    join: Callable[..., Shape] = join
    obj_text: Callable[..., str] = obj_text


@pytest.fixture(scope="session")
def shapes() -> Shapes:
    """Makers of known shapes."""
    return Shapes()


@pytest.fixture
def write_tube(tmp_path: Path) -> Callable[..., Path]:
    """Writes a shape as `<name>.obj` with its path as `<name>_centerline.obj` beside it."""

    def write(shape: Shape, name: str = "tube") -> Path:
        path = tmp_path / f"{name}.obj"
        path.write_text(obj_text(shape.vertices, shape.faces))
        steps = np.stack([np.arange(len(shape.axis) - 1), np.arange(1, len(shape.axis))], axis=1)
        path.with_name(f"{name}_centerline.obj").write_text(obj_text(shape.axis, lines=steps))
        return path

    return write


@pytest.fixture
def cylinder(write_tube: Callable[..., Path]) -> Tube:
    """10 m along x, radius 1 m."""
    return read_tube(write_tube(straight(), "cylinder"))


@pytest.fixture
def half_torus(write_tube: Callable[..., Path]) -> Tube:
    """Half a turn about z at 4 m, radius 1 m, from (4, 0, 0)."""
    return read_tube(write_tube(bend(), "half_torus"))
