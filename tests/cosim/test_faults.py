"""Interrupted and killed flights: typed ends, saved recordings, no process and no shared memory left."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from flights import DEADLINE, ROOT, Done, command, environment, gone, leftovers, run_cosim, wait_until

from cosim.runs import read_run

SLOW = ("--realtime", "1", "--max-steps", "400")
"""A flight that lasts long enough to be disturbed."""


@contextmanager
def flying(session: str, folder: Path, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A flight under way: at least five steps are on disk when the body runs."""
    process = subprocess.Popen(
        command("launch", "--session", session, "--out", str(folder), *SLOW, *arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=folder.parent,
        env=environment(),
    )
    try:
        wait_until(lambda: recorded(folder) >= 5 or process.poll() is not None)
        assert process.poll() is None, process.communicate()
        yield process
    finally:
        process.kill()
        process.communicate()


def recorded(folder: Path) -> int:
    """Whole records on disk so far; none before the manifest, which is written after the log is opened."""
    return len(read_run(folder).records) if (folder / "manifest.json").exists() else 0


def physics_pid(folder: Path) -> int:
    """Process id of the physics process of a flight."""
    return int(read_run(folder).manifest["physics_pid"])


def test_ctrl_c_saves_the_run_and_ends_both_processes(session_name: str, tmp_path: Path) -> None:
    """SIGINT exits with 130, the recording says so, and the physics process is gone."""
    folder = tmp_path / "run"
    with flying(session_name, folder) as process:
        physics = physics_pid(folder)
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=DEADLINE)
        assert process.returncode == 130, stderr
        assert "Traceback" not in stderr
    assert gone(physics)
    run = read_run(folder)
    assert run.manifest["status"] == "interrupted"
    assert run.manifest["records"] == len(run.records) >= 5


def test_impatience_changes_nothing(session_name: str, tmp_path: Path) -> None:
    """A second and third Ctrl-C while a stopped physics process is being ended: it is ended all the same."""
    folder = tmp_path / "run"
    with flying(session_name, folder) as process:
        physics = physics_pid(folder)
        os.kill(physics, signal.SIGSTOP)
        for _ in range(3):
            process.send_signal(signal.SIGINT)
            time.sleep(0.3)
        process.communicate(timeout=DEADLINE)
        assert process.returncode == 130
    assert gone(physics)


def test_what_a_server_started_itself_is_ended_too(fly: Callable[..., Done], tmp_path: Path) -> None:
    """A physics command that is a script: its children do not outlive the launch."""
    script = tmp_path / "server.sh"
    script.write_text(f"sleep 600 & echo $! > {tmp_path}/pid; wait\n")
    done = fly("--server", f"sh {script}", "--attach-timeout", "2")
    assert done.status == 3, done.stderr
    assert gone(int((tmp_path / "pid").read_text()))


def test_sigterm_ends_both_processes(session_name: str, tmp_path: Path) -> None:
    """SIGTERM is handled like Ctrl-C and exits with 143."""
    folder = tmp_path / "run"
    with flying(session_name, folder) as process:
        physics = physics_pid(folder)
        process.terminate()
        process.communicate(timeout=DEADLINE)
        assert process.returncode == 143
    assert gone(physics)


def test_a_killed_physics_process_is_reported(session_name: str, tmp_path: Path) -> None:
    """kill -9 of the physics process exits with 3, names the signal and the step, and the recording is kept."""
    folder = tmp_path / "run"
    with flying(session_name, folder) as process:
        os.kill(physics_pid(folder), signal.SIGKILL)
        _, stderr = process.communicate(timeout=DEADLINE)
        assert process.returncode == 3, stderr
        assert "SIGKILL" in stderr
        assert "step" in stderr
        assert "Traceback" not in stderr
    assert read_run(folder).manifest["status"] == "failed"


def test_a_killed_launcher_leaves_nothing_but_its_recording(session_name: str, tmp_path: Path) -> None:
    """kill -9 of the launcher: the physics process ends by itself and removes the segments; the log is whole."""
    folder = tmp_path / "run"
    with flying(session_name, folder) as process:
        physics = physics_pid(folder)
        time.sleep(1.2)
        process.kill()
        process.wait()
        wait_until(lambda: gone(physics))
        wait_until(lambda: not leftovers(session_name))
    run = read_run(folder)
    assert run.manifest["status"] == "running"
    assert len(run.records) >= 5
    assert np.array_equal(run.records["step"], np.arange(len(run.records)))


@pytest.mark.parametrize("which", ["launcher", "physics"])
def test_a_paused_process_gives_the_same_flight(fly: Callable[..., Done], tmp_path: Path, which: str) -> None:
    """SIGSTOP of either side, again and again, changes nothing in commands and poses."""
    undisturbed = fly("--max-steps", "25", out="plain").report["trajectory_hash"]
    folder = tmp_path / "run"
    with flying(f"test-pause-{os.getpid()}-{which}", folder, "--max-steps", "25", "--json") as process:
        pid = process.pid if which == "launcher" else physics_pid(folder)
        for seconds in (0.6, 0.05, 0.2, 0.1):
            os.kill(pid, signal.SIGSTOP)
            time.sleep(seconds)
            assert process.poll() is None
            os.kill(pid, signal.SIGCONT)
            time.sleep(0.15)
        stdout, stderr = process.communicate(timeout=DEADLINE)
        assert process.returncode == 0, stderr
    assert Done(0, stdout, stderr).report["trajectory_hash"] == undisturbed


def test_a_peer_started_by_hand_is_waited_for_and_not_killed(tmp_path: Path, session_name: str) -> None:
    """--connect flies with a server that somebody else started, and does not kill it."""
    server = subprocess.Popen(
        [sys.executable, "-m", "physics_server", f"shm:{session_name}", "--attach-timeout", "60"],
        cwd=ROOT,
        stderr=subprocess.PIPE,
    )
    try:
        connect = ("--connect", f"shm:{session_name}", "--out", str(tmp_path / "run"))
        done = run_cosim("launch", *connect, "--max-steps", "3", cwd=tmp_path)
        assert done.status == 0, done.stderr
        assert server.wait(DEADLINE) == 0  # it left by itself after the goodbye
    finally:
        server.kill()
        server.communicate()


def test_another_physics_command_is_started_with_the_rendezvous(fly: Callable[..., Done]) -> None:
    """--server starts the given command with the rendezvous appended, and the run says what it is."""
    done = fly("--server", f"{sys.executable} -m physics_server --engine null", "--max-steps", "3")
    assert done.status == 0, done.stderr
    assert "null" in done.stderr


def test_a_server_that_dies_at_once_is_reported_with_its_last_words(fly: Callable[..., Done]) -> None:
    """A peer that exits before it attaches ends the launch with status 3 and what it wrote to stderr."""
    done = fly("--server", f"{sys.executable} -c \"import sys; sys.exit('no licence found')\"")
    assert done.status == 3, done.stderr
    assert "no licence found" in done.stderr
    assert "code 1" in done.stderr
