"""What a glTF document says beside its triangles: the files that it names, and what the reader of its triangles
would misread without a word."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote

from meshes.errors import MeshReadError
from meshes.obj import read_bytes

COMPRESSIONS: Final = ("KHR_draco_mesh_compression", "EXT_meshopt_compression")
"""Extensions without which the vertices of a file cannot be read."""

INSTANCING: Final = "EXT_mesh_gpu_instancing"
"""An extension that puts one mesh into many places, of which one would be read."""

TRIANGLE_FAN: Final = 6
"""Mode of a primitive that is not read."""

_GLB: Final = struct.Struct("<4sIIII")
"""Magic, version and length of the file; length and type of the first chunk, which is the document."""


def read_document(content: bytes, path: Path) -> dict[str, Any]:
    """The JSON document of a .gltf or .glb; `path` names it in errors.

    Raises:
        MeshReadError: no such document, or one whose vertices would be misread.
    """
    text = content
    if content[:4] == b"glTF" and len(content) >= _GLB.size:
        length = _GLB.unpack_from(content)[3]
        text = content[_GLB.size : _GLB.size + length]
    try:
        document = json.loads(text)
        _check(document, path)
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise MeshReadError(
            f"{path}: not a readable mesh of format {path.suffix.lower()}: damaged, cut short, or of another format"
        ) from error
    return document  # type: ignore[no-any-return]


def _check(document: Any, path: Path) -> None:
    """Refuse what would be read as other triangles than the file has."""
    for name in COMPRESSIONS:
        if name in document.get("extensionsRequired", ()):
            raise MeshReadError(
                f"{path}: expected vertices that are not compressed, found {name}; export it without compression"
            )
    if INSTANCING in document.get("extensionsUsed", ()):
        raise MeshReadError(
            f"{path}: expected a node for each place of a mesh, found {INSTANCING}; export it without instancing"
        )
    accessors = document.get("accessors", [])
    for mesh in document.get("meshes", ()):
        for primitive in mesh["primitives"]:
            if primitive.get("mode") == TRIANGLE_FAN:
                raise MeshReadError(
                    f"{path}: expected triangles, found a fan of them; export it as triangles"
                )
            if accessors[primitive["attributes"]["POSITION"]].get("normalized"):
                raise MeshReadError(
                    f"{path}: expected vertices as they are, found them quantised to fractions "
                    "(KHR_mesh_quantization); export it without quantisation"
                )


def read_buffers(document: dict[str, Any], path: Path) -> dict[str, bytes]:
    """The bytes of the files that hold a document's buffers, by the names under which the document has them.

    Raises:
        MeshReadError: one of them is missing, too short, or somewhere else than on this machine.
    """
    files = {}
    for buffer in document.get("buffers", ()):
        uri = buffer.get("uri")
        if uri is None or uri.startswith("data:"):
            continue
        if "://" in uri:
            raise MeshReadError(f"{path}: expected its buffers in files beside it, found {uri}")
        try:
            files[uri] = read_bytes(locate(path, uri))
        except MeshReadError as error:
            raise MeshReadError(f"{path}: its vertices lie in another file: {error}") from error
        if len(files[uri]) < buffer.get("byteLength", 0):
            raise MeshReadError(
                f"{path}: expected {buffer['byteLength']} bytes in {locate(path, uri)}, found {len(files[uri])}"
            )
    return files


def locate(path: Path, name: str) -> Path:
    """The file that a document at `path` has under a name, in which blanks and the like are written as %20."""
    return path.parent / unquote(name)
