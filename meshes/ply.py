"""Polygons of .ply files, in text or binary.

Read here, and not by a library, because loaders of meshes take all faces for as large as the first, while Blender
writes triangles, quads and larger polygons side by side.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from meshes.errors import MeshReadError
from meshes.geometry import Floats
from meshes.polygons import triangulate

_TYPES: Final = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_ORDERS: Final = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS: Final = ("vertex_indices", "vertex_index")


@dataclass(frozen=True)
class _Element:
    """One kind of rows of a file."""

    name: str
    count: int
    properties: list[tuple[str, str, str]]
    """Name, type of a list's length or "", type of the values."""


class _DamageError(Exception):
    """The rows end too early, or are none."""


def parse_ply(content: bytes, path: Path) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices (V, 3) and triangles (F, 3) in the bytes of a .ply file; `path` names it in errors.

    Raises:
        MeshReadError: no .ply file, or one that is damaged or cut short.
    """
    vertices, polygons = np.empty((0, 3)), [np.empty((0, 3), np.int64)]
    try:
        order, elements, start = _header(content)
        rows = _Text(content[start:]) if order == "" else _Binary(content, start, order)
        for element in elements:
            columns = rows.read(element)
            if element.name == "vertex":
                vertices = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)
            elif element.name == "face":
                corners = next(columns[name] for name in _CORNERS if name in columns)
                polygons = list(_by_size(corners))
        if not np.isfinite(vertices).all():
            raise _DamageError("expected finite coordinates, found NaN or infinity")
        if any(len(p) and not (p.min() >= 0 and p.max() < len(vertices)) for p in polygons):
            raise _DamageError("a face names a vertex that is not there")
    except (_DamageError, ValueError, LookupError, StopIteration, UnicodeDecodeError) as error:
        raise MeshReadError(
            f"{path}: not a readable mesh of format .ply: damaged, cut short, or of another format ({error})"
        ) from error
    return vertices, np.concatenate([triangulate(vertices, p).reshape(-1, 3) for p in polygons])


def _header(content: bytes) -> tuple[str, list[_Element], int]:
    """Order of the bytes, the elements, and where their rows begin."""
    end = content.find(b"end_header")
    if not content.startswith(b"ply") or end < 0:
        raise _DamageError("no header of a .ply file")
    order, elements = "", list[_Element]()
    for line in content[:end].decode("latin-1").splitlines()[1:]:
        words = line.split()
        match words:
            case ["format", name, _]:
                order = _ORDERS[name]
            case ["element", name, count]:
                elements.append(_Element(name, int(count), []))
            case ["property", "list", length, kind, name]:
                elements[-1].properties.append((name, _TYPES[length], _TYPES[kind]))
            case ["property", kind, name]:
                elements[-1].properties.append((name, "", _TYPES[kind]))
    return order, elements, content.index(b"\n", end) + 1


def _by_size(corners: Sequence[NDArray[Any]]) -> Iterator[NDArray[np.int64]]:
    """Polygons (P, n) of each size, in the order of the file within each."""
    if isinstance(corners, np.ndarray):  # all are of one size
        if corners.shape[1] >= 3:
            yield corners.astype(np.int64)
        return
    sizes = np.array([len(polygon) for polygon in corners])
    for size in np.unique(sizes[sizes >= 3]):
        yield np.array([corners[i] for i in np.flatnonzero(sizes == size).tolist()], dtype=np.int64)


class _Binary:
    """Rows one after the other, in bytes."""

    def __init__(self, content: bytes, start: int, order: str) -> None:
        self._content, self._at, self._order = content, start, order

    def read(self, element: _Element) -> dict[str, Any]:
        """The columns of all rows: an array each, or of lists of several lengths a list of arrays."""
        columns = self._read_alike(element)
        return self._read_rows(element) if columns is None else columns

    def _read_alike(self, element: _Element) -> dict[str, Any] | None:
        """The rows, if every list is as long as in the first; None where one is not."""
        if element.count == 0:
            return {name: np.empty((0, 3)) for name, *_ in element.properties}
        fields: list[Any] = []
        at = self._at
        for name, length, kind in element.properties:
            if length:
                size = self._value(length, at)
                fields += [(f"{name} size", self._order + length), (name, self._order + kind, (size,))]
            else:
                fields.append((name, self._order + kind))
            at = self._at + np.dtype(fields).itemsize
        dtype = np.dtype(fields)
        if self._at + element.count * dtype.itemsize > len(self._content):
            if any(length for _, length, _ in element.properties):
                return None
            raise _DamageError(f"it ends among the rows of {element.name!r}")
        rows = np.frombuffer(self._content, dtype, element.count, self._at)
        for name, length, _ in element.properties:
            if length and (rows[f"{name} size"] != rows[f"{name} size"][0]).any():
                return None
        self._at += element.count * dtype.itemsize
        return {name: rows[name] for name, *_ in element.properties}

    def _read_rows(self, element: _Element) -> dict[str, Any]:
        columns: dict[str, Any] = {name: [] for name, *_ in element.properties}
        for _ in range(element.count):
            for name, length, kind in element.properties:
                size = 1
                if length:
                    size = self._value(length, self._at)
                    self._at += np.dtype(length).itemsize
                dtype = np.dtype(self._order + kind)
                if size < 0 or self._at + size * dtype.itemsize > len(self._content):
                    raise _DamageError(f"it ends among the rows of {element.name!r}")
                columns[name].append(np.frombuffer(self._content, dtype, size, self._at))
                self._at += size * dtype.itemsize
        return columns

    def _value(self, kind: str, at: int) -> int:
        dtype = np.dtype(self._order + kind)
        if at + dtype.itemsize > len(self._content):
            raise _DamageError("it ends too early")
        return int(np.frombuffer(self._content, dtype, 1, at)[0])


class _Text:
    """Rows one after the other, in words."""

    def __init__(self, text: bytes) -> None:
        self._words = text.split()
        self._at = 0

    def read(self, element: _Element) -> dict[str, Any]:
        """The columns of all rows: an array each, of lists a list of arrays."""
        if not any(length for _, length, _ in element.properties):
            width = len(element.properties)
            table = np.array(self._take(element.count * width), dtype=np.float64).reshape(-1, width)
            return {name: table[:, i] for i, (name, *_) in enumerate(element.properties)}
        columns: dict[str, Any] = {name: [] for name, *_ in element.properties}
        for _ in range(element.count):
            for name, length, _ in element.properties:
                size = int(self._take(1)[0]) if length else 1
                columns[name].append(np.array(self._take(size), dtype=np.float64))
        return columns

    def _take(self, count: int) -> list[bytes]:
        words = self._words[self._at : self._at + count]
        if count < 0 or len(words) < count:
            raise _DamageError("it ends too early")
        self._at += count
        return words
