"""Tubes from files: walls in every format, centrelines in every order, and all that is refused."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from meshes.centreline import parse_centreline, resample
from meshes.errors import CentrelineError, MeshReadError
from meshes.tube import read_tube
from meshes.wall import read_wall

WriteTube = Callable[..., Path]
ELSEWHERE = Path(__file__).parents[3] / "shared" / "meshes"
"""Meshes that others made, where they lie beside this repository."""


def chain(text: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Parse a centreline under a name that errors can be matched by."""
    return parse_centreline(text.encode(), Path("line.obj"))


def points_of(count: int) -> str:
    """Vertices 1 to count along x, at their own numbers."""
    return "".join(f"v {i + 1} 0 0\n" for i in range(count))


# ---------------------------------------------------------------- walls


def test_wall_carries_the_hash_of_its_file(write_tube: WriteTube, shapes: Any) -> None:
    """The SHA-256 is that of the bytes on disk."""
    path = write_tube(shapes.straight())
    assert read_wall(path).sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_y_up_files_are_turned(tmp_path: Path) -> None:
    """`yup` maps the file's (x, y, z) to the world's (x, -z, y); `zup` keeps it."""
    path = tmp_path / "turned.obj"
    path.write_text("v 1 2 3\nv 4 5 6\nv 7 8 10\nf 1 2 3\n")
    assert read_wall(path, "yup").vertices.tolist() == [[1, -3, 2], [4, -6, 5], [7, -10, 8]]
    assert read_wall(path).vertices.tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 10]]


def test_scale_is_metres_in_a_unit(tmp_path: Path) -> None:
    """A file in centimetres is read with scale 0.01."""
    path = tmp_path / "scaled.obj"
    path.write_text("v 100 0 0\nv 0 200 0\nv 0 0 300\nf 1 2 3\n")
    np.testing.assert_allclose(read_wall(path, scale=0.01).vertices, np.diag([1.0, 2.0, 3.0]))


def test_vertices_that_no_face_uses_are_left_out(tmp_path: Path) -> None:
    """A centreline in the same file is no part of the wall."""
    path = tmp_path / "both.obj"
    path.write_text("v 9 9 9\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 2 3 4\nl 1 2\n")
    wall = read_wall(path)
    assert wall.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert wall.faces.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".glb", ".off"])
def test_other_formats_read_as_the_same_wall(suffix: str, tmp_path: Path, shapes: Any) -> None:
    """A mesh in another format has the same triangles, and its duplicates are dropped and counted too."""
    shape = shapes.straight(sides=12)
    faces = np.concatenate([shape.faces, shape.faces[:5]])
    path = tmp_path / f"wall{suffix}"
    trimesh.Trimesh(shape.vertices, faces, process=False).export(path)
    wall = read_wall(path)
    assert (len(wall.faces), wall.duplicate_faces) == (len(shape.faces), 5)
    found = np.sort(np.linalg.norm(wall.vertices[wall.faces].mean(axis=1), axis=1))
    expected = np.sort(np.linalg.norm(shape.vertices[shape.faces].mean(axis=1), axis=1))
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty.obj", b"", "expected a mesh of format .obj, found an empty file"),
        ("points.obj", b"v 0 0 0\nv 1 1 1\n", "expected a mesh with faces, found 2 vertices and no face"),
        ("noise.ply", b"no mesh at all", "not a readable mesh"),
        ("noise.stl", b"no mesh at all", "noise.stl: "),
        ("noise.glb", b"no mesh at all", "not a readable mesh"),
        (
            "notes.txt",
            b"no mesh at all",
            r"that can be read \(\.dae, \.glb, \.gltf, \.obj, \.off, \.ply, \.stl\), found '\.txt'",
        ),
    ],
)
def test_what_is_no_mesh_is_refused(name: str, content: bytes, message: str, tmp_path: Path) -> None:
    """Files that hold no faces, or are no mesh, are refused by name."""
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(MeshReadError, match=message):
        read_wall(path)


def test_a_damaged_file_is_refused_whatever_its_reader_lacks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A damaged .off makes the loader guess an encoding; without the package for that, it is damaged all the same."""
    path = tmp_path / "noise.off"
    path.write_bytes(bytes(range(128, 256)) * 3)
    monkeypatch.setitem(sys.modules, "charset_normalizer", None)
    with pytest.raises(MeshReadError, match=r"not a readable mesh of format \.off: damaged"):
        read_wall(path)


def test_missing_file_and_meaningless_options_are_refused(tmp_path: Path) -> None:
    """No such file, an unknown axis convention, and a scale that is no positive number."""
    with pytest.raises(MeshReadError, match=r"absent\.stl: no such file"):
        read_wall(tmp_path / "absent.stl")
    path = tmp_path / "one.obj"
    path.write_text("v 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\n")
    with pytest.raises(MeshReadError, match="axes: expected 'auto', 'zup' or 'yup', found 'xup'"):
        read_wall(path, "xup")  # type: ignore[arg-type]
    for scale in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(MeshReadError, match="scale: expected a positive number"):
            read_wall(path, scale=scale)


@pytest.mark.skipif(not ELSEWHERE.is_dir(), reason=f"no meshes of others in {ELSEWHERE}")
@pytest.mark.parametrize(
    ("name", "faces", "duplicates"),
    [
        ("inpipe22/pipes22.obj", 14688, 7344),
        ("tile_ramp2/cave_tile_ramp2.obj", 328, 0),
        ("tile_5/cave_tile_5.obj", 218, 0),
        ("colon/Colon.stl", 5844, 0),
        ("colon/Colon.ply", 5844, 0),
        ("cal_coil/coil.stl", 10270, 0),
        ("trimesh_tube/tube.obj", 120, 0),
    ],
)
def test_meshes_that_others_made_are_read(name: str, faces: int, duplicates: int) -> None:
    """Meshes from elsewhere are read whole, less their duplicates."""
    wall = read_wall(ELSEWHERE / name)
    assert (len(wall.faces), wall.duplicate_faces) == (faces, duplicates)
    assert wall.faces.max() == len(wall.vertices) - 1


@pytest.mark.skipif(not ELSEWHERE.is_dir(), reason=f"no meshes of others in {ELSEWHERE}")
@pytest.mark.parametrize(
    ("name", "line", "radius"),
    [
        ("inpipe22/pipes22.obj", "v 0.01 0 0\nv 1 0 0\nl 1 2\n", 0.2),
        ("trimesh_tube/tube.obj", "v 0 0.1 0\nv 0 11.8 0\nl 1 2\n", 0.678),
    ],
)
def test_double_walls_that_others_made_have_their_inner_radius(
    name: str, line: str, radius: float, tmp_path: Path
) -> None:
    """The local radius of a pipe with a thickness is that of its inner surface, within 2 %."""
    path = tmp_path / "line.obj"
    path.write_text(line)
    np.testing.assert_allclose(read_tube(ELSEWHERE / name, path).radius, radius, rtol=0.02)


# ---------------------------------------------------------------- centrelines


def test_segments_in_file_order_are_followed() -> None:
    """Points come back in path order, from the end that stands first in the file."""
    assert chain(points_of(4) + "l 1 2\nl 2 3\nl 3 4\n")[:, 0].tolist() == [1, 2, 3, 4]


def test_first_end_is_that_of_the_lower_vertex_number() -> None:
    """The path 3-1-2-4 begins at vertex 3, not at the vertex of the first segment."""
    assert chain(points_of(4) + "l 1 2\nl 4 2\nl 1 3\n")[:, 0].tolist() == [3, 1, 2, 4]


@given(st.permutations(range(12)), st.lists(st.booleans(), min_size=12, max_size=12))
def test_order_and_direction_of_segments_mean_nothing(order: list[int], flips: list[bool]) -> None:
    """Shuffled and turned segments, as Blender writes them after an edit, chain to the same path."""
    segments = [(i + 1, i + 2) if flip else (i + 2, i + 1) for i, flip in enumerate(flips)]
    shuffled = "".join("l {} {}\n".format(*segments[i]) for i in order)
    assert chain(points_of(13) + shuffled)[:, 0].tolist() == list(range(1, 14))


def test_pieces_that_meet_at_a_place_are_one_path() -> None:
    """Two polylines with a vertex each at exactly the same place continue one another."""
    text = "v 0 0 0\nv 1 0 0\nv 1 0 0\nv 2 0 0\nl 1 2\nl 3 4\n"
    assert chain(text).tolist() == [[0, 0, 0], [1, 0, 0], [2, 0, 0]]


def test_a_centreline_written_twice_counts_once() -> None:
    """A duplicate object does not make branches."""
    once = "v 0 0 0\nv 1 0 0\nv 2 0 0\n"
    assert len(chain(once + "l 1 2 3\n" + once + "l 4 5 6\n")) == 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            points_of(4) + "l 1 2 3\nl 2 4\n",
            r"without branches, found 1 branching: 3 segments meet at \(2, 0, 0\)",
        ),
        (points_of(3) + "l 1 2 3 1\n", r"found a loop through \(1, 0, 0\)"),
        (
            points_of(5) + "l 1 2\nl 3 4 5\n",
            r"found 2 pieces: 2 points from \(1, 0, 0\) to \(2, 0, 0\); 3 points from \(3, 0, 0\) to \(5, 0, 0\)",
        ),
        (points_of(5) + "l 1 2\nl 3 4 5 3\n", "found a loop"),
        (points_of(3), "expected at least 2 points joined by 'l' lines, found 3 vertices and no segment"),
        (points_of(3) + "l 1 1\n", "no segment of any length"),
        ("", "expected at least 2 points joined by 'l' lines, found 0 vertices"),
    ],
)
def test_what_is_no_single_open_path_is_refused(text: str, message: str) -> None:
    """Branches, loops, several pieces and less than a segment are refused, with how many and where."""
    with pytest.raises(CentrelineError, match=message):
        chain(text)


def test_centreline_in_another_format_is_refused() -> None:
    """Only an .obj can hold line segments here."""
    with pytest.raises(
        MeshReadError, match=r"expected a centreline as an \.obj of line segments, found '\.stl'"
    ):
        parse_centreline(b"", Path("line.stl"))


def test_resampling_is_even_and_keeps_ends_and_length() -> None:
    """Uneven points become even ones on the same line, and the step divides the length."""
    points = np.array([[0.0, 0, 0], [0.1, 0, 0], [3.0, 0, 0], [3.0, 4.05, 0]])
    axis, tangent = resample(points, 0.1)
    assert len(axis) == 72
    np.testing.assert_allclose(axis[[0, -1]], points[[0, -1]])
    np.testing.assert_allclose(axis[10], [10 * 7.05 / 71, 0, 0])
    np.testing.assert_allclose(np.linalg.norm(tangent, axis=1), 1.0)
    np.testing.assert_allclose(tangent[[0, -1]], [[1, 0, 0], [0, 1, 0]], atol=1e-12)


def test_tangents_of_a_coarse_circle_are_smooth() -> None:
    """A circle of radius 2.5 m in segments of 0.2 m has tangents within a degree of the exact ones."""
    angle = np.linspace(0.0, np.pi, 40)
    points = 2.5 * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    axis, tangent = resample(points, 0.1)
    exact = np.stack([-axis[:, 1], axis[:, 0], axis[:, 2]], axis=1)
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    cosine = np.sum(tangent * exact, axis=1)
    assert np.degrees(np.arccos(np.minimum(cosine, 1.0)))[2:-2].max() < 1.0
    assert np.degrees(np.arccos(np.minimum(cosine, 1.0))).max() < 3.0


# ---------------------------------------------------------------- tubes


def test_tube_of_a_cylinder(cylinder: Any) -> None:
    """Length, step and radius of a cylinder of radius 1 m, in the axes of the world."""
    assert cylinder.length == pytest.approx(10.0)
    assert cylinder.step == pytest.approx(0.05)
    np.testing.assert_allclose(cylinder.arc_length, cylinder.axis[:, 0], atol=1e-12)
    np.testing.assert_allclose(cylinder.radius, 1.0, atol=1e-3)
    assert cylinder.centreline_path.name == "cylinder_centerline.obj"
    assert cylinder.centreline_sha256 == hashlib.sha256(cylinder.centreline_path.read_bytes()).hexdigest()


def test_long_tube_has_steps_of_a_tenth_of_a_metre(half_torus: Any) -> None:
    """The length of half a torus is that of its circle, within 1e-4, and the step at most 0.1 m."""
    assert half_torus.length == pytest.approx(4 * np.pi, rel=1e-4)
    assert half_torus.step <= 0.1
    np.testing.assert_allclose(half_torus.radius, 1.0, atol=2e-3)


def test_radius_follows_a_cone(write_tube: WriteTube, shapes: Any) -> None:
    """In a cone the local radius is the exact one of the section."""
    tube = read_tube(write_tube(shapes.straight(radius=np.linspace(0.8, 1.2, 11))))
    np.testing.assert_allclose(tube.radius[1:-1], (0.8 + 0.04 * tube.arc_length)[1:-1], atol=2e-3)


def test_radius_is_that_of_the_inner_surface(write_tube: WriteTube, shapes: Any) -> None:
    """A wall with a thickness is measured from inside."""
    tube = read_tube(write_tube(shapes.join(shapes.straight(), shapes.straight(radius=1.1))))
    np.testing.assert_allclose(tube.radius, 1.0, atol=1e-3)


def test_start_end_turns_the_centreline(write_tube: WriteTube, shapes: Any) -> None:
    """`last` starts from the other end: points and tangents are reversed, arc length starts there."""
    path = write_tube(shapes.bend())
    first, last = read_tube(path), read_tube(path, start_end="last")
    np.testing.assert_allclose(last.axis, first.axis[::-1], atol=1e-12)
    np.testing.assert_allclose(last.tangent, -first.tangent[::-1], atol=1e-12)
    np.testing.assert_allclose(last.arc_length, first.arc_length)


def test_axes_and_scale_apply_to_both_files(write_tube: WriteTube, shapes: Any) -> None:
    """A tube in centimetres with Y up is the same tube, turned and in metres."""
    shape = shapes.bend()
    in_file = type(shape)(
        *(
            array if array.dtype.kind == "i" else 100 * array[:, [0, 2, 1]] * [1, 1, -1]
            for array in (shape.vertices, shape.faces, shape.axis)
        )
    )
    turned = read_tube(write_tube(in_file, "turned"), axes="yup", scale=0.01)
    plain = read_tube(write_tube(shape, "plain"))
    np.testing.assert_allclose(turned.axis, plain.axis, atol=1e-9)
    np.testing.assert_allclose(turned.radius, plain.radius, atol=1e-6)
    assert (turned.axes, turned.scale) == ("yup", 0.01)


def test_far_from_the_origin_nothing_is_lost(write_tube: WriteTube, shapes: Any) -> None:
    """A tube 100 km away has the same radius to 1e-5 m, although rays are cast in float32."""
    shape = shapes.bend()
    near = read_tube(write_tube(shape, "near"))
    far = read_tube(write_tube(type(shape)(shape.vertices + 1e5, shape.faces, shape.axis + 1e5), "far"))
    np.testing.assert_allclose(far.radius, near.radius, atol=1e-5)


def test_centreline_may_share_the_file_of_the_wall(tmp_path: Path, shapes: Any) -> None:
    """Named explicitly, the mesh itself can hold the centreline."""
    shape = shapes.straight()
    count = len(shape.vertices)
    path = tmp_path / "both.obj"
    path.write_text(
        shapes.obj_text(
            np.concatenate([shape.vertices, shape.axis[[0, -1]]]), shape.faces, np.array([[count, count + 1]])
        )
    )
    assert read_tube(path, path).length == pytest.approx(10.0)


def write_line(path: Path, *points: tuple[float, float, float]) -> Path:
    """A centreline through the points."""
    numbers = " ".join(str(i + 1) for i in range(len(points)))
    path.write_text("".join("v {} {} {}\n".format(*point) for point in points) + f"l {numbers}\n")
    return path


@pytest.mark.parametrize(
    ("points", "where"),
    [
        (
            [(0.0, 3.0, 0.0), (10.0, 3.0, 0.0)],
            r"arc length 0\.00 m of 10\.00 m \d+ of 36 rays around it that meet no wall",
        ),
        ([(0.0, 0.0, 0.0), (14.0, 0.0, 0.0)], r"arc length 10\.\d\d m of 14\.00 m 36 of 36 rays"),
        (
            [(0.5, 0.0, 0.0), (9.5, 3.0, 0.0)],
            r"arc length 3\.\d\d m of 9\.49 m \d+ of 36 rays .* and the wall crossed by it",
        ),
        ([(0.0, 1.01, 0.0), (10.0, 1.01, 0.0)], r"arc length 0\.00 m .* rays around it that meet no wall"),
    ],
)
def test_centreline_outside_of_the_tube_is_refused(
    points: list[tuple[float, float, float]], where: str, write_tube: WriteTube, shapes: Any, tmp_path: Path
) -> None:
    """Beside the tube, beyond its end, through its wall, just on its skin: each is refused, with where it begins."""
    line = write_line(tmp_path / "line.obj", *points)
    with pytest.raises(CentrelineError, match=where):
        read_tube(write_tube(shapes.straight(rings=101)), line)


def test_named_centrelines_must_exist(write_tube: WriteTube, shapes: Any, tmp_path: Path) -> None:
    """One that is named and absent is an error, and none is looked for in its place."""
    path = write_tube(shapes.straight())
    with pytest.raises(CentrelineError, match=r"absent\.obj: expected the centreline of .*tube\.obj here"):
        read_tube(path, tmp_path / "absent.obj")


def test_centreline_is_found_where_none_is_given(write_tube: WriteTube, shapes: Any) -> None:
    """Without a file beside the mesh it is found from the wall; the tube says so, with the hash of its points."""
    path = write_tube(shapes.bend())
    given = read_tube(path)
    path.with_name("tube_centerline.obj").unlink()
    found = read_tube(path)
    assert (found.centreline_path, given.found) == (None, None)
    assert found.found is not None
    assert len(found.centreline_sha256) == 64
    assert found.length == pytest.approx(given.length, abs=0.3)
    assert read_tube(path).centreline_sha256 == found.centreline_sha256


@pytest.mark.parametrize("scale", [1e-300, 1e-5, 1e5, 1e12, 1e300])
def test_absurd_scales_are_refused(scale: float, write_tube: WriteTube, shapes: Any) -> None:
    """A 10 m tube that becomes a grain of dust, or longer than any, is refused before it is resampled."""
    with pytest.raises(
        (MeshReadError, CentrelineError), match=r"tube.*\.obj: scale: expected .* found 1[0e]"
    ):
        read_tube(write_tube(shapes.straight()), scale=scale)


def test_files_behind_a_locked_folder_are_refused(
    write_tube: WriteTube, shapes: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where looking at the centreline is forbidden already, the reason is given, and not that it is missing."""
    path = write_tube(shapes.straight())
    wall = read_wall(path)

    def locked(self: Path, *_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr("meshes.tube.read_wall", lambda *_: wall)
    monkeypatch.setattr(Path, "stat", locked)
    monkeypatch.setattr(Path, "read_bytes", locked)
    with pytest.raises(MeshReadError, match=r"tube_centerline\.obj: cannot be read: Permission denied$"):
        read_tube(path)


def test_a_folder_is_no_centreline(write_tube: WriteTube, shapes: Any, tmp_path: Path) -> None:
    """A folder given as centreline is called one."""
    with pytest.raises(MeshReadError, match="expected a file, found a folder"):
        read_tube(write_tube(shapes.straight()), tmp_path)


def test_centreline_that_changes_sides_of_a_wall_is_refused(
    write_tube: WriteTube, shapes: Any, tmp_path: Path
) -> None:
    """Into the gap between an inner and an outer pipe: every ray meets a wall, but one was crossed."""
    path = write_tube(shapes.join(shapes.straight(rings=101), shapes.straight(radius=3.0, rings=101)))
    with pytest.raises(CentrelineError, match=r"m 0 of 36 rays .* and the wall crossed by it"):
        read_tube(path, write_line(tmp_path / "line.obj", (0.5, 0.0, 0.0), (9.5, 2.0, 0.0)))


def test_mouth_that_is_not_square_is_accepted(write_tube: WriteTube, shapes: Any, tmp_path: Path) -> None:
    """A centreline at 20 degrees to the mouth: part of the first rings passes it, so the next whole ring counts."""
    path = write_tube(shapes.straight(rings=101))
    slant = np.tan(np.radians(20))
    tube = read_tube(
        path, write_line(tmp_path / "line.obj", (0.02, -0.5, 0.0), (2.5, -0.5 + 2.48 * slant, 0.0))
    )
    assert tube.length == pytest.approx(2.48 / np.cos(np.radians(20)))
    assert np.all((tube.radius > 0.8) & (tube.radius < 1.2))
