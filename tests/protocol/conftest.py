"""Shared means of the protocol's tests: unique names, peers that end with their test, every transport."""

from __future__ import annotations

import importlib.util
import json
import os
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from protocol.agent import AgentSession, SessionSettings
from protocol.compiled_choice import ENVIRONMENT
from protocol.liveness import describe_exit
from protocol.plant import PARAMETER_INDEX, CommandBatch, ResetBatch
from protocol.toy import DEFAULTS
from protocol.twin import open_twin

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
PATIENCE_S = 20.0
SOAK_PATIENCE_S = 120.0


def _load_peers() -> ModuleType:
    spec = importlib.util.spec_from_file_location("protocol_test_peers", HERE / "peers.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session", autouse=True)
def heed_interrupts() -> Iterator[None]:
    """Let peers heed SIGINT: a shell that runs the tests in the background has it ignored by all who inherit that."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def peers() -> ModuleType:
    """The module of misbehaving plants and of programs to start."""
    return _load_peers()


@pytest.fixture
def name() -> Iterator[str]:
    """A name of shared memory that nobody else has; the test fails if it leaves something behind."""
    name = f"cosim-test-{os.getpid()}-{secrets.token_hex(4)}"
    yield name
    left = [path.name for path in Path("/dev/shm").glob(f"{name}*")]
    for path in Path("/dev/shm").glob(f"{name}*"):
        path.unlink()
    assert left == []


@pytest.fixture(params=["shm", "file"])
def rendezvous(request: pytest.FixtureRequest, name: str, tmp_path: Path) -> Iterator[str]:
    """A rendezvous of each transport; the test fails if a segment is left behind."""
    if request.param == "shm":
        yield f"shm:{name}"
        return
    folder = tmp_path / "segments"
    folder.mkdir()
    yield f"file:{folder / 'session'}"
    assert list(folder.iterdir()) == []


Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def trace(tmp_path: Path) -> Path:
    """The file in which a RecordingPlant notes what it was asked."""
    return tmp_path / "serve.txt"


@pytest.fixture
def flown(tmp_path: Path) -> Path:
    """The file in which an agent that was started notes its last step."""
    return tmp_path / "fly.txt"


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start `peers.py` with a part and a rendezvous; what still runs after the test is killed."""
    started: list[subprocess.Popen[str]] = []

    def run(part: str, rendezvous: str, *arguments: object) -> subprocess.Popen[str]:
        notes = tmp_path / f"{part}.txt"
        command = [sys.executable, str(HERE / "peers.py"), part, rendezvous, str(notes), *map(str, arguments)]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        started.append(subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True))
        return started[-1]

    yield run
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate(timeout=PATIENCE_S)


@pytest.fixture
def watch() -> Callable[[subprocess.Popen[str]], Callable[[], str | None]]:
    """Make a launcher's view of a process."""

    def make(process: subprocess.Popen[str]) -> Callable[[], str | None]:
        def look() -> str | None:
            code = process.poll()
            return None if code is None else describe_exit(code)

        return look

    return make


Open = Callable[..., AgentSession]


@pytest.fixture(params=["twin", "shm", "file", "compiled"])
def open_session(
    request: pytest.FixtureRequest,
    name: str,
    trace: Path,
    tmp_path: Path,
    start: Start,
    peers: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Open]:
    """Open a session over a RecordingPlant: in memory, with a second process over either transport, and compiled."""
    opened: list[AgentSession] = []
    if request.param == "compiled":
        pytest.importorskip("numba", reason="numba is not installed: pip install numba")
    monkeypatch.setenv(ENVIRONMENT, "compiled" if request.param == "compiled" else "stdlib")

    def run(lanes: int = 1, dt: float = 0.1, inner_steps: int = 4, tube_slots: int = 4) -> AgentSession:
        settings = SessionSettings(lanes, dt, dt / inner_steps, tube_slots)
        if request.param == "twin":
            opened.append(open_twin(peers.RecordingPlant(trace), settings))
        else:
            place = f"file:{tmp_path / 'session'}" if request.param == "file" else f"shm:{name}"
            start("serve", place)
            opened.append(AgentSession.open(place, settings, attach_timeout=PATIENCE_S))
        return opened[-1]

    yield run
    for session in opened:
        session.close()
    assert list(tmp_path.glob("session*")) == []


@pytest.fixture
def resets() -> Callable[..., ResetBatch]:
    """Make resets of all lanes at rest at the origin, with the toy's default parameters or others by name."""

    def make(lanes: int = 1, **parameters: float) -> ResetBatch:
        batch = ResetBatch.zeros(lanes)
        batch.selected[:] = 1
        batch.parameters[:, : len(DEFAULTS)] = DEFAULTS
        for key, value in parameters.items():
            batch.parameters[:, PARAMETER_INDEX[key]] = value
        return batch

    return make


@pytest.fixture
def commands() -> Callable[..., CommandBatch]:
    """Make the same command for all lanes: along x, with a speed and a compensation."""

    def make(lanes: int = 1, speed: float = 1.0, compensation: float = 1.0) -> CommandBatch:
        batch = CommandBatch.zeros(lanes)
        batch.direction[:, 0] = 1.0
        batch.speed[:], batch.compensation[:] = speed, compensation
        return batch

    return make


@pytest.fixture
def eventually() -> Callable[[Callable[[], bool]], None]:
    """Wait until something holds, or fail."""

    def wait(holds: Callable[[], bool]) -> None:
        patience = time.monotonic() + PATIENCE_S
        while not holds():
            assert time.monotonic() < patience, "it never came true"
            time.sleep(0.005)

    return wait


@pytest.fixture(scope="session")
def soak() -> Callable[..., dict[str, Any]]:
    """Run `tests/soak`, which forks its peers and so wants a process without threads, and return what it found."""

    def run(*arguments: str) -> dict[str, Any]:
        done = subprocess.run(
            [sys.executable, str(ROOT / "tests" / "soak"), *arguments, "--json"],
            check=False,
            capture_output=True,
            text=True,
            timeout=SOAK_PATIENCE_S,
            env=os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"},
        )
        assert done.stdout, done.stderr
        return dict(json.loads(done.stdout))

    return run
