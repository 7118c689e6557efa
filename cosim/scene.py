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

from cosim.pilots import SHIPPED_CHECKPOINT
from cosim.runs import Run, chunks, column
from meshes.errors import MeshError
from meshes.sweep import sweep_wall
from meshes.swept import SweptTube, minimal_frame
from meshes.tube import INDUSTRIAL
from meshes.wall import read_wall
from protocol.layout import Axes

SHIPPED: Final = (INDUSTRIAL, INDUSTRIAL.with_name(f"{INDUSTRIAL.stem}_centerline.obj"), SHIPPED_CHECKPOINT)
"""Files that every installation has."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

REBUILT_SIDES: Final = 32
"""Sides of a tube that is rebuilt from the log."""
REBUILT_STEP: Final = 0.25
"""Shortest distance of its rings, over R."""
MOST_POINTS: Final = 20_000
"""Of the axis that is read from a log; of a longer one every other is kept, as often as it takes."""


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
    """The scene of a run, from its folder and the mesh that it names; see `read_surroundings`."""
    tube, axis, note = read_surroundings(run)
    return Scene(
        tube=tube,
        axis=axis,
        drone=drone_surface(run.manifest["parameters"]["body_radius"]),
        times=column(run, "sim_time"),
        positions=column(run, "position"),
        quaternions=column(run, "quaternion"),
        note=note,
    )


def read_surroundings(run: Run) -> tuple[Surface, Floats, str]:
    """The tube of a run, its axis (M, 3), and what is not as it was flown; a log of any length fits in memory.

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
    return tube, axis, note


def where_is(run: Run, recorded: str) -> Path:
    """Where a file of the run is: in the run folder if it went with it, else where it was.

    A shipped file of another installation is the one of this installation; whether it is the same its hash tells.
    """
    there = Path(recorded)
    beside = run.folder / there.name
    if beside.is_file():
        return beside
    if not there.is_file():
        return next((path for path in SHIPPED if path.name == there.name), there)
    return there


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
    names = ("arc_length", "radius", "axis_position", "tangent")
    kept = {name: np.empty((0, *run.records.dtype[name].shape)) for name in names}
    for records in chunks(run):
        seen = {name: np.concatenate([kept[name], records[name]]) for name in names}
        apart = _apart(seen["arc_length"], seen["radius"])
        while len(apart) > MOST_POINTS:
            apart = apart[::2]
        kept = {name: values[apart] for name, values in seen.items()}
    return kept["axis_position"], kept["radius"], kept["tangent"]


def _apart(along: Floats, radius: Floats) -> list[int]:
    """Which of the places stand a part of R apart along the axis, in order of arc length."""
    order = np.argsort(along, kind="stable")
    kept, last = [], -np.inf
    steps = REBUILT_STEP * np.maximum(radius[order], 1e-9)
    for i, place, step in zip(order.tolist(), along[order].tolist(), steps.tolist(), strict=True):
        if place - last >= step:
            kept.append(i)
            last = place
    return kept


def _tube(run: Run) -> tuple[Surface | None, str]:
    """The wall that was flown in; None and why where it cannot be had."""
    described = run.manifest["mesh"]
    path = where_is(run, described["path"])
    try:
        if hashlib.sha256(path.read_bytes()).hexdigest() != described["sha256"]:
            return None, f"{path} is not the mesh that was flown"
        wall = read_wall(path, Axes[described["axes"]].name, described["scale"])  # type: ignore[arg-type]
        if dict(wall.companions) != described.get("companions", {}):
            return None, f"a file that {path} names is not the one that was flown"
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
