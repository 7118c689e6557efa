"""`cosim launch` through meshes without a centreline: found, stored, flown by the shipped policy, or refused."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from flights import ROOT, Done, manifest_of, run_cosim, run_here
from tubular import Mesh, circle, cut, extrude, in_tube, join, junction, line, rectangle, s_bend

from agent_client.flight import FlightResult, fly
from agent_client.task import Outcome
from cosim.pilots import Terms, choose_pilot, read_pilot
from cosim.runs import read_run
from cosim.sessions import server_session
from cosim.verify import find_tube
from meshes.errors import MeshError
from meshes.formats import AxesChoice
from meshes.mesh_geometry import MeshGeometry
from meshes.scale import MeanRadius, parse_scale
from meshes.tube import Tube, read_tube
from protocol.agent import SessionSettings
from protocol.plant import TubeReference

SEEDS = 10
REAL = ROOT.parent / "shared" / "meshes"
needs_real = pytest.mark.skipif(
    not REAL.is_dir(), reason=f"no meshes of others here: expected the folder {REAL}"
)

Fly = Callable[[Tube], FlightResult]


@pytest.fixture(scope="module")
def fly_seeds() -> Iterator[Fly]:
    """Fly the shipped policy through a tube with the seeds 0 to 9, as `cosim launch` does one by one: here in the
    lanes of one physics server."""
    pilot = read_pilot(choose_pilot("tube_ppo", None, None), Terms())
    indices = itertools.count()
    with server_session(SessionSettings(SEEDS, pilot.dt, 1.0 / 240.0)) as session:

        def flown(tube: Tube) -> FlightResult:
            geometry, index = MeshGeometry([tube], SEEDS), next(indices)
            wall = TubeReference(str(tube.path.resolve()), tube.axes, tube.scale, tube.sha256)
            session.register_tube(index, wall)
            controller = pilot.make_controller(geometry)
            return fly(session, geometry, controller, pilot.settings, seeds=range(SEEDS), tube=index)

        yield flown


def read(
    path: Path, axes: AxesChoice = "auto", entry: Any = None, exit: Any = None, radius: float = 1.0
) -> Tube:
    """A tube as `cosim launch --scale radius=1` reads it."""
    return read_tube(path, None, axes, MeanRadius(radius), "first", entry, exit)


def successes(result: FlightResult) -> int:
    """How many lanes reached the end."""
    return sum(outcome is Outcome.SUCCESS for outcome in result.outcome)


def write(mesh: Mesh, path: Path) -> Path:
    """Write a mesh in the format of the path."""
    trimesh.Trimesh(*mesh, process=False).export(path)
    return path


def wavy(sides: int = 24, radius: float = 1.0) -> Mesh:
    """A round tube of 14 radii that winds."""
    x = np.linspace(0.0, 14.0, 60)
    return extrude(
        radius * np.stack([x, np.sin(x / 2.5), 0.6 * np.sin(x / 3.0)], axis=1), circle(sides, radius)
    )


@needs_real
@pytest.mark.parametrize(
    ("name", "axes", "ends"),
    [
        ("inpipe22/pipes22.obj", "auto", (None, None)),
        ("tile_ramp2/cave_tile_ramp2.obj", "yup", (None, None)),
        ("colon/Colon.stl", "auto", (None, None)),
        ("trimesh_tube/tube.obj", "auto", (None, None)),
        ("tile_5/cave_tile_5.obj", "yup", ((0.0, 2.2, 9.99), (-10.0, 2.0, 0.0))),
    ],
)
def test_a_mesh_that_nobody_here_made_is_flown(
    fly_seeds: Fly, name: str, axes: AxesChoice, ends: tuple[Any, Any]
) -> None:
    """The shipped policy flies a pipe, a tunnel, an organ, a prism and a way through a junction in 9 of 10 seeds."""
    result = fly_seeds(read(REAL / name, axes, *ends))
    assert successes(result) >= 9, result.outcome


@needs_real
def test_a_coil_with_capped_ends_is_flown_from_inside(fly: Callable[..., Done], tmp_path: Path) -> None:
    """A coil whose ends are both closed: the caps are said, and the flight ends before the second one."""
    done = fly("--mesh", str(REAL / "cal_coil" / "coil.stl"), "--scale", "radius=1")
    assert done.status == 0, done.stderr
    assert done.report["progress"] >= 0.95
    assert (done.report["outcome"], done.report["contacts"]) == ("success", 0)
    assert done.stderr.count("a cap at") == 2
    assert manifest_of(tmp_path / "run")["mesh"]["found"]["capped"] == [True, True]


@pytest.mark.parametrize(
    "mesh",
    [
        extrude(s_bend(61, 5.0), rectangle(2.0, 2.0)),
        extrude(
            line([0, 0, 0], [16, 0, 2], 161), [circle(24, r) for r in 1.0 + 0.1 * np.sin(np.arange(161))]
        ),
        extrude(line([0, 0, 0], [15, 2, 0], 30), [circle(20, r) for r in np.linspace(1.5, 0.7, 30)]),
        extrude(line([0, 0, 0], [0, 1, 14]), circle(5)),
    ],
    ids=["square duct", "corrugated", "cone", "prism of ten vertices"],
)
def test_a_generated_tube_is_flown(fly_seeds: Fly, tmp_path: Path, mesh: Mesh) -> None:
    """Tubes that are not round, not of one width, or of few triangles are flown in 9 of 10 seeds."""
    result = fly_seeds(read(write(mesh, tmp_path / "tube.stl")))
    assert successes(result) >= 9, result.outcome


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_a_tube_of_any_unit_is_made_as_wide_as_wanted(tmp_path: Path, unit: float) -> None:
    """Microns or thousands of kilometres: the same tube, of the same radius and length."""
    vertices, faces = wavy()
    tube = read(write((unit * vertices, faces), tmp_path / "tube.ply"), radius=2.0)
    assert tube.radius.mean() == pytest.approx(2.0, rel=0.02)
    assert tube.length / 2.0 == pytest.approx(read(write(wavy(), tmp_path / "one.ply")).length, rel=0.01)


def test_a_found_centreline_makes_a_whole_run(fly: Callable[..., Done], tmp_path: Path) -> None:
    """The run keeps the centreline that was found, in the file's coordinates; it is verified and flown on from, and
    a change of the centreline is named."""
    mesh = write((25.0 * wavy()[0], wavy()[1]), tmp_path / "organ.stl")
    done = fly("--mesh", str(mesh), "--scale", "radius=1", "--seed", "3")
    assert (done.status, done.report["outcome"]) == (0, "success"), done.stderr
    for words in ("scale: 0.04", "centreline: found", "opening 1 at", "opening 2 at"):
        assert words in done.stderr
    described = manifest_of(tmp_path / "run")["mesh"]
    assert done.report["mesh"] == described
    stored = tmp_path / "run" / "organ_centerline.obj"
    assert described["centreline"] == str(stored)
    assert described["centreline_sha256"] == hashlib.sha256(stored.read_bytes()).hexdigest()
    assert described["scale"] == pytest.approx(1.0 / 25.0, rel=0.02)
    assert described["found"]["used"] == [1, 2]

    again = tmp_path / "again"
    flown_on = run_cosim(
        "replay",
        "run",
        "--policy",
        "tube_ppo",
        "--from-step",
        "5",
        "--out",
        str(again),
        "--json",
        cwd=tmp_path,
    )
    assert flown_on.status == 0, flown_on.stderr
    assert flown_on.report["trajectory_hash"] == done.report["trajectory_hash"]
    assert manifest_of(again)["mesh"]["centreline"] == str(again / stored.name)  # it needs no other run
    moved = (tmp_path / "run").rename(tmp_path / "elsewhere")
    assert find_tube(read_run(again), None)[1] == []
    verified = run_cosim("verify", str(moved), "--json", cwd=tmp_path)
    assert (verified.status, verified.report["verified"]) == (0, True), verified.stdout

    path = moved / stored.name
    path.write_text(path.read_text().replace("v ", "v 1", 1))
    damaged = run_cosim("verify", str(moved), "--json", cwd=tmp_path)
    assert damaged.status == 1
    assert str(path) in damaged.report["changed_files"][0]["what"]
    refused = run_cosim("replay", str(moved), "--policy", "tube_ppo", "--from-step", "5", cwd=tmp_path)
    assert refused.status == 2
    assert str(path) in refused.stderr


def test_a_gltf_file_is_flown_in_its_own_axes(fly: Callable[..., Done], tmp_path: Path) -> None:
    """The up-axis that the format states is followed, said, and handed on to physics; the file with the vertices
    belongs to the mesh, and is missed where it is another."""
    mesh = tmp_path / "tube.gltf"
    for name, content in trimesh.Trimesh(*wavy(), process=False).export(file_type="gltf").items():
        (mesh if name == "model.gltf" else tmp_path / name).write_bytes(content)
    done = fly("--mesh", str(mesh), "--max-steps", "3")
    assert (done.status, done.report["outcome"]) == (0, "timeout"), done.stderr
    described = manifest_of(tmp_path / "run")["mesh"]
    assert (described["axes"], described["scale"]) == ("yup", 1.0)
    assert "axes: Y up, as glTF" in done.stderr

    assert find_tube(read_run(tmp_path / "run"), None)[1] == []
    name = next(iter(described["companions"]))
    buffer = bytearray((tmp_path / name).read_bytes())
    buffer[40] ^= 1
    (tmp_path / name).write_bytes(buffer)
    reference, findings = find_tube(read_run(tmp_path / "run"), None)
    assert reference is None
    assert [name in finding.what for finding in findings] == [True]


def test_a_collada_file_is_flown_in_its_own_unit(fly: Callable[..., Done], tmp_path: Path) -> None:
    """A .dae in centimetres, Y up, is flown in metres, Z up."""
    pytest.importorskip("collada", reason="no pycollada, which reads .dae: pip install pycollada")
    vertices, faces = wavy()
    numbers = " ".join(f"{100.0 * value:.6g}" for value in vertices.ravel())
    corners = " ".join(map(str, faces.ravel()))
    (tmp_path / "tube.dae").write_text(
        COLLADA.format(numbers, vertices.size, len(vertices), len(faces), corners)
    )
    done = fly("--mesh", str(tmp_path / "tube.dae"), "--max-steps", "3")
    assert (done.status, done.report["outcome"]) == (0, "timeout"), done.stderr
    described = manifest_of(tmp_path / "run")["mesh"]
    assert (described["axes"], described["scale"]) == ("yup", 0.01)
    assert described["length_m"] == pytest.approx(15.0, abs=1.0)


COLLADA = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="centimeter" meter="0.01"/><up_axis>Y_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="{1}">{0}</float_array><technique_common>
<accessor source="#a" count="{2}" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="{3}"><input semantic="VERTEX" source="#v" offset="0"/><p>{4}</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>
"""


def test_one_way_through_a_junction_is_named(fly: Callable[..., Done], tmp_path: Path) -> None:
    """Of three openings two have to be named, by coordinates of the file or by the numbers that the refusal lists."""
    mesh = write(junction([-8.0, 0.0, 0.0], [8.0, 0.0, 0.0], [0.0, 8.0, 0.0]), tmp_path / "tee.ply")
    refused = fly("--mesh", str(mesh))
    assert refused.status == 2, refused.stderr
    assert "3 openings" in refused.stderr
    assert "--entry" in refused.stderr
    assert not (tmp_path / "run").exists()
    done = fly("--mesh", str(mesh), "--entry", "8,0,0", "--exit", "-8,0,0", "--max-steps", "2")
    assert done.status == 0, done.stderr
    found = manifest_of(tmp_path / "run")["mesh"]["found"]
    assert np.allclose(found["ends"], [[8.0, 0.0, 0.0], [-8.0, 0.0, 0.0]], atol=0.2)

    first, second = found["used"]
    back = fly(
        "--mesh", str(mesh), "--entry", str(second), "--exit", str(first), "--max-steps", "2", out="back"
    )
    assert back.status == 0, back.stderr
    ends = manifest_of(tmp_path / "back")["mesh"]["found"]["ends"]
    assert np.allclose(ends, found["ends"][::-1], atol=0.2)


def test_a_tube_that_cannot_be_flown_is_refused_with_the_place(
    fly: Callable[..., Done], tmp_path: Path
) -> None:
    """A tube that is narrower than the drone somewhere inside: the reason, where, and what to do, in one sentence;
    nothing is left behind, and a centreline of the user's in the named folder stays."""
    axis = line([0.0, 0.0, 0.0], [16.0, 0.0, 0.0], 65)
    waist = 1.0 - 0.6 * np.exp(-(((axis[:, 0] - 8.0) / 1.0) ** 2))
    mesh = write(extrude(axis, [circle(24, r) for r in waist]), tmp_path / "waist.stl")
    done = fly("--mesh", str(mesh), "--scale", "0.3")
    assert done.status == 2, done.stderr
    for words in ("room for the drone", "0.15 m", "2.4 m along", "--scale radius=0."):
        assert words in done.stderr
    assert not (tmp_path / "run").exists()

    (tmp_path / "run").mkdir()
    kept = tmp_path / "run" / "waist_centerline.obj"
    kept.write_text("# mine\n")
    done = fly("--mesh", str(mesh))
    assert done.status == 2, done.stderr
    assert kept.name in done.stderr
    assert kept.read_text() == "# mine\n"


def test_a_unit_that_nobody_states_is_guessed(fly: Callable[..., Done], tmp_path: Path) -> None:
    """A tube 40 wide in a file without a unit is flown in metres, and said to look like millimetres."""
    mesh = write((20.0 * wavy()[0], wavy()[1]), tmp_path / "tube.stl")
    done = fly("--mesh", str(mesh), "--max-steps", "1")
    assert done.status == 0, done.stderr
    for words in ("mean radius of 19.9 m", "radius=1", "millimetres"):
        assert words in done.stderr


def test_a_blocked_tube_is_refused(fly: Callable[..., Done], tmp_path: Path) -> None:
    """A wall across the tube: where it is blocked is said."""
    axis = line([0.0, 0.0, 0.0], [6.0, 0.0, 0.0], 13)
    halves = extrude(axis, circle(), caps=True), extrude(axis + np.array([6.0, 0.0, 0.0]), circle())
    lid = in_tube(line([-1.0, 0.0, 0.0], [0.5, 0.0, 0.0]), 0.99)
    done = fly("--mesh", str(write(cut(join(*halves), lid, rounds=0), tmp_path / "blocked.stl")))
    assert done.status == 2, done.stderr
    assert "blocked" in done.stderr
    assert "(6" in done.stderr or "(5.9" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--scale", "0"), "radius=METRES"),
        (("--scale", "radius=-1"), "radius=METRES"),
        (("--scale", "width=1"), "radius=METRES"),
        (("--entry", "1,2"), "x,y,z"),
        (("--exit", "0"), "number of an opening"),
        (("--entry", "1", "--centerline", "axis.obj"), "--centerline"),
        (("--tube", "level=1,seed=1", "--exit", "1"), "--tube"),
        (("--tube", "level=1,seed=1", "--scale", "radius=1"), "--tube"),
    ],
)
def test_options_of_a_mesh_that_make_no_sense(arguments: tuple[str, ...], words: str) -> None:
    """A scale that is none, a place that is none, and ends of a tube that has its own: refused in one sentence."""
    done = run_here("launch", *arguments)
    assert done.status == 2
    assert words in done.stderr


def test_a_scale_is_metres_a_unit_or_a_mean_radius() -> None:
    """`0.001` and `radius=1`, with or without blanks; nothing else."""
    assert parse_scale("0.001") == 0.001
    assert parse_scale("radius = 1.5") == MeanRadius(1.5)
    for text in ("", "radius=", "=1", "radius=nan", "inf", "1 m"):
        with pytest.raises(MeshError, match="radius=METRES"):
            parse_scale(text)
