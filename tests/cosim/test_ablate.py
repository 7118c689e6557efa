"""`cosim ablate`: every variant trained and flown as it says, one table, and the same however many processes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
import time
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("stable_baselines3", reason="the extra 'train' is not installed")

from flights import DEADLINE, Done, command, environment, run_cosim, run_here

import cosim.ablate
from agent_client.ablations import ABLATIONS
from agent_client.conditions import HARD
from agent_client.evaluation import EpisodeResult
from agent_client.policy import load_policy
from agent_client.task import Outcome
from agent_client.training_log import Progress
from agent_client.tubes import HARD_TUBES
from cosim.ablate import AblateOptions, make_plan
from cosim.workers import FlyJob, Job, TrainJob

TINY = ("--steps", "400", "--envs", "2", "--pool", "2", "--seeds", "1", "--episodes", "2")

KEYS = {
    "variant", "changed", "claim", "level", "success", "success_range", "exit", "collision", "timeout", "mean_steps",
    "steps_to_paper", "seeds_past_paper", "seeds",
}  # fmt: skip


def ablate_here(*arguments: str) -> Done:
    """`cosim ablate` in this process by one worker, on a tiny budget."""
    return run_here("ablate", "--workers", "1", *TINY, *arguments)


def test_each_variant_is_trained_and_flown_at_each_level(tmp_path: Path) -> None:
    """A row a variant and level; the checkpoints carry their masks, and fly in other commands too."""
    out = tmp_path / "out"
    done = ablate_here("--json", "--variants", "no-memory,full", "--out", str(out))
    assert done.status == 0, done.stderr
    report = json.loads(done.stdout)
    assert json.loads((out / "results.json").read_text()) == report
    rows = report["rows"]
    assert [(row["variant"], row["level"]) for row in rows] == [
        (name, level) for name in ("full", "no-memory") for level in (0, 1, 2)
    ]
    for row in rows:
        assert set(row) == KEYS
        assert row["success"] + row["exit"] + row["collision"] + row["timeout"] == pytest.approx(1.0)
        assert [run["seed"] for run in row["seeds"]] == [0]
    assert (report["steps"], report["engine"]) == (400, "kinematic")
    assert "trained 2 of 2: no-memory, seed 0" in done.stderr
    files = sorted(str(path.relative_to(out)) for path in out.rglob("*") if path.is_file())
    assert files == [
        "full/seed0.csv", "full/seed0.zip", "no-memory/seed0.csv", "no-memory/seed0.zip", "results.json",
    ]  # fmt: skip
    contract = load_policy(out / "no-memory" / "seed0.zip").contract
    assert "memory_available" in contract.masked
    assert contract.training["preset"] == "quick no-memory"
    assert load_policy(out / "full" / "seed0.zip").contract.masked == ()
    again = run_here(
        "evaluate",
        "--json",
        "--workers",
        "1",
        "--episodes",
        "2",
        "--policy",
        str(out / "no-memory" / "seed0.zip"),
    )
    assert again.status == 0, again.stderr
    flown = [(row["success"], row["mean_steps"]) for row in json.loads(again.stdout)["rows"]]
    assert flown == [(row["success"], row["mean_steps"]) for row in rows[3:]]


def test_the_table_names_what_was_changed() -> None:
    """A line a variant beside the paper's word, and below what each changed and what was left out."""
    done = ablate_here("--variants", "one-regime,per-metre,literal-reward", "--unknown-tube")
    assert done.status == 0, done.stderr
    lines = done.stdout.splitlines()
    assert max(map(len, lines)) <= 110
    assert [line.split()[0] for line in lines if line.endswith(("required", "its own"))] == [
        "literal-reward",
        "one-regime",
    ]
    text = " ".join(done.stdout.split())
    assert "no policy sees progress, position_f, position_u, position_r" in text
    assert "literal-reward: the reward as the paper writes it, per step" in text
    assert "left out, since the preset is so already: per-metre" in text


def test_results_do_not_depend_on_the_workers(tmp_path: Path) -> None:
    """One process and two write the same results and the same policies, bit for bit."""
    found = []
    arguments = (
        "--seeds",
        "2",
        "--variants",
        "no-camera,no-curriculum",
        "--hard",
        "--dynamics",
        "rigid-body",
    )
    for workers in (1, 2):
        out = tmp_path / str(workers)
        if workers == 1:
            done = ablate_here(*arguments, "--out", str(out))
        else:
            done = run_cosim("ablate", *TINY, *arguments, "--workers", "2", "--out", str(out), cwd=tmp_path)
        assert done.status == 0, done.stderr
        actors = [
            zipfile.ZipFile(out / name / f"seed{seed}.zip").read("actor.npz")
            for name in ("no-camera", "no-curriculum")
            for seed in (0, 1)
        ]
        found.append(((out / "results.json").read_text(), actors))
    assert found[0] == found[1]
    assert len(set(found[0][1])) == 4
    assert json.loads(found[0][0])["engine"] == "reference"


def progress(steps: int, level: int, success: float) -> Progress:
    """A row of a log."""
    blank: dict[str, Any] = dict.fromkeys(Progress.__dataclass_fields__, 0)
    return Progress(**blank | {"steps": steps, "level": level, "success_rate": success})


@pytest.fixture
def jobs(monkeypatch: pytest.MonkeyPatch) -> list[Job]:
    """Jobs that nobody does: at each level, a policy of seed s has s + 1 of four episodes time out.

    Seeds 0 and 1 are above 87 % at level 2 after 2,000 and 4,000 steps, the third one never.
    """
    asked: list[Job] = []

    def result(seed: int, at: int) -> EpisodeResult:
        outcome = Outcome.TIMEOUT if at <= seed else Outcome.SUCCESS
        return EpisodeResult(0, at, outcome, 100 * (at + 1), 1.0, 1.0, 0.1, 0, 1.0, {})

    def do(job: Job) -> Any:
        asked.append(job)
        if isinstance(job, TrainJob):
            seed = job.options.seed
            steps = 2000 * (seed + 1)
            return (progress(1000, 2, 0.5), progress(steps, 2, 0.9 if seed < 2 else 0.8))
        assert isinstance(job, FlyJob)
        return tuple(
            tuple(result(seed, at) for at in range(len(job.episodes))) for seed in range(len(job.pilots))
        )

    @contextmanager
    def crew(_workers: int) -> Iterator[Any]:
        yield lambda jobs: map(do, jobs)

    monkeypatch.setattr(cosim.ablate, "crew", crew)
    return asked


def flown_by(jobs: Sequence[Job], variant: str) -> list[FlyJob]:
    """Jobs that fly a variant."""
    return [job for job in jobs if isinstance(job, FlyJob) and job.pilots[0].name.startswith(variant)]


def test_rows_are_means_over_the_seeds(jobs: list[Job]) -> None:
    """Mean, range and each seed alone, worked out by hand for three seeds of four episodes."""
    done = run_here("ablate", "--json", "--seeds", "3", "--episodes", "4", "--variants", "full,no-camera")
    assert done.status == 0, done.stderr
    row = json.loads(done.stdout)["rows"][0]
    assert (row["success"], row["success_range"]) == (0.5, [0.25, 0.75])
    assert (row["timeout"], row["exit"], row["collision"], row["mean_steps"]) == (0.5, 0.0, 0.0, 250.0)
    assert (row["steps_to_paper"], row["seeds_past_paper"]) == (3000.0, 2)
    assert [run["steps_to_paper"] for run in row["seeds"]] == [2000, 4000, None]
    assert [run["success"] for run in row["seeds"]] == [0.75, 0.5, 0.25]
    text = run_here("ablate", "--seeds", "3", "--episodes", "4", "--variants", "full").stdout
    cells = ["full", *["50.0 (25-75)"] * 3, "50/50/50", "250/250/250", "3k 2/3", "84/71/87"]
    assert " ".join(cells) in " ".join(text.split())


def test_what_is_taken_away_in_training_is_taken_away_in_flight(jobs: list[Job]) -> None:
    """The camera sees nothing on either side; all variants fly the same episodes under otherwise the same draws."""
    assert run_here("ablate", "--hard", "--episodes", "60", "--dynamics", "rigid-body").status == 0
    blind, full = flown_by(jobs, "no-camera"), flown_by(jobs, "full")
    assert {job.conditions.camera_dropout for job in blind} == {(1.0, 1.0)}
    assert {job.conditions for job in full} == {HARD}
    assert [job.episodes for job in blind] == [job.episodes for job in full]
    assert [len(job.episodes) for job in full] == [50, 10] * 3
    trained = [job for job in jobs if isinstance(job, TrainJob)]
    assert all(job.engine == "reference" and job.options.tubes == (HARD_TUBES,) for job in trained)
    assert all(job.options.threads == 1 for job in trained)
    assert [job.options.seed for job in trained] == [0, 1, 2] * (len(trained) // 3)
    dropout = {job.options.preset: job.options.world.conditions.camera_dropout for job in trained}
    assert dropout["quick no-camera"] == (1.0, 1.0)
    assert dropout["quick no-memory"] == HARD.camera_dropout


def test_what_needs_inertia_is_left_out_of_the_kinematic_world() -> None:
    """Hard conditions keep their sensors and body there; gain and compensation are the usual ones."""
    plan = make_plan(AblateOptions(hard=True))
    assert plan.conditions.body_radius == (0.25, 0.25)
    assert (plan.conditions.gain, plan.conditions.compensation) == ((8.0, 8.0), (0.9, 0.9))
    assert plan.base.world.conditions == plan.conditions


def test_no_teacher_teaches_what_is_taken_away(jobs: list[Job]) -> None:
    """The recipe that imitates a teacher, who sees the axis, cannot be ablated; the same task by PPO can."""
    assert run_here("ablate", "--preset", "robust").status == 2
    done = run_here("ablate", "--preset", "robust-ppo", "--seeds", "1", "--episodes", "1")
    assert done.status == 0, done.stderr
    assert all(job.options.imitation is None for job in jobs if isinstance(job, TrainJob))
    assert "left out, since the preset is so already: no-position" in " ".join(done.stdout.split())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--variants", "full,no-wings"), ("--variants", "no-memory", "'no-wings'")),
        (("--variants", ""), ("--variants", "an empty string")),
        (("--variants", "per-metre"), ("per-metre", "quick", "already")),
        (("--seeds", "0"), ("--seeds", "0")),
        (("--steps", "none"), ("--steps", "none")),
        (("--dynamics", "aerial"), ("--dynamics", "rigid-body")),
        (("--out", "/dev/null/below"), ("/dev/null/below",)),
    ],
    ids=lambda value: " ".join(value) if value and value[0].startswith("--") else "",
)
def test_bad_input_is_refused(arguments: tuple[str, ...], words: tuple[str, ...]) -> None:
    """Exit status 2 and a sentence that names what was expected and found, before anything is trained."""
    done = ablate_here(*arguments)
    assert (done.status, done.stdout) == (2, "")
    for word in words:
        assert word in done.stderr


def test_results_are_not_overwritten(tmp_path: Path) -> None:
    """A folder that holds results is refused."""
    (tmp_path / "results.json").write_text("{}")
    done = ablate_here("--out", str(tmp_path))
    assert done.status == 2
    assert "results.json" in done.stderr


def test_help_is_one_screen_and_names_every_variant(tmp_path: Path) -> None:
    """An example, all variants, and at most 50 lines of 110 characters."""
    text = run_cosim("ablate", "--help", cwd=tmp_path).stdout
    assert all(f"{ablation.name} " in text for ablation in ABLATIONS)
    assert "cosim ablate --variants" in text
    assert len(text.splitlines()) <= 50
    assert max(map(len, text.splitlines())) <= 110


def living(group: int) -> list[int]:
    """Processes of a group that live."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                state, _, its_group = (entry / "stat").read_text().rsplit(")", 1)[1].split()[:3]
            except OSError:
                continue
            if int(its_group) == group and state != "Z":
                found.append(int(entry.name))
    return found


@pytest.mark.parametrize("workers", ["1", "2"])
def test_ctrl_c_keeps_what_is_trained_and_leaves_nothing_else(tmp_path: Path, workers: str) -> None:
    """SIGINT to all, as a terminal sends it: status 130, whole checkpoints, no table, no process, no scratch file."""
    temporary, out = tmp_path / "temporary", tmp_path / "out"
    temporary.mkdir()
    # Importing torch makes a cache folder among the temporary files, which is none of ours.
    elsewhere = {"TMPDIR": str(temporary), "TORCHINDUCTOR_CACHE_DIR": str(tmp_path / "torch")}
    process = subprocess.Popen(
        command("ablate", *TINY, "--seeds", "500", "--workers", workers, "--out", str(out)),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path, start_new_session=True,
        env=environment() | elsewhere,
    )  # fmt: skip
    watchdog = threading.Timer(DEADLINE, process.kill)
    watchdog.start()
    try:
        assert process.stderr is not None
        assert process.stderr.readline().startswith("training")
        assert process.stderr.readline().startswith("trained 1 of")
        os.killpg(process.pid, signal.SIGINT)
        stdout, stderr = process.communicate(timeout=DEADLINE)
        deadline = time.monotonic() + DEADLINE
        while living(process.pid):
            assert time.monotonic() < deadline, "deadline passed"
            time.sleep(0.02)
    finally:
        watchdog.cancel()
        process.kill()
        process.communicate()
    assert (process.returncode, stdout) == (130, "")
    assert f"stopped before the end: no table; what was trained is in {out}" in stderr
    assert "Traceback" not in stderr
    assert not (out / "results.json").exists()
    assert load_policy(out / "full" / "seed0.zip").contract.training["steps"] == 400
    assert list(temporary.iterdir()) == []
