"""`python -m physics_server` as a process of its own: it serves a session, and ends as it says."""

from __future__ import annotations

import signal
import subprocess
import sys
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from physics_server.bullet import BulletPlant
from physics_server.null import NullPlant
from physics_server.parameters import BodyParameters
from physics_server.reference import ReferencePlant
from protocol.agent import AgentSession, SessionSettings
from protocol.errors import PeerLost, Refusal
from protocol.plant import NO_TUBE, CommandBatch, ResetBatch
from protocol.twin import open_twin

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = SessionSettings(lanes=2, dt=0.1, physics_dt=1 / 240)
DEADLINE = 30.0


@pytest.fixture
def rendezvous() -> str:
    """A name that no other test uses."""
    return f"shm:test-physics-{uuid.uuid4().hex[:12]}"


@pytest.fixture
def start() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start the program with arguments; whatever still runs in the end is killed."""
    started: list[subprocess.Popen[str]] = []

    def run(*arguments: str, before: str = "") -> subprocess.Popen[str]:
        code = f"import runpy, sys; {before}; runpy.run_module('physics_server', run_name='__main__')"
        command = ["-c", code] if before else ["-m", "physics_server"]
        started.append(
            subprocess.Popen(
                [sys.executable, *command, *arguments],
                cwd=ROOT,
                text=True,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
            )
        )
        return started[-1]

    yield run
    for process in started:
        process.kill()
        process.communicate()


def resets(tube: int = NO_TUBE) -> ResetBatch:
    """Both lanes at the start of a tube, 0.1 m apart."""
    batch = ResetBatch.zeros(2)
    batch.selected[:] = 1
    batch.tube[:] = tube
    batch.position[:] = [[1, 0, 0], [1, 0, 0.1]]
    row = BodyParameters(gust=0.5).row()
    batch.parameters[:, : len(row)] = row
    return batch


def fly(session: AgentSession, tube: Any, steps: int = 30) -> list[bytes]:
    """Register a tube, reset into it and fly into its wall; the bytes of every pose batch."""
    session.register_tube(0, tube)
    poses = [session.reset(resets(tube=0)).raw.tobytes()]
    command = CommandBatch.zeros(2)
    command.direction[:] = [0.8, 0.6, 0.0]
    command.speed[:] = 1.5
    command.compensation[:] = 0.9
    poses += [session.step(command).raw.tobytes() for _ in range(steps)]
    return poses


def test_the_process_flies_as_the_plant_does_in_this_one(
    start: Callable[..., Any], rendezvous: str, tube_file: Callable[..., Any]
) -> None:
    """A session with the process answers with the same bytes as the twin; it ends with 0 and says nothing."""
    tube = tube_file()
    with open_twin(BulletPlant(), SETTINGS) as twin:
        expected = fly(twin, tube)
        described = twin.description
    process = start(rendezvous)
    with AgentSession.open(rendezvous, SETTINGS, attach_timeout=DEADLINE) as session:
        assert session.description == described
        assert session.description.engine.startswith("bullet 3.")
        assert fly(session, tube) == expected
    contacts = np.frombuffer(expected[-1], np.int64).reshape(2, 16)[:, 14]
    assert contacts.any()
    out, err = process.communicate(timeout=DEADLINE)
    assert (process.returncode, out, err) == (0, "", "")


def test_a_refused_tube_leaves_the_session_alive(
    start: Callable[..., Any], rendezvous: str, tube_file: Callable[..., Any]
) -> None:
    """The process reports a file that changed and flies on; a tube in use cannot be released."""
    tube = tube_file()
    changed = tube_file(radius=0.5)
    Path(changed.path).write_text(Path(tube.path).read_text())
    start(rendezvous)
    with AgentSession.open(rendezvous, SETTINGS, attach_timeout=DEADLINE) as session:
        fly(session, tube, steps=1)
        with pytest.raises(Refusal, match=changed.sha256):
            session.register_tube(1, changed)
        with pytest.raises(Refusal):
            session.release_tube(0)
        assert session.reset(resets()).step.tolist() == [0, 0]
        session.release_tube(0)


def test_the_null_engine_counts_and_moves_nothing(start: Callable[..., Any], rendezvous: str) -> None:
    """With --engine null poses are those of the reset, steps and time count, and no mesh is looked at."""
    process = start(rendezvous, "--engine", "null")
    command = CommandBatch.zeros(2)
    command.direction[:, 2] = 1.0
    with AgentSession.open(rendezvous, SETTINGS, attach_timeout=DEADLINE) as session:
        assert session.description.engine == "null"
        first = session.reset(resets()).raw.copy()
        for _ in range(3):
            poses = session.step(command)
        assert np.array_equal(poses.raw[:, :13], first[:, :13])
        assert poses.step.tolist() == [3, 3]
        assert poses.sim_time.tolist() == [3 * 0.1] * 2
        second = resets()
        second.selected[0] = 0
        poses = session.reset(second)
        assert poses.step.tolist() == [3, 0]
    assert process.wait(DEADLINE) == 0


def test_the_reference_engine_flies_as_in_this_process(
    start: Callable[..., Any], rendezvous: str, tube_file: Callable[..., Any]
) -> None:
    """With --engine reference a tube is refused, and free flight is the twin's to the byte."""
    command = CommandBatch.zeros(2)
    command.direction[:] = [0.8, 0.6, 0.0]
    command.speed[:] = 1.5

    def fly_free(session: AgentSession) -> list[bytes]:
        with pytest.raises(Refusal, match="reference 1 has no walls"):
            session.register_tube(0, tube_file())
        poses = [session.reset(resets()).raw.tobytes()]
        return poses + [session.step(command).raw.tobytes() for _ in range(30)]

    with open_twin(ReferencePlant(), SETTINGS) as twin:
        expected = fly_free(twin)
        described = twin.description
    process = start(rendezvous, "--engine", "reference")
    with AgentSession.open(rendezvous, SETTINGS, attach_timeout=DEADLINE) as session:
        assert session.description == described
        assert session.description.engine == "reference 1"
        assert fly_free(session) == expected
    out, err = process.communicate(timeout=DEADLINE)
    assert (process.returncode, out, err) == (0, "", "")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_and_the_agent_is_told(
    start: Callable[..., Any], rendezvous: str, number: signal.Signals
) -> None:
    """SIGTERM and SIGINT end the process with 128 + n and without a word; the agent learns of it."""
    process = start(rendezvous)
    command = CommandBatch.zeros(2)
    command.direction[:, 2] = 1.0
    with AgentSession.open(rendezvous, SETTINGS, attach_timeout=DEADLINE) as session:
        session.reset(resets())
        process.send_signal(number)
        out, err = process.communicate(timeout=DEADLINE)
        with pytest.raises(PeerLost):
            session.step(command)
    assert (process.returncode, out, err) == (128 + number, "", "")


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        ((), 2, "RENDEZVOUS"),
        (("nowhere",), 2, "expected shm:NAME or file:/path/stem, found 'nowhere'"),
        (("shm:test-physics-none", "--engine", "unity"), 2, "invalid choice: 'unity'"),
        (("shm:test-physics-none", "--attach-timeout", "0.1"), 3, "test-physics-none"),
        (("shm:test-physics-none", "--attach-timeout", "nan"), 2, "finite time in seconds >= 0, found 'nan'"),
        (("shm:test-physics-none", "--attach-timeout", "inf"), 2, "finite time in seconds >= 0, found 'inf'"),
        (("shm:test-physics-none", "--attach-timeout", "-1"), 2, "finite time in seconds >= 0, found '-1'"),
        (
            ("shm:test-physics-none", "--attach-timeout", "soon"),
            2,
            "finite time in seconds >= 0, found 'soon'",
        ),
        (("shm:test-physics-none", "--launcher", "0"), 2, "expected a process id >= 1, found '0'"),
        (("shm:test-physics-none", "--launcher", "me"), 2, "expected a process id >= 1, found 'me'"),
    ],
)
def test_what_cannot_be_served_is_said(
    start: Callable[..., Any], arguments: tuple[str, ...], status: int, said: str
) -> None:
    """Bad usage ends with 2 and no session in time with 3; the last line on stderr says what was wrong."""
    process = start(*arguments)
    out, err = process.communicate(timeout=DEADLINE)
    assert (process.returncode, out) == (status, "")
    assert said in err.splitlines()[-1]
    assert "Traceback" not in err


def test_it_ends_with_its_launcher_before_a_session(start: Callable[..., Any], rendezvous: str) -> None:
    """A launcher that is killed before it offers a session takes the process with it, long before its timeout."""
    idle = "import sys; sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", idle], stdin=subprocess.PIPE) as launcher:
        pid = str(launcher.pid)
        process = start(rendezvous, "--engine", "null", "--attach-timeout", "600", "--launcher", pid)
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(1.0)
        launcher.kill()
        out, err = process.communicate(timeout=DEADLINE)
    assert (process.returncode, out, err.count("\n")) == (3, "", 1)
    assert f"lost launcher (pid {pid}) at step 0, phase attach: ended before a session was offered" in err
    late = start(rendezvous, "--engine", "null", "--attach-timeout", "600", "--launcher", pid)
    assert late.wait(DEADLINE) == 3


def test_a_session_outlives_the_launcher(start: Callable[..., Any], rendezvous: str) -> None:
    """Once the session is there it is the agent that counts, and the launcher may go."""
    idle = "import sys; sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", idle], stdin=subprocess.PIPE) as launcher:
        process = start(rendezvous, "--engine", "null", "--launcher", str(launcher.pid))
        with AgentSession.open(rendezvous, SETTINGS, attach_timeout=DEADLINE) as session:
            launcher.kill()
            launcher.wait(DEADLINE)
            assert session.reset(resets()).step.tolist() == [0, 0]
    assert process.wait(DEADLINE) == 0


def test_a_missing_engine_is_explained(start: Callable[..., Any], rendezvous: str) -> None:
    """Where pybullet cannot be imported, one line says so and what to do; the null engine works all the same."""
    process = start(rendezvous, before="sys.modules['pybullet'] = None")
    out, err = process.communicate(timeout=DEADLINE)
    assert (process.returncode, out, err.count("\n")) == (2, "", 1)
    assert "needs pybullet" in err
    assert "wheels of it for Linux" in err


def test_starting_imports_only_what_flying_needs() -> None:
    """The process starts without numba, trimesh, scipy or torch: it is ready in a fraction of a second."""
    code = (
        "import sys, physics_server.__main__, physics_server.bullet; "
        "print([m for m in ('numba', 'trimesh', 'scipy', 'torch', 'agent_client', 'cosim') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=DEADLINE, check=True
    )
    assert done.stdout.strip() == "[]"


def test_the_null_plant_is_the_same_in_a_twin() -> None:
    """The null engine stands behind the same contract in one process."""
    with open_twin(NullPlant(), SETTINGS) as session:
        session.reset(resets())
        command = CommandBatch.zeros(2)
        command.direction[:, 0] = 1.0
        assert session.step(command).step.tolist() == [1, 1]
