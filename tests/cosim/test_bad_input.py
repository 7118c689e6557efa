"""Bad input: exit status 2, one clear sentence, nothing left behind."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from flights import DEADLINE, Done, command, environment, run_cosim, run_here

SQUARE_TUBE = """v 0 1 1\nv 0 -1 1\nv 0 -1 -1\nv 0 1 -1\nv 9 1 1\nv 9 -1 1\nv 9 -1 -1\nv 9 1 -1
f 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n"""


def tube(folder: Path, centreline: str | None) -> str:
    """A square tube of 9 m along x, with this text as its centreline file."""
    (folder / "tube.obj").write_text(SQUARE_TUBE)
    if centreline is not None:
        (folder / "tube_centerline.obj").write_text(centreline)
    return str(folder / "tube.obj")


def refused(done: Done, folder: Path, *words: str) -> None:
    """Status 2, one line that contains the words, nothing on stdout, no run folder."""
    assert done.status == 2, done.stderr
    assert done.stdout == ""
    sentences = [line for line in done.stderr.splitlines() if not line.startswith(("mesh:", "policy:"))]
    assert len(sentences) == 1 or sentences[0].startswith("Usage"), done.stderr
    for word in words:
        assert word in done.stderr
    assert not (folder / "run").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, ("No such file", "nowhere.obj")),
        ("# nothing\n", ("face",)),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", ("face",)),
        ("v 0 0\nf 1 2 3\n", ("line 1",)),
        ("v 0 0 0\ncstype bspline\ncurv 0 1 1\n", ("NURBS",)),
    ],
    ids=["missing", "empty", "no faces", "malformed", "nurbs"],
)
def test_a_mesh_that_cannot_be_used(
    fly: Callable[..., Done], tmp_path: Path, text: str | None, words: tuple[str, ...]
) -> None:
    """A mesh that is missing, unreadable, without faces, or exported as NURBS is refused."""
    path = tmp_path / "nowhere.obj"
    if text is not None:
        path.write_text(text)
    done = fly("--mesh", str(path))
    assert done.status == 2, done.stderr
    assert any(word.lower() in done.stderr.lower() for word in words), done.stderr
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("centreline", "words"),
    [
        ("v 0 0 0\nv 5 0 0\nv 9 0 0\nv 5 1 0\nl 1 2\nl 2 3\nl 2 4\n", ("branch",)),
        ("v 0 5 0\nv 9 5 0\nl 1 2\n", ("inside",)),
        ("v 0 0 0\nv 1 0 0\n", ("segment",)),
    ],
    ids=["branches", "outside", "no segments"],
)
def test_a_centreline_that_cannot_be_used(
    fly: Callable[..., Done], tmp_path: Path, centreline: str, words: tuple[str, ...]
) -> None:
    """A centreline that branches, has no segments, or lies outside of the tube is refused."""
    refused(fly("--mesh", tube(tmp_path, centreline)), tmp_path, *words)


def test_a_tube_without_room_for_the_drone(fly: Callable[..., Done], tmp_path: Path) -> None:
    """A tube that is narrower than the drone, or too short to fly through, is refused with nothing recorded."""
    mesh = tube(tmp_path, "v 0.5 0 0\nv 8.5 0 0\nl 1 2\n")
    for scale, word in (("0.12", "body's radius"), ("0.01", "expected")):
        done = fly("--mesh", mesh, "--scale", scale)
        assert done.status == 2, done.stderr
        assert word in done.stderr
        assert not (tmp_path / "run").exists()


def test_a_named_centreline_that_is_missing(fly: Callable[..., Done], tmp_path: Path) -> None:
    """A centreline that was named is not replaced by another."""
    mesh = tube(tmp_path, "v 0 0 0\nv 9 0 0\nl 1 2\n")
    refused(fly("--mesh", mesh, "--centerline", str(tmp_path / "other.obj")), tmp_path, "other.obj")


def test_a_checkpoint_that_cannot_be_used(fly: Callable[..., Done], tmp_path: Path) -> None:
    """A checkpoint that is missing, empty or foreign is refused by name."""
    refused(fly("--policy", str(tmp_path / "none.zip")), tmp_path, "none.zip", "no such file")
    (tmp_path / "empty.zip").touch()
    refused(fly("--policy", str(tmp_path / "empty.zip")), tmp_path, "empty file")
    with zipfile.ZipFile(tmp_path / "foreign.zip", "w") as archive:
        archive.writestr("letter.txt", "hello")
    refused(fly("--policy", str(tmp_path / "foreign.zip")), tmp_path, "foreign")


def test_time_steps_that_do_not_divide(fly: Callable[..., Done], tmp_path: Path) -> None:
    """A dt that is no whole multiple of the inner step is refused and the nearest one is named."""
    done = fly("--physics-dt", "0.03", "--policy", "pure-pursuit")
    refused(done, tmp_path, "0.09")


def test_an_output_folder_that_cannot_be_written(fly: Callable[..., Done], tmp_path: Path) -> None:
    """A folder below a file, or one that already holds a run, is refused."""
    (tmp_path / "file").touch()
    refused(fly("--out", str(tmp_path / "file" / "below")), tmp_path, "below")
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "manifest.json").write_text("{}")
    refused(fly("--out", str(tmp_path / "old")), tmp_path, "old", "already")


def test_no_room_in_shared_memory(tmp_path: Path, session_name: str) -> None:
    """Where /dev/shm is too small the launch says so, with status 2, in place of a bus error."""
    launch = command("launch", "--json", "--session", session_name, "--out", str(tmp_path / "run"))
    inside = f"mount -t tmpfs -o size=4k tmpfs /dev/shm && exec {shlex.join(launch)}"
    namespace = ["unshare", "--mount", "sh", "-c"]
    if (
        shutil.which("unshare") is None
        or subprocess.run([*namespace, "mount -t tmpfs t /mnt"], check=False).returncode
    ):
        pytest.skip("needs the right to mount a small /dev/shm in a namespace of its own")
    done = subprocess.run(
        [*namespace, inside],
        check=False,
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=environment(),
        timeout=DEADLINE,
    )
    refused(Done(done.returncode, done.stdout, done.stderr), tmp_path, "no room", "/dev/shm")


def test_bad_input_leaves_no_folder_behind(tmp_path: Path) -> None:
    """Not even the runs/ that a first run would have made, and no log in a folder of the user's."""
    mesh = tube(tmp_path, "v 0 5 0\nv 9 5 0\nl 1 2\n")
    (tmp_path / "mine").mkdir()
    before = sorted(tmp_path.rglob("*"))
    for out in ((), ("--out", "new/deep"), ("--out", "mine")):
        assert run_cosim("launch", "--mesh", mesh, *out, cwd=tmp_path).status == 2
        assert sorted(tmp_path.rglob("*")) == before


def launch_here(folder: Path, *arguments: str) -> Done:
    """`cosim launch` in this process, for what is refused before another one is started."""
    return run_here("launch", "--json", "--out", str(folder / "run"), *arguments)


def test_values_out_of_range(fly: Callable[..., Done], tmp_path: Path) -> None:
    """Options with impossible values are refused before anything is started."""
    refused(launch_here(tmp_path, "--scale", "-1"), tmp_path, "--scale")
    refused(launch_here(tmp_path, "--parameter", "mess=1"), tmp_path, "mess", "mass")
    refused(launch_here(tmp_path, "--parameter", "mass=heavy"), tmp_path, "mass", "heavy")
    refused(launch_here(tmp_path, "--parameter", "mass=-1"), tmp_path, "mass", "> 0")
    refused(launch_here(tmp_path, "--parameter", "restitution=2"), tmp_path, "restitution", "0 to 1")
    refused(launch_here(tmp_path, "--compensation", "3"), tmp_path, "compensation")
    refused(launch_here(tmp_path, "--seed", str(2**64)), tmp_path, "--seed")
    refused(launch_here(tmp_path, "--server", "'x"), tmp_path, "--server")
    refused(launch_here(tmp_path, "--connect", "x", "--server", "y"), tmp_path, "--connect")
    refused(launch_here(tmp_path, "--mesh", str(tmp_path)), tmp_path, "a folder")
    refused(fly("--server", "/no/such/program"), tmp_path, "/no/such/program")
    refused(fly("--session", "a/b"), tmp_path, "a/b")
