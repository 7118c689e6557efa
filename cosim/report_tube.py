"""A tube on the page of `cosim report`: few enough triangles, and where outwards is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.errors import CosimError
from cosim.report_run import AddArray
from cosim.requirements import install_command
from cosim.scene import Scene, Surface

Floats = NDArray[np.float64]

AXIS_POINTS: Final = 1500
"""Points of the axis that outwards is told by."""
_PIECE: Final = 4096


def describe_tube(
    scenes: Sequence[Scene], whole: Floats | None, share: float, add: AddArray
) -> dict[str, Any]:
    """The tube of some scenes that share it, as JSON with the numbers of its arrays.

    Args:
        scenes: of the runs; the longest axis counts.
        whole: (M, 3) all of its axis (m), None where only what was flown is known.
        share: of its triangles that the page has room for.
        add: takes the arrays.

    Raises:
        CosimError: it must be simplified, and the library for that is not installed.
    """
    axis = max((scene.axis for scene in scenes), key=len)
    tube = scenes[0].tube
    shown = tube if share >= 1.0 else simplify(tube, max(int(share * len(tube.faces)), 1))
    return {
        "vertices": add(shown.vertices.astype(np.float32)),
        "faces": add(shown.faces.astype(np.uint16 if len(shown.vertices) <= 2**16 else np.uint32)),
        "outward": add(outward(shown.vertices, axis)),
        "axis": add((axis if whole is None else _thin(whole, AXIS_POINTS)).astype(np.float32)),
        "triangles": len(shown.faces),
        "triangles_flown": len(tube.faces),
    }


def simplify(surface: Surface, triangles: int) -> Surface:
    """The same surface with about so many triangles, where they change its shape least.

    Raises:
        CosimError: fast-simplification is not installed.
    """
    try:
        import fast_simplification  # quadric error metrics
    except ImportError as error:
        raise CosimError(
            f"large meshes need fast-simplification; install it with: {install_command('view')}"
        ) from error
    vertices, faces = fast_simplification.simplify(
        surface.vertices.astype(np.float32), surface.faces.astype(np.int32), target_count=triangles
    )
    return Surface(vertices.astype(np.float64), faces)


def outward(vertices: Floats, axis: Floats) -> NDArray[np.int8]:
    """Direction from the axis to each vertex in its section, (V, 3) in units of 1/127, by which the tube is cut open.

    Zero for vertices beyond the ends of the axis: that part of the tube was not flown, and stays closed.
    """
    axis = _thin(axis, AXIS_POINTS)
    if len(axis) < 2:
        return np.zeros(vertices.shape, np.int8)
    tangent = np.gradient(axis, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    square = (axis**2).sum(axis=1)
    found = np.empty((len(vertices), 3))
    for start in range(0, len(vertices), _PIECE):
        piece = vertices[start : start + _PIECE]
        nearest = (square - 2.0 * piece @ axis.T).argmin(axis=1)
        away = piece - axis[nearest]
        along = np.einsum("ij,ij->i", away, tangent[nearest])
        away -= along[:, None] * tangent[nearest]
        width = np.linalg.norm(away, axis=1)
        beyond = np.abs(along) > width
        found[start : start + _PIECE] = np.where(
            beyond[:, None], 0.0, away / np.maximum(width, 1e-12)[:, None]
        )
    return np.rint(127.0 * found).astype(np.int8)


def _thin(points: Floats, most: int) -> Floats:
    """Every n-th of some points, so that there are not more than `most`."""
    return points[:: -(-len(points) // most)]
