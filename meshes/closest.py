"""Exact distance from points to a wall of triangles: a tree of boxes, compiled."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from meshes.compiled import compiled
from meshes.geometry import Floats

LEAF = 4
"""Triangles in a leaf at most."""
_BITS = 16
"""Bits of each coordinate in a Morton code."""


@dataclass(frozen=True)
class WallTree:
    """A complete binary tree of boxes over triangles in Morton order; node n has children 2n + 1, 2n + 2."""

    boxes: Floats  # (2 L - 1, 6)
    """Lowest and highest corner of every node, for L leaves; leaves come last. Empty ones are inside out."""
    triangles: Floats  # (F, 9)
    """Corners; leaf l has the F/L triangles, one more or less, from l F // L on."""


def build_tree(vertices: Floats, faces: NDArray[np.int32]) -> WallTree:
    """Sort triangles of vertices (V, 3), faces (F, 3) into a tree."""
    corners = vertices[faces]  # (F, 3, 3)
    triangles = corners[np.argsort(_morton(corners.mean(axis=1)), kind="stable")].reshape(-1, 9)
    leaves = 1 << max(math.ceil(math.log2(len(faces) / LEAF)), 0)
    boxes = np.empty((2 * leaves - 1, 6))
    _fill_boxes(triangles, leaves, boxes)
    return WallTree(boxes, triangles)


def distances_to_wall(points: Floats, vertices: Floats, faces: NDArray[np.int32]) -> Floats:
    """Distance (M,) of points (M, 3) to the nearest of triangles of vertices (V, 3), faces (F, 3)."""
    tree = build_tree(vertices, faces)
    distances = np.empty(len(points))
    nearest = np.full(len(points), -1, dtype=np.int64)
    wall_distance(np.ascontiguousarray(points), tree.boxes, tree.triangles, nearest, distances)
    return distances


def _morton(points: Floats) -> NDArray[np.uint64]:
    """Codes (F,) that order points (F, 3) along a curve on which neighbours stay close."""
    low = points.min(axis=0)
    # One scale for all axes, so that the cells of the curve are cubes.
    extent = (points.max(axis=0) - low).max() or 1.0
    cells = ((points - low) / extent * (2**_BITS - 1)).astype(np.uint64)
    codes = np.zeros(len(points), dtype=np.uint64)
    for bit in range(_BITS):
        for axis in range(3):
            codes |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return codes


@compiled
def _fill_boxes(triangles: Floats, leaves: int, boxes: Floats) -> None:
    count = len(triangles)
    for leaf in range(leaves):
        box = boxes[leaves - 1 + leaf]
        box[:3] = np.inf
        box[3:] = -np.inf
        for i in range(leaf * count // leaves, (leaf + 1) * count // leaves):
            for k in range(9):
                box[k % 3] = min(box[k % 3], triangles[i, k])
                box[3 + k % 3] = max(box[3 + k % 3], triangles[i, k])
    for node in range(leaves - 2, -1, -1):
        for k in range(3):
            boxes[node, k] = min(boxes[2 * node + 1, k], boxes[2 * node + 2, k])
            boxes[node, 3 + k] = max(boxes[2 * node + 1, 3 + k], boxes[2 * node + 2, 3 + k])


@compiled
def wall_distance(
    points: Floats, boxes: Floats, triangles: Floats, nearest: NDArray[np.int64], distances: Floats
) -> None:
    """Distance from each point (N, 3) to the nearest triangle of a `WallTree`; writes `distances` (N,).

    `nearest` (N,) holds the triangle that was nearest to each point before, or -1, and is brought up to date. A
    point that moved a little then begins with a bound that spares it two thirds of the tree; the result is the
    same from whatever triangle it begins.
    """
    leaves = (len(boxes) + 1) // 2
    count = len(triangles)
    stack = np.empty(64, dtype=np.int64)
    bounds = np.empty(64)
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        best = np.inf
        if nearest[n] >= 0:
            best = _triangle_squared(x, y, z, triangles, nearest[n])
        stack[0], bounds[0] = 0, 0.0
        size = 1
        while size > 0:
            size -= 1
            node = stack[size]
            if bounds[size] >= best:
                continue
            # Descend to the leaf on the near side, keeping the far sides for later.
            while node < leaves - 1:
                near, far = 2 * node + 1, 2 * node + 2
                near_bound = _box_squared(x, y, z, boxes, near)
                far_bound = _box_squared(x, y, z, boxes, far)
                if far_bound < near_bound:
                    near, far = far, near
                    near_bound, far_bound = far_bound, near_bound
                if far_bound < best:
                    stack[size], bounds[size] = far, far_bound
                    size += 1
                node = near
                if near_bound >= best:
                    break
            if node >= leaves - 1:
                leaf = node - (leaves - 1)
                for i in range(leaf * count // leaves, (leaf + 1) * count // leaves):
                    squared = _triangle_squared(x, y, z, triangles, i)
                    if squared < best:
                        best = squared
                        nearest[n] = i
        distances[n] = math.sqrt(best)


@compiled
def _box_squared(x: float, y: float, z: float, boxes: Floats, node: int) -> float:
    """Squared distance from a point to a box of the tree."""
    dx = max(boxes[node, 0] - x, x - boxes[node, 3], 0.0)
    dy = max(boxes[node, 1] - y, y - boxes[node, 4], 0.0)
    dz = max(boxes[node, 2] - z, z - boxes[node, 5], 0.0)
    return float(dx * dx + dy * dy + dz * dz)


@compiled
def _triangle_squared(x: float, y: float, z: float, triangles: Floats, i: int) -> float:
    """Squared distance from a point to triangle i, which may be a line or a single place.

    The foot of the perpendicular counts where it falls within the triangle, else the nearest edge.
    """
    ax, ay, az = triangles[i, 0], triangles[i, 1], triangles[i, 2]
    ux, uy, uz = triangles[i, 3] - ax, triangles[i, 4] - ay, triangles[i, 5] - az
    vx, vy, vz = triangles[i, 6] - ax, triangles[i, 7] - ay, triangles[i, 8] - az
    wx, wy, wz = x - ax, y - ay, z - az
    uu = ux * ux + uy * uy + uz * uz
    uv = ux * vx + uy * vy + uz * vz
    vv = vx * vx + vy * vy + vz * vz
    wu = wx * ux + wy * uy + wz * uz
    wv = wx * vx + wy * vy + wz * vz
    area = uu * vv - uv * uv
    s = vv * wu - uv * wv
    t = uu * wv - uv * wu
    if s >= 0.0 and t >= 0.0 and s + t <= area and area > 0.0:
        s /= area
        t /= area
        dx, dy, dz = wx - s * ux - t * vx, wy - s * uy - t * vy, wz - s * uz - t * vz
        return float(dx * dx + dy * dy + dz * dz)
    ww = wx * wx + wy * wy + wz * wz
    # From b to c: the offset from b is w - u.
    ee = uu - 2.0 * uv + vv
    we = (wv - wu) - (uv - uu)
    bb = ww - 2.0 * wu + uu
    return float(min(_edge_squared(ww, wu, uu), _edge_squared(ww, wv, vv), _edge_squared(bb, we, ee)))


@compiled
def _edge_squared(offset_squared: float, along: float, edge_squared: float) -> float:
    """Squared distance to an edge, from dot products of the offset from its start and its own vector."""
    if along <= 0.0 or edge_squared <= 0.0:
        return offset_squared
    if along >= edge_squared:
        return max(offset_squared - 2.0 * along + edge_squared, 0.0)
    return max(offset_squared - along * along / edge_squared, 0.0)
