"""The axis of a run's tube for the page of `cosim report`: all of it where its file is at hand, and how it bends."""

from __future__ import annotations

import hashlib
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.runs import Run, column
from cosim.scene import where_is
from meshes.centreline import parse_centreline, resample
from meshes.errors import MeshError
from meshes.swept import segment_curvature
from meshes.wall import to_world
from protocol.layout import Axes

Floats = NDArray[np.float64]

CURVATURE_STEP: Final = 0.5
"""Arc length over R over which the turn of the axis is taken."""
AXIS_STEP: Final = 0.1
"""Distance of the points of an axis, over R."""
LEAST_STEPS: Final = 4
"""Of curvature: a shorter piece of axis is told by shorter steps."""


def whole_axis(run: Run) -> tuple[Floats, Floats] | None:
    """Points (M, 3) and unit tangents (M, 3) of the centreline at even arc lengths, from where the run set out.

    None where its file is gone or is not the one that was flown along.
    """
    mesh = run.manifest["mesh"]
    if not mesh.get("centreline"):
        return None
    path = where_is(run, mesh["centreline"])
    try:
        content = path.read_bytes()
        if hashlib.sha256(content).hexdigest() != mesh["centreline_sha256"]:
            return None
        points = to_world(parse_centreline(content, path), Axes[mesh["axes"]].name, mesh["scale"], path)  # type: ignore[arg-type]
    except (OSError, MeshError):
        return None
    if run.manifest["options"].get("start_end") == "last":
        points = points[::-1]
    return resample(points, AXIS_STEP * float(np.median(column(run, "radius"))))


def axis_curvature(run: Run, axis: tuple[Floats, Floats] | None) -> Floats:
    """Curvature of the axis (1/m) at every record of a run, (T,): of the whole axis, else of what came by."""
    along, step = column(run, "arc_length"), CURVATURE_STEP * float(np.median(column(run, "radius")))
    if axis is None:
        return curvature_along(along, along, column(run, "tangent"), step)
    points, tangents = axis
    places = np.linspace(0.0, float(run.manifest["mesh"]["length_m"]), len(points))
    return curvature_along(along, places, tangents, step)


def curvature_along(arc_length: Floats, places: Floats, tangents: Floats, step: float) -> Floats:
    """Curvature (1/m) of an axis at some arc lengths, (T,).

    Args:
        arc_length: (T,) where it is asked for (m).
        places: (M,) arc lengths where the axis is known, in any order (m).
        tangents: (M, 3) of the axis there.
        step: arc length over which a turn is taken (m); a piece shorter than some of them is told by shorter ones.

    Returns:
        NaN everywhere where the axis is known at one place alone.
    """
    known, first = np.unique(places, return_index=True)
    if len(known) < 3:
        return np.full(len(arc_length), np.nan)
    span = float(known[-1] - known[0])
    step = min(step, span / LEAST_STEPS)
    even = known[0] + step * np.arange(int(span / step + 1e-9) + 1)
    sampled = np.stack([np.interp(even, known, tangents[first, c]) for c in range(3)], axis=1)
    sampled /= np.linalg.norm(sampled, axis=1, keepdims=True)
    curvature: Floats = np.interp(arc_length, even[:-1] + 0.5 * step, segment_curvature(sampled, step))
    return curvature
