"""Mesh files of every format that is read: their triangles, and the unit and up-axis that they state.

An .obj is read by `meshes.obj`, the others by trimesh, which applies the transforms of scenes, but neither the
unit nor the up-axis of a .dae.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from meshes.errors import MeshReadError
from meshes.geometry import Floats
from meshes.obj import first_of_each, parse_obj, weld

Axes = Literal["zup", "yup"]
"""Which way a file points: "zup" as the world; "yup" as Blender's export writes by default, (x, z, -y)."""
AxesChoice = Literal["auto", "zup", "yup"]
"""The same; "auto" for what the format or the file states."""

FORMATS: Final = (".dae", ".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
"""Suffixes of the mesh formats that are read."""


@dataclass(frozen=True)
class Stated:
    """What a file states of itself."""

    axes: Axes | None
    """None where neither the file nor its format states it."""
    unit: float | None
    """Metres in one unit of the file."""
    where: str
    """Who states it, for people."""


UNSTATED: Final = Stated(None, None, "the format states neither unit nor up-axis")


@dataclass(frozen=True)
class MeshData:
    """The triangles of a file, in its own axes and unit."""

    vertices: Floats  # (V, 3)
    faces: NDArray[np.int64]  # (F, 3)
    duplicate_faces: int
    """How many were dropped, since others have the same corners."""
    stated: Stated


def parse_mesh(content: bytes, path: Path) -> MeshData:
    """The triangles in the bytes of a mesh file; `path` says the format, and where files that it names lie.

    Raises:
        MeshReadError: not a readable mesh of this format.
    """
    suffix = path.suffix.lower()
    if suffix == ".obj":
        data = parse_obj(content, path)
        return MeshData(data.vertices, data.faces.astype(np.int64), data.duplicate_faces, UNSTATED)
    if suffix not in FORMATS:
        raise MeshReadError(
            f"{path}: expected a mesh format that can be read ({', '.join(FORMATS)}), found {path.suffix!r}"
        )
    vertices, faces = _parse_by_trimesh(content, path)
    if not np.isfinite(vertices).all():
        raise MeshReadError(f"{path}: expected finite coordinates, found NaN or infinity")
    kept = first_of_each(weld(vertices)[faces]) if len(faces) else np.empty(0, np.int64)
    return MeshData(vertices, faces[kept], len(faces) - len(kept), _stated(content, suffix))


def _stated(content: bytes, suffix: str) -> Stated:
    if suffix in (".glb", ".gltf"):
        return Stated("yup", 1.0, "glTF is in metres with Y up")
    if suffix == ".dae":
        return _stated_by_collada(content)
    return UNSTATED


def _stated_by_collada(content: bytes) -> Stated:
    """From <asset> at the top of the document; by COLLADA's rules a metre and Y up where it says nothing."""
    root = ElementTree.fromstring(content)
    namespace = root.tag.partition("}")[0] + "}" if root.tag.startswith("{") else ""
    unit = root.find(f"{namespace}asset/{namespace}unit")
    up = root.find(f"{namespace}asset/{namespace}up_axis")
    try:
        metres = float(unit.get("meter", "1")) if unit is not None else 1.0
    except ValueError:
        metres = 0.0
    axis = up.text.strip() if up is not None and up.text else "Y_UP"
    axes: dict[str, Axes] = {"Z_UP": "zup", "Y_UP": "yup"}
    return Stated(
        axes.get(axis), metres if metres > 0.0 else None, f"the file states {metres:g} m a unit and {axis}"
    )


def _parse_by_trimesh(content: bytes, path: Path) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices (V, 3) and triangles (F, 3) of all objects of the scene, in their places."""
    import trimesh  # here, since it takes half a second that an .obj does not need

    suffix = path.suffix.lower()
    try:
        # A .gltf may keep its buffers in files beside it.
        resolver = trimesh.resolvers.FilePathResolver(str(path.absolute()))
        scene = trimesh.load_scene(io.BytesIO(content), file_type=suffix[1:], resolver=resolver)
        mesh = scene.to_mesh()
        vertices = np.array(mesh.vertices, dtype=np.float64).reshape(-1, 3)
        faces = np.array(mesh.faces, dtype=np.int64).reshape(-1, 3)
    except ImportError as error:  # asked for by rare contents only, damaged ones among them
        raise MeshReadError(
            f"{path}: not a readable mesh of format {suffix}; if the file is whole, reading it needs the package "
            f"{error.name}, which is not installed"
        ) from error
    except Exception as error:  # every loader of trimesh fails in its own way
        raise MeshReadError(f"{path}: not a readable mesh of format {suffix} ({error})") from error
    return vertices, faces
