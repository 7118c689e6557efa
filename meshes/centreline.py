"""The centreline of a tube from an .obj of line segments: one open path, in any order of segments."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from meshes.errors import CentrelineError, MeshReadError
from meshes.geometry import Floats
from meshes.obj import parse_obj, weld

_NAMED_PLACES = 3
"""A message names this many places at most: enough to find the fault in Blender."""


def parse_centreline(content: bytes, path: Path) -> Floats:
    """Points (P, 3) of the path in the bytes of an .obj file, in the file's own axes and unit.

    Segments are chained by the vertices that they share; vertices at exactly the same place are one. The path
    begins at the end whose vertex stands first in the file.

    Raises:
        MeshReadError: `path` does not end in .obj, or the file cannot be parsed.
        CentrelineError: fewer than two points, branches, a loop, or several pieces.
    """
    if path.suffix.lower() != ".obj":
        raise MeshReadError(
            f"{path}: expected a centreline as an .obj of line segments, found {path.suffix!r}"
        )
    data = parse_obj(content, path)
    if not len(data.segments):
        raise CentrelineError(
            f"{path}: expected at least 2 points joined by 'l' lines, found {len(data.vertices)} vertices "
            f"and no segment of any length; in Blender, convert the guide curve, unbevelled, to a mesh first"
        )
    places = weld(data.vertices)
    # Number every place by the first vertex in the file that lies there.
    first = np.empty(len(places), dtype=np.int64)
    first[places[::-1]] = np.arange(len(places))[::-1]
    order = _chain(first[places[data.segments]], data.vertices, path)
    return data.vertices[order]


def resample(points: Floats, longest_step: float) -> tuple[Floats, Floats]:
    """Points (M, 3) and unit tangents (M, 3) at even arc lengths along a polyline (P, 3), ends included.

    The step is the longest, not above `longest_step`, that divides the length. Points lie on the given
    polyline and nowhere else: a spline through unevenly spaced points can overshoot, out of the tube in the
    worst case. Tangents are central differences over four steps, which smooths the corners between segments;
    at the two ends they are extrapolated to second order.
    """
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    length = along[-1]
    # A length that is a whole number of steps but for rounding must not gain another step.
    count = max(int(np.ceil(length / longest_step - 1e-6)), 4)
    arc_length = np.linspace(0.0, length, count + 1)
    axis = np.stack([np.interp(arc_length, along, points[:, i]) for i in range(3)], axis=1)

    tangent = np.gradient(axis, axis=0, edge_order=2)
    tangent[2:-2] = axis[4:] - axis[:-4]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return axis, tangent


def _chain(segments: NDArray[np.int64], vertices: Floats, path: Path) -> list[int]:
    """Vertex numbers along the one open path that segments (S, 2) make, from its end of lower number."""
    neighbours: dict[int, list[int]] = {}
    for a, b in segments.tolist():
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    _refuse_branches(neighbours, vertices, path)

    pieces = []
    unseen = set(neighbours)
    for end in sorted(v for v, joined in neighbours.items() if len(joined) == 1):
        if end in unseen:
            pieces.append(_walk(end, neighbours))
            unseen.difference_update(pieces[-1])
    if unseen:
        at = vertices[min(unseen)]
        raise CentrelineError(
            f"{path}: expected one open path, found a loop through {_place(at)}; remove one of its edges"
        )
    if len(pieces) > 1:
        described = "; ".join(
            f"{len(piece)} points from {_place(vertices[piece[0]])} to {_place(vertices[piece[-1]])}"
            for piece in pieces[:_NAMED_PLACES]
        )
        more = "; ..." if len(pieces) > _NAMED_PLACES else ""
        raise CentrelineError(
            f"{path}: expected one open path, found {len(pieces)} pieces: {described}{more}; keep or join one"
        )
    return pieces[0]


def _refuse_branches(neighbours: dict[int, list[int]], vertices: Floats, path: Path) -> None:
    branches = sorted(v for v, joined in neighbours.items() if len(joined) > 2)
    if branches:
        named = ", ".join(
            f"{len(neighbours[v])} segments meet at {_place(vertices[v])}" for v in branches[:_NAMED_PLACES]
        )
        more = ", ..." if len(branches) > _NAMED_PLACES else ""
        raise CentrelineError(
            f"{path}: expected one path without branches, found {len(branches)} branching: {named}{more}"
        )


def _walk(end: int, neighbours: dict[int, list[int]]) -> list[int]:
    walked, before = [end], end
    while True:
        onward = [v for v in neighbours[walked[-1]] if v != before]
        if not onward:
            return walked
        before = walked[-1]
        walked.append(onward[0])


def _place(point: Floats) -> str:
    return "({:.6g}, {:.6g}, {:.6g})".format(*point)
