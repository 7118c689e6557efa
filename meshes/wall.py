"""The wall of a tube from a mesh file, in the world frame."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from meshes.embree import RayScene
from meshes.errors import MeshReadError
from meshes.formats import Axes, AxesChoice, Stated, parse_mesh
from meshes.geometry import Floats
from meshes.obj import read_bytes

FARTHEST: Final = 1e9
"""Largest coordinate (m): room for any survey's origin, and far from where single precision overflows."""


@dataclass(frozen=True)
class Wall:
    """The wall of a tube in the world frame (m): open or closed, single or double, in any winding."""

    vertices: Floats  # (V, 3)
    faces: NDArray[np.int32]  # (F, 3)
    path: Path
    sha256: str
    """Of the bytes of the file, in hexadecimal."""
    axes: Axes
    scale: float
    """Metres in one unit of the file."""
    duplicate_faces: int
    """How many faces were dropped, since others have the same corners."""
    stated: Stated
    """What the file states of its axes and unit, whether it was followed or not."""
    companions: Mapping[str, str] = field(default_factory=dict)
    """Further files that hold vertices or faces, see `MeshData`."""

    @cached_property
    def scene(self) -> RayScene:
        """The wall ready for rays; built once, when first asked for."""
        return RayScene(self.vertices, self.faces)

    def to_world(self, points: Floats) -> Floats:
        """Points (P, 3) of the file's own coordinates in the world frame (m)."""
        return to_world(points, self.axes, self.scale, self.path)

    def to_file(self, points: Floats) -> Floats:
        """Points (P, 3) of the world frame (m) in the file's own coordinates."""
        if self.axes == "yup":
            x, y, z = points.T
            points = np.stack([x, z, -y], axis=1)
        return points / self.scale

    def rescaled(self, scale: float) -> Wall:
        """The same wall at another scale (metres a unit), equal to reading it so but for rounding."""
        return replace(self, vertices=self.vertices * (scale / self.scale), scale=scale)


def read_wall(path: str | Path, axes: AxesChoice = "auto", scale: float | None = None) -> Wall:
    """Read a mesh as the wall of a tube, in one of `meshes.formats.FORMATS`.

    Args:
        path: the file.
        axes: "zup" keeps the file's axes; "yup" maps (x, y, z) to (x, -z, y); "auto" follows the file or its
            format, and keeps the axes of a format that states none.
        scale: metres in one unit of the file; None follows the file or its format, and takes metres where
            neither states a unit.

    Raises:
        MeshReadError: no such file, not a readable mesh, one without faces, or a scale that no tube has.
    """
    path = Path(path)
    content = read_bytes(path)
    data = parse_mesh(content, path)
    if not len(data.faces):
        raise MeshReadError(
            f"{path}: expected a mesh with faces, found {len(data.vertices)} vertices and no face"
        )
    used, faces = np.unique(data.faces, return_inverse=True)
    resolved = _resolve_axes(axes, data.stated, path)
    scale = (data.stated.unit or 1.0) if scale is None else scale
    return Wall(
        vertices=to_world(data.vertices[used], resolved, scale, path),
        faces=faces.reshape(-1, 3).astype(np.int32),
        path=path,
        sha256=hashlib.sha256(content).hexdigest(),
        axes=resolved,
        scale=scale,
        duplicate_faces=data.duplicate_faces,
        stated=data.stated,
        companions=data.companions,
    )


def _resolve_axes(axes: AxesChoice, stated: Stated, path: Path) -> Axes:
    if axes == "auto":
        if "X_UP" in stated.where:
            raise MeshReadError(
                f"{path}: expected Z_UP or Y_UP, found X_UP; say with --axes zup or yup how it is meant"
            )
        return stated.axes or "zup"
    if axes not in ("zup", "yup"):
        raise MeshReadError(f"axes: expected 'auto', 'zup' or 'yup', found {axes!r}")
    return axes


def to_world(points: Floats, axes: Axes, scale: float, path: Path) -> Floats:
    """Points (P, 3) of a file in the world frame (m).

    Raises:
        MeshReadError: a scale that no tube has; `path` names the file.
    """
    if not (np.isfinite(scale) and scale > 0):
        raise MeshReadError(f"scale: expected a positive number of metres a unit, found {scale}")
    with np.errstate(over="ignore", under="ignore"):
        points = points * scale
    farthest = np.abs(points).max(initial=0.0)
    if not farthest <= FARTHEST:
        raise MeshReadError(
            f"{path}: scale: expected one that keeps all coordinates within {FARTHEST:g} m, found {scale:g} "
            f"metres a unit, which puts one at {farthest:g} m; check the unit of the file"
        )
    if axes == "zup":
        return points
    x, y, z = points.T
    return np.stack([x, -z, y], axis=1)


def place(wall: Wall, point: Floats) -> str:
    """A point (3,), metres, world frame, in the coordinates of the file, for people."""
    return place_in_file(wall, wall.to_file(point[None])[0])


def place_in_file(wall: Wall, coordinates: ArrayLike) -> str:
    """A point (3,) in the coordinates of the file, for people: to a ten thousandth of the wall's extent, so that
    a place in a survey's coordinates is told from the next."""
    extent = float(np.linalg.norm(np.ptp(wall.vertices, axis=0))) / wall.scale
    digits = 4 - math.floor(math.log10(extent)) if extent > 0.0 else 4
    rounded = np.round(np.asarray(coordinates, dtype=np.float64), digits) + 0.0  # no -0
    return "({:.12g}, {:.12g}, {:.12g})".format(*rounded)


def in_units(wall: Wall, metres: float) -> str:
    """A length (m) in the unit of the file, for people."""
    return f"{metres / wall.scale:.3g}"
