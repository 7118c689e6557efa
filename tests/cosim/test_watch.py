"""`cosim watch`: what it says of a session that others run, and how it ends."""

from __future__ import annotations

import io
import json
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import stamped
from flights import Done, command, environment, run_here

from cosim import watch
from protocol.leftovers import Found, Standing, remove
from protocol.memory import Rendezvous

PATIENCE_S = 30.0
LANES = 3


@pytest.fixture(params=["shm", "file"])
def rendezvous(request: pytest.FixtureRequest, session_name: str, tmp_path: Path) -> str:
    """A rendezvous of each transport."""
    return f"shm:{session_name}" if request.param == "shm" else f"file:{tmp_path / 'session'}"


@contextmanager
def watching(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """`cosim watch` as a user starts it."""
    process = subprocess.Popen(
        command("watch", *arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def end_of(process: subprocess.Popen[str]) -> Done:
    """Wait for the command's end."""
    stdout, stderr = process.communicate(timeout=PATIENCE_S)
    return Done(process.returncode, stdout, stderr)


def objects(text: str) -> list[dict[str, Any]]:
    """The JSON objects that were printed, one a line."""
    return [json.loads(line) for line in text.splitlines()]


def first_object(process: subprocess.Popen[str], state: str) -> dict[str, Any]:
    """Read objects until one shows a state."""
    assert process.stdout is not None
    for line in process.stdout:
        found: dict[str, Any] = json.loads(line)
        if found["state"] == state:
            return found
    raise AssertionError(f"it ended and never was {state}")


def test_it_follows_a_session_from_its_offer_to_its_goodbye(rendezvous: str) -> None:
    """One object a line, the last one closed; status 0 after an orderly end."""
    with watching(rendezvous, "--json", "--wait", "20", "--interval", "0.05") as process:
        with stamped.part("fly", rendezvous, LANES, 400) as agent:
            offered = first_object(process, "offered")
            assert offered["session"] == rendezvous
            assert offered["agent"] == {"pid": agent.pid, "life": "running"}
            assert (offered["physics"], offered["step"], offered["ended"]) == (None, None, None)
            with stamped.part("serve", rendezvous):
                done = end_of(process)
        last = objects(done.stdout)[-1]
    assert done.status == 0
    assert (last["state"], last["ended"], last["step"], last["lanes"]) == ("closed", "goodbye", 400, LANES)
    assert last["position_m"] == [400.0, 400.0, 400.0]
    assert last["contact_steps"] == 400
    assert last["plant"] == "stamp 1, none"


@pytest.mark.parametrize("victim", ["agent", "physics"])
def test_it_says_who_was_killed(session_name: str, victim: str) -> None:
    """After kill -9 of either side it ends by itself, names the dead, and has the status of a peer's failure."""
    rendezvous = f"shm:{session_name}"
    with (
        stamped.part("serve", rendezvous) as physics,
        stamped.part("fly", rendezvous, LANES) as agent,
        watching(session_name, "--wait", "20", "--interval", "0.05") as process,
    ):
        assert process.stdout is not None
        line = process.stdout.readline()
        while "step" not in line:
            line = process.stdout.readline()
            assert line, "it ended before there was a step"
        assert line.startswith(f"session {rendezvous}  state ")
        assert f"lane 0 of {LANES}" in line
        killed = {"agent": agent, "physics": physics}[victim]
        killed.kill()
        done = end_of(process)
    assert done.status == 3
    last = done.stdout.splitlines()[-1]
    assert last.startswith(f"{rendezvous} ended after ")
    assert f"{victim} (pid {killed.pid}) is dead: " in last
    assert "it gave up: lost" in last


def test_ctrl_c_ends_the_watching_alone(session_name: str) -> None:
    """Status 0, no traceback, and the session goes on; --once then says so too."""
    rendezvous = f"shm:{session_name}"
    with stamped.part("serve", rendezvous), stamped.part("fly", rendezvous, 1) as agent:
        with watching(session_name, "--wait", "20", "--json", "--interval", "0.05") as process:
            assert process.stdout is not None
            process.stdout.readline()
            process.send_signal(signal.SIGINT)
            done = end_of(process)
        assert (done.status, done.stderr) == (0, "")
        with watching(session_name, "--json", "--once") as process:
            once = end_of(process)
        assert once.status == 0
        (figures,) = objects(once.stdout)
        assert figures["ended"] is None
        assert figures["steps_per_second"] > 0.0
        agent.kill()
        agent.wait()
        with watching(session_name, "--wait", "0") as process:  # gone, or seen to break
            assert end_of(process).status in (2, 3)


def test_a_wrong_name_is_bad_input_and_lists_what_runs(
    session_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Status 2 and one sentence with the names that there are."""
    stay_in_front(monkeypatch)
    monkeypatch.setattr("protocol.observer.sessions", lambda _: (_found("other"),))
    done = run_here("watch", session_name)
    assert done.status == 2
    assert done.stderr == (
        f"cosim: session {session_name!r}: expected a running session, found none; running now: shm:other\n"
    )


def test_without_a_name_it_takes_the_only_session_or_says_which_there_are(
    session_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """None running: what to do; one: that one; two: both are listed."""
    stay_in_front(monkeypatch)
    running: list[Found] = []
    monkeypatch.setattr(watch, "sessions", lambda _: tuple(running))
    none = run_here("watch")
    assert (none.status, "no session is running; start one" in none.stderr) == (2, True)
    running.append(_found(session_name))
    rendezvous = f"shm:{session_name}"
    with stamped.part("fly", rendezvous, 1) as agent:
        one = run_here("watch", "--json", "--once", "--wait", "20")
        agent.terminate()  # before anybody attached
        agent.wait()
    assert one.status == 0
    assert [figures["session"] for figures in objects(one.stdout)] == [rendezvous]
    remove(Rendezvous("shm", session_name))
    running.append(_found("other"))
    two = run_here("watch")
    assert two.status == 2
    assert f"2 sessions are running; name the one to watch: cosim watch ...\n  {rendezvous}" in two.stderr


def test_a_file_that_is_no_session_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A foreign file under the name is no session of ours, and is said to be none."""
    stay_in_front(monkeypatch)
    (tmp_path / "notes.cmd").write_bytes(b"n" * 4096)
    done = run_here("watch", f"file:{tmp_path / 'notes'}")
    assert done.status == 3
    assert "magic of the command segment: expected b'TUBE.CMD', found b'nnnnnnnn'" in done.stderr


def test_on_a_terminal_it_draws_a_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """The table has a row for each figure, and says what is missing before the physics process is there."""
    from rich.console import Console

    figures = {
        "session": "shm:x",
        "state": "offered",
        "agent": {"pid": 7, "life": "stopped"},
        "physics": None,
    }
    console = Console(width=60, record=True, file=io.StringIO())
    console.print(watch._draw(figures | {"step": None}))
    rows = [line.split() for line in console.export_text().splitlines()]
    assert rows == [
        ["session", "shm:x"],
        ["state", "offered"],
        ["agent", "7", "stopped"],
        ["physics", "none", "yet"],
    ]


def stay_in_front(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the tests' own process at its priority."""
    monkeypatch.setattr(watch, "step_back", lambda: None)


def _found(name: str) -> Found:
    return Found(Rendezvous("shm", name), Standing.LIVE, "its agent (pid 1) lives", 0)
