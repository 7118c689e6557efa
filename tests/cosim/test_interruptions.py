"""Launches that are disturbed while they start or while they speak: quiet ends, and nothing of them is left."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from flights import DEADLINE, ROOT, Done, command, environment, leftovers, wait_until

from cosim.runs import read_run
from protocol.leftovers import leftovers as dead_sessions
from protocol.leftovers import remove
from protocol.memory import Rendezvous

IMPORTING = """
import sys, time
from importlib.abc import MetaPathFinder

class Slow(MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == "cosim.cli":
            print("importing", flush=True)
            time.sleep(60)

from cosim.__main__ import main
sys.meta_path.insert(0, Slow())
main()
"""

LISTENING = """
import ctypes, signal, time
from cosim import interrupts
interrupts.listen()
press = lambda: signal.raise_signal(signal.SIGINT)
"""
CLEANING = """
try:
    try:
        press()
    finally:
        press()
        print("cleaned", interrupts.hurried())
except KeyboardInterrupt:
    print("ended")
"""
SWALLOWED = """
try:
    press()
except BaseException:
    print("swallowed", interrupts.hurried())
try:
    press()
except KeyboardInterrupt:
    print("ended", interrupts.hurried())
"""
SWALLOWED_IN_A_CALLBACK = """
try:
    ctypes.CFUNCTYPE(None)(press)()
    time.sleep(60)
except KeyboardInterrupt:
    print("ended")
"""


def start(*arguments: str, cwd: Path) -> subprocess.Popen[str]:
    """Start `cosim`, for which Ctrl-C is not ignored as it is for a shell's jobs in the background."""
    return subprocess.Popen(
        command(*arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=cwd,
        env=environment(),
    )


def finish(process: subprocess.Popen[str]) -> Done:
    """Wait for the end."""
    try:
        stdout, stderr = process.communicate(timeout=DEADLINE)
    finally:
        process.kill()
    return Done(process.returncode, stdout, stderr)


def test_of_two_launches_of_one_name_the_first_flies_on(session_name: str, tmp_path: Path) -> None:
    """Started at the same moment: one flies undisturbed, the other ends with one sentence and leaves nothing."""
    flown = [
        start(
            *("launch", "--session", session_name, "--out", str(tmp_path / which)),
            *("--max-steps", "20", "--realtime", "2"),
            cwd=tmp_path,
        )
        for which in ("one", "other")
    ]
    done = [finish(process) for process in flown]
    assert sorted(each.status for each in done) == [0, 2], done
    winner, loser = sorted(done, key=lambda each: each.status)
    pid = flown[done.index(winner)].pid
    taken = rf"shm:{session_name} belongs to a session whose agent \(pid {pid}\) is alive; use another name"
    assert re.fullmatch(f"cosim: {taken}\n", loser.stderr), loser.stderr
    left = [path.name for path in tmp_path.iterdir()]
    assert left == [("one", "other")[done.index(winner)]]
    assert read_run(tmp_path / left[0]).manifest["status"] == "completed"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_while_the_command_is_imported_is_quiet(number: signal.Signals) -> None:
    """From the first line of the console script on: the status of the signal and not a word."""
    process = subprocess.Popen(
        [sys.executable, "-c", IMPORTING], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "importing\n"
    process.send_signal(number)
    done = finish(process)
    assert (done.status, done.stderr) == (128 + number, "")


@pytest.mark.parametrize(
    ("code", "said", "told"),
    [
        (CLEANING, "cleaned True\nended\n", "cosim: ending, a moment\n"),
        (SWALLOWED, "swallowed False\nended False\n", ""),
        (SWALLOWED_IN_A_CALLBACK, "ended\n", ""),
    ],
    ids=["cleaning", "swallowed", "callback"],
)
def test_ctrl_c_is_neither_lost_nor_cuts_cleaning_short(code: str, said: str, told: str) -> None:
    """Pressed again while the first is answered it hurries; where the first was swallowed it is raised again."""
    done = finish(
        subprocess.Popen(
            [sys.executable, "-c", LISTENING + code],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT,
        )
    )  # fmt: skip
    assert (done.status, done.stdout, done.stderr) == (0, said, told)


def test_ctrl_c_in_code_that_a_library_makes_leaves_the_exit_status_alone(tmp_path: Path) -> None:
    """Dataclasses run strings at an import; `python -m` would end by SIGINT in place of the status it was given."""
    made = "try:\n    exec('press()')\nexcept KeyboardInterrupt:\n    interrupts.ignore()\n"
    (tmp_path / "made.py").write_text(f"{LISTENING}{made}raise SystemExit(130)\n")
    done = subprocess.run(
        [sys.executable, "-m", "made"],
        check=False,
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=environment(),
        timeout=DEADLINE,
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_ctrl_c_at_any_moment_of_the_start_leaves_nothing(session_name: str, tmp_path: Path) -> None:
    """Between the first import and the first step: status 130, no traceback, no process, no segment, no folder.

    Nor does a terminal that is closed leave anything.
    """
    interrupt, hangup = signal.SIGINT, signal.SIGHUP
    for moment, number in ((0.15, interrupt), (0.35, hangup), (0.55, interrupt), (0.8, hangup)):
        process = start("launch", "--session", session_name, "--realtime", "1", cwd=tmp_path)
        time.sleep(moment)
        process.send_signal(number)
        done = finish(process)
        # Before our first line the interpreter itself ends by the signal, of which a shell makes 130 too.
        assert done.status in (128 + number, -number), done
        assert "Traceback" not in done.stderr
        assert leftovers(session_name) == []
        assert processes_with(session_name) == []
        for run in tmp_path.glob("runs/*"):  # a flight that had begun by then is kept
            assert read_run(run).manifest["status"] == "interrupted"


def processes_with(text: str) -> list[str]:
    """Command lines that contain a text."""
    lines = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            lines.append(path.read_bytes().replace(b"\0", b" ").decode(errors="replace"))
        except OSError:
            continue
    return [line for line in lines if text in line]


@pytest.mark.parametrize(("lines", "flies"), [(1, False), (4, True)])
def test_a_reader_that_leaves_ends_the_command(
    session_name: str, tmp_path: Path, lines: int, flies: bool
) -> None:
    """`cosim launch | head`: ended as by SIGPIPE, before the flight or after it; no half of a run is left."""
    process = start("launch", "--session", session_name, "--out", "run", "--max-steps", "5", cwd=tmp_path)
    assert process.stdout is not None
    for _ in range(lines):
        assert process.stdout.readline()
    process.stdout.close()
    assert process.stderr is not None
    with process.stderr as stderr:
        said = stderr.read()
    assert (process.wait(DEADLINE), said) == (141, "")
    assert leftovers(session_name) == []
    assert processes_with(session_name) == []
    assert [path.name for path in tmp_path.iterdir()] == (["run"] if flies else [])
    if flies:
        assert read_run(tmp_path / "run").manifest["status"] == "completed"


def test_what_a_killed_launch_left_without_physics_is_known_as_dead(
    session_name: str, tmp_path: Path
) -> None:
    """--connect, nobody came, kill -9: its segments stay until somebody looks, and `cosim doctor --clean` will."""
    process = start("launch", "--connect", session_name, cwd=tmp_path)
    wait_until(lambda: len(leftovers(session_name)) == 2)
    process.kill()
    finish(process)
    # One that was killed before its header stood is given up half a second later.
    wait_until(lambda: bool(dead_of(session_name)))
    (dead,) = dead_of(session_name)
    remove(dead)


def dead_of(session: str) -> list[Rendezvous]:
    """The names of dead sessions that contain that of a session."""
    return [one.rendezvous for one in dead_sessions() if session in str(one.rendezvous)]
