"""Tubes from files: the wall, and the centreline that runs inside it."""

from __future__ import annotations

import hashlib
import io
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from meshes.centreline import parse_centreline, resample
from meshes.embree import RayScene
from meshes.errors import CentrelineError, MeshReadError
from meshes.geometry import Floats
from meshes.obj import first_of_each, parse_obj, read_bytes, weld

Axes = Literal["zup", "yup"]
"""Which way a file points: "zup" as the world; "yup" as Blender's export writes by default, (x, z, -y)."""

FORMATS = (".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
"""Suffixes of the mesh formats that are read: those that trimesh reads without further packages, and .obj."""

INDUSTRIAL = Path(__file__).parent / "industrial" / "industrial.obj"
"""The shipped conduit."""

LONGEST_STEP = 0.1
"""Longest step of a resampled centreline (m)."""
LEAST_STEPS = 200
"""Steps that a short tube has at least."""
LENGTHS = (1e-3, 1e5)
"""Shortest and longest centreline (m): what lies outside is a wrong unit, not a tube."""
FARTHEST = 1e9
"""Largest coordinate (m): room for any survey's origin, and far from where single precision overflows."""
RING = 36
"""Rays over which the local radius is the mean."""
LEAST_HITS = RING // 2 + 1
"""Rays of a ring that must meet a wall: from outside of a convex wall fewer than half of them can. The rest may
leave through a side opening, or near an end through a mouth that is not square to the centreline."""


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
    duplicate_faces: int
    """How many faces were dropped, since others have the same corners."""

    @cached_property
    def scene(self) -> RayScene:
        """The wall ready for rays; built once, when first asked for."""
        return RayScene(self.vertices, self.faces)


@dataclass(frozen=True)
class Tube:
    """A wall and its centreline, resampled at M even arc lengths from the end where the drone starts."""

    wall: Wall
    axis: Floats  # (M, 3)
    """Points of the centreline (m), world frame."""
    tangent: Floats  # (M, 3)
    """Unit tangents, away from the start."""
    radius: Floats  # (M,)
    """Local radius R (m): mean distance of the wall's inner surface from the axis in the local section."""
    arc_length: Floats  # (M,)
    """From the start (m)."""
    step: float
    """Arc length between neighbouring points (m)."""
    length: float
    """Length of the centreline (m)."""
    centreline_path: Path
    centreline_sha256: str

    @property
    def path(self) -> Path:
        """Where the wall was read from."""
        return self.wall.path

    @property
    def sha256(self) -> str:
        """Of the bytes of the wall's file, in hexadecimal."""
        return self.wall.sha256

    @property
    def axes(self) -> Axes:
        """Axes of both files."""
        return self.wall.axes

    @property
    def scale(self) -> float:
        """Metres in one unit of both files."""
        return self.wall.scale


def read_wall(path: str | Path, axes: Axes = "zup", scale: float = 1.0) -> Wall:
    """Read a mesh as the wall of a tube: .obj by this package, the other `FORMATS` by trimesh.

    Args:
        path: the file.
        axes: "zup" keeps the file's axes; "yup" maps (x, y, z) to (x, -z, y).
        scale: metres in one unit of the file.

    Raises:
        MeshReadError: no such file, not a readable mesh, one without faces, or a scale that no tube has.
    """
    path = Path(path)
    content = read_bytes(path)
    if path.suffix.lower() == ".obj":
        data = parse_obj(content, path)
        vertices, corners, duplicates = data.vertices, data.faces.astype(np.int64), data.duplicate_faces
    else:
        vertices, corners, duplicates = _parse_by_trimesh(content, path)
    if not len(corners):
        raise MeshReadError(f"{path}: expected a mesh with faces, found {len(vertices)} vertices and no face")
    used, faces = np.unique(corners, return_inverse=True)
    return Wall(
        vertices=_to_world(vertices[used], axes, scale, path),
        faces=faces.reshape(-1, 3).astype(np.int32),
        path=path,
        sha256=hashlib.sha256(content).hexdigest(),
        axes=axes,
        scale=scale,
        duplicate_faces=duplicates,
    )


def read_tube(
    mesh: str | Path,
    centreline: str | Path | None = None,
    axes: Axes = "zup",
    scale: float = 1.0,
    start_end: Literal["first", "last"] = "first",
) -> Tube:
    """Read a wall and its centreline, and check that the one runs inside the other.

    Args:
        mesh: the file of the wall.
        centreline: the .obj of the centreline; None for `<mesh stem>_centerline.obj` beside the mesh.
        axes: of both files, see `read_wall`.
        scale: metres in one unit of both files.
        start_end: the end of the centreline where the drone starts; "first" is the one whose vertex stands
            first in the file.

    Raises:
        MeshReadError: either file cannot be read.
        CentrelineError: the centreline is missing, is no single open path, has a length out of `LENGTHS`, or
            leaves the tube.
    """
    wall = read_wall(mesh, axes, scale)
    path = _find_centreline(wall.path, centreline)
    content = read_bytes(path)
    points = _to_world(parse_centreline(content, path), axes, scale, path)
    if start_end == "last":
        points = points[::-1]

    length = _length(points, scale, path)
    axis, tangent = resample(points, min(LONGEST_STEP, length / LEAST_STEPS))
    tube = Tube(
        wall=wall,
        axis=axis,
        tangent=tangent,
        radius=np.zeros(len(axis)),
        arc_length=np.linspace(0.0, length, len(axis)),
        step=length / (len(axis) - 1),
        length=length,
        centreline_path=path,
        centreline_sha256=hashlib.sha256(content).hexdigest(),
    )
    return replace(tube, radius=_local_radius(tube))


def _find_centreline(mesh: Path, named: str | Path | None) -> Path:
    if named is not None:
        path = Path(named)
        if _is_missing(path):
            raise CentrelineError(f"{path}: expected the centreline of {mesh} here, found no such file")
        return path
    path = mesh.with_name(f"{mesh.stem}_centerline.obj")
    if _is_missing(path):
        raise CentrelineError(
            f"{mesh}: expected its centreline beside it as {path.name}, found no such file; it cannot be "
            f"found from the mesh yet: export the guide curve as an .obj of edges, under that name or "
            f"named with --centerline"
        )
    return path


def _is_missing(path: Path) -> bool:
    """Whether nothing is there; what is there and cannot be read is left to `read_bytes` to explain."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return True
    except OSError:
        return False
    return False


def _to_world(points: Floats, axes: Axes, scale: float, path: Path) -> Floats:
    if not (np.isfinite(scale) and scale > 0):
        raise MeshReadError(f"scale: expected a positive number of metres a unit, found {scale}")
    if axes not in ("zup", "yup"):
        raise MeshReadError(f"axes: expected 'zup' or 'yup', found {axes!r}")
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


def _length(points: Floats, scale: float, path: Path) -> float:
    """Length (m) of a polyline (P, 3) that is plausible for a tube; CentrelineError for any other."""
    with np.errstate(under="ignore"):
        length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    shortest, longest = LENGTHS
    if not shortest <= length <= longest:
        raise CentrelineError(
            f"{path}: scale: expected one that makes the centreline {shortest:g} m to {longest:g} m long, found "
            f"{scale:g} metres a unit, which makes it {length:.4g} m; check the unit of the file"
        )
    return length


def _parse_by_trimesh(content: bytes, path: Path) -> tuple[Floats, NDArray[np.int64], int]:
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise MeshReadError(
            f"{path}: expected a mesh format that can be read ({', '.join(FORMATS)}), found {path.suffix!r}"
        )
    import trimesh  # here, since it takes half a second that an .obj does not need

    try:
        mesh = trimesh.load_scene(io.BytesIO(content), file_type=suffix[1:]).to_mesh()
        vertices = np.array(mesh.vertices, dtype=np.float64).reshape(-1, 3)
        faces = np.array(mesh.faces, dtype=np.int64).reshape(-1, 3)
    except ImportError as error:  # asked for by rare contents only, damaged ones among them
        raise MeshReadError(
            f"{path}: not a readable mesh of format {suffix}; if the file is whole, reading it needs the package "
            f"{error.name}, which is not installed"
        ) from error
    except Exception as error:  # every loader of trimesh fails in its own way
        raise MeshReadError(f"{path}: not a readable mesh of format {suffix} ({error})") from error
    if not np.isfinite(vertices).all():
        raise MeshReadError(f"{path}: expected finite coordinates, found NaN or infinity")
    kept = first_of_each(weld(vertices)[faces]) if len(faces) else np.empty(0, np.int64)
    return vertices, faces[kept], len(faces) - len(kept)


def _local_radius(tube: Tube) -> Floats:
    """Mean wall distance over a ring of rays in each local section, (M,).

    A section that some rays leave through an opening has no such mean: it takes the radius between those of its
    whole neighbours, since the rays that remain would favour one side.

    Raises:
        CentrelineError: a point has too few walls around it, or a wall lies between neighbouring points.
    """
    origins = tube.axis.copy()
    # At the very ends half of the rays could pass the rim: look from half a step inside.
    origins[0] += tube.tangent[0] * tube.step / 2
    origins[-1] -= tube.tangent[-1] * tube.step / 2
    directions = _ring(tube.tangent)
    distances = tube.wall.scene.distances(
        np.repeat(origins, RING, axis=0), directions.reshape(-1, 3), np.inf
    ).reshape(-1, RING)
    hit = np.isfinite(distances)

    hits = hit.sum(axis=1)
    crossed = np.zeros(len(hits), dtype=bool)
    crossed[1:] = tube.wall.scene.blocked(tube.axis[:-1], tube.axis[1:])
    wrong = (hits < LEAST_HITS) | crossed
    if wrong.any():
        i = int(np.argmax(wrong))
        found = f"{RING - hits[i]} of {RING} rays around it that meet no wall"
        if crossed[i]:
            found += " and the wall crossed by it"
        raise CentrelineError(
            f"{tube.centreline_path}: expected a centreline inside of the tube {tube.path.name}, found at "
            f"arc length {tube.arc_length[i]:.2f} m of {tube.length:.2f} m {found}; "
            f"{wrong.sum()} of {len(wrong)} points are wrong: check that both files have the same axes and unit"
        )
    radius = np.where(hit, distances, 0.0).sum(axis=1) / hits
    whole = hits == RING
    if whole.any():
        radius = np.interp(tube.arc_length, tube.arc_length[whole], radius[whole])
    return radius  # type: ignore[no-any-return]


def _ring(tangent: Floats) -> Floats:
    """Directions (M, RING, 3) evenly around unit tangents (M, 3)."""
    least_aligned = np.eye(3)[np.argmin(np.abs(tangent), axis=1)]
    side = np.cross(tangent, least_aligned)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(tangent, side)
    angle = np.linspace(0.0, 2 * np.pi, RING, endpoint=False)
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return cos * side[:, None] + sin * other[:, None]  # type: ignore[no-any-return]
