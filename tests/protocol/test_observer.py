"""Observers: what they see is whole, and nobody notices them."""

from __future__ import annotations

import mmap
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
import stamped

from protocol import handshake, layout
from protocol.agent import AgentSession, SessionSettings
from protocol.errors import HandshakeError, SessionError
from protocol.handshake import Answer, Offer
from protocol.layout import COMMAND, POSE, Op, write_i64
from protocol.liveness import Life, start_time
from protocol.observer import Observer, Request, Snapshot, sessions
from protocol.plant import CommandBatch
from protocol.states import State
from protocol.toy import ToyPlant

PATIENCE_S = 20.0
LANES = 64

Start = Callable[..., subprocess.Popen[str]]


def first_steps(observer: Observer, steps: int = 3) -> Snapshot:
    """Wait until some steps are integrated."""
    patience = time.monotonic() + PATIENCE_S
    while time.monotonic() < patience:
        snapshot = observer.wait_for_new(1.0)
        if snapshot is not None and snapshot.step >= steps:
            return snapshot
    raise AssertionError("no steps came")


def ended(observer: Observer) -> str:
    """Wait for the session's end; returns why it ended, in the words of whoever survived."""
    patience = time.monotonic() + PATIENCE_S
    while not observer.status().ended:
        assert time.monotonic() < patience, "the session never ended"
        time.sleep(0.01)
    time.sleep(0.2)  # the survivor looks every 30 ms
    return observer.status().why


def assert_whole(snapshot: Snapshot) -> None:
    """Every word of every lane is that of the reply's step."""
    poses = snapshot.poses
    assert np.all(poses.raw[:, :14] == snapshot.step)
    assert np.all(poses.contact_steps == snapshot.step)
    assert np.all(poses.step == snapshot.step)


def assert_due(request: Request, expected: CommandBatch) -> None:
    """Every command is the one of the request's step."""
    if request.op == Op.STEP:
        stamped.stamp(expected, request.step)
        assert np.array_equal(request.commands.raw, expected.raw)


def test_no_reading_is_torn_while_the_writers_run_at_full_speed(rendezvous: str) -> None:
    """Of thousands of replies and requests read from a session at full speed, none mixes two steps."""
    expected = CommandBatch.zeros(LANES)
    seen: set[int] = set()
    with (
        stamped.part("serve", rendezvous),
        stamped.part("fly", rendezvous, LANES) as agent,
        Observer.attach(rendezvous, timeout=PATIENCE_S) as observer,
    ):
        first_steps(observer)
        whole, patience = 0, time.monotonic() + PATIENCE_S
        while whole < 3000 or len(seen) < 50:
            assert time.monotonic() < patience, f"{whole} readings, {len(seen)} steps"
            snapshot, request = observer.latest(), observer.request()
            if snapshot is not None:
                assert_whole(snapshot)
                assert not seen or snapshot.step >= max(seen)
                seen.add(snapshot.step)
                whole += 1
            if request is not None:
                assert_due(request, expected)
        agent.kill()
        agent.wait()
        ended(observer)


def test_no_reading_is_torn_while_a_writer_is_stopped_again_and_again(rendezvous: str) -> None:
    """A writer that is stopped at any moment, also in mid-write, shows whole poses or none."""
    with (
        stamped.part("serve", rendezvous) as physics,
        stamped.part("fly", rendezvous, 1024) as agent,
        Observer.attach(rendezvous, timeout=PATIENCE_S) as observer,
    ):
        first_steps(observer)
        for _ in range(40):
            physics.send_signal(signal.SIGSTOP)
            for _ in range(5):
                snapshot = observer.latest()
                if snapshot is not None:
                    assert_whole(snapshot)
            physics.send_signal(signal.SIGCONT)
            time.sleep(0.003)
        agent.kill()
        agent.wait()
        ended(observer)


@contextmanager
def session_by_hand(folder: Path, lanes: int = 2) -> Iterator[tuple[str, memoryview, memoryview]]:
    """Two files with headers as an agent and a physics process write them; nobody stands behind them."""
    pid = os.getpid()
    offer = Offer(SessionSettings(lanes, 0.1, 0.1), os.urandom(16), pid, start_time(pid))
    views = []
    for suffix, size in ((".cmd", layout.command_bytes(lanes)), (".pose", layout.pose_bytes(lanes))):
        path = folder / f"by-hand{suffix}"
        path.write_bytes(bytes(size))
        with path.open("r+b") as file:
            views.append(memoryview(mmap.mmap(file.fileno(), 0)))
    handshake.write_offer(views[0], offer)
    handshake.write_answer(views[1], offer, Answer(ToyPlant().describe(), pid, start_time(pid)))
    yield f"file:{folder / 'by-hand'}", views[0], views[1]
    for view in views:
        view.release()


def test_a_message_that_stays_half_written_is_given_up_and_counted(tmp_path: Path) -> None:
    """Between `begin` and `end` there is no snapshot, however long the writer takes; behind it there is."""
    with session_by_hand(tmp_path) as (rendezvous, _, pose), Observer.attach(rendezvous) as observer:
        assert observer.latest() is None
        assert observer.torn == 0
        write_i64(pose, POSE["begin"], 1)
        pose[layout.pose_rows(2)] = np.full((2, 16), 7.0).tobytes()
        write_i64(pose, POSE["end"], 0)
        assert observer.latest() is None
        assert observer.torn == 1
        write_i64(pose, POSE["end"], 1)
        write_i64(pose, POSE["doorbell"], 1)
        snapshot = observer.wait_for_new(PATIENCE_S)
        assert snapshot is not None
        assert snapshot.number == 1
        assert np.all(snapshot.poses.raw == 7.0)
        write_i64(pose, POSE["begin"], 2)
        assert observer.latest() is None
        assert observer.torn == 2


def test_doorbells_that_do_not_fit_together_are_the_end(tmp_path: Path) -> None:
    """A reply to a request that nobody made is shown as a broken session."""
    with session_by_hand(tmp_path) as (rendezvous, _, pose), Observer.attach(rendezvous) as observer:
        assert observer.status().state is State.READY
        write_i64(pose, POSE["doorbell"], 3)
        assert observer.status().state is State.BROKEN
        assert "doorbells" in observer.status().why


@pytest.mark.parametrize(
    ("op", "state"),
    [
        (Op.STEP, State.STEPPING),
        (Op.RESET, State.RESETTING),
        (Op.REGISTER_TUBE, State.REGISTERING),
        (Op.RELEASE_TUBE, State.RELEASING),
        (Op.GOODBYE, State.CLOSING),
    ],
)
def test_the_state_follows_the_words(tmp_path: Path, op: Op, state: State) -> None:
    """A request under way is shown as the state it leads to, and its reply as the state after it."""
    with session_by_hand(tmp_path) as (rendezvous, command, pose), Observer.attach(rendezvous) as observer:
        for name, value in (("begin", 1), ("op", op), ("step", 0), ("end", 1)):
            write_i64(command, COMMAND[name], value)
            assert observer.status().state is State.READY
        write_i64(command, COMMAND["doorbell"], 1)
        assert observer.status().state is state
        request = observer.request()
        assert request is not None
        assert (request.number, request.op) == (1, op)
        write_i64(pose, POSE["doorbell"], 1)
        assert observer.status().state is (State.CLOSED if op is Op.GOODBYE else State.READY)


def test_an_observer_has_no_way_to_write(rendezvous: str) -> None:
    """Its mappings are read-only in the eyes of the system and of Python, and so are its snapshots."""
    with (
        stamped.part("serve", rendezvous),
        stamped.part("fly", rendezvous, 1) as agent,
        Observer.attach(rendezvous, timeout=PATIENCE_S) as observer,
    ):
        snapshot = first_steps(observer)
        stem = rendezvous.split(":")[1]
        maps = [line.split() for line in Path("/proc/self/maps").read_text().splitlines() if stem in line]
        assert sorted(line[1] for line in maps) == ["r--s", "r--s"]
        with pytest.raises(TypeError):
            observer._pose[0] = 1
        with pytest.raises(ValueError, match="read-only"):
            snapshot.poses.position[0, 0] = 1.0
        agent.kill()
        agent.wait()
        ended(observer)


def test_the_process_of_a_session_may_not_observe_it(rendezvous: str) -> None:
    """Looking on from the agent's own process is refused, and the agent keeps its lock."""
    with AgentSession.offer(rendezvous, SessionSettings(1, 0.1, 0.1)):
        with pytest.raises(SessionError, match="observe it from another process"):
            Observer.attach(rendezvous)
        code = (
            "import sys; from protocol.memory import parse_rendezvous as read; "
            "from protocol.read_only import open_read_only; "
            "print(open_read_only(read(sys.argv[1]), '.cmd').locked())"
        )
        command = [sys.executable, "-c", code, rendezvous]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE_S)
        assert done.stdout.strip() == "True"


def test_a_session_is_seen_from_its_offer_to_its_goodbye(rendezvous: str) -> None:
    """An observer sees a session that waits for its physics side, then its steps, then its orderly end."""
    with stamped.part("fly", rendezvous, 2, 300), Observer.attach(rendezvous, timeout=PATIENCE_S) as observer:
        status = observer.status()
        assert status.state is State.OFFERED
        assert (status.physics.pid, status.agent.life) == (0, Life.RUNNING)
        assert observer.description is None
        assert observer.latest() is None
        assert observer.request() is None
        assert observer.wait_for_new(0.05) is None
        assert observer.settings == SessionSettings(2, 0.1, 0.1)
        with stamped.part("serve", rendezvous):
            first_steps(observer, 1)
            assert observer.description is not None
            assert observer.description.name == "stamp"
            assert ended(observer) == "goodbye"
        status, snapshot = observer.status(), observer.latest()
        assert status.state is State.CLOSED
        assert snapshot is not None
        assert snapshot.step == 300
        assert_whole(snapshot)
        assert observer.wait_for_new(PATIENCE_S) is None  # at once: nothing more can come


def test_waiting_gives_each_reply_at_most_once(rendezvous: str) -> None:
    """What `wait_for_new` returns is newer every time."""
    with (
        stamped.part("serve", rendezvous),
        stamped.part("fly", rendezvous, 1) as agent,
        Observer.attach(rendezvous, timeout=PATIENCE_S) as observer,
    ):
        first_steps(observer)
        numbers = [snapshot.number for _ in range(20) if (snapshot := observer.wait_for_new(1.0)) is not None]
        assert len(numbers) > 1
        assert numbers == sorted(set(numbers))
        agent.kill()
        agent.wait()
        ended(observer)


@pytest.mark.parametrize("victim", ["agent", "physics"])
def test_a_killed_side_is_named(rendezvous: str, victim: str) -> None:
    """After kill -9 of either side the session is broken, and the reason names who is dead."""
    with (
        stamped.part("serve", rendezvous) as physics,
        stamped.part("fly", rendezvous, 1) as agent,
        Observer.attach(rendezvous, timeout=PATIENCE_S) as observer,
    ):
        first_steps(observer)
        killed = {"agent": agent, "physics": physics}[victim]
        killed.kill()
        why = ended(observer)
        assert f"{victim} (pid {killed.pid}) is dead: killed by SIGKILL" in why
        assert f"it gave up: lost {victim} (pid {killed.pid})" in why
        assert observer.status().state is State.BROKEN


def test_a_farewell_is_passed_on(rendezvous: str, start: Start, peers: object) -> None:
    """An engine that fails ends the session with its own words."""
    start("fly", rendezvous, peers.FAIL)  # type: ignore[attr-defined]
    with Observer.attach(rendezvous, timeout=PATIENCE_S) as observer:
        start("serve", rendezvous)  # not before: the session ends with its first step
        assert "failed: ZeroDivisionError: the engine exploded" in ended(observer)


def test_a_stopped_side_is_seen(rendezvous: str, start: Start) -> None:
    """SIGSTOP shows as a stopped process in a session that goes on."""
    with start_pair(start, rendezvous) as observer:
        first_steps(observer)
        os.kill(observer.status().physics.pid, signal.SIGSTOP)
        time.sleep(0.05)
        status = observer.status()
        assert status.physics.life is Life.STOPPED
        assert not status.ended
        os.kill(status.physics.pid, signal.SIGCONT)
        first_steps(observer)
        os.kill(status.agent.pid, signal.SIGTERM)
        assert ended(observer)  # by its goodbye, or told to stop in the middle of a step


@contextmanager
def start_pair(start: Start, rendezvous: str, speed: float = 1.0) -> Iterator[Observer]:
    """An observer of a session between two of the peers."""
    start("serve", rendezvous)
    start("fly", rendezvous, speed)
    with Observer.attach(rendezvous, timeout=PATIENCE_S) as observer:
        yield observer


def test_a_wrong_name_lists_what_runs(name: str, start: Start) -> None:
    """Whoever mistypes a session's name is told which ones are running; the bare name finds it."""
    start("serve", f"shm:{name}")
    agent = start("fly", f"shm:{name}")
    with Observer.attach(name, timeout=PATIENCE_S) as observer:
        first_steps(observer)
        assert str(observer.rendezvous) == f"shm:{name}"
        assert f"shm:{name}" in [str(found.rendezvous) for found in sessions()]
        with pytest.raises(SessionError, match=f"running now: .*shm:{name}"):
            Observer.attach(f"{name}-mistyped")
        agent.send_signal(signal.SIGTERM)
        ended(observer)
    with pytest.raises(SessionError, match=r"found none within 0\.1 s"):
        Observer.attach(name, timeout=0.1)


@pytest.mark.parametrize("where", ["", "no/name", "tcp:host"])
def test_what_is_no_name_is_refused(where: str) -> None:
    """A text that is neither a name nor a rendezvous is refused with what was expected."""
    with pytest.raises(SessionError, match="expected"):
        Observer.attach(where)


def test_another_version_and_foreign_files_are_refused(tmp_path: Path) -> None:
    """A major version that we do not speak, a foreign magic and a short file are named; they are left as they are."""
    with session_by_hand(tmp_path) as (rendezvous, command, _):
        write_i64(command, COMMAND["version_major"], 2)
        with pytest.raises(HandshakeError, match="version_major of the command segment: expected 1, found 2"):
            Observer.attach(rendezvous)
        write_i64(command, COMMAND["version_major"], 1)
        write_i64(command, COMMAND["version_minor"], 99)
        Observer.attach(rendezvous).close()
        command[:8] = b"ELSEWISE"
        with pytest.raises(HandshakeError, match="magic of the command segment"):
            Observer.attach(rendezvous)
        command[:8] = bytes(8)
        with pytest.raises(SessionError, match="found none"):
            Observer.attach(rendezvous)
    (tmp_path / "short.cmd").write_bytes(b"TUBE.CMD")
    with pytest.raises(HandshakeError, match=r"size of .*short\.cmd"):
        Observer.attach(f"file:{tmp_path / 'short'}")


def test_a_header_of_another_session_is_never_taken(tmp_path: Path) -> None:
    """A physics header that does not echo the agent's is a broken session, not a plant."""
    with session_by_hand(tmp_path) as (rendezvous, _, pose), Observer.attach(rendezvous) as observer:
        pose[32:48] = bytes(16)
        assert observer.status().state is State.BROKEN
        assert "session: expected" in observer.status().why
        with pytest.raises(HandshakeError, match="session"):
            assert observer.description
