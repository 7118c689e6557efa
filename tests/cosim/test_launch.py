"""`cosim launch` from end to end: a real physics process, a real mesh, a trained policy."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from flights import DEADLINE, Done, environment

KEYS = {
    "outcome", "steps", "sim_time_s", "wall_time_s", "steps_per_second", "progress", "quality",
    "min_clearance_m", "contacts", "trajectory_hash", "run_dir",
}  # fmt: skip


def test_the_shipped_policy_flies_the_shipped_conduit(conduit_run: tuple[Done, Path]) -> None:
    """With no options at all the flight succeeds without contact and reports every promised key."""
    done, folder = conduit_run
    assert done.status == 0, done.stderr
    report = done.report
    assert set(report) >= KEYS
    assert report["outcome"] == "success"
    assert report["contacts"] == 0
    assert report["min_clearance_m"] > 0.0
    assert Path(report["run_dir"]) == folder
    assert report["sim_time_s"] == pytest.approx(report["steps"] * 0.1)


def test_stdout_holds_the_json_object_alone(conduit_run: tuple[Done, Path]) -> None:
    """--json prints one line on stdout and nothing else there."""
    assert len(conduit_run[0].stdout.splitlines()) == 1


def test_the_same_seed_gives_the_same_hash(fly: Callable[..., Done]) -> None:
    """Two flights from one seed agree in every bit of commands and poses; another seed differs."""
    first, again, other = (
        fly("--max-steps", "60", "--seed", str(seed), out=f"run{i}").report
        for i, seed in enumerate((3, 3, 4))
    )
    assert first["trajectory_hash"] == again["trajectory_hash"]
    assert first["trajectory_hash"] != other["trajectory_hash"]


def test_transport_and_pace_do_not_change_the_flight(fly: Callable[..., Done]) -> None:
    """Mapped files in place of shared memory, and the pace of the wall clock, give the same hash."""
    options = ("--max-steps", "12", "--seed", "5")
    plain = fly(*options, out="plain").report
    files = fly(*options, "--transport", "file", out="files").report
    paced = fly(*options, "--realtime", "1", out="paced").report
    assert plain["trajectory_hash"] == files["trajectory_hash"] == paced["trajectory_hash"]
    assert paced["wall_time_s"] >= 1.1


def test_pure_pursuit_flies_the_conduit(fly: Callable[..., Done]) -> None:
    """The baseline that knows the centreline reaches the end without contact."""
    report = fly("--policy", "pure-pursuit", "--seed", "1").report
    assert (report["outcome"], report["contacts"]) == ("success", 0)


def test_flying_backwards_starts_at_the_other_end(fly: Callable[..., Done]) -> None:
    """--start-end last flies the same conduit from its other end."""
    first = fly("--max-steps", "5", out="first").report
    last = fly("--max-steps", "5", "--start-end", "last", out="last").report
    assert first["trajectory_hash"] != last["trajectory_hash"]
    assert last["progress"] < 0.1


def test_a_flight_without_success_is_completed_all_the_same(fly: Callable[..., Done]) -> None:
    """A time-out exits with 0, and with 1 under --require-success."""
    done = fly("--max-steps", "3", out="a")
    assert (done.status, done.report["outcome"], done.report["steps"]) == (0, "timeout", 3)
    assert fly("--max-steps", "3", "--require-success", out="b").status == 1


def test_contact_ends_the_flight_or_is_counted(fly: Callable[..., Done]) -> None:
    """With no compensation of gravity and a weak gain the drone falls onto the wall: a collision, or counted."""
    weak = ("--compensation", "0", "--parameter", "force_gain=0.5", "--max-steps", "40")
    ended = fly(*weak, out="end").report
    assert (ended["outcome"], ended["contacts"]) == ("collision", 1)
    counted = fly(*weak, "--on-contact", "continue", out="continue").report
    assert counted["outcome"] != "collision"
    assert counted["contacts"] > 1


def test_what_was_chosen_for_the_user_is_said(fly: Callable[..., Done], tmp_path: Path) -> None:
    """The output says that industrial.obj and tube_ppo are the shipped ones, and the manifest records it."""
    done = fly("--max-steps", "2")
    assert "industrial.obj is the shipped one" in done.stderr
    assert "tube_ppo is the shipped one" in done.stderr
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert manifest["plant"]["engine"].startswith("bullet")
    assert manifest["options"]["max_steps"] == 2


def test_a_larger_body_has_a_smaller_gap(fly: Callable[..., Done], tmp_path: Path) -> None:
    """A body radius that is named reaches physics, sensors and the reported gap, and is said to differ."""
    options = ("--max-steps", "2", "--policy")
    usual = fly(*options, "pure-pursuit", out="usual").report["min_clearance_m"]
    large = fly(*options, "pure-pursuit", "--parameter", "body_radius=0.3", out="large").report
    assert large["min_clearance_m"] == pytest.approx(usual - 0.15, abs=1e-6)
    done = fly(*options, "tube_ppo", "--parameter", "body_radius=0.3", out="policy")
    assert "drone.body_radius: made for 0.15, flown with 0.3" in done.stderr


def test_files_of_the_users_folder_are_not_taken_for_modules(
    fly: Callable[..., Done], tmp_path: Path
) -> None:
    """A random.py or protocol.py beside the user's data does not reach the physics process."""
    for name in ("random.py", "protocol.py"):
        (tmp_path / name).write_text("raise SystemExit('shadowed')\n")
    code = "import sys; sys.path.pop(0); from cosim.cli import main; sys.argv[0] = 'cosim'; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, "launch", "--json", "--max-steps", "2", "--out", "run"],
        check=False,
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=environment(),
        timeout=DEADLINE,
    )
    assert done.returncode == 0, done.stderr


def test_another_control_step_must_be_allowed(fly: Callable[..., Done], tmp_path: Path) -> None:
    """A dt that differs from the checkpoint's is refused, and flown and recorded under --allow-mismatch dt."""
    refused = fly("--dt", "0.05", "--max-steps", "4", out="refused")
    assert refused.status == 2
    assert "dt: expected 0.1, found 0.05" in refused.stderr
    assert "--allow-mismatch dt" in refused.stderr
    allowed = fly("--dt", "0.05", "--allow-mismatch", "dt", "--max-steps", "4", out="allowed")
    assert allowed.report["sim_time_s"] == pytest.approx(0.2)
    manifest = json.loads((tmp_path / "allowed" / "manifest.json").read_text())
    assert manifest["policy"]["mismatch"] == [{"name": "dt", "expected": "0.1", "found": "0.05"}]
