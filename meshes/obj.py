"""Wavefront .obj files as Blender and others write them: vertices, faces and line segments by object.

Read here, and not by a library, because loaders of meshes drop the `l` lines that carry a centreline, or lose
them where faces share the file. Texture coordinates, normals and materials are skipped: a tube needs none.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from meshes.errors import MeshReadError
from meshes.geometry import Floats
from meshes.polygons import triangulate

Ints = NDArray[np.int32]

_FREE_FORM = frozenset(
    ("cstype", "deg", "bmat", "step", "curv", "curv2", "surf", "parm", "trim", "hole", "scrv", "sp", "con")
)
"""Keywords of curves and surfaces given by control points, of which no vertex need lie on the shape."""

_CONTINUED = re.compile(r"(?:[^\n]*\\\n)+[^\n]*\n?")
_REFERENCE = re.compile(r"-?[0-9]+(?:/-?[0-9]*){0,2}")


@dataclass(frozen=True)
class ObjData:
    """What one .obj file holds. Indices count from 0 and run over the whole file."""

    vertices: Floats  # (V, 3)
    """In the file's own axes and unit."""
    faces: Ints  # (F, 3)
    """Triangles, see `triangulate`. Exact duplicates of polygons are dropped."""
    segments: Ints  # (S, 2)
    """The two vertices of every line segment, in file order. Exact duplicates are dropped."""
    objects: tuple[str, ...]
    """Names of the objects and groups (`o`, `g`); the first, "", holds what comes before any name."""
    face_object: Ints  # (F,)
    """Index into `objects`."""
    segment_object: Ints  # (S,)
    """Index into `objects`."""
    duplicate_faces: int
    """How many polygons were dropped, since others have the same corners."""
    duplicate_segments: int
    """How many line segments were dropped, since others have the same ends."""


@dataclass(frozen=True)
class _Lines:
    """All lines of one keyword: numbers in the file and what follows the keyword."""

    numbers: list[int]
    texts: list[str]


@dataclass(frozen=True)
class _Elements:
    """References of all `f` or all `l` lines: index of every corner, corners per line, object per line."""

    corners: NDArray[np.int64]
    sizes: NDArray[np.int64]
    owners: NDArray[np.int64]


def read_obj(path: Path) -> ObjData:
    """Read a .obj file.

    Raises:
        MeshReadError: no such file, free-form curves or surfaces, or a malformed line, which is named.
    """
    return parse_obj(read_bytes(path), path)


def read_bytes(path: Path) -> bytes:
    """The bytes of a file, or a MeshReadError that says why there are none."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise MeshReadError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise MeshReadError(f"{path}: expected a file, found a folder") from None
    except OSError as error:
        raise MeshReadError(f"{path}: cannot be read: {error.strerror}") from error


def parse_obj(content: bytes, path: Path) -> ObjData:
    """Parse the bytes of a .obj file; `path` only names the file in errors, which are those of `read_obj`."""
    lines = _lines_by_keyword(content, path)
    vertices = _vertices(lines["v"], path)
    names, name_lines = _objects(lines)
    faces = _elements(lines["f"], lines["v"], len(vertices), name_lines, 3, path)
    polylines = _elements(lines["l"], lines["v"], len(vertices), name_lines, 2, path)

    welded = weld(vertices)
    triangles, face_object, duplicate_faces = _triangles(faces, vertices, welded)
    segments, segment_object, duplicate_segments = _segments(polylines, welded)
    return ObjData(
        vertices=vertices,
        faces=triangles,
        segments=segments,
        objects=names,
        face_object=face_object,
        segment_object=segment_object,
        duplicate_faces=duplicate_faces,
        duplicate_segments=duplicate_segments,
    )


def weld(vertices: Floats) -> NDArray[np.int64]:
    """Number the places of vertices (V, 3): those at exactly the same place share a number, (V,)."""
    order = np.lexsort(vertices.T)
    in_order = vertices[order]
    new_place = np.ones(len(vertices), dtype=bool)
    new_place[1:] = np.any(in_order[1:] != in_order[:-1], axis=1)
    places = np.empty(len(vertices), dtype=np.int64)
    places[order] = np.cumsum(new_place) - 1
    return places


def first_of_each(corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows of corners (F, K) that repeat no earlier row, in any order of corners; ascending."""
    rows = np.sort(corners, axis=1)
    order = np.lexsort(rows.T)  # stable: of equal rows, the earliest comes first
    in_order = rows[order]
    new = np.ones(len(rows), dtype=bool)
    new[1:] = np.any(in_order[1:] != in_order[:-1], axis=1)
    return np.sort(order[new])


def _lines_by_keyword(content: bytes, path: Path) -> dict[str, _Lines]:
    text = content.decode("utf-8", errors="replace").replace("\r\n", "\n").replace("\r", "\n")
    if "\\\n" in text:
        text = _CONTINUED.sub(_join_continued, text)
    found = {keyword: _Lines([], []) for keyword in ("v", "f", "l", "o", "g")}
    for number, line in enumerate(text.replace("\t", " ").split("\n"), start=1):
        keyword, _, rest = line.partition(" ")
        if not keyword:  # the line is empty or indented
            keyword, _, rest = line.lstrip().partition(" ")
        if keyword in found:
            if "#" in rest and keyword not in "og":  # a name may hold any sign
                rest = rest.partition("#")[0]
            found[keyword].numbers.append(number)
            found[keyword].texts.append(rest)
        elif keyword in _FREE_FORM:
            raise MeshReadError(
                f"{path}, line {number}: expected vertices, faces and lines, found a free-form curve or "
                f"surface ({keyword!r}); in Blender, convert the curve to a mesh, or export with the option "
                f"'Curves as NURBS' (export_curves_as_nurbs) off"
            )
    return found


def _join_continued(match: re.Match[str]) -> str:
    """One logical line, then as many empty ones as were joined, so that later line numbers stay right."""
    block = match.group()
    return block.replace("\\\n", " ").rstrip("\n") + "\n" * block.count("\n")


def _vertices(lines: _Lines, path: Path) -> Floats:
    count = len(lines.texts)
    try:
        numbers = np.array(" ".join(lines.texts).split(), dtype=np.float64)
    except ValueError:
        numbers = np.empty(0)
    # More than three numbers a line (a weight, a colour) are legal and rare, so they take the slow way.
    if len(numbers) == 3 * count and np.isfinite(numbers).all() and _count_words(lines.texts, 3):
        return numbers.reshape(count, 3)
    return np.array([_vertex(lines, i, path) for i in range(count)], dtype=np.float64).reshape(count, 3)


def _count_words(texts: list[str], expected: int) -> bool:
    return all(len(text.split()) == expected for text in texts)


def _vertex(lines: _Lines, i: int, path: Path) -> list[float]:
    words = lines.texts[i].split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) < 3 or not np.isfinite(numbers).all():
        raise MeshReadError(
            f"{path}, line {lines.numbers[i]}: expected three finite numbers after 'v', "
            f"found {lines.texts[i].strip()!r}"
        )
    return numbers[:3]


def _objects(lines: dict[str, _Lines]) -> tuple[tuple[str, ...], list[int]]:
    """Names, and the line on which each begins."""
    named = [
        (number, text.strip())
        for keyword in ("o", "g")
        for number, text in zip(lines[keyword].numbers, lines[keyword].texts, strict=True)
    ]
    named.sort()
    return ("", *(name for _, name in named)), [0, *(number for number, _ in named)]


def _elements(
    lines: _Lines, vertex_lines: _Lines, vertices: int, name_lines: list[int], least: int, path: Path
) -> _Elements:
    """References of `f` or `l` lines as indices from 0; negative ones count back from their own line."""
    words = [text.split() for text in lines.texts]
    sizes = np.array([len(line) for line in words], dtype=np.int64)
    flat = [word.partition("/")[0] for line in words for word in line]
    try:
        corners = np.array(flat, dtype=np.int64) if flat else np.empty(0, np.int64)
    except (ValueError, OverflowError):
        corners = np.zeros(len(flat), np.int64)  # refused below: no reference is 0
    numbers = np.array(lines.numbers, dtype=np.int64)
    known = np.repeat(np.searchsorted(vertex_lines.numbers, numbers), sizes)
    corners = np.where(corners < 0, known + corners, corners - 1)
    if np.any(sizes < least) or np.any(corners < 0) or np.any(corners >= vertices):
        _refuse_elements(lines, words, vertex_lines, vertices, least, path)
    owners = np.searchsorted(name_lines, numbers, side="right") - 1
    return _Elements(corners, sizes, owners)


def _refuse_elements(
    lines: _Lines, words: list[list[str]], vertex_lines: _Lines, vertices: int, least: int, path: Path
) -> NoReturn:
    """Raise for the first line that is wrong; called only where one is."""
    keyword = "f" if least == 3 else "l"
    for number, line in zip(lines.numbers, words, strict=True):
        where = f"{path}, line {number}"
        if len(line) < least:
            raise MeshReadError(
                f"{where}: expected at least {least} vertices after {keyword!r}, found {len(line)}"
            )
        known = int(np.searchsorted(vertex_lines.numbers, number))
        for word in line:
            if not _REFERENCE.fullmatch(word):
                raise MeshReadError(f"{where}: expected vertex numbers after {keyword!r}, found {word!r}")
            index = int(word.partition("/")[0])
            if index == 0 or index > vertices or index < -known:
                raise MeshReadError(
                    f"{where}: expected a vertex from 1 to {vertices}, or from -{known} to -1, found {index}"
                )
    raise MeshReadError(f"{path}: expected vertex numbers after {keyword!r}, found what cannot be read")


def _triangles(faces: _Elements, vertices: Floats, places: NDArray[np.int64]) -> tuple[Ints, Ints, int]:
    """The polygons that are no duplicates as triangles, with their objects, and how many were dropped.

    Polygons are compared, not triangles: the same quad cut along its other diagonal is a duplicate too.
    """
    starts = np.cumsum(faces.sizes) - faces.sizes
    triangles, owners, order = [], [], []
    dropped = 0
    for size in np.unique(faces.sizes):
        rows = np.flatnonzero(faces.sizes == size)
        polygons = faces.corners[starts[rows][:, None] + np.arange(size)]
        kept = first_of_each(places[polygons])
        dropped += len(rows) - len(kept)
        triangles.append(triangulate(vertices, polygons[kept]).reshape(-1, 3))
        owners.append(np.repeat(faces.owners[rows[kept]], size - 2))
        order.append(np.repeat(rows[kept], size - 2))
    if not triangles:
        return np.empty((0, 3), np.int32), np.empty(0, np.int32), 0
    in_file_order = np.argsort(np.concatenate(order), kind="stable")
    stacked = np.concatenate(triangles)[in_file_order]
    owner = np.concatenate(owners)[in_file_order]
    a, b, c = places[stacked].T
    solid = (a != b) & (b != c) & (c != a)  # a triangle with two equal corners is none
    return stacked[solid].astype(np.int32), owner[solid].astype(np.int32), dropped


def _segments(polylines: _Elements, places: NDArray[np.int64]) -> tuple[Ints, Ints, int]:
    """Pairs of neighbours in every polyline that have a length and no double; objects; number dropped."""
    ends = np.cumsum(polylines.sizes)
    within = np.ones(len(polylines.corners), dtype=bool)
    within[ends - 1] = False  # no segment from the last vertex of one polyline to the first of the next
    starts = np.flatnonzero(within)
    pairs = np.stack([polylines.corners[starts], polylines.corners[starts + 1]], axis=1)
    owners = np.repeat(polylines.owners, polylines.sizes)[starts]
    long = places[pairs[:, 0]] != places[pairs[:, 1]]
    pairs, owners = pairs[long], owners[long]
    kept = first_of_each(places[pairs])
    return pairs[kept].astype(np.int32), owners[kept].astype(np.int32), len(pairs) - len(kept)
