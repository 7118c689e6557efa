"""`cosim view`: pictures and films without a display, several runs, damaged runs, and the window."""

from __future__ import annotations

import itertools
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import av
import numpy as np
import pytest
from flights import DEADLINE, Done, command, environment, run_cosim, run_here
from numpy.typing import NDArray
from PIL import Image

from cosim.drone_figure import CAMERA_COLOUR
from cosim.live_senses import LiveSenses
from cosim.mesh_view import OPENING_COLOUR
from cosim.playback import AXIS_COLOUR, RUN_COLOURS
from cosim.requirements import install_command
from cosim.tracks import read_tracks
from meshes.tube import read_tube

Picture = NDArray[np.int64]

TUBE = "level=2,seed=1234,length=8"
SIZE = (320, 200)
STEPS = 30


def view(*arguments: str | Path, cwd: Path) -> Done:
    """`cosim view` in small pictures."""
    return run_cosim("view", "--size", f"{SIZE[0]}x{SIZE[1]}", *map(str, arguments), cwd=cwd)


@pytest.fixture(scope="session")
def drawing(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Something to draw with; else the tests that need it are skipped."""
    code = (
        "from cosim.view import open_stage\n"
        "stage = open_stage((64, 64), offscreen=True)\n"
        "assert stage.picture().shape == (64, 64, 3)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        check=False,
        capture_output=True,
        text=True,
        cwd=tmp_path_factory.mktemp("drawing"),
        env=environment(),
        timeout=DEADLINE,
    )
    if "expected EGL or OSMesa" in done.stderr:
        pytest.skip("nothing draws without a display: apt-get install libegl1 libgl1-mesa-dri")
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Thirty steps of the shipped policy and of Pure Pursuit in one short tube."""
    folder = tmp_path_factory.mktemp("viewed")
    for name, policy in (("ppo", "tube_ppo"), ("pursuit", "pure-pursuit")):
        done = run_cosim(
            "launch", "--tube", TUBE, "--policy", policy, "--max-steps", str(STEPS), "--out", name, cwd=folder
        )
        assert done.status == 0, done.stderr
    return folder / "ppo", folder / "pursuit"


def read(path: Path) -> Picture:
    """A picture as numbers, (height, width, 3)."""
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(np.int64)


def count(picture: Picture, colour: str, within: int = 40) -> int:
    """Pixels whose colour is nearly `colour`."""
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    return int((np.abs(picture - wanted).max(axis=2) <= within).sum())


def seen(picture: Picture) -> float:
    """Share of a picture that is not background, which has one colour a row."""
    return float((np.abs(picture - picture[:, :1]).max(axis=2) > 12).mean())


def differ(one: Picture, other: Picture) -> float:
    """Share of the pixels in which two pictures differ."""
    return float((np.abs(one - other).max(axis=2) > 12).mean())


@pytest.mark.usefixtures("drawing")
def test_a_run_becomes_a_picture_and_a_film(runs: tuple[Path, Path], tmp_path: Path) -> None:
    """The picture shows tube and camera; the film has a frame for every second record, and moves."""
    done = view(
        runs[0], "--screenshot", "a.png", "--step", "20", "--movie", "a.mp4", "--realtime", "6", cwd=tmp_path
    )
    assert done.status == 0, done.stderr
    assert done.stdout.split() == ["a.png", "a.mp4"]
    picture = read(tmp_path / "a.png")
    assert picture.shape == (SIZE[1], SIZE[0], 3)
    assert seen(picture) > 0.1
    assert count(picture, CAMERA_COLOUR) > 10
    with av.open(str(tmp_path / "a.mp4")) as film:
        assert film.streams.video[0].average_rate == 30
        frames = [frame.to_ndarray(format="rgb24").astype(np.int64) for frame in film.decode(video=0)]
    assert len(frames) == STEPS // 2 + 1
    assert all(frame.shape == (SIZE[1], SIZE[0], 3) for frame in frames)
    assert min(differ(a, b) for a, b in itertools.pairwise(frames)) > 0.01


@pytest.mark.usefixtures("drawing")
def test_several_runs_are_overlaid_each_in_its_colour(runs: tuple[Path, Path], tmp_path: Path) -> None:
    """Both trajectories have their own colours and names; coloured by speed they have not."""
    large = ("--size", "640x400", "--screenshot")
    done = view(*runs, *large, "both.png", "--movie", "both.gif", "--realtime", "30", cwd=tmp_path)
    assert done.status == 0, done.stderr
    both = read(tmp_path / "both.png")
    legend, below = both[:50, 320:], both[100:]
    for colour in RUN_COLOURS[:2]:
        assert count(legend, colour, within=64) >= 5
        assert count(below, colour) >= 10
    with Image.open(tmp_path / "both.gif") as film:
        assert film.format == "GIF"
        assert film.n_frames == STEPS // 10 + 1  # type: ignore[attr-defined]
        assert film.size == (640, 400)
        frame = np.asarray(film.convert("RGB")).astype(np.int64)
    for colour in (*RUN_COLOURS[:2], CAMERA_COLOUR):
        assert count(frame[100:], colour) >= 10, "a palette of few colours keeps those of thin lines"
    done = view(*runs, *large, "speed.png", "--colour", "speed", cwd=tmp_path)
    assert done.status == 0, done.stderr
    speed = read(tmp_path / "speed.png")
    assert count(speed, RUN_COLOURS[1]) < count(both, RUN_COLOURS[1]), "no scale of speeds has vermilion"
    assert differ(speed, both) > 0.01


@pytest.mark.usefixtures("drawing")
def test_a_run_that_was_cut_short_and_lost_its_mesh_is_shown(runs: tuple[Path, Path], tmp_path: Path) -> None:
    """Ten whole records and a changed mesh: the tube is rebuilt, and that is said."""
    folder = tmp_path / "cut"
    shutil.copytree(runs[0], folder)
    log = folder / "steps.bin"
    size = log.stat().st_size // (STEPS + 1)
    with log.open("r+b") as file:
        file.truncate(10 * size + 77)
    (folder / "tube.obj").write_text("v 0 0 0\n")
    done = view("cut", "--screenshot", "cut.png", "--camera", "inside", "--step", "9", cwd=tmp_path)
    assert done.status == 0, done.stderr
    assert "tube.obj is not the mesh that was flown" in done.stderr
    assert "rebuilt from the recorded axis" in done.stderr
    assert seen(read(tmp_path / "cut.png")) > 0.4, "inside of a tube the wall is all around"


def test_the_whole_centreline_is_shown_of_a_run_that_was_cut_short(
    runs: tuple[Path, Path], tmp_path: Path
) -> None:
    """It comes from its file; where that is another one, it is of the part that was flown, and that is said."""
    folder = tmp_path / "cut"
    shutil.copytree(runs[0], folder)
    with (folder / "steps.bin").open("r+b") as file:
        file.truncate((folder / "steps.bin").stat().st_size // 3)

    def length() -> float:
        return float(np.linalg.norm(np.diff(track.centreline, axis=0), axis=1).sum())

    (track,) = read_tracks([folder])
    assert length() == pytest.approx(track.length, rel=1e-3)
    assert track.note == ""
    assert track.words(track.last).splitlines()[0].endswith("cut short")
    (folder / "tube_centerline.obj").write_text("v 0 0 0\n")
    (track,) = read_tracks([folder])
    assert length() < 0.6 * track.length
    assert track.note.endswith("the centreline shown is that of the part that was flown")


@pytest.mark.usefixtures("drawing")
def test_a_mesh_is_shown_with_what_was_found_of_it(runs: tuple[Path, Path], tmp_path: Path) -> None:
    """Without a centreline beside it, it is found and said so, and both openings are marked."""
    mesh = tmp_path / "mesh.obj"
    shutil.copy(runs[0] / "tube.obj", mesh)
    done = view(mesh, "--screenshot", "mesh.png", cwd=tmp_path)
    assert done.status == 0, done.stderr
    assert "the centreline shown was found from the mesh" in done.stderr
    picture = read(tmp_path / "mesh.png")
    assert seen(picture) > 0.1
    assert count(picture, AXIS_COLOUR) > 20
    assert count(picture, OPENING_COLOUR) > 20


@pytest.mark.usefixtures("drawing")
def test_the_papers_figure_is_one_command(tmp_path: Path) -> None:
    """Four panels of the shipped conduit: dark on the left, light on the right, tube above, centreline below."""
    done = view("--figure", "figure.png", "--size", "640x400", cwd=tmp_path)
    assert done.status == 0, done.stderr
    picture = read(tmp_path / "figure.png")
    assert picture.shape == (400, 640, 3)
    half = (200, 320)
    solid, tube = picture[: half[0], : half[1]], picture[: half[0], half[1] :]
    edge, line = picture[half[0] :, : half[1]], picture[half[0] :, half[1] :]
    assert solid.mean() < 130 < tube.mean()
    assert edge.mean() < 130 < line.mean()
    assert (solid > 150).all(axis=2).mean() > 3 * (edge > 150).all(axis=2).mean(), "an opaque tube above"
    assert count(line, AXIS_COLOUR) > 20


def test_the_live_viewer_works_out_what_the_agent_sensed(runs: tuple[Path, Path]) -> None:
    """Gap, target and memory at every recorded pose are the agent's own, but for the wall's triangles (7 mm)."""
    (track,) = read_tracks(runs[:1])
    mesh, records = track.run.manifest["mesh"], track.run.records
    tube = read_tube(mesh["path"], mesh["centreline"], "zup", 1.0)
    steps = track.run.manifest["settings"]["memory"]["steps"]
    senses = LiveSenses(tube, track.sensors, steps, track.body_radius)
    visible = []
    for k, record in enumerate(records):
        sensed = senses.sense(k, np.array(record["position"]), np.array(record["quaternion"]))
        assert sensed.gap == pytest.approx(record["clearance"] - track.body_radius, abs=0.008)
        assert sensed.along == pytest.approx(record["arc_length"], abs=0.01)
        visible.append(sensed.sighting.target is not None)
        assert visible[-1] == record["target_visible"]
        if visible[-1]:
            assert sensed.sighting.target == pytest.approx(np.array(record["target_position"]), abs=0.01)
    assert visible[-1]
    x, y, z, w = records[-1]["quaternion"]
    backwards = np.array([y, -x, w, -z])  # turned by half a turn about its own up
    place = np.array(records[-1]["position"])
    seen = np.array(records[-1]["target_position"]) - place
    remembered = senses.sense(len(records) - 1 + steps, place, backwards).sighting
    assert remembered.target is None
    assert remembered.memory == pytest.approx(seen / np.linalg.norm(seen), abs=0.01)
    assert senses.sense(len(records) + steps, place, backwards).sighting.memory is None


def fails(*arguments: str | Path, saying: str) -> None:
    """The command ends with 2 and says this."""
    done = run_here("view", *map(str, arguments))
    assert done.status == 2
    assert saying in done.stderr


def test_wrong_arguments_are_refused_before_any_work(runs: tuple[Path, Path], tmp_path: Path) -> None:
    """What cannot be shown or written is named, with what was expected."""
    picture = tmp_path / "a.png"
    fails(runs[0], "--screenshot", tmp_path / "a.bmp", saying="expected a file that ends in .png")
    fails(runs[0], "--movie", tmp_path / "a.avi", saying="expected a file that ends in .mp4 or .gif")
    fails(runs[0], "--screenshot", tmp_path / "no" / "a.png", saying="expected a folder")
    fails(runs[0], "--figure", picture, saying="expected a mesh, found a run")
    fails(runs[0], runs[0] / "tube.obj", "--screenshot", picture, saying="found both")
    fails(
        tmp_path / "none.obj", "--screenshot", picture, saying="expected a run folder or the file of a mesh"
    )
    fails(tmp_path, "--screenshot", picture, saying="expected the manifest of a run")
    fails("--movie", tmp_path / "a.gif", saying="expected a run, found a mesh")
    fails("--size", "10x10", "--screenshot", picture, saying="WIDTHxHEIGHT")
    assert not list(tmp_path.iterdir())


def test_without_vedo_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A user who installed the core alone is told what to install."""
    monkeypatch.setitem(sys.modules, "vedo", None)
    monkeypatch.delitem(sys.modules, "cosim.vedo_scene", raising=False)
    fails("--screenshot", tmp_path / "a.png", saying=install_command("view"))


def test_a_window_without_a_display_says_what_to_do(runs: tuple[Path, Path], tmp_path: Path) -> None:
    """No display, or one that cannot be opened: status 2, and the ways out."""
    for display, found in ((None, "found none"), (":4999", "DISPLAY=:4999, which cannot be opened")):
        without = {name: value for name, value in environment().items() if name != "DISPLAY"}
        done = subprocess.run(
            command("view", str(runs[0])),
            check=False,
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env=without | ({} if display is None else {"DISPLAY": display}),
            timeout=DEADLINE,
        )
        assert done.returncode == 2, done.stderr
        assert found in done.stderr
        assert "--screenshot FILE.png" in done.stderr


@pytest.fixture(scope="module")
def display() -> Iterator[str]:
    """An X server without a screen."""
    if shutil.which("Xvfb") is None:
        pytest.skip("Xvfb is not installed: apt-get install xvfb")
    reading, writing = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(writing), "-screen", "0", "800x600x24", "-nolisten", "tcp"],
        pass_fds=[writing],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(writing)
    try:
        with os.fdopen(reading) as number:
            yield f":{number.readline().strip()}"
    finally:
        server.terminate()
        server.wait(DEADLINE)


@pytest.fixture
def on_display(display: str, tmp_path: Path) -> Callable[[list[str]], subprocess.Popen[str]]:
    """Starts a command whose windows open on the display."""
    return lambda words: subprocess.Popen(
        words,
        cwd=tmp_path,
        env=environment() | {"DISPLAY": display},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


WINDOW = """
import sys
from pathlib import Path
from cosim.playback import Playback
from cosim.tracks import read_tracks
from cosim.view import open_stage
from cosim.view_window import Controls

stage = open_stage((400, 300), offscreen=False)
playback = Playback(stage, read_tracks([Path(sys.argv[1])]), colour=None, view="overview")
controls = Controls(stage, playback, 1.0)
events = stage._plotter.interactor


def press(key):
    events.SetKeySym(key)
    events.InvokeEvent("KeyPressEvent")


def click(x, y):
    events.SetEventInformation(int(400 * x), int(300 * y), 0, 0, chr(0), 0, None)
    events.InvokeEvent("LeftButtonPressEvent")
    events.InvokeEvent("LeftButtonReleaseEvent")


assert stage.pump()
press("Right")
press("Right")
print("keys", controls.moment)
click(0.055, 0.06)
print("playing", controls.playing)
click(0.171, 0.06)
print("button", controls.moment, controls.playing)
click(0.238, 0.06)
print("view", playback.view)
click(0.59, 0.06)
print("slid", 10 < controls.moment < 20)
stage._plotter.window.SetSize(600, 450)
assert stage.pump()
print("resized", stage.size)
events.InvokeEvent("ExitEvent")
print("open", stage.pump())
stage.close()
"""


def test_keys_buttons_and_slider_work_in_a_real_window(
    runs: tuple[Path, Path], on_display: Callable[[list[str]], subprocess.Popen[str]]
) -> None:
    """Key presses and mouse clicks reach the controls through vedo; closing the window ends it."""
    process = on_display([sys.executable, "-c", WINDOW, str(runs[0])])
    said, errors = process.communicate(timeout=DEADLINE)
    assert process.returncode == 0, errors
    assert said.splitlines() == [
        "keys 2",
        "playing True",
        "button 3 False",
        "view follow",
        "slid True",
        "resized (600, 450)",
        "open False",
    ]


def test_ctrl_c_closes_the_window(
    runs: tuple[Path, Path], on_display: Callable[[list[str]], subprocess.Popen[str]]
) -> None:
    """The window stays until it is told to go; SIGINT ends the command with 130."""
    process = on_display(command("view", str(runs[0]), "--size", "400x300"))
    try:
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(3.0)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=DEADLINE)
        assert process.returncode == 130, errors
    finally:
        process.kill()
        process.wait()
