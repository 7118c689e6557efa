"""Mesh files of every format that is read: their triangles, and the unit and up-axis that they state.

An .obj is read by `meshes.obj`, a .ply by `meshes.ply`, the others by trimesh, which applies the transforms of
scenes, but neither the unit nor the up-axis of a .dae.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from meshes.errors import MeshReadError
from meshes.geometry import Floats
from meshes.gltf import read_buffers, read_document
from meshes.obj import first_of_each, parse_obj, weld
from meshes.ply import parse_ply

Axes = Literal["zup", "yup"]
"""Which way a file points: "zup" as the world; "yup" as Blender's export writes by default, (x, z, -y)."""
AxesChoice = Literal["auto", "zup", "yup"]
"""The same; "auto" for what the format or the file states."""

FORMATS: Final = (".dae", ".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
"""Suffixes of the mesh formats that are read."""

_BEGINNINGS: Final = {
    b"glTF": ".glb",
    b"ply": ".ply",
    b"OFF": ".off",
    b"PK\x03\x04": "an archive (.zip); unpack it",
    b"version https://git-lfs": "a pointer of Git LFS; fetch the file itself with git lfs pull",
}
"""How files begin that are found under wrong names, and what they are."""

_STL_HEADER: Final = 84
"""Bytes of a binary .stl before its triangles."""
_STL_TRIANGLE: Final = 50
"""Bytes of each."""


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
    companions: Mapping[str, str] = field(default_factory=dict)
    """SHA-256 of the further files that hold vertices or faces, by the names under which the file has them."""


def parse_mesh(content: bytes, path: Path) -> MeshData:
    """The triangles in the bytes of a mesh file; `path` says the format, and where files that it names lie.

    Raises:
        MeshReadError: not a readable mesh of this format.
    """
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise MeshReadError(
            f"{path}: expected a mesh format that can be read ({', '.join(FORMATS)}), found {path.suffix!r}"
        )
    _check_beginning(content, suffix, path)
    if suffix == ".obj":
        data = parse_obj(content, path)
        return MeshData(data.vertices, data.faces.astype(np.int64), data.duplicate_faces, UNSTATED)
    if suffix == ".stl":
        content = _whole_stl(content, path)
    buffers = read_buffers(read_document(content, path), path) if suffix in (".glb", ".gltf") else {}
    if suffix == ".ply":
        vertices, faces = parse_ply(content, path)
    else:
        vertices, faces = _parse_by_trimesh(content, path, buffers)
    if not np.isfinite(vertices).all():
        raise MeshReadError(f"{path}: expected finite coordinates, found NaN or infinity")
    places = weld(vertices)
    _, first = np.unique(places, return_index=True)
    faces = places[faces]
    kept = first_of_each(faces) if len(faces) else np.empty(0, np.int64)
    companions = {name: hashlib.sha256(data).hexdigest() for name, data in buffers.items()}
    return MeshData(
        vertices[first], faces[kept], len(faces) - len(kept), _stated(content, suffix), companions
    )


def _check_beginning(content: bytes, suffix: str, path: Path) -> None:
    """Refuse what is empty, or begins as a file of another kind does."""
    if not content.strip():
        raise MeshReadError(f"{path}: expected a mesh of format {suffix}, found an empty file")
    for beginning, kind in _BEGINNINGS.items():
        if content.startswith(beginning) and not kind.startswith(suffix):
            raise MeshReadError(f"{path}: expected a mesh of format {suffix}, found what begins as {kind}")


def _whole_stl(content: bytes, path: Path) -> bytes:
    """A .stl that is not cut short, its text in UTF-8; in whatever encoding its name of the solid may be."""
    if content.lstrip()[:5].lower() == b"solid" and b"facet" in content[:2000]:
        if b"endsolid" not in content[-2000:].lower():
            raise MeshReadError(f"{path}: expected 'endsolid' at the end, found none: the file is cut short")
        try:
            content.decode()
        except UnicodeDecodeError:
            return content.decode("latin-1").encode()
        return content
    count = int.from_bytes(content[80:84], "little")
    expected = _STL_HEADER + count * _STL_TRIANGLE
    if len(content) < max(expected, _STL_HEADER + _STL_TRIANGLE):
        raise MeshReadError(
            f"{path}: not a readable mesh of format .stl: {count:,} triangles stated, which take {expected:,} bytes, "
            f"found {len(content):,}: cut short, or no .stl"
        )
    return content


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


def _parse_by_trimesh(
    content: bytes, path: Path, buffers: Mapping[str, bytes]
) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices (V, 3) and triangles (F, 3) of all objects of the scene, in their places.

    Args:
        content: of the file.
        path: its name.
        buffers: contents of the files that a glTF document names.
    """
    import trimesh  # here, since it takes half a second that an .obj does not need

    suffix = path.suffix.lower()
    # Unprocessed: trimesh would drop vertices that are not finite, and the faces at them.
    how: dict[str, Any] = {"file_type": suffix[1:], "process": False}
    if suffix in (".glb", ".gltf"):
        how |= {"resolver": buffers, "skip_materials": True}
    try:
        mesh = trimesh.load_scene(io.BytesIO(content), **how).to_mesh()
        vertices = np.array(mesh.vertices, dtype=np.float64).reshape(-1, 3)
        faces = np.array(mesh.faces, dtype=np.int64).reshape(-1, 3)
    except Exception as error:  # every loader of trimesh fails in its own way
        reason = f" ({error})" if str(error) and not isinstance(error, ImportError) else ""
        raise MeshReadError(
            f"{path}: not a readable mesh of format {suffix}: damaged, cut short, or of another format{reason}"
        ) from error
    return vertices, faces
