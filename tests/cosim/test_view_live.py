"""`cosim launch --view`: the live viewer draws a flight, and whatever becomes of it, the flight is the same."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from flights import DEADLINE, Done, command, environment, run_cosim
from PIL import Image

from cosim.drone_figure import CAMERA_COLOUR
from cosim.live_scene import COMMAND_COLOUR, FRAME_SIZE

TUBE = ("--tube", "level=2,seed=1234,length=8")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The hash of the flight without a viewer."""
    folder = tmp_path_factory.mktemp("undisturbed")
    return str(run_cosim("launch", "--json", *TUBE, "--out", "run", cwd=folder).report["trajectory_hash"])


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """A folder for the viewer's pictures."""
    folder = tmp_path / "frames"
    folder.mkdir()
    return folder


def viewers(session: str) -> list[int]:
    """Processes that look on at a session."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                words = (folder / "cmdline").read_bytes()
            except OSError:
                continue
            if b"cosim.live_view" in words and f"shm:{session}".encode() in words:
                found.append(int(folder.name))
    return found


def wait_for(reached: Callable[[], bool]) -> None:
    """Look until it is so."""
    until = time.monotonic() + DEADLINE
    while not reached():
        assert time.monotonic() < until, "nothing happened"
        time.sleep(0.02)


def is_drawing_nothing(done: Done) -> bool:
    """Whether the machine has nothing to draw with."""
    return "expected EGL or OSMesa" in done.stderr


def test_the_viewer_draws_the_flight_and_leaves_its_hash_alone(
    fly: Callable[..., Done], frames: Path, session_name: str, undisturbed: str
) -> None:
    """Pictures appear while it flies and show the drone move, and the viewer ends with the session."""
    done = fly(*TUBE, "--view-frames", str(frames), "--realtime", "1")
    assert done.status == 0, done.stderr
    if is_drawing_nothing(done):
        pytest.skip("nothing draws without a display: apt-get install libegl1 libgl1-mesa-dri")
    assert "live view" not in done.stderr
    assert done.report["trajectory_hash"] == undisturbed
    assert viewers(session_name) == []
    drawn = sorted(frames.iterdir())
    steps = [int(path.stem.split("-")[1]) for path in drawn]
    assert len(steps) >= 2
    assert steps[-1] > steps[0]
    first, last = (np.asarray(Image.open(path).convert("RGB")).astype(int) for path in (drawn[0], drawn[-1]))
    assert first.shape == (FRAME_SIZE[1], FRAME_SIZE[0], 3)
    assert (np.abs(first - last).max(axis=2) > 12).mean() > 0.1
    for colour, what in ((COMMAND_COLOUR, "the command is an arrow"), (CAMERA_COLOUR, "the camera's field")):
        shade = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
        assert (np.abs(last[100:] - shade).max(axis=2) < 60).sum() > 5, what


def test_a_viewer_that_is_killed_takes_nothing_with_it(
    tmp_path: Path, frames: Path, session_name: str, undisturbed: str
) -> None:
    """SIGKILL in mid flight: the flight goes on to the same hash, and the end of the view is said once."""
    words = command(
        "launch", "--json", "--session", session_name, "--out", "run", *TUBE, "--realtime", "1",
        "--view-frames", str(frames),
    )  # fmt: skip
    log = tmp_path / "run" / "steps.bin"
    flight = subprocess.Popen(
        words, cwd=tmp_path, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        wait_for(lambda: flight.poll() is not None or (log.exists() and log.stat().st_size > 0))
        for pid in viewers(session_name):
            os.kill(pid, signal.SIGKILL)
        stdout, stderr = flight.communicate(timeout=DEADLINE)
    finally:
        flight.kill()
        flight.wait()
    done = Done(flight.returncode, stdout, stderr)
    assert done.status == 0, done.stderr
    if is_drawing_nothing(done):
        pytest.skip("nothing draws without a display: apt-get install libegl1 libgl1-mesa-dri")
    assert done.report["trajectory_hash"] == undisturbed
    said = [line for line in done.stderr.splitlines() if "live view" in line]
    assert said == ["live view: killed by SIGKILL; the flight went on without it"]


def test_without_a_display_the_flight_goes_on_and_says_so_once(
    tmp_path: Path, session_name: str, undisturbed: str
) -> None:
    """A window that cannot be opened is one line; the flight succeeds."""
    done = subprocess.run(
        command(
            "launch",
            "--json",
            "--session",
            session_name,
            "--out",
            "run",
            *TUBE,
            "--realtime",
            "100",
            "--view",
        ),
        check=False,
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={name: value for name, value in environment().items() if name != "DISPLAY"},
        timeout=DEADLINE,
    )
    assert done.returncode == 0, done.stderr
    assert Done(0, done.stdout, "").report["trajectory_hash"] == undisturbed
    said = [line for line in done.stderr.splitlines() if "live view" in line]
    assert said == ["live view: a window: expected a display, found none; the flight goes on without it"]


def test_a_live_window_opens_and_closes_with_the_session(
    tmp_path: Path, session_name: str, undisturbed: str
) -> None:
    """On a display the window is drawn, nothing is said of it, and no viewer is left."""
    if shutil.which("xvfb-run") is None or shutil.which("xauth") is None:
        pytest.skip("xvfb-run is not installed: apt-get install xvfb xauth")
    words = command("launch", "--json", "--session", session_name, "--out", "run", *TUBE)
    done = subprocess.run(
        ["xvfb-run", "--auto-servernum", *words, "--realtime", "4", "--view"],
        check=False,
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=environment(),
        timeout=DEADLINE,
    )
    assert done.returncode == 0, done.stderr
    assert Done(0, done.stdout, "").report["trajectory_hash"] == undisturbed
    assert "live view" not in done.stderr
    assert viewers(session_name) == []
