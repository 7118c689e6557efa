"""`cosim evaluate`: one table for all pilots, whoever flies it and however many processes there are."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from flights import DEADLINE, command, environment, leftovers, run_cosim, run_here, wait_until

from agent_client.conditions import CONDITIONS, HARD, Conditions
from agent_client.evaluation import wilson
from agent_client.tubes import HARD_TUBES, PAPER_TUBES, TUBE_SETTINGS, TubeRecipe
from cosim.evaluation_plan import EvaluateOptions, make_plan
from cosim.evaluation_table import table_lines
from cosim.named_settings import NamedSettings, arguments_of, parse_setting, setting_names, write_value

KEYS = {
    "policy", "dynamics", "level", "episodes", "success", "exit", "collision", "timeout", "quality",
    "mean_steps", "length_ratio", "success_ci95", "engine", "sees",
}  # fmt: skip


def evaluate(*arguments: str) -> dict[str, Any]:
    """The object of `cosim evaluate --json`, run in this process by one worker."""
    done = run_here("evaluate", "--json", "--workers", "1", *arguments)
    assert done.status == 0, done.stderr
    return dict(json.loads(done.stdout))


@pytest.fixture(scope="module")
def kinematic(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], dict[str, Any]]:
    """What an evaluation with no names says, and what it writes."""
    out = tmp_path_factory.mktemp("evaluate")
    report = evaluate("--episodes", "6", "--levels", "0,2", "--tuning-episodes", "10", "--out", str(out))
    return report, json.loads((out / "results.json").read_text())


def test_everybody_is_flown_when_nobody_is_named(kinematic: tuple[dict[str, Any], dict[str, Any]]) -> None:
    """A row for each of the four pilots at each level, with every promised key and fractions that sum to one."""
    rows = kinematic[0]["rows"]
    pilots = ["pure-pursuit", "pure-pursuit-tuned", "lidar-rule", "tube_ppo"]
    assert [(row["level"], row["policy"]) for row in rows] == [(n, p) for n in (0, 2) for p in pilots]
    for row in rows:
        assert set(row) >= KEYS
        assert row["success"] + row["exit"] + row["collision"] + row["timeout"] == pytest.approx(1.0)
        assert tuple(row["success_ci95"]) == wilson(round(6 * row["success"]), 6)
    assert rows[0]["lookahead"] == 3.0
    assert rows[1]["sees"].startswith("exact centreline and position; no sensor noise")
    assert "no centreline" in rows[2]["sees"]
    assert rows[3]["sees"].endswith(
        "no centreline; learnt by imitating a teacher that sees the axis and the dynamics"
    )


def test_the_papers_figures_stand_beside(kinematic: tuple[dict[str, Any], dict[str, Any]]) -> None:
    """The report has the paper's table, of the levels that were flown."""
    paper = {(row["policy"], row["level"]): row for row in kinematic[0]["paper"]}
    assert set(paper) == {(name, level) for name in ("Pure Pursuit", "PPO") for level in (0, 2)}
    assert (paper["PPO", 2]["success"], paper["PPO", 2]["exit"], paper["PPO", 2]["quality"]) == (
        0.87,
        0.13,
        0.522,
    )


def test_every_episode_is_kept(kinematic: tuple[dict[str, Any], dict[str, Any]]) -> None:
    """results.json is the report and all episodes: all pilots flew the same seeds, and the rows sum them up."""
    report, written = kinematic
    assert {name: written[name] for name in report} == report
    flown = written["flown"]
    for row in report["rows"]:
        own = [e for e in flown if (e["policy"], e["level"]) == (row["policy"], row["level"])]
        assert sum(e["outcome"] == "success" for e in own) == round(6 * row["success"])
        assert [e["seed"] for e in own] == [
            e["seed"] for e in flown if (e["policy"], e["level"]) == ("lidar-rule", row["level"])
        ]
    tuned = next(e for e in flown if e["policy"] == "pure-pursuit-tuned")
    found = report["rows"][1]
    assert tuned["launch"] == (
        f"cosim launch --tube level=0,seed={tuned['seed']} --policy pure-pursuit "
        f"--lookahead {found['lookahead']:g} --speed {found['speed']:g}"
    )
    assert not any(e["launch_repeats"] for e in flown)


@pytest.mark.parametrize("engine", ["reference", "bullet"])
def test_results_do_not_depend_on_the_workers(tmp_path: Path, engine: str) -> None:
    """One process and two write the same results, bit for bit."""
    texts = []
    for workers in ("1", "2"):
        out = tmp_path / workers
        done = run_cosim(
            "evaluate", "--policy", "lidar-rule", "--policy", "tube_ppo", "--hard", "--levels", "1,2",
            "--episodes", "2", "--dynamics", "rigid-body", "--engine", engine, "--workers", workers,
            "--out", str(out), cwd=tmp_path,
        )  # fmt: skip
        assert done.status == 0, done.stderr
        texts.append((out / "results.json").read_text())
    assert texts[0] == texts[1]


def test_the_seed_names_the_episodes(tmp_path: Path) -> None:
    """More episodes keep the first ones as they were; another seed shares none of them."""
    flown = []
    for name, episodes, seed in (("few", "3", "7"), ("more", "5", "7"), ("other", "3", "8")):
        out = tmp_path / name
        evaluate(
            "--policy",
            "lidar-rule",
            "--levels",
            "2",
            "--episodes",
            episodes,
            "--seed",
            seed,
            "--out",
            str(out),
        )
        flown.append(json.loads((out / "results.json").read_text())["flown"])
    few, more, other = flown
    assert more[:3] == few
    assert not {e["seed"] for e in few} & {e["seed"] for e in other}


def test_hard_conditions_without_inertia_are_left_out_and_said(tmp_path: Path) -> None:
    """In the kinematic world --hard keeps its sensors and tubes; what needs inertia is named as left out."""
    done = run_cosim(
        "evaluate", "--hard", "--policy", "lidar-rule", "--levels", "2", "--episodes", "2", cwd=tmp_path
    )
    assert done.status == 0, done.stderr
    text = " ".join(done.stdout.split())
    assert "field_of_view 0.65" in text
    assert "0.9 / R" in text
    assert (
        "left out, since they mean nothing without inertia: gain 1.5 to 6, compensation 0.8 to 1.05" in text
    )
    assert "PPO (paper) 87.0 79.0-92.2 13.0" in text
    assert "lidar-rule sees: LiDAR alone" in text


def test_a_sweep_evaluates_each_value_alone() -> None:
    """A row a value, with the setting's name and value, on the same seeds; a longer tube takes more steps."""
    report = evaluate(
        "--policy", "pure-pursuit", "--levels", "0", "--episodes", "3", "--sweep", "lengths=10,30"
    )
    rows = report["rows"]
    assert [(row["setting"], row["value"]) for row in rows] == [("lengths", 10.0), ("lengths", 30.0)]
    assert 2.0 * rows[0]["mean_steps"] < rows[1]["mean_steps"]
    assert "lengths" not in report["recipe"]
    named = [{**row, "setting": "a setting with a name that is longer than any policy's"} for row in rows]
    lines = list(table_lines({**report, "rows": named}))
    tops = [at for at, line in enumerate(lines) if line.endswith("length")]
    assert len(tops) == 2
    assert all(len(lines[at]) == len(lines[at + 1]) == len(lines[at + 3]) for at in tops)


def test_a_map_shows_where_nobody_succeeds(tmp_path: Path) -> None:
    """Over gain and compensation: a row a cell and pilot, a PNG, and no success where the drone just falls."""
    pytest.importorskip("matplotlib", reason="the extra 'view' is not installed")
    report = evaluate(
        "--map", "--map-gains", "8,0.3", "--map-compensations", "0.2,0.9", "--episodes", "4",
        "--tuning-episodes", "5", "--policy", "lidar-rule", "--out", str(tmp_path / "map"),
    )  # fmt: skip
    cells = {(r["policy"], r["gain"], r["compensation"]): r["success"] for r in report["rows"]}
    assert len(cells) == 8
    assert report["engine"] == "reference"
    assert cells["pure-pursuit-tuned", 0.3, 0.2] == cells["lidar-rule", 0.3, 0.2] == 0.0
    assert cells["pure-pursuit-tuned", 8.0, 0.9] == 1.0
    assert (tmp_path / "map" / "success_map.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--gain", "2"), ("--gain", "--dynamics rigid-body")),
        (("--sweep", "compensation=1"), ("--compensation", "--dynamics rigid-body")),
        (("--sweep", "colour=1"), ("colour", "curvature_cap")),
        (("--sweep", "radius=1,x"), ("radius", "'x'")),
        (("--sweep", "radius=1", "--radius", "2"), ("--radius",)),
        (("--radius", "9"), ("0.5 to 2 m", "9")),
        (("--field-of-view", "1:0.5"), ("low <= high", "1 to 0.5")),
        (("--action-delay", "1.5"), ("whole numbers", "1.5")),
        (("--curvature-cap", "0.3:0.5"), ("expected a number", "0.3:0.5")),
        (("--shape", "knot"), ("knot", "helix")),
        (("--levels", "0,3"), ("0,1,2", "0,3")),
        (("--engine", "bullet"), ("--engine", "rigid-body")),
        (("--map",), ("--out",)),
        (("--map-gains", "1,2"), ("--map-gains", "add --map")),
        (("--map-compensations", "1"), ("--map-compensations", "add --map")),
        (("--map", "--dynamics", "kinematic", "--out", "x"), ("--dynamics",)),
        (("--map", "--gain", "2", "--out", "x"), ("--map-gains",)),
        (("--map", "--sweep", "radius=1", "--out", "x"), ("--sweep",)),
        (("--map", "--map-gains", "a,b", "--out", "x"), ("a,b",)),
        (("--policy", "none.zip"), ("none.zip", "no such file")),
        (("--episodes", "0"), ("--episodes",)),
        (("--out", "/dev/null/below"), ("/dev/null/below",)),
    ],
    ids=lambda value: " ".join(value) if value and value[0].startswith("--") else "",
)
def test_bad_input_is_refused(arguments: tuple[str, ...], words: tuple[str, ...]) -> None:
    """Exit status 2 and a sentence that names what was expected and found, before anything is flown."""
    done = run_here("evaluate", "--workers", "1", *arguments)
    assert (done.status, done.stdout) == (2, "")
    for word in words:
        assert word in done.stderr


def test_results_are_not_overwritten(tmp_path: Path) -> None:
    """A folder that holds results is refused."""
    (tmp_path / "results.json").write_text("{}")
    done = run_here("evaluate", "--out", str(tmp_path))
    assert done.status == 2
    assert "results.json" in done.stderr


def test_settings_are_written_as_their_options_take_them() -> None:
    """Conditions and recipes survive the way to options and back."""
    cases = [
        (Conditions(), PAPER_TUBES),
        (HARD, HARD_TUBES),
        (HARD.with_ranges({"gain": (2.0, 2.0), "gust": (0.0, 1 / 3)}), HARD_TUBES),
        (
            Conditions(action_delay=(1, 2)),
            TubeRecipe((20.0, 40.0), (0.6, 1.6), lobes=(0.1, 0.1), shape="helix"),
        ),
    ]
    for conditions, recipe in cases:
        words = arguments_of(conditions, recipe)
        hard = "--hard" in words
        words = [word for word in words if word != "--hard"]
        given = {
            option[2:].replace("-", "_"): text for option, text in zip(words[::2], words[1::2], strict=True)
        }
        found = {name: parse_setting(name, text) for name, text in given.items()}
        ranges = {row.name: found.pop(row.name) for row in CONDITIONS if row.name in found}
        base, tubes = (HARD, HARD_TUBES) if hard else (Conditions(), PAPER_TUBES)
        assert base.with_ranges(ranges) == conditions
        assert {name: getattr(recipe, name) for name in found} == found
        same = {row.name for row in TUBE_SETTINGS} - set(found)
        assert all(getattr(recipe, name) == getattr(tubes, name) for name in same)
        assert given.get("shape", tubes.shape) == recipe.shape
    assert arguments_of(HARD, HARD_TUBES) == ["--hard"]


def test_every_setting_can_be_swept() -> None:
    """A sweep of any named setting, `shape` too, is one variant a value; a value named twice is flown once."""
    values = {
        "shape": ["helix", "elbow"],
        "lobe_count": [(3.0, 3.0), (5.0, 5.0)],
        "lengths": [(10.0,), (20.0,)],
    }
    for name in setting_names():
        row = next((row for row in (*CONDITIONS, *TUBE_SETTINGS) if row.name == name), None)
        ends = [] if row is None else [(row.lowest, row.lowest), (row.highest, row.highest)]
        if name == "curvature_cap":
            ends = [low for low, _ in ends]
        swept = values.get(name, ends)
        text = ",".join(write_value(value) for value in swept)
        plan = make_plan(
            EvaluateOptions(("lidar-rule",), dynamics="rigid-body", sweep=f"{name}={text},{text}")
        )
        assert [variant.values[name] for variant in plan.variants] == swept
        assert "flown once" in plan.notes[0]


@pytest.mark.parametrize(
    ("settings", "sweep", "levels", "words"),
    [
        (NamedSettings(False, {"mass": (2.0, 2.0)}), None, (2,), "--mass: the law scales the force"),
        (NamedSettings(), "mass=1,2", (2,), "--mass: the law scales the force"),
        (NamedSettings(False, {"mass": (2.0, 2.0)}), "gust=0,1", (2,), None),
        (NamedSettings(), "lobe_count=3,5", (2,), "--lobe-count: without lobes"),
        (NamedSettings(False, {}, {"lobes": (0.1, 0.1)}), "lobe_count=3,5", (2,), None),
        (NamedSettings(), "curvature_cap=0.3,0.9", (0, 1, 2), "--curvature-cap: at level 0 and 1"),
        (NamedSettings(), "curvature_cap=0.3,0.9", (2,), None),
        (NamedSettings(False, {}, {"shape": "elbow"}), "curvature_cap=0.3,0.9", (0,), None),
    ],
)
def test_a_setting_that_changes_nothing_is_named(
    settings: NamedSettings, sweep: str | None, levels: tuple[int, ...], words: str | None
) -> None:
    """A note says of a setting, given or swept, that it changes nothing under the others; else there is none."""
    options = EvaluateOptions(("lidar-rule",), levels, dynamics="rigid-body", settings=settings, sweep=sweep)
    notes = make_plan(options).notes
    assert len(notes) == (words is not None)
    assert all(note.startswith(str(words)) for note in notes)


def test_every_setting_is_an_option_that_help_names(tmp_path: Path) -> None:
    """The generated options stand in a few lines of the help, and --list-settings says what each means."""
    text = run_cosim("evaluate", "--help-all", cwd=tmp_path).stdout
    meanings = run_cosim("evaluate", "--list-settings", cwd=tmp_path).stdout
    for row in (*CONDITIONS, *TUBE_SETTINGS):
        option = f"--{row.name.replace('_', '-')}"
        assert f"{option} [" in text
        assert option in meanings
        assert row.meaning in meanings
    assert len(text.splitlines()) <= 60
    assert max(map(len, text.splitlines())) <= 110


def children(pid: int) -> list[int]:
    """Processes that this one started and that live."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                state, parent = (entry / "stat").read_text().rsplit(")", 1)[1].split()[:2]
            except OSError:
                continue
            if int(parent) == pid and state != "Z":
                found.append(int(entry.name))
    return found


@contextmanager
def evaluating(folder: Path, workers: str) -> Iterator[tuple[subprocess.Popen[str], list[int], list[int]]]:
    """An evaluation in PyBullet that lasts, with the ids of its workers and of their servers."""
    process = subprocess.Popen(
        command(
            "evaluate", "--policy", "tube_ppo", "--dynamics", "rigid-body", "--episodes", "3000", "--workers",
            workers,
        ),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder, env=environment(),
        start_new_session=True,
    )  # fmt: skip
    count = int(workers)

    def servers() -> list[int]:
        above = [process.pid] if count == 1 else children(process.pid)
        return [pid for worker in above for pid in children(worker)]

    try:
        wait_until(lambda: len(servers()) == count or process.poll() is not None)
        time.sleep(0.5)  # now they fly
        assert process.poll() is None, process.communicate()
        yield process, children(process.pid), servers()
    finally:
        process.kill()
        process.communicate()


def gone(pids: list[int]) -> bool:
    """Whether none of these processes runs any more."""
    for pid in pids:
        try:
            if (Path("/proc") / str(pid) / "stat").read_text().rsplit(")", 1)[1].split()[0] != "Z":
                return False
        except OSError:
            continue
    return True


@pytest.mark.parametrize("workers", ["1", "2"])
def test_ctrl_c_ends_workers_and_servers(tmp_path: Path, workers: str) -> None:
    """SIGINT to all, as a terminal sends it: status 130, no process and no shared memory left, no traceback."""
    with evaluating(tmp_path, workers) as (process, started, servers):
        os.killpg(process.pid, signal.SIGINT)
        _, stderr = process.communicate(timeout=DEADLINE)
        assert process.returncode == 130
        assert "stopped before the end: no table; nothing was kept" in stderr
        assert "Traceback" not in stderr
        wait_until(lambda: gone([*started, *servers]))
        for pid in (process.pid, *started):
            assert leftovers(f"cosim-{pid}-") == []


def test_a_killed_worker_is_a_typed_error(tmp_path: Path) -> None:
    """SIGKILL to one worker: status 3, one sentence, and everything else ends."""
    with evaluating(tmp_path, "2") as (process, started, servers):
        worker = next(pid for pid in started if children(pid))
        os.kill(worker, signal.SIGKILL)
        stdout, stderr = process.communicate(timeout=DEADLINE)
        assert (process.returncode, stdout) == (3, "")
        assert "worker" in stderr
        assert "Traceback" not in stderr
        wait_until(lambda: gone([*started, *servers]))
        wait_until(lambda: not any(leftovers(f"cosim-{pid}-") for pid in started))


def test_a_killed_server_is_a_typed_error(tmp_path: Path) -> None:
    """SIGKILL to one physics server: status 3, a sentence that says so, and everything else ends."""
    with evaluating(tmp_path, "2") as (process, started, servers):
        os.kill(servers[0], signal.SIGKILL)
        _, stderr = process.communicate(timeout=DEADLINE)
        assert process.returncode == 3
        assert "lost physics" in stderr
        assert "SIGKILL" in stderr
        wait_until(lambda: gone([*started, *servers]))
