"""The .obj reader against files as they are met."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshes.errors import MeshReadError
from meshes.obj import ObjData, parse_obj, read_obj

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def parse(text: str) -> ObjData:
    """Parse text under a name that errors can be matched by."""
    return parse_obj(text.encode(), Path("part.obj"))


def test_quads_and_polygons_become_fans() -> None:
    """A polygon of n corners becomes n - 2 triangles, all from its first corner."""
    data = parse(SQUARE + "v 0.5 2 0\nf 1 2 3 4\nf 2 3 5 4 1\n")
    assert data.faces.tolist() == [[0, 1, 2], [0, 2, 3], [1, 2, 4], [1, 4, 3], [1, 3, 0]]


def test_triangles_keep_the_order_of_the_file() -> None:
    """Faces of different sizes come out in the order in which they stand in the file."""
    data = parse(SQUARE + "v 0 0 1\nf 1 2 5\nf 1 2 3 4\nf 2 3 5\n")
    assert data.faces.tolist() == [[0, 1, 4], [0, 1, 2], [0, 2, 3], [1, 2, 4]]


@pytest.mark.parametrize(
    "line", ["f 1 2 3", "f 1/1 2/2 3/3", "f 1//7 2//7 3//7", "f 1/1/7 2/2/7 3/3/7", "f 1/ 2/ 3/"]
)
def test_texture_and_normal_numbers_are_skipped(line: str) -> None:
    """Only the first number of a reference names a vertex."""
    assert parse(SQUARE + line).faces.tolist() == [[0, 1, 2]]


def test_negative_numbers_count_back_from_their_own_line() -> None:
    """-1 is the last vertex before the line, not the last of the file."""
    data = parse("v 0 0 0\nv 1 0 0\nv 1 1 0\nf -3 -2 -1\nl -1 -2\nv 5 5 5\nv 6 6 6\nf -5 -2 -1\n")
    assert data.faces.tolist() == [[0, 1, 2], [0, 3, 4]]
    assert data.segments.tolist() == [[2, 1]]


def test_polylines_become_segments() -> None:
    """A line of n vertices is n - 1 segments, and lines do not join each other."""
    assert parse(SQUARE + "l 1 2 3\nl 4 1\n").segments.tolist() == [[0, 1], [1, 2], [3, 0]]


def test_continued_lines_are_joined() -> None:
    """A backslash at the end of a line joins it to the next, also several times and with Windows line ends."""
    text = SQUARE + "f 1 2 \\\n 3 \\\n 4\nl 1 \\\n2\n"
    for content in (text, text.replace("\n", "\r\n")):
        data = parse(content)
        assert data.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
        assert data.segments.tolist() == [[0, 1]]


def test_line_numbers_stay_right_after_continued_lines() -> None:
    """An error behind a continued line names the line as an editor counts it."""
    with pytest.raises(MeshReadError, match="line 8: expected vertex numbers after 'f', found 'x'"):
        parse(SQUARE + "f 1 2 \\\n 3 \\\n 4\nf 1 2 x\n")


def test_comments_blank_lines_tabs_and_indents_are_harmless() -> None:
    """Spacing and comments carry no meaning."""
    data = parse("# made by hand\n\n\tv\t0 0 0 # origin\nv  1 0 0\n  v 1 1 0 \n\nf 1 2 3 # first\n#f 1 2 3\n")
    assert data.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0]]
    assert data.faces.tolist() == [[0, 1, 2]]


def test_weights_and_colours_after_a_vertex_are_skipped() -> None:
    """A vertex line may carry a weight or a colour after its three coordinates."""
    assert parse("v 1 2 3 1.0\nv 4 5 6 0.1 0.2 0.3\nv 7 8 9\n").vertices.tolist() == [
        [1, 2, 3],
        [4, 5, 6],
        [7, 8, 9],
    ]


def test_elements_know_their_objects() -> None:
    """Faces and segments belong to the object or group that was named last before them."""
    data = parse(SQUARE + "f 1 2 3\no pipe\nf 2 3 4\ng rim #2\nl 1 2\nf 1 3 4\n")
    assert data.objects == ("", "pipe", "rim #2")
    assert data.face_object.tolist() == [0, 1, 2]
    assert data.segment_object.tolist() == [2]


@pytest.mark.parametrize("again", ["f 1 2 3 4", "f 4 3 2 1", "f 2 3 4 1"])
def test_duplicate_faces_are_dropped_and_counted(again: str) -> None:
    """A second face on the same corners is dropped, whatever its winding and first corner."""
    data = parse(SQUARE + f"f 1 2 3 4\n{again}\n")
    assert (len(data.faces), data.duplicate_faces) == (2, 1)


def test_duplicate_objects_are_dropped_and_counted() -> None:
    """An object written twice, with vertices of its own at the same places, counts once."""
    second = SQUARE + "o copy\nf 5 6 7 8\nl 6 5\n"
    data = parse(SQUARE + "o first\nf 1 2 3 4\nl 1 2\n" + second)
    assert data.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert data.segments.tolist() == [[0, 1]]
    assert (data.duplicate_faces, data.duplicate_segments) == (1, 1)


def test_what_has_no_extent_is_dropped() -> None:
    """Triangles with two equal corners and segments of no length are none."""
    data = parse(SQUARE + "f 1 1 2\nf 1 2 3\nl 1 1\nl 1 2\n")
    assert (data.faces.tolist(), data.segments.tolist()) == ([[0, 1, 2]], [[0, 1]])


@pytest.mark.parametrize("keyword", ["cstype bspline", "curv 0 1 1 2 3", "surf 0 1 0 1 1 2"])
def test_free_form_curves_are_refused_with_what_to_do(keyword: str) -> None:
    """A NURBS export is refused and the option of Blender that made it is named."""
    with pytest.raises(MeshReadError, match=r"part\.obj, line 5: .*export_curves_as_nurbs"):
        parse(SQUARE + keyword)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0 0\nv 1 0\n", "line 2: expected three finite numbers after 'v', found '1 0'"),
        ("v 0 0 zero\n", "line 1: expected three finite numbers after 'v', found '0 0 zero'"),
        ("v 0 0 0\nv nan 0 0\n", "line 2: expected three finite numbers after 'v', found 'nan 0 0'"),
        ("v 0 0 0\nv 0 1e999 0\n", "line 2: expected three finite numbers after 'v', found '0 1e999 0'"),
        ("v 0 0 0 0 0\nv 1\n", "line 2: expected three finite numbers"),
        (SQUARE + "f 1 2\n", "line 5: expected at least 3 vertices after 'f', found 2"),
        (SQUARE + "l 1\n", "line 5: expected at least 2 vertices after 'l', found 1"),
        (SQUARE + "f 1 2 3\nf 1 2 5\n", "line 6: expected a vertex from 1 to 4, or from -4 to -1, found 5"),
        (SQUARE + "f 0 1 2\n", "line 5: expected a vertex from 1 to 4, or from -4 to -1, found 0"),
        ("v 0 0 0\nl -1 -2\n" + SQUARE, "line 2: expected a vertex from 1 to 5, or from -1 to -1, found -2"),
        (SQUARE + "f 1 2 3.5\n", "line 5: expected vertex numbers after 'f', found '3.5'"),
        (SQUARE + "f 1 2 99999999999999999999\n", "line 5: expected a vertex from 1 to 4"),
    ],
)
def test_malformed_lines_are_named(text: str, message: str) -> None:
    """What cannot be meant is refused, with the file, the line, what was expected and what was found."""
    with pytest.raises(MeshReadError, match=message):
        parse(text)


def test_files_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    """A missing file and a folder are refused by name."""
    with pytest.raises(MeshReadError, match=r"absent\.obj: no such file"):
        read_obj(tmp_path / "absent.obj")
    with pytest.raises(MeshReadError, match="expected a file, found a folder"):
        read_obj(tmp_path)


def test_bytes_that_are_no_text_hold_nothing() -> None:
    """Arbitrary bytes parse to an empty file, not to a crash: who needs faces then refuses it."""
    data = parse_obj(bytes(range(256)) * 4, Path("noise.obj"))
    assert (len(data.vertices), len(data.faces), len(data.segments)) == (0, 0, 0)


@given(
    st.lists(st.tuples(*[st.floats(-1e6, 1e6)] * 3), min_size=3, max_size=8),
    st.data(),
)
def test_what_is_written_is_read(vertices: list[tuple[float, float, float]], data: st.DataObject) -> None:
    """Vertices come back bit for bit, and positive and negative references to them mean the same."""
    count = len(vertices)
    corners = data.draw(st.lists(st.integers(0, count - 1), min_size=3, max_size=3, unique=True))
    body = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in vertices)
    positive = parse(body + "f " + " ".join(str(i + 1) for i in corners))
    negative = parse(body + "f " + " ".join(str(i - count) for i in corners))
    assert positive.vertices.tolist() == [list(vertex) for vertex in vertices]
    np.testing.assert_array_equal(positive.faces, negative.faces)
