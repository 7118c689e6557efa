"""Two policies from the same instant: the beginning of a run is flown again bit for bit, then another flies on."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from flights import Done, run_cosim, run_here

from cosim.recording import manifest_digest, manifest_text
from cosim.runs import read_run

SHARED = 60
"""Control steps that both flights have in common."""


@pytest.fixture(scope="module")
def hard_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight with sensor noise, drop-outs and drawn dynamics, which all have to be met again."""
    folder = tmp_path_factory.mktemp("hard")
    arguments = ("--tube", "level=2,seed=5", "--hard", "--action-delay", "1", "--out", str(folder / "run"))
    done = run_cosim("launch", "--json", *arguments, cwd=folder)
    assert done.status == 0, done.stderr
    return folder / "run"


@pytest.fixture
def replay(hard_run: Path, tmp_path: Path) -> Callable[..., Done]:
    """Fly on from a step of the recorded flight, into a folder of the test."""

    def run(policy: str, step: int) -> Done:
        out = ("--out", str(tmp_path / "on"))
        arguments = ("--policy", policy, "--from-step", str(step), *out, "--json")
        return run_cosim("replay", str(hard_run), *arguments, cwd=tmp_path)

    return run


def test_the_same_policy_repeats_the_rest_of_the_flight(hard_run: Path, replay: Callable[..., Done]) -> None:
    """State, sensors' noise, delays and the policy's memory are all rebuilt: the whole trajectory is the same."""
    done = replay("tube_ppo", SHARED)
    assert done.status == 0, done.stderr
    recorded = json.loads((hard_run / "manifest.json").read_text())
    assert done.report["trajectory_hash"] == recorded["trajectory_hash"]
    again, before = read_run(Path(done.report["run_dir"])).records, read_run(hard_run).records
    for name in ("observation", "lidar", "action", "reward", "memory_age", "clearance"):
        assert np.array_equal(again[name], before[name]), name
    assert np.isnan(again["entropy"][1 : SHARED + 1]).all()
    assert np.array_equal(again["entropy"][SHARED + 1 :], before["entropy"][SHARED + 1 :])


def test_another_policy_parts_exactly_after_the_step(hard_run: Path, replay: Callable[..., Done]) -> None:
    """Commands and poses are shared up to and with step K, and the run that goes on says what it continues."""
    done = replay("lidar-rule", SHARED)
    assert done.status == 0, done.stderr
    folder = Path(done.report["run_dir"])
    again, before = read_run(folder).records, read_run(hard_run).records
    assert np.array_equal(again["chain"][: SHARED + 1], before["chain"][: SHARED + 1])
    assert not np.array_equal(again["chain"][SHARED + 1], before["chain"][SHARED + 1])
    continues = read_run(folder).manifest["continues"]
    assert continues["from_step"] == SHARED
    assert continues["trajectory_hash"] == before["chain"][SHARED].tobytes().hex()


def test_a_run_that_was_cut_short_goes_on_from_its_last_step(hard_run: Path, tmp_path: Path) -> None:
    """What a crash left behind is flown on, by the same policy to the end that the flight would have had."""
    cut = tmp_path / "cut"
    shutil.copytree(hard_run, cut)
    size = read_run(cut).records.dtype.itemsize
    with (cut / "steps.bin").open("r+b") as log:
        log.truncate((SHARED + 1) * size + size // 2)
    manifest = json.loads((cut / "manifest.json").read_text()) | {"status": "running"}
    whole = manifest.pop("trajectory_hash")
    for key in ("records", "outcome"):
        del manifest[key]
    manifest["manifest_sha256"] = manifest_digest(manifest)
    (cut / "manifest.json").write_text(manifest_text(manifest))
    arguments = ("--policy", "tube_ppo", "--from-step", str(SHARED), "--out", str(tmp_path / "on"))
    done = run_cosim("replay", str(cut), *arguments, cwd=tmp_path)
    assert done.status == 0, done.stderr
    assert json.loads((tmp_path / "on" / "manifest.json").read_text())["trajectory_hash"] == whole
    assert "cut short" in done.stdout


def test_a_step_that_the_run_does_not_have_is_refused(hard_run: Path) -> None:
    """The message says how many steps there are."""
    done = run_here("replay", str(hard_run), "--policy", "tube_ppo", "--from-step", "100000")
    assert done.status == 2
    assert "--from-step: expected 0 to" in done.stderr


def test_physics_that_makes_other_poses_ends_the_replay(hard_run: Path, tmp_path: Path) -> None:
    """Where the state at step K is not the recorded one, no comparison is made."""
    server = f"{sys.executable} -m physics_server --engine null"
    arguments = (
        "--policy",
        "lidar-rule",
        "--from-step",
        "5",
        "--server",
        server,
        "--out",
        str(tmp_path / "on"),
    )
    done = run_cosim("replay", str(hard_run), *arguments, cwd=tmp_path)
    assert done.status == 2
    assert "physics did not make the same poses of the same commands" in done.stderr
