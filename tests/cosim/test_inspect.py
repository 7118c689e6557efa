"""`cosim inspect`: what it says, writes and refuses; the measures themselves are tested with the meshes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flights import Done, run_here
from matplotlib.image import imread
from tubular import circle, extrude, line, s_bend

from meshes.centreline import parse_centreline
from meshes.sweep import write_centreline_obj, write_obj

LENGTH, RADIUS = 10.0, 0.5


@pytest.fixture(scope="module")
def pipe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A straight open pipe along x, without a centreline."""
    path = tmp_path_factory.mktemp("pipe") / "pipe.obj"
    write_obj(path, *extrude(line([0.0, 0.0, 0.0], [LENGTH, 0.0, 0.0], 21), circle(24, RADIUS)))
    return path


def inspected(*arguments: str | Path) -> tuple[Done, dict[str, Any]]:
    """An inspection with --json: what came of it, and the one object on stdout."""
    done = run_here("inspect", *map(str, arguments), "--json")
    return done, json.loads(done.stdout)


def test_all_that_is_promised_is_in_print_pictures_and_numbers(tmp_path: Path) -> None:
    """Of an S of two arcs of 4 m: radius, curvature, torsion, shape, clearance, the narrowest and the tightest place,
    unit, openings, the engine's rays, how the axis was found; the numbers are those of the curve."""
    mesh, out = tmp_path / "bend.obj", tmp_path / "out"
    write_obj(mesh, *extrude(s_bend(), circle(24)))
    done = run_here("inspect", str(mesh), "--out", str(out))
    assert done.status == 0, done.stderr
    for words in (
        "radius", "curvature", "torsion", "round", "clearance", "narrowest", "tightest bend", "looks like metres",
        "openings", "engine", "Embree", "skeletor", "1/m",
    ):  # fmt: skip
        assert words in done.stdout, words
    for picture in ("profile.png", "overview.png"):
        assert imread(out / picture)[..., :3].std() > 0.05  # something is drawn
    points = parse_centreline((out / "bend_centerline.obj").read_bytes(), out / "bend_centerline.obj")
    assert np.linalg.norm(points[0] - s_bend()[0]) < 0.1
    assert np.linalg.norm(points[-1] - s_bend()[-1]) < 0.1

    report = json.loads((out / "inspection.json").read_text())
    assert all(Path(name).is_file() for name in report["files"])
    assert (report["flyable"], report["section"]["shape"], len(report["openings"])) == (True, "round", 2)
    assert report["radius"]["mean_m"] == pytest.approx(1.0, abs=0.02)
    assert report["tightest"]["curvature_per_m"] == pytest.approx(0.25, rel=0.15)
    narrowest = report["narrowest"]
    assert narrowest["clearance_m"] == pytest.approx(narrowest["wall_distance_m"] - 0.15, abs=1e-9)
    assert min(report["profile"]["clearance_m"]) == pytest.approx(narrowest["clearance_m"])
    assert len({len(values) for values in report["profile"].values()}) == 1
    assert report["engine_agreement"]["largest_m"] < 1e-4

    again = run_here("inspect", str(mesh), "--out", str(out))
    assert again.status == 2
    assert "inspection.json" in again.stderr


def test_ends_of_a_given_centreline_are_told(pipe: Path, tmp_path: Path) -> None:
    """Reversed, it runs from the second opening to the first; one that begins inside says so; with ends for another
    it is refused."""
    reverse, short = tmp_path / "reverse.obj", tmp_path / "short.obj"
    write_centreline_obj(reverse, line([LENGTH, 0.0, 0.0], [0.0, 0.0, 0.0], 5))
    write_centreline_obj(short, line([4.0, 0.0, 0.0], [LENGTH, 0.0, 0.0], 5))
    assert inspected(pipe, "--centerline", reverse)[1]["centreline"]["openings"] == [2, 1]
    assert inspected(pipe, "--centerline", short)[1]["centreline"]["openings"] == [None, 2]
    done, report = inspected(pipe, "--centerline", short, "--entry", "1")
    assert (done.status, report["flyable"]) == (2, False)
    assert "has its own ends" in report["refused"]


def test_a_tube_too_narrow_for_the_drone_is_measured_and_refused(pipe: Path) -> None:
    """All numbers are there, and the reason with the place: as `cosim launch` refuses it."""
    done, report = inspected(pipe, "--body-radius", "0.6")
    assert (done.status, report["flyable"]) == (2, False)
    assert report["narrowest"]["clearance_m"] < 0.0
    for words in ("room for the drone", "m along", "--scale radius="):
        assert words in report["refused"]
        assert words in done.stderr


def test_what_is_refused_can_be_inspected_again(pipe: Path, tmp_path: Path) -> None:
    """A wrong opening: the wall is drawn; with the right one the same folder takes the inspection, unless it would
    overwrite a centreline that is the user's."""
    out = tmp_path / "out"
    done, report = inspected(pipe, "--entry", "3", "--out", out)
    assert (done.status, report["flyable"]) == (2, False)
    assert sorted(path.name for path in out.iterdir()) == ["inspection.json", "overview.png"]
    kept = out / "pipe_centerline.obj"
    kept.write_text("# mine\n")
    assert run_here("inspect", str(pipe), "--entry", "2", "--out", str(out)).status == 2
    assert kept.read_text() == "# mine\n"
    kept.unlink()
    done, report = inspected(pipe, "--entry", "2", "--out", out)
    assert (done.status, report["centreline"]["openings"]) == (0, [2, 1])
    assert json.loads((out / "inspection.json").read_text()) == report


def test_what_is_no_tube_is_refused_with_one_sentence(tmp_path: Path) -> None:
    """A plane has nothing inside: status 2 and the reason, and no empty folder where there is no mesh at all."""
    plane = tmp_path / "plane.obj"
    plane.write_text("v 0 0 0\nv 9 0 0\nv 9 9 0\nv 0 9 0\nf 1 2 3 4\n")
    done = run_here("inspect", str(plane))
    assert done.status == 2
    assert "plane.obj" in done.stderr
    assert run_here("inspect", str(tmp_path / "none.obj"), "--out", str(tmp_path / "a" / "b")).status == 2
    assert not (tmp_path / "a").exists()
