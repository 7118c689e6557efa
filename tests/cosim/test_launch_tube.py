"""`cosim launch --tube` and the named settings: any episode of an evaluation again, recorded."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
from flights import Done, manifest_of, run_cosim, run_here

from agent_client.tubes import TubeRecipe, draw_tube
from cosim.inputs import setting_notes
from cosim.named_settings import NamedSettings
from cosim.options import FlightOptions, TubeChoice
from cosim.runs import read_run
from meshes.tube import read_tube


@pytest.mark.parametrize(
    "settings",
    [
        ("--hard",),
        ("--gain", "1.5:3", "--gust", "0:2", "--near-wall", "0.5", "--action-delay", "0:2", "--shape", "helix",
         "--radius", "0.8:1.2", "--lobes", "0.1:0.2", "--lengths", "10,15"),
    ],
    ids=["hard", "many"],
)  # fmt: skip
def test_an_evaluated_episode_is_flown_again_bit_for_bit(
    fly: Callable[..., Done], tmp_path: Path, settings: tuple[str, ...]
) -> None:
    """The command that an evaluation in PyBullet writes beside an episode gives the same flight: same outcome,
    steps, quality, gap and draws, although another process and another wall file were used."""
    done = run_cosim(
        "evaluate", "--dynamics", "rigid-body", "--policy", "tube_ppo", "--policy", "pure-pursuit", "--levels", "2",
        "--episodes", "3", "--workers", "1", "--out", str(tmp_path / "evaluation"), *settings, cwd=tmp_path,
    )  # fmt: skip
    assert done.status == 0, done.stderr
    flown = json.loads((tmp_path / "evaluation" / "results.json").read_text())["flown"]
    for index in (1, 5):  # of the policy and of Pure Pursuit
        episode = flown[index]
        assert episode["launch_repeats"]
        words = shlex.split(episode["launch"])
        assert words[:2] == ["cosim", "launch"]
        report = fly(*words[2:], out=f"again{index}").report
        for key in ("outcome", "steps", "progress", "quality", "min_clearance_m", "contacts"):
            assert report[key] == episode[key], (key, episode["launch"])
        drawn = manifest_of(tmp_path / f"again{index}")["conditions"]["drawn"]
        assert drawn == episode["conditions"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (FlightOptions(settings=NamedSettings(True)), ["--hard: on a mesh"]),
        (FlightOptions(tube=TubeChoice(2, 1), settings=NamedSettings(True)), []),
        (FlightOptions(settings=NamedSettings(False, {"mass": (2.0, 2.0)})), ["--mass: the law"]),
        (
            FlightOptions(
                settings=NamedSettings(False, {"mass": (2.0, 2.0)}), parameters=("disturbance_x=1",)
            ),
            [],
        ),
        (
            FlightOptions(tube=TubeChoice(1, 1), settings=NamedSettings(False, {}, {"curvature_cap": 0.5})),
            ["--curvature-cap: at level 1"],
        ),
    ],
)
def test_what_changes_nothing_of_a_flight_is_said(options: FlightOptions, words: list[str]) -> None:
    """A note for the tubes of --hard where a mesh is flown, and for each setting that is idle under the others."""
    notes = list(setting_notes(options, *options.settings.resolve()))
    assert len(notes) == len(words)
    assert all(note.startswith(word) for note, word in zip(notes, words, strict=True))


def test_the_run_folder_has_the_tube(fly: Callable[..., Done], tmp_path: Path) -> None:
    """Wall and centreline are written beside the log and describe the tube that was drawn; all is recorded."""
    done = fly("--tube", "level=1,seed=42,length=12", "--max-steps", "3", "--gain", "2:4")
    assert done.status == 0, done.stderr
    manifest = manifest_of(tmp_path / "run")
    drawn = draw_tube(1, (42,), "evaluate", TubeRecipe(lengths=(12.0,)))
    tube = read_tube(tmp_path / "run" / "tube.obj")
    assert tube.length == pytest.approx(drawn.length, rel=1e-4)
    assert tube.radius == pytest.approx(1.0, abs=0.01)
    assert (manifest["mesh"]["sha256"], manifest["mesh"]["centreline_sha256"]) == (
        tube.sha256,
        tube.centreline_sha256,
    )
    assert (manifest["tube"]["level"], manifest["tube"]["seed"]) == (1, 42)
    assert manifest["options"]["seed"] == 42
    assert manifest["conditions"]["chosen"] == {"gain": [2.0, 4.0]}
    gain = manifest["conditions"]["drawn"]["gain"]
    assert 2.0 <= gain <= 4.0
    assert manifest["parameters"]["force_gain"] == gain
    assert len(read_run(tmp_path / "run").records) == 4
    assert f"gain {gain:.4g}" in done.stderr


def test_a_seed_of_its_own_changes_the_start_and_not_the_tube(
    fly: Callable[..., Done], tmp_path: Path
) -> None:
    """--seed defaults to the tube's; another one starts elsewhere in the same tube."""
    choice = ("--tube", "level=0,seed=5", "--max-steps", "2")
    hashes = []
    for out, more in (("a", ()), ("b", ("--seed", "5")), ("c", ("--seed", "6"))):
        hashes.append(fly(*choice, *more, out=out).report["trajectory_hash"])
    assert hashes[0] == hashes[1] != hashes[2]
    walls = [manifest_of(tmp_path / out)["mesh"]["sha256"] for out in "abc"]
    assert len(set(walls)) == 1


def test_conditions_hold_for_meshes_too(fly: Callable[..., Done], tmp_path: Path) -> None:
    """A named condition is the plant parameter that it stands for; what nobody names stays the plant's own."""
    by_condition = fly("--gain", "3", "--compensation", "0.95", "--max-steps", "5", out="condition").report
    by_parameter = fly(
        "--parameter", "force_gain=3", "--compensation", "0.95", "--max-steps", "5", out="parameter"
    ).report
    plain = fly("--max-steps", "5", out="plain").report
    assert by_condition["trajectory_hash"] == by_parameter["trajectory_hash"] != plain["trajectory_hash"]
    manifest = manifest_of(tmp_path / "parameter")
    assert manifest["parameters"] | {"force_gain": 8.0} == manifest["plant"]["defaults"]
    assert manifest["tube"] is None


def test_the_lidar_rule_flies(fly: Callable[..., Done]) -> None:
    """--policy lidar-rule flies a generated tube, and the manifest says what it sees."""
    report = fly("--tube", "level=0,seed=1", "--policy", "lidar-rule").report
    assert (report["outcome"], report["contacts"]) == ("success", 0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--tube", "level=2,seed=1", "--mesh", "tube.obj"), ("--mesh", "--tube")),
        (("--tube", "level=2,seed=1", "--scale", "2"), ("--scale", "--tube")),
        (("--tube", "level=2,seed=1", "--centerline", "c.obj"), ("--centerline", "--tube")),
        (("--tube", "level=2,seed=1,length=20", "--lengths", "30"), ("--lengths", "length=")),
        (("--tube", "level=3,seed=1"), ("level", "0, 1 or 2", "3")),
        (("--tube", "level=2"), ("level=L,seed=N", "level=2")),
        (("--tube", "level=2,seed=-1"), ("seed", "-1")),
        (("--tube", "level=2,seed=1,seed=2"), ("seed=1,seed=2",)),
        (("--tube", "level=2,seed=1,length=x"), ("length=x",)),
        (("--tube", "level=2,seed=1,length=0.1"), ("lengths", "0.1")),
        (("--radius", "1.2"), ("--radius", "--tube")),
        (("--gain", "2", "--parameter", "force_gain=3"), ("force_gain", "--gain")),
        (("--speed", "1"), ("--speed", "pure-pursuit")),
        (("--policy", "pure-pursuit-tuned"), ("--lookahead", "--speed")),
    ],
    ids=lambda value: " ".join(value) if value and value[0].startswith("--") else "",
)
def test_contradictions_are_refused(
    tmp_path: Path, arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    """Exit status 2, a sentence with both names, and nothing left behind."""
    done = run_here("launch", "--json", "--out", str(tmp_path / "run"), *arguments)
    assert (done.status, done.stdout) == (2, "")
    for word in words:
        assert word in done.stderr
    assert not (tmp_path / "run").exists()


def test_a_tube_file_of_the_users_is_kept(fly: Callable[..., Done], tmp_path: Path) -> None:
    """A folder with a tube.obj of its own is refused and stays as it was."""
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "tube.obj").write_text("mine")
    done = fly("--tube", "level=0,seed=1")
    assert done.status == 2
    assert "tube.obj" in done.stderr
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["tube.obj"]
    assert (tmp_path / "run" / "tube.obj").read_text() == "mine"
