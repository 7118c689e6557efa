"""What there is to see of a run, in the world frame: the tube, its axis, the drone and how it moved.

Every picture, film, page and 3-D file is made from this; nothing here knows how it will be drawn.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.runs import Run, column
from meshes.errors import MeshError
from meshes.sweep import sweep_wall
from meshes.swept import SweptTube, minimal_frame
from meshes.wall import read_wall
from protocol.layout import Axes

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

REBUILT_SIDES: Final = 32
"""Sides of a tube that is rebuilt from the log."""
REBUILT_STEP: Final = 0.25
"""Shortest distance of its rings, over R."""


@dataclass(frozen=True)
class Surface:
    """Triangles: vertices (V, 3) in metres, faces (F, 3)."""

    vertices: Floats
    faces: Ints


@dataclass(frozen=True)
class Scene:
    """A run's tube and the way of its drone; T records, the reset pose first."""

    tube: Surface
    axis: Floats  # (M, 3)
    """Points of the centreline along which the drone came, in order (m)."""
    drone: Surface
    """In the body's frame: x forward, z up."""
    times: Floats  # (T,)
    """Simulated time (s)."""
    positions: Floats  # (T, 3)
    quaternions: Floats  # (T, 4)
    """x y z w, body to world."""
    note: str
    """What is not as it was flown, for people; empty where all is."""


def read_scene(run: Run) -> Scene:
    """The scene of a run, from its folder and the mesh that it names.

    Where the mesh is gone or another, the tube is rebuilt from the axis and the mean radius that the log holds of
    the part that was flown, and the note says so.
    """
    axis, radius, tangent = read_axis(run)
    tube, note = _tube(run)
    if tube is None:
        tube = _rebuild(axis, tangent, radius)
        note += (
            "; the tube shown is rebuilt from the recorded axis and mean radius of the part that was flown"
        )
    return Scene(
        tube=tube,
        axis=axis,
        drone=drone_surface(run.manifest["parameters"]["body_radius"]),
        times=column(run, "sim_time"),
        positions=column(run, "position"),
        quaternions=column(run, "quaternion"),
        note=note,
    )


def where_is(run: Run, recorded: str) -> Path:
    """Where a file of the run is: in the run folder if it went with it, else where it was."""
    beside = run.folder / Path(recorded).name
    return beside if beside.is_file() else Path(recorded)


def drone_surface(body_radius: float, rings: int = 8, sides: int = 16) -> Surface:
    """The collision sphere of the body, with a nose that shows where forward (x) is.

    Args:
        body_radius: of the sphere (m).
        rings: bands from pole to pole.
        sides: of each band.
    """
    polar = np.linspace(0.0, np.pi, rings + 1)[1:-1]
    around = 2.0 * np.pi * np.arange(sides) / sides
    band = np.stack(
        [
            np.repeat(np.cos(polar), sides),
            np.outer(np.sin(polar), np.cos(around)).ravel(),
            np.outer(np.sin(polar), np.sin(around)).ravel(),
        ],
        axis=1,
    )
    nose, tail = np.array([[1.9, 0.0, 0.0]]), np.array([[-1.0, 0.0, 0.0]])
    vertices = body_radius * np.concatenate([nose, band, tail])
    corner, after = np.arange(sides), (np.arange(sides) + 1) % sides
    faces = [np.stack([np.zeros(sides, np.int64), 1 + corner, 1 + after], axis=1)]
    for ring in range(rings - 2):
        a, b = 1 + ring * sides + corner, 1 + ring * sides + after
        faces += [np.stack([a, a + sides, b], axis=1), np.stack([b, a + sides, b + sides], axis=1)]
    last = 1 + (rings - 2) * sides
    faces.append(np.stack([last + corner, np.full(sides, len(vertices) - 1), last + after], axis=1))
    return Surface(vertices, np.concatenate(faces).astype(np.int32))


def read_axis(run: Run) -> tuple[Floats, Floats, Floats]:
    """Axis points (M, 3), mean radii (M,) and tangents (M, 3) where the drone came along, in order of arc length."""
    along, radius = column(run, "arc_length"), column(run, "radius")
    order = np.argsort(along, kind="stable")
    kept = [int(order[0])]
    for i in order.tolist()[1:]:
        if along[i] - along[kept[-1]] >= REBUILT_STEP * max(float(radius[i]), 1e-9):
            kept.append(i)
    return column(run, "axis_position")[kept], radius[kept], column(run, "tangent")[kept]


def _tube(run: Run) -> tuple[Surface | None, str]:
    """The wall that was flown in; None and why where it cannot be had."""
    described = run.manifest["mesh"]
    path = where_is(run, described["path"])
    try:
        if hashlib.sha256(path.read_bytes()).hexdigest() != described["sha256"]:
            return None, f"{path} is not the mesh that was flown"
        wall = read_wall(path, Axes[described["axes"]].name, described["scale"])  # type: ignore[arg-type]
    except OSError as error:
        return None, f"{path} cannot be read ({error.strerror})"
    except MeshError as error:
        return None, str(error)
    return Surface(wall.vertices, wall.faces), ""


def _rebuild(axis: Floats, tangent: Floats, radius: Floats) -> Surface:
    if len(axis) < 2:  # a flight that did not move: a short piece around its place
        axis = np.concatenate([axis, axis + 0.5 * radius * tangent])
        tangent, radius = np.repeat(tangent, 2, axis=0), np.repeat(radius, 2)
    swept = SweptTube(axis, 1.0, tangent, minimal_frame(axis, tangent), radius, np.zeros((len(axis), 0, 2)))
    return Surface(*sweep_wall(swept, REBUILT_SIDES))
