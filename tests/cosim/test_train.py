"""`cosim train` as a user runs it, on tiny budgets: files, figures, kills, resumption, dynamics, refusals."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from pathlib import Path

import pytest
from flights import DEADLINE, ROOT, command, environment, leftovers, run_cosim, run_here

pytest.importorskip("stable_baselines3", reason="the extra 'train' is not installed")

from agent_client.errors import TrainingError
from agent_client.policy import load_policy
from agent_client.training_log import read_log
from cosim.errors import CosimError, OutputError
from cosim.figures import draw_figures
from cosim.train import TrainArguments, train

PNG = b"\x89PNG\r\n\x1a\n"

TINY = ("--preset", "quick", "--envs", "4", "--pool", "3")
"""One iteration is 800 steps."""


def started(*arguments: str, cwd: Path) -> subprocess.Popen[str]:
    """A command that runs beside the test."""
    return subprocess.Popen(
        command(*arguments),
        cwd=cwd,
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for_iterations(process: subprocess.Popen[str], folder: Path, count: int) -> None:
    """Wait until a training has kept the state of its first iteration and collected `count` of them."""
    deadline = time.monotonic() + DEADLINE
    log, state = folder / "policy.csv", folder / "policy.state"
    while not (state.exists() and len(log.read_text().splitlines()) > count):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_a_policy_trained_by_the_command_can_be_flown(tmp_path: Path, session_name: str) -> None:
    """A folder with checkpoint, log, TensorBoard's logs and figures; a line an iteration where no terminal is."""
    out = tmp_path / "out"
    trained = run_here("train", *TINY, "--steps", "1600", "--seed", "7", "--out", str(out))
    assert trained.status == 0, trained.stderr
    assert trained.stdout.strip() == str(out / "policy.zip")
    assert "training 'quick' to 1,600 steps, seed 7: 4 drones, kinematic dynamics" in trained.stderr
    lines = [line for line in trained.stderr.splitlines() if line.startswith("iteration")]
    assert len(lines) == 2
    assert all(
        word in lines[1]
        for word in ("1,600 of 1,600 steps", "level 0", "success", "return", "steps/s", "left")
    )
    for name in ("success.png", "return.png"):
        assert (out / name).read_bytes().startswith(PNG)
    assert list((out / "tensorboard").rglob("events.out.tfevents.*"))
    flown = run_cosim(
        "launch", "--json", "--policy", str(out / "policy.zip"), "--max-steps", "5", "--session", session_name,
        "--out", str(tmp_path / "run"), cwd=tmp_path,
    )  # fmt: skip
    assert flown.status == 0, flown.stderr
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert manifest["policy"]["training"]["preset"] == "quick"


def test_a_training_survives_kills_and_stops(tmp_path: Path) -> None:
    """After kill -9 `--resume` needs nothing else and loses at most one iteration; Ctrl-C keeps the last one.

    While it runs a second one in its folder is refused; when all is done, it is said and the figures are drawn.
    """
    out = tmp_path / "mine"
    process = started("train", *TINY, "--steps", "400000", "--out", "mine", cwd=tmp_path)
    wait_for_iterations(process, out, 3)
    process.kill()
    process.communicate(timeout=DEADLINE)
    collected = len(read_log(out / "policy.csv"))
    assert load_policy(out / "policy.zip").contract.training["steps"] >= 800 * (collected - 2)

    process = started("train", "--resume", "mine", cwd=tmp_path)
    wait_for_iterations(process, out, collected + 2)
    second = run_cosim("train", "--resume", "mine", cwd=tmp_path)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=DEADLINE)
    assert process.returncode == 130
    assert "episodes that were under way begin anew" in said
    assert second.status == 2
    assert "--resume mine: expected a folder in which no training runs" in second.stderr
    first = next(line for line in said.splitlines() if line.startswith("iteration"))
    assert int(first.split()[1]) in (collected, collected + 1)
    assert "go on with: cosim train --resume mine" in said.strip().splitlines()[-1]
    assert "Traceback" not in said

    steps = 800 * (len(read_log(out / "policy.csv")) + 1)
    ended = run_here("train", "--resume", str(out), "--steps", str(steps))
    assert ended.status == 0, ended.stderr
    assert [row.steps for row in read_log(out / "policy.csv")] == list(range(800, steps + 1, 800))
    assert load_policy(out / "policy.zip").contract.training["steps"] == steps
    (out / "success.png").unlink()
    again = run_here("train", "--resume", str(out), "--steps", str(steps))
    assert again.status == 0, again.stderr
    assert "steps are done; for more, add --steps" in again.stderr
    assert (out / "success.png").exists()


def test_the_same_training_is_the_same_file(tmp_path: Path) -> None:
    """Two processes that train alike write the same checkpoint, byte for byte."""
    run = ("train", *TINY, "--steps", "800", "--out")
    for done in (run_cosim(*run, "one", cwd=tmp_path), run_here(*run, str(tmp_path / "two"))):
        assert done.status == 0, done.stderr
    one, two = ((tmp_path / name / "policy.zip").read_bytes() for name in ("one", "two"))
    assert one == two


@pytest.mark.parametrize(("engine", "name"), [("reference", "reference 1"), ("bullet", "bullet")])
def test_rigid_bodies_are_trained_in_by_either_engine(engine: str, name: str, tmp_path: Path) -> None:
    """`--dynamics rigid-body` means inertia: in this process, or in a physics process that is gone afterwards."""
    process = started(
        "train", "--preset", "robust", "--envs", "2", "--pool", "2", "--steps", "400", "--engine", engine,
        "--out", "out", cwd=tmp_path,
    )  # fmt: skip
    _, said = process.communicate(timeout=DEADLINE)
    assert process.returncode == 0, said
    assert f"rigid-body dynamics integrated by {engine}" in said
    training = load_policy(tmp_path / "out" / "policy.zip").contract.training
    assert training["dynamics"].startswith(name)
    assert training["steps"] == 400
    assert leftovers(f"cosim-{process.pid}-") == []


def test_what_the_paper_leaves_open_is_printed(tmp_path: Path) -> None:
    """`--explain` prints the table and trains nothing; for another preset there is none."""
    done = run_here("train", "--preset", "paper", "--explain")
    assert done.status == 0
    assert done.stdout.strip() == (ROOT / "agent_client" / "PAPER.md").read_text().strip()
    assert list(tmp_path.iterdir()) == []
    other = run_here("train", "--preset", "quick", "--explain")
    assert other.status == 2
    assert "expected --preset paper, found quick" in other.stderr


def test_an_engine_needs_inertia(tmp_path: Path) -> None:
    """The refusal says what to add."""
    with pytest.raises(CosimError, match="kinematic dynamics have no engine; add --dynamics rigid-body"):
        train(TrainArguments(preset="quick", engine="bullet"), tmp_path / "out", None)
    assert not (tmp_path / "out").exists()


def test_a_folder_holds_one_training(tmp_path: Path) -> None:
    """A second training in a folder is refused before anything is done, with both ways on."""
    (tmp_path / "policy.zip").touch()
    with pytest.raises(OutputError, match=r"found policy\.zip; name another folder, or go on with --resume"):
        train(TrainArguments(), tmp_path, None)


def test_a_training_goes_on_as_it_was_begun(tmp_path: Path) -> None:
    """No argument but the steps may change, a folder is named once, and it must be a training's."""
    with pytest.raises(CosimError, match=r"expected the folder of a training, found no training\.json"):
        train(TrainArguments(), None, tmp_path)
    (tmp_path / "training.json").write_text('{"preset": "quick", "seed": 1, "dynamics": "kinematic"}')
    with pytest.raises(
        CosimError, match="--seed 2: expected that of the training that goes on, 1; leave it out"
    ):
        train(TrainArguments(seed=2), None, tmp_path)
    (tmp_path / "training.json").write_text('{"preset": "quickest"}')
    with pytest.raises(CosimError, match=r"training\.json: expected a preset out of .* found 'quickest'"):
        train(TrainArguments(), None, tmp_path)
    with pytest.raises(CosimError, match="leave out --out"):
        train(TrainArguments(), tmp_path, tmp_path)


LOG = """\
iteration,steps,total_steps,level,success_rate,mean_return,mean_steps,timeout_rate,batch_episodes,batch_success,\
batch_return,steps_per_second,seconds_left
1,800,3200,0,nan,nan,nan,nan,0,nan,nan,1000.0,2.4
2,1600,3200,0,0.5,10.0,50.0,0.0,16,0.5,10.0,1000.0,1.6
3,2400,3200,1,0.9,20.0,50.0,0.0,16,0.9,20.0,1000.0,0.8
"""


def test_figures_are_drawn_from_a_log_alone(tmp_path: Path) -> None:
    """Also of a training under way, also where no episode ended; without an iteration there is nothing to draw."""
    log = tmp_path / "policy.csv"
    log.write_text(LOG)
    assert [path.name for path in draw_figures(log, tmp_path)] == ["success.png", "return.png"]
    assert all((tmp_path / name).read_bytes().startswith(PNG) for name in ("success.png", "return.png"))
    with pytest.raises(OutputError, match=r"success\.png: cannot be written"):
        draw_figures(log, tmp_path / "nowhere")
    log.write_text(LOG[: LOG.index("\n") + 1])
    with pytest.raises(CosimError, match="expected at least one iteration"):
        draw_figures(log, tmp_path)
    with pytest.raises(TrainingError, match="expected the log of a training, found none"):
        draw_figures(tmp_path / "other.csv", tmp_path)
