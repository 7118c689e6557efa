"""How a flight went wrong, as the page of `cosim report` tells it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flights import Done
from pages import copy_run, read_page

from cosim.recording import LOG, MANIFEST
from cosim.report import report
from cosim.report_ending import describe_ending, nearest_on_wall, sides
from cosim.runs import Run, read_run
from cosim.scene import Surface, read_scene

COLLISION, TIMEOUT = 3, 4


def doctored(run: Path, folder: Path, outcome: int, contact: int | None = None) -> Run:
    """The first 60 records of a run, with another outcome and with contact from one record on."""
    copy = copy_run(run, folder, records=60)
    records = np.frombuffer(
        bytearray((copy / LOG).read_bytes()[: 60 * read_run(run).records.itemsize]),
        read_run(run).records.dtype,
    )
    records["outcome"][-1] = outcome
    if contact is not None:
        records["contact"][contact:], records["contact_steps"][contact] = True, 7
    (copy / LOG).write_bytes(records.tobytes())
    return read_run(copy)


def told(run: Run) -> dict[str, Any]:
    """What is told of a run that went wrong, its facts by name."""
    ending = describe_ending(run, read_scene(run), np.full(len(run.records), 0.5))
    assert ending is not None
    return ending | {"facts": dict(ending["facts"])}


def test_the_nearest_place_of_a_square_duct_is_the_foot_on_its_nearest_side() -> None:
    """Within walls at y = -1, 1 and z = -1, 1 the nearest place has the wall's coordinate, else the point's."""
    corners = np.array(
        [[x, y, z] for x in (0.0, 9.0) for y, z in ((-1, -1), (1, -1), (1, 1), (-1, 1))], float
    )
    faces = [[a, b, b + 4] for a, b in ((0, 1), (1, 2), (2, 3), (3, 0))]
    faces += [[a, b + 4, a + 4] for a, b in ((0, 1), (1, 2), (2, 3), (3, 0))]
    wall = Surface(corners, np.array(faces, np.int32))
    for point, foot in (([3.0, 0.4, 0.1], [3.0, 1.0, 0.1]), ([8.0, 0.1, -0.7], [8.0, 0.1, -1.0])):
        np.testing.assert_allclose(nearest_on_wall(wall, np.array(point)), foot, atol=1e-9)


@pytest.mark.parametrize(
    ("direction", "words"),
    [
        ([1.0, 0.0, 0.0], "ahead"),
        ([-2.0, 0.1, 0.1], "behind"),
        ([0.0, 1.0, 1.0], "above, to the right"),
        ([1.0, -1.0, -1.0], "ahead, below, to the left"),
    ],
)
def test_sides_are_named_as_the_drone_has_them(direction: list[float], words: str) -> None:
    """Along f, u and r and against them."""
    assert sides(np.array(direction)) == words


def test_the_first_contact_is_the_moment(conduit_run: tuple[Done, Path], tmp_path: Path) -> None:
    """Step, inner steps and time are the record's; the wall is as far off as perception says, and so are speeds."""
    run = doctored(conduit_run[1], tmp_path / "run", COLLISION, contact=50)
    ending, record, before = told(run), run.records[50], run.records[49]
    assert ending["title"] == "It touched the wall in step 50, 5.0 s after the start, in 7 of 24 inner steps"
    assert (np.float32(record["sim_time"]), np.float32(before["sim_time"])) == (
        ending["time"],
        ending["before"],
    )
    away = np.array(ending["wall"]) - record["position"]
    assert np.linalg.norm(away) == pytest.approx(record["clearance"], rel=0.02)
    assert ending["facts"]["where"].startswith(f"{record['arc_length']:.2f} m along the axis of 75.0 m")
    assert "in a bend of radius 2.00 m" in ending["facts"]["where"]
    told_by_axis = describe_ending(run, replace(read_scene(run), note="gone"), np.full(60, 0.5))
    assert told_by_axis is not None
    np.testing.assert_allclose(told_by_axis["wall"], ending["wall"], atol=0.06, err_msg="without the mesh")
    towards = np.array(ending["wall"]) - before["position"]
    speed = before["linear_velocity"] @ towards / np.linalg.norm(towards)
    assert f"{speed:.2f} m/s of it towards" in ending["facts"]["flown"]
    rays = before["lidar"].reshape(2, -1)
    for name, ring in zip(("front", "rear"), rays, strict=True):
        assert f"{name} ring {ring.min():.2f} m or more" in ending["facts"]["LiDAR before"]


def test_a_time_out_met_no_wall(conduit_run: tuple[Done, Path], tmp_path: Path) -> None:
    """It says how far the flight came, and claims nothing of a wall."""
    run = doctored(conduit_run[1], tmp_path / "run", TIMEOUT)
    ending = told(run)
    assert ending["wall"] is None
    reached = run.records["arc_length"].max()
    assert ending["title"].endswith(f"it was still coming on, at {reached:.2f} m")
    assert not {"the wall", "LiDAR before"} & ending["facts"].keys()


def test_nothing_went_wrong_in_a_success(conduit_run: tuple[Done, Path], tmp_path: Path) -> None:
    """Neither in a flight that reached the end without contact nor in one that was cut short is there a moment."""
    for run in (read_run(conduit_run[1]), doctored(conduit_run[1], tmp_path / "run", 0)):
        assert describe_ending(run, read_scene(run), np.zeros(len(run.records))) is None


def test_a_replayed_run_says_whose_flight_it_began_with(
    conduit_run: tuple[Done, Path], tmp_path: Path
) -> None:
    """Steps that another policy flew are not passed off as the pilot's own."""
    run = copy_run(conduit_run[1], tmp_path / "run", records=60)
    manifest = json.loads((run / MANIFEST).read_text())
    manifest["continues"] = {"run": "runs/first", "from_step": 20, "trajectory_hash": "00"}
    (run / MANIFEST).write_text(json.dumps(manifest))
    (shown,) = read_page(report([run])).data["runs"]
    (note,) = (note for note in shown["notes"] if "runs/first" in note)
    assert note.startswith("steps 1 to 20 are those of runs/first")


def test_the_axis_is_drawn_to_the_end_that_was_not_reached(
    conduit_run: tuple[Done, Path], tmp_path: Path
) -> None:
    """Of a short flight the page has the whole centreline, and the curvature that a long one finds in its place."""
    short = read_page(report([copy_run(conduit_run[1], tmp_path / "run", records=60)])).data
    page = read_page(tmp_path / "run" / "report.html")
    axis = page.array(short["tubes"][0]["axis"])
    length = np.linalg.norm(np.diff(axis, axis=0), axis=1).sum()
    assert length == pytest.approx(short["runs"][0]["length"], rel=1e-3)
    whole = read_page(report([conduit_run[1]], tmp_path / "whole.html"))
    series = whole.data["runs"][0]["series"]["curvature"]
    found = page.array(short["runs"][0]["series"]["curvature"])
    np.testing.assert_allclose(found, whole.array(series)[:60], atol=0.01)
    assert found.max() > 0.3
