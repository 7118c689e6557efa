"""Exports for other tools, read back by readers that are not ours; runs cut short, moved and very long."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flights import DEADLINE, Done, environment

from cosim import export_scene
from cosim.export import export
from cosim.recording import manifest_digest
from cosim.runs import Run, read_run


@pytest.fixture
def run(conduit_run: tuple[Done, Path]) -> Run:
    """The recorded flight through the conduit."""
    return read_run(conduit_run[1])


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrix of a unit quaternion x y z w."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(quaternion).as_matrix()


def test_pandas_polars_and_duckdb_read_the_parquet(run: Run, tmp_path: Path) -> None:
    """Three readers find every record, and the same numbers."""
    pandas = pytest.importorskip("pandas")
    polars = pytest.importorskip("polars")
    duckdb = pytest.importorskip("duckdb")
    path, _ = export(run.folder, "parquet", tmp_path / "run.parquet")
    z = run.records["position"][:, 2].tolist()
    assert pandas.read_parquet(path)["position_z"].tolist() == z
    assert polars.read_parquet(path)["position_z"].to_list() == z
    rows = duckdb.sql(f"select position_z from '{path}' order by step").fetchall()
    assert [row[0] for row in rows] == z


def test_evo_reads_the_tum_trajectory(run: Run, tmp_path: Path) -> None:
    """Times, positions and quaternions arrive exactly, whatever order of components evo keeps."""
    file_interface = pytest.importorskip("evo.tools.file_interface")
    path, _ = export(run.folder, "tum", tmp_path / "run.tum")
    trajectory = file_interface.read_tum_trajectory_file(str(path))
    assert trajectory.timestamps.tolist() == run.records["sim_time"].tolist()
    assert np.array_equal(trajectory.positions_xyz, run.records["position"])
    assert np.array_equal(trajectory.orientations_quat_wxyz[:, [1, 2, 3, 0]], run.records["quaternion"])
    assert trajectory.check()[0]


def test_mcap_holds_poses_commands_scans_and_schemas(run: Run, tmp_path: Path) -> None:
    """Every topic has one message a record at its simulated time, with a schema that Foxglove knows by name."""
    reader_of = pytest.importorskip("mcap.reader").make_reader
    path, _ = export(run.folder, "mcap", tmp_path / "run.mcap")
    messages: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    schemas = {}
    with path.open("rb") as file:
        for schema, channel, message in reader_of(file).iter_messages():
            messages.setdefault(channel.topic, []).append((message.log_time, json.loads(message.data)))
            schemas[channel.topic] = schema.name
            assert_fits(json.loads(message.data), json.loads(schema.data))
    assert schemas["/tf"] == "foxglove.FrameTransform"
    assert schemas["/drone/pose"] == "foxglove.PoseInFrame"
    assert schemas["/drone/lidar/front"] == schemas["/drone/lidar/rear"] == "foxglove.LaserScan"
    assert schemas["/tube"] == "foxglove.SceneUpdate"
    per_record = [rows for topic, rows in messages.items() if topic != "/tube"]
    assert all(len(rows) == len(run.records) for rows in per_record)
    time, pose = messages["/drone/pose"][100]
    assert time == round(1e9 * run.records["sim_time"][100])
    assert list(pose["pose"]["position"].values()) == run.records["position"][100].tolist()
    assert messages["/drone/command"][100][1]["speed"] == run.records["commanded_speed"][100]
    assert messages["/drone/state"][-1][1]["outcome"] == "success"


def assert_fits(value: Any, schema: dict[str, Any]) -> None:
    """Hold a message against its JSON schema: the types, and nothing that the schema does not describe."""
    kinds = {
        "object": dict,
        "array": list,
        "number": (int, float),
        "integer": int,
        "string": str,
        "boolean": bool,
    }
    assert isinstance(value, kinds[schema["type"]]), (value, schema)
    if schema["type"] == "object":
        assert set(value) <= set(schema["properties"])
        for name, inner in value.items():
            assert_fits(inner, schema["properties"][name])
    elif schema["type"] == "array":
        for inner in value:
            assert_fits(inner, schema["items"])


def test_a_scan_in_mcap_meets_the_wall_where_the_lidar_did(run: Run, tmp_path: Path) -> None:
    """Rays rebuilt by the schema's own rule stand where `place_rays` puts them: along cos r + sin u of the drone."""
    reader_of = pytest.importorskip("mcap.reader").make_reader
    path, _ = export(run.folder, "mcap", tmp_path / "run.mcap")
    index, rays = 120, 36
    with path.open("rb") as file:
        found = reader_of(file).iter_messages(topics=["/drone/lidar/front"])
        scan = json.loads([message.data for _, _, message in found][index])
    record = run.records[index]
    body = rotation(record["quaternion"])
    turn = rotation(np.array([scan["pose"]["orientation"][c] for c in "xyzw"]))
    angles = np.linspace(scan["start_angle"], scan["end_angle"], rays)
    local = np.stack([np.cos(angles), np.sin(angles), np.zeros(rays)], axis=1)
    right, up = -body[:, 1], body[:, 2]
    expected = np.cos(angles)[:, None] * right + np.sin(angles)[:, None] * up
    np.testing.assert_allclose(local @ turn.T @ body.T, expected, atol=1e-12)
    assert scan["ranges"] == record["lidar"][:rays].tolist()
    assert scan["pose"]["position"] == {"x": 0.2, "y": 0.0, "z": 0.0}


def test_trimesh_reads_the_gltf_scene(run: Run, tmp_path: Path) -> None:
    """The tube stands in glTF's axes, Y up, with every triangle."""
    trimesh = pytest.importorskip("trimesh")
    path, note = export(run.folder, "gltf", tmp_path / "run.glb")
    assert note == ""
    scene = trimesh.load_scene(path)
    assert {"tube", "drone"} <= set(scene.geometry)
    tube = scene.dump(concatenate=False)
    wall = next(
        part for part in tube if getattr(part, "faces", None) is not None and len(part.faces) > 10_000
    )
    industrial = trimesh.load_mesh(Path(run.manifest["mesh"]["path"]), process=False)
    x, y, z = industrial.bounds.T
    np.testing.assert_allclose(np.sort(wall.bounds.T[1]), np.sort(z), atol=1e-4)
    np.testing.assert_allclose(np.sort(wall.bounds.T[2]), np.sort(-y), atol=1e-4)
    np.testing.assert_allclose(wall.bounds.T[0], x, atol=1e-4)


def test_the_gltf_animation_is_the_recorded_flight(run: Run, tmp_path: Path) -> None:
    """Times, places and turns of the animation, taken from the bytes by the format's own rules."""
    path, _ = export(run.folder, "gltf", tmp_path / "run.glb")
    raw = path.read_bytes()
    length = struct.unpack_from("<I", raw, 12)[0]
    document, buffer = json.loads(raw[20 : 20 + length]), raw[20 + length + 8 :]

    def read(accessor: int, width: int) -> np.ndarray:
        described = document["accessors"][accessor]
        view = document["bufferViews"][described["bufferView"]]
        values = np.frombuffer(buffer, "<f4", width * described["count"], view.get("byteOffset", 0))
        return values.reshape(-1, width)

    (animation,) = document["animations"]
    by_path = {c["target"]["path"]: animation["samplers"][c["sampler"]] for c in animation["channels"]}
    times = read(by_path["translation"]["input"], 1)[:, 0]
    np.testing.assert_allclose(times, run.records["sim_time"], rtol=1e-6)
    np.testing.assert_allclose(read(by_path["translation"]["output"], 3), run.records["position"], atol=1e-5)
    turns = read(by_path["rotation"]["output"], 4).astype(float)
    dots = np.abs(np.einsum("ij,ij->i", turns, run.records["quaternion"]))
    np.testing.assert_allclose(dots, 1.0, atol=1e-6)
    assert (np.einsum("ij,ij->i", turns[1:], turns[:-1]) >= 0.0).all()


def test_pixars_library_reads_the_usd_stage(run: Run, tmp_path: Path) -> None:
    """Z up, metres, 24 time codes a second, the drone at its recorded pose at each step; the tube lets one see in."""
    usd = pytest.importorskip("pxr.Usd")
    geometry = pytest.importorskip("pxr.UsdGeom")
    shade = pytest.importorskip("pxr.UsdShade")
    path, _ = export(run.folder, "usd", tmp_path / "run.usdc")
    stage = usd.Stage.Open(str(path))
    assert geometry.GetStageUpAxis(stage) == "Z"
    assert geometry.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetTimeCodesPerSecond() == 24.0  # of Blender's scenes, which take a time code for a frame
    assert stage.GetEndTimeCode() == 24.0 * run.records["sim_time"][-1]
    drone = geometry.Xformable(stage.GetPrimAtPath("/World/Drone"))
    for step in (0, 57, len(run.records) - 1):
        code = 24.0 * float(run.records["sim_time"][step])
        matrix = np.array(drone.ComputeLocalToWorldTransform(code))
        np.testing.assert_allclose(matrix[3, :3], run.records["position"][step], atol=1e-9)
        np.testing.assert_allclose(matrix[:3, :3].T, rotation(run.records["quaternion"][step]), atol=1e-5)
    tube = geometry.Mesh(stage.GetPrimAtPath("/World/Tube"))
    assert len(tube.GetFaceVertexCountsAttr().Get()) > 10_000
    material, _ = shade.MaterialBindingAPI(tube.GetPrim()).ComputeBoundMaterial()
    surface = shade.Shader(stage.GetPrimAtPath(f"{material.GetPath()}/Surface"))
    assert 0.0 < surface.GetInput("opacity").Get() < 0.5


def test_a_usd_stage_of_a_long_flight_holds_fewer_poses_and_says_so(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pixar's library holds a stage in memory: of more poses than that is for, every n-th and the last are kept."""
    usd = pytest.importorskip("pxr.Usd")
    geometry = pytest.importorskip("pxr.UsdGeom")
    monkeypatch.setattr(export_scene, "MOST_POSES", 100)
    path, note = export(run.folder, "usd", tmp_path / "run.usdc")
    assert f"one in 5 of {len(run.records)} poses" in note
    stage = usd.Stage.Open(str(path))
    drone = geometry.Xformable(stage.GetPrimAtPath("/World/Drone"))
    kept = sorted({*range(0, len(run.records), 5), len(run.records) - 1})
    np.testing.assert_allclose(drone.GetTimeSamples(), 24.0 * run.records["sim_time"][kept])


@pytest.mark.parametrize("kind", ["csv", "npz", "parquet", "tum", "mcap", "gltf", "usd"])
def test_a_run_that_was_cut_short_and_moved_is_exported(run: Run, tmp_path: Path, kind: str) -> None:
    """From the folder alone, with half a record at its end and its mesh gone: a tube is rebuilt, and that is said."""
    folder = tmp_path / "moved"
    folder.mkdir()
    manifest = json.loads((run.folder / "manifest.json").read_text())
    manifest["mesh"]["path"] = "/nowhere/gone.obj"
    manifest["manifest_sha256"] = manifest_digest(manifest)
    (folder / "manifest.json").write_text(json.dumps(manifest))
    size = run.records.dtype.itemsize
    (folder / "steps.bin").write_bytes((run.folder / "steps.bin").read_bytes()[: 40 * size + size // 2])
    path, note = export(folder, kind)
    assert path.stat().st_size > 1000
    assert (kind in ("gltf", "usd")) == ("rebuilt" in note)
    assert sorted(p.name for p in folder.iterdir()) == sorted(["manifest.json", "steps.bin", path.name])


@pytest.mark.parametrize("kind", ["gltf", "usd"])
def test_a_run_of_its_reset_alone_is_a_scene_without_lines(run: Run, tmp_path: Path, kind: str) -> None:
    """Importers fail at a line through a single point; the tube and the drone stand there all the same."""
    shutil.copy(run.folder / "manifest.json", tmp_path / "manifest.json")
    (tmp_path / "steps.bin").write_bytes(
        (run.folder / "steps.bin").read_bytes()[: run.records.dtype.itemsize]
    )
    path, _ = export(tmp_path, kind)
    if kind == "gltf":
        names = {
            mesh["name"] for mesh in json.loads(path.read_bytes()[20:].split(b"BIN\0")[0][:-4])["meshes"]
        }
    else:
        stage = pytest.importorskip("pxr.Usd").Stage.Open(str(path))
        names = {prim.GetName().lower() for prim in stage.GetPrimAtPath("/World").GetChildren()} - {
            "materials"
        }
    assert names == {"tube", "drone"}


LONG = """
import resource, sys
from pathlib import Path
from cosim import export_scene
from cosim.export import export
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
export(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024)
"""


@pytest.mark.parametrize(
    ("kind", "steps"),
    [("tum", 1_000_000), ("parquet", 300_000), ("npz", 300_000), ("gltf", 300_000), ("csv", 60_000)],
)
def test_a_long_log_is_exported_in_bounded_memory(run: Run, tmp_path: Path, kind: str, steps: int) -> None:
    """A sparse log, of a million steps 1.6 GB long, is streamed: an export takes less than 300 MB of memory."""
    shutil.copy(run.folder / "manifest.json", tmp_path / "manifest.json")
    with (tmp_path / "steps.bin").open("wb") as log:
        log.truncate(steps * run.records.dtype.itemsize)
    target = str(tmp_path / f"out.{kind}")
    done = subprocess.run(
        [sys.executable, "-c", LONG, str(tmp_path), kind, target],
        check=True, capture_output=True, text=True, env=environment(), timeout=DEADLINE,
    )  # fmt: skip
    assert float(done.stdout) < 300.0
