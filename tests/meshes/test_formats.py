"""Mesh files of every format: transforms, unit and up-axis as their format states them, unless a user says more."""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from tubular import Mesh, circle, extrude, line, s_bend

from meshes.errors import MeshReadError
from meshes.formats import FORMATS
from meshes.tube import read_tube
from meshes.wall import place, read_wall

TUBE = extrude(line([0.0, 0.0, 0.0], [8.0, 0.0, 0.0], 9), circle(16))
"""From the origin along x, 1 m wide."""
STANDING = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Turns (x, y, z) of the world into (x, z, -y), as a file with Y up has it."""


def write_dae(path: Path, mesh: Mesh, *, asset: str = "", matrix: np.ndarray | None = None) -> Path:
    """A COLLADA document with one mesh in one node."""
    pytest.importorskip("collada", reason="pycollada is not installed: pip install pycollada")
    vertices, faces = mesh
    numbers = " ".join(f"{x:.9g}" for x in vertices.ravel())
    corners = " ".join(str(i) for i in faces.ravel())
    placed = "" if matrix is None else f"<matrix>{' '.join(f'{x:.9g}' for x in matrix.ravel())}</matrix>"
    path.write_text(
        f"""<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><created>2020-01-01T00:00:00</created><modified>2020-01-01T00:00:00</modified>{asset}</asset>
<library_geometries><geometry id="wall"><mesh>
<source id="p"><float_array id="pa" count="{vertices.size}">{numbers}</float_array><technique_common>
<accessor source="#pa" count="{len(vertices)}" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="{len(faces)}"><input semantic="VERTEX" source="#v" offset="0"/><p>{corners}</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node id="n">{placed}<instance_geometry url="#wall"/></node>
</visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>"""
    )
    return path


def write_gltf(path: Path, mesh: Mesh, *, translation: list[float], scale: list[float]) -> Path:
    """A .gltf whose buffer lies beside it, and whose node moves and scales it."""
    vertices, faces = mesh
    points = vertices.astype("<f4").tobytes()
    corners = faces.astype("<u4").tobytes()
    path.with_suffix(".bin").write_bytes(points + corners)
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": translation, "scale": scale}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": len(points) + len(corners), "uri": path.with_suffix(".bin").name}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": len(points)},
            {"buffer": 0, "byteOffset": len(points), "byteLength": len(corners)},
        ],
        "accessors": [
            {
                "bufferView": 0, "componentType": 5126, "count": len(vertices), "type": "VEC3",
                "min": vertices.min(axis=0).tolist(), "max": vertices.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": 5125, "count": faces.size, "type": "SCALAR"},
        ],
    }  # fmt: skip
    path.write_text(json.dumps(document))
    return path


def box_of(path: Path, **options: object) -> np.ndarray:
    """Lowest and highest corner of a wall, (2, 3), metres."""
    vertices = read_wall(path, **options).vertices  # type: ignore[arg-type]
    return np.array([vertices.min(axis=0), vertices.max(axis=0)])


UPRIGHT = np.array([[0.0, -1.0, -1.0], [8.0, 1.0, 1.0]])
"""Box of TUBE."""


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".ply", ".off"])
def test_formats_that_state_nothing_are_read_as_they_are(suffix: str, tmp_path: Path) -> None:
    """Metres and Z up, with `auto` as without; the wall says that nobody stated it."""
    path = tmp_path / f"tube{suffix}"
    trimesh.Trimesh(*TUBE, process=False).export(path)
    wall = read_wall(path)
    assert (wall.axes, wall.scale, wall.stated.unit) == ("zup", 1.0, None)
    np.testing.assert_allclose(box_of(path), UPRIGHT, atol=1e-6)
    assert np.array_equal(wall.vertices, read_wall(path, "zup", 1.0).vertices)


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_gltf_has_y_up_in_metres(suffix: str, tmp_path: Path) -> None:
    """A tube that lies along x in the file's plane with Y up lies along x in the world, and can be read otherwise."""
    vertices, faces = TUBE
    path = tmp_path / f"tube{suffix}"
    standing = (vertices @ STANDING.T + np.array([0.0, 5.0, 0.0]), faces)  # 5 m above the ground
    if suffix == ".glb":
        trimesh.Trimesh(*standing, process=False).export(path)
    else:
        write_gltf(path, standing, translation=[0.0, 0.0, 0.0], scale=[1.0, 1.0, 1.0])
    wall = read_wall(path)
    assert (wall.axes, wall.scale) == ("yup", 1.0)
    np.testing.assert_allclose(box_of(path), UPRIGHT + np.array([0.0, 0.0, 5.0]), atol=1e-5)
    np.testing.assert_allclose(box_of(path, axes="zup"), UPRIGHT + np.array([0.0, 5.0, 0.0]), atol=1e-5)
    np.testing.assert_allclose(
        box_of(path, scale=0.1), 0.1 * (UPRIGHT + np.array([0.0, 0.0, 5.0])), atol=1e-5
    )


def test_transforms_of_scenes_are_applied(tmp_path: Path) -> None:
    """A node of a .gltf that moves and scales its mesh, with the buffer in a file beside it."""
    path = write_gltf(tmp_path / "moved.gltf", TUBE, translation=[10.0, 0.0, 0.0], scale=[2.0, 1.0, 1.0])
    np.testing.assert_allclose(box_of(path, axes="zup"), [[10.0, -1.0, -1.0], [26.0, 1.0, 1.0]], atol=1e-5)


def test_a_gltf_is_all_of_its_files(tmp_path: Path) -> None:
    """The buffer of a file with a blank in its name, as Blender writes it: read, hashed, and missed when gone."""
    path = write_gltf(tmp_path / "my tube.gltf", TUBE, translation=[0.0, 0.0, 0.0], scale=[1.0, 1.0, 1.0])
    path.write_text(path.read_text().replace("my tube.bin", "my%20tube.bin"))
    wall = read_wall(path)
    assert len(wall.faces) == len(TUBE[1])
    buffer = tmp_path / "my tube.bin"
    assert wall.companions == {"my%20tube.bin": hashlib.sha256(buffer.read_bytes()).hexdigest()}
    buffer.write_bytes(buffer.read_bytes()[:100])
    with pytest.raises(MeshReadError, match=r"bytes in .*my tube\.bin, found 100"):
        read_wall(path)
    buffer.unlink()
    with pytest.raises(MeshReadError, match=r"another file: .*my tube\.bin: no such file"):
        read_wall(path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "KHR_draco_mesh_compression"),
        ({"extensionsUsed": ["EXT_mesh_gpu_instancing"]}, "without instancing"),
        ({"accessors": [{"normalized": True}, {}]}, "quantised"),
        ({"meshes": [{"primitives": [{"mode": 6, "attributes": {"POSITION": 0}}]}]}, "fan"),
        ({"buffers": [{"byteLength": 1, "uri": "https://example.org/a.bin"}]}, "beside it"),
        ({"meshes": 3}, "damaged"),
    ],
)
def test_gltf_that_would_be_misread_is_refused(change: dict[str, object], words: str, tmp_path: Path) -> None:
    """Compressed or quantised vertices, and fans, become other triangles, or none, where nobody looks."""
    path = write_gltf(tmp_path / "odd.gltf", TUBE, translation=[0.0, 0.0, 0.0], scale=[1.0, 1.0, 1.0])
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(MeshReadError, match=words):
        read_wall(path)


def test_several_objects_of_a_scene_are_one_wall(tmp_path: Path) -> None:
    """Two halves of a tube as two nodes of a .glb: one wall with the faces of both, each in its place."""
    half = trimesh.Trimesh(*extrude(line([0, 0, 0], [4, 0, 0], 5), circle(16)), process=False)
    scene = trimesh.Scene()
    scene.add_geometry(half)
    scene.add_geometry(half, transform=trimesh.transformations.translation_matrix([4.0, 0.0, 0.0]))
    path = tmp_path / "halves.glb"
    scene.export(path)
    assert len(read_wall(path).faces) == 2 * len(half.faces)
    np.testing.assert_allclose(box_of(path, axes="zup"), UPRIGHT, atol=1e-5)


@pytest.mark.parametrize(
    ("asset", "axes", "scale"),
    [
        ('<unit name="centimeter" meter="0.01"/><up_axis>Z_UP</up_axis>', "zup", 0.01),
        ("<up_axis>Y_UP</up_axis>", "yup", 1.0),
        ('<unit meter="0.0254"/>', "yup", 0.0254),
        ("", "yup", 1.0),
    ],
)
def test_collada_states_unit_and_up_axis(asset: str, axes: str, scale: float, tmp_path: Path) -> None:
    """As <asset> says; where it says nothing, a metre and Y up, as COLLADA has it."""
    wall = read_wall(write_dae(tmp_path / "tube.dae", TUBE, asset=asset))
    assert (wall.axes, wall.scale) == (axes, scale)
    corner = wall.vertices.max(axis=0)
    np.testing.assert_allclose(corner, scale * np.array([8.0, 1.0, 1.0]), rtol=1e-6)


def test_collada_is_read_as_the_user_says(tmp_path: Path) -> None:
    """Files lie: axes and scale that are named win, and what the file states is still told."""
    path = write_dae(tmp_path / "tube.dae", TUBE, asset='<unit meter="0.01"/><up_axis>Z_UP</up_axis>')
    wall = read_wall(path, "yup", 2.0)
    assert (wall.axes, wall.scale) == ("yup", 2.0)
    assert "0.01 m a unit and Z_UP" in wall.stated.where
    assert np.array_equal(read_wall(path).vertices, read_wall(path, "zup", 0.01).vertices)


def test_collada_with_x_up_asks_for_axes(tmp_path: Path) -> None:
    """What cannot be said as Y or Z up is refused unless the user says how it is meant."""
    path = write_dae(tmp_path / "tube.dae", TUBE, asset="<up_axis>X_UP</up_axis>")
    with pytest.raises(MeshReadError, match="found X_UP; say with --axes"):
        read_wall(path)
    assert read_wall(path, "zup").axes == "zup"


def test_nodes_of_collada_are_placed(tmp_path: Path) -> None:
    """A matrix of a node moves its mesh before unit and axes are applied."""
    matrix = np.eye(4)
    matrix[0, 3] = 100.0
    asset = '<unit meter="0.01"/><up_axis>Z_UP</up_axis>'
    path = write_dae(tmp_path / "tube.dae", TUBE, asset=asset, matrix=matrix)
    np.testing.assert_allclose(box_of(path), 0.01 * (UPRIGHT + np.array([100.0, 0.0, 0.0])), atol=1e-7)


def test_file_and_world_coordinates_are_each_other_back(tmp_path: Path) -> None:
    """What a user reads off the file is found in the world, and named again as it was read."""
    path = tmp_path / "tube.stl"
    trimesh.Trimesh(*TUBE, process=False).export(path)
    wall = read_wall(path, "yup", 0.5)
    points = np.array([[1.0, 2.0, 3.0], [-4.0, 0.0, 6.0]])
    np.testing.assert_allclose(wall.to_world(points), [[0.5, -1.5, 1.0], [-2.0, -3.0, 0.0]])
    np.testing.assert_allclose(wall.to_file(wall.to_world(points)), points)


@pytest.mark.parametrize("suffix", [suffix for suffix in FORMATS if suffix not in (".gltf", ".dae")])
def test_a_bend_is_found_in_every_format(suffix: str, tmp_path: Path) -> None:
    """Written by trimesh and read here, the same tube has the same length."""
    path = tmp_path / f"bend{suffix}"
    trimesh.Trimesh(*extrude(s_bend(), circle(24)), process=False).export(path)
    assert read_tube(path, axes="zup").length == pytest.approx(4.0 * np.pi, abs=0.15)


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_a_ply_has_polygons_of_any_size(order: str, tmp_path: Path) -> None:
    """A box of a pentagon's section, as Blender writes one: quads and pentagons side by side, further properties of
    vertices and faces, and faces before vertices."""
    ring = circle(5)
    vertices = np.array([(x, y, z) for x in (0.0, 3.0) for y, z in ring])
    faces = [[*range(5)], [*range(9, 4, -1)], *([i, i + 5, (i + 1) % 5 + 5, (i + 1) % 5] for i in range(5))]
    header = (
        f"ply\nformat {order} 1.0\ncomment made\nelement face 7\nproperty uchar shade\n"
        "property list uchar int vertex_index\nelement vertex 10\nproperty double x\nproperty double y\n"
        "property double z\nproperty float s\nend_header\n"
    )
    if order == "ascii":
        lines = [f"7 {len(face)} {' '.join(map(str, face))}" for face in faces]
        lines += [f"{x:.9g} {y:.9g} {z:.9g} 0.5" for x, y, z in vertices]
        body = "\n".join(lines).encode()
    else:
        sign = "<" if order == "binary_little_endian" else ">"
        body = b"".join(struct.pack(f"{sign}BB{len(face)}i", 7, len(face), *face) for face in faces)
        body += b"".join(struct.pack(f"{sign}dddf", *vertex, 0.5) for vertex in vertices)
    path = tmp_path / "box.ply"
    path.write_bytes(header.encode() + body)
    wall = read_wall(path)
    assert len(wall.faces) == 2 * 3 + 5 * 2
    np.testing.assert_allclose(np.unique(wall.vertices, axis=0), np.unique(vertices, axis=0), atol=1e-8)
    a, b, c = (wall.vertices[wall.faces[:, k]] for k in range(3))
    volume = abs((np.cross(a, b) * c).sum()) / 6.0
    assert volume == pytest.approx(3.0 * 2.5 * np.sin(2.0 * np.pi / 5.0))
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(MeshReadError, match="cut short"):
        read_wall(path)


def _truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:200])


def _binary(path: Path) -> None:
    path.write_bytes(struct.pack("<80sI", b"", 7))


def _text(path: Path) -> None:
    path.write_text("solid tube\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\n")


def _empty(path: Path) -> None:
    path.write_bytes(b"\n")


def _pointer(path: Path) -> None:
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 7\n")


def _misnamed(path: Path) -> None:
    path.write_text("ply\nformat ascii 1.0\n")


@pytest.mark.parametrize(
    ("suffix", "damage", "words"),
    [
        (".glb", _truncated, "cut short"),
        (".ply", _truncated, "cut short"),
        (".off", _truncated, "cut short"),
        (".gltf", _truncated, "cut short"),
        (".stl", _truncated, "cut short"),
        (".stl", _binary, "7 triangles stated, which take 434 bytes, found 84: cut short"),
        (".stl", _text, "cut short"),
        (".dae", _empty, "empty"),
        (".obj", _pointer, "git lfs pull"),
        (".stl", _misnamed, "begins as .ply"),
    ],
)
def test_damaged_files_are_refused_by_name(
    suffix: str, damage: Callable[[Path], None], words: str, tmp_path: Path
) -> None:
    """Cut short, empty or of another kind: one sentence that names the file and what is wrong."""
    path = tmp_path / f"damaged{suffix}"
    if suffix in (".glb", ".gltf", ".ply", ".off", ".stl"):
        path.write_bytes(_exported(suffix))
    damage(path)
    with pytest.raises(MeshReadError, match=rf"damaged\{suffix}.*{words}"):
        read_wall(path)


def _exported(suffix: str) -> bytes:
    written = trimesh.Trimesh(*TUBE, process=False).export(file_type=suffix[1:])
    if isinstance(written, dict):  # a .gltf and its buffer
        return bytes(written["model.gltf"])
    return written.encode() if isinstance(written, str) else bytes(written)


@pytest.mark.parametrize("suffix", [".stl", ".ply"])
def test_coordinates_that_are_no_numbers_are_refused(suffix: str, tmp_path: Path) -> None:
    """A vertex that is not a number is a damaged file, not a hole in the wall."""
    vertices, faces = TUBE[0].copy(), TUBE[1]
    vertices[5] = np.nan
    path = tmp_path / f"tube{suffix}"
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    with pytest.raises(MeshReadError, match="finite"):
        read_wall(path)


def test_an_stl_may_be_named_in_any_encoding(tmp_path: Path) -> None:
    """The name of the solid in Latin-1; its vertices, one for each corner in the file, are joined again."""
    text = trimesh.Trimesh(*TUBE, process=False).export(file_type="stl_ascii")
    path = tmp_path / "tube.stl"
    path.write_bytes(text.replace("solid ", "solid Röhre ").encode("latin-1"))
    wall = read_wall(path)
    assert (len(wall.vertices), len(wall.faces)) == (len(TUBE[0]), len(TUBE[1]))


def test_places_are_named_to_a_share_of_the_extent(tmp_path: Path) -> None:
    """A place in a survey's coordinates is told from the next, and one near the origin has no more digits."""
    path = tmp_path / "tube.obj"
    lines = [f"v {x + 450000.0:.3f} {y + 5600000.0:.3f} {z:.3f}" for x, y, z in TUBE[0]]
    path.write_text("\n".join(lines + [f"f {a} {b} {c}" for a, b, c in TUBE[1] + 1]))
    wall = read_wall(path)
    assert place(wall, np.array([450003.21, 5600000.0, -0.0])) == "(450003.21, 5600000, 0)"


def test_damaged_collada_is_refused_by_name(tmp_path: Path) -> None:
    """XML that ends too early."""
    path = write_dae(tmp_path / "cut.dae", TUBE)
    _truncated(path)
    with pytest.raises(MeshReadError, match=r"cut\.dae: not a readable mesh of format \.dae"):
        read_wall(path)
