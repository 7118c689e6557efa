"""Meshes of tubes, and of what only looks like one, for tests: arrays of vertices and triangles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from meshes.formats import UNSTATED
from meshes.swept import minimal_frame, unit_tangents
from meshes.wall import Wall

Floats = NDArray[np.float64]
Mesh = tuple[Floats, NDArray[np.int64]]


def wall_of(mesh: Mesh, name: str = "made.obj") -> Wall:
    """A mesh as a wall, without a file."""
    vertices, faces = mesh
    return Wall(vertices, faces.astype(np.int32), Path(name), "0" * 64, "zup", 1.0, 0, UNSTATED)


def circle(sides: int = 24, radius: float = 1.0) -> Floats:
    """Corners (sides, 2) of a section."""
    angle = 2.0 * np.pi * np.arange(sides) / sides
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def rectangle(width: float, height: float) -> Floats:
    """Corners (4, 2) of a section."""
    return 0.5 * np.array([[width, height], [-width, height], [-width, -height], [width, -height]])


def line(start: ArrayLike, end: ArrayLike, count: int = 2) -> Floats:
    """Points (count, 3) of a straight axis."""
    return np.linspace(np.asarray(start, dtype=float), np.asarray(end, dtype=float), count)


def extrude(
    axis: Floats,
    section: Floats | Sequence[Floats],
    *,
    caps: bool = False,
    closed: bool = False,
    upright: bool = False,
) -> Mesh:
    """A section (K, 2), one or one a point, carried along an axis (M, 3).

    Args:
        axis: the points of the axis.
        section: corners, from the frame's normal towards its binormal.
        caps: close both ends.
        closed: join the last section to the first.
        upright: the section's second coordinate points up, in place of a frame that does not twist.
    """
    count = len(axis)
    tangents = unit_tangents(axis)
    if closed:
        tangents = np.roll(axis, -1, axis=0) - np.roll(axis, 1, axis=0)
        tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    normals = minimal_frame(axis, tangents)
    if upright:
        normals = np.cross(tangents, [0.0, 0.0, 1.0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    binormals = np.cross(normals, tangents) if upright else np.cross(tangents, normals)
    corners = np.broadcast_to(np.asarray(section, dtype=float), (count, *np.shape(section)[-2:]))
    rings = axis[:, None] + corners[..., :1] * normals[:, None] + corners[..., 1:] * binormals[:, None]
    sides = rings.shape[1]
    i, j = np.meshgrid(np.arange(count if closed else count - 1), np.arange(sides), indexing="ij")
    a, b = i * sides + j, i * sides + (j + 1) % sides
    c, d = (a + sides) % (count * sides), (b + sides) % (count * sides)
    faces = np.concatenate([np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)])
    vertices = rings.reshape(-1, 3)
    if caps:
        ends = np.array([count * sides, count * sides + 1])
        rim = np.arange(sides)
        lid = np.stack([rim, (rim + 1) % sides, np.full(sides, ends[0])], axis=1)
        last = (count - 1) * sides
        back = np.stack([last + rim, last + (rim + 1) % sides, np.full(sides, ends[1])], axis=1)
        vertices = np.concatenate([vertices, axis[[0, -1]]])
        faces = np.concatenate([faces, lid, back])
    return vertices, faces


def join(*meshes: Mesh) -> Mesh:
    """All meshes in one."""
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    return (
        np.concatenate([vertices for vertices, _ in meshes]),
        np.concatenate([faces + offset for (_, faces), offset in zip(meshes, offsets, strict=False)]),
    )


def cut(mesh: Mesh, inside: Callable[[Floats], NDArray[np.bool_]], rounds: int = 2) -> Mesh:
    """A mesh without the triangles whose middle lies inside; all are quartered some times before."""
    vertices, faces = mesh
    corners = vertices[faces]
    for _ in range(rounds):
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        corners = np.concatenate([np.stack(part, axis=1) for part in parts])
    corners = corners[~inside(corners.mean(axis=1))]
    return corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)


def in_tube(axis: Floats, radius: float) -> Callable[[Floats], NDArray[np.bool_]]:
    """Whether points (P, 3) lie within a radius of a straight axis (2, 3), between its ends."""

    def inside(points: Floats) -> NDArray[np.bool_]:
        along = axis[1] - axis[0]
        length = float(np.linalg.norm(along))
        along = along / length
        reached = (points - axis[0]) @ along
        aside = np.linalg.norm(points - axis[0] - reached[:, None] * along, axis=1)
        return (aside < radius) & (reached > 0.0) & (reached < length)

    return inside


def junction(*ends: ArrayLike, radius: float = 1.0, sides: int = 24) -> Mesh:
    """Round tubes from the origin to some ends, glued with a ball at the origin, each without what lies in others."""
    axes = [line([0.0, 0.0, 0.0], end, 25) for end in ends]
    within = [in_tube(axis[[0, -1]], 0.95 * radius) for axis in axes]

    def in_any(points: Floats) -> NDArray[np.bool_]:
        return np.any([inside(points) for inside in within], axis=0)

    tubes = []
    for axis, own in zip(axes, within, strict=True):
        others = [inside for inside in within if inside is not own]
        tubes.append(
            cut(
                extrude(axis, circle(sides, radius)),
                lambda points, others=others: np.any([inside(points) for inside in others], axis=0),
                rounds=1,
            )
        )
    ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    joint = np.asarray(ball.vertices, dtype=float), np.asarray(ball.faces, dtype=np.int64)
    return join(*tubes, cut(joint, in_any, rounds=1))


def helix(turns: float, radius: float, pitch: float, count: int) -> Floats:
    """Points (count, 3) around z."""
    angle = np.linspace(0.0, 2.0 * np.pi * turns, count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), pitch * angle / (2.0 * np.pi)], axis=1)


def trefoil(count: int = 400, size: float = 3.0) -> Floats:
    """Points (count, 3) of a closed knot."""
    t = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return size * np.stack(
        [np.sin(t) + 2.0 * np.sin(2.0 * t), np.cos(t) - 2.0 * np.cos(2.0 * t), -np.sin(3.0 * t)], axis=1
    )


def s_bend(count: int = 121, bend: float = 4.0) -> Floats:
    """Points (count, 3): a quarter to the left, then one to the right."""
    half = np.linspace(0.0, np.pi / 2.0, count // 2 + 1)
    first = bend * np.stack([np.sin(half), 1.0 - np.cos(half), 0.0 * half], axis=1)
    second = first[-1] * 2.0 - first[::-1]
    return np.concatenate([first, second[1:]])
