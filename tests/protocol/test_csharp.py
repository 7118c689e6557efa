"""The C# server: the toy bit for bit, the kit over both transports, a whole flight, death of either side."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import kit
import numpy as np
import pytest
from csharp import (
    DT,
    INNER_STEPS,
    MONO,
    PATIENCE_S,
    SOURCES,
    Serve,
    build,
    needs_mono,
    open_session,
    random_commands,
    random_resets,
    run_rules,
    serving,
)
from flights import run_cosim

from protocol.agent import SessionSettings
from protocol.conformance.rule import Level
from protocol.errors import PeerLost, Verdict
from protocol.plant import CommandBatch, ResetBatch
from protocol.toy import DEFAULTS, SPEED_MAX, ToyPlant
from protocol.twin import open_twin

pytestmark = needs_mono

LANES = 3

Commands = Callable[..., CommandBatch]
Folder = pytest.TempPathFactory
Resets = Callable[..., ResetBatch]
Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture(scope="session")
def server(tmp_path_factory: Folder) -> Path:
    """The console server."""
    return build(tmp_path_factory.mktemp("csharp") / "ToyServer.exe", "TubeCosim.ToyServer")


@pytest.fixture
def serve(rendezvous: str) -> Iterator[Serve]:
    """Start a program at the rendezvous; it has to end by itself within the test."""
    with serving(rendezvous) as start:
        yield start


def test_the_server_repeats_the_toy_bit_for_bit(serve: Serve, server: Path, rendezvous: str) -> None:
    """2,000 control steps of three bodies that are reset now and then end in Python's very bits."""
    process = serve(server)
    rng = np.random.default_rng(4)
    settings = SessionSettings(LANES, DT, DT / INNER_STEPS)
    with open_session(rendezvous, LANES) as there, open_twin(ToyPlant(), settings) as here:
        assert (there.description.defaults, there.description.speed_max) == (DEFAULTS, SPEED_MAX)
        for episode in range(40):
            resets = random_resets(rng, LANES)
            resets.selected[:] = rng.integers(0, 2, LANES) if episode else 1
            assert there.reset(resets).raw.tobytes() == here.reset(resets).raw.tobytes()
            for _ in range(50):
                commands = random_commands(rng, LANES)
                assert there.step(commands).raw.tobytes() == here.step(commands).raw.tobytes()
    assert process.wait(PATIENCE_S) == 0


def test_the_server_passes_the_suite(server: Path) -> None:
    """Every rule that is not about speed holds, but for those that need walls or gusts; its page says how many."""
    found = run_rules(server, "shm", Level.CORE, Level.ROBUSTNESS, Level.LANES)
    assert found == ([], kit.SKIPPED)
    assert kit.count_in_words() in " ".join((SOURCES / "README.md").read_text().split())


def test_the_server_keeps_the_rules_over_files(server: Path) -> None:
    """Every rule that the transport could touch holds over ordinary mapped files too."""
    failed, skipped = kit.run(f"{MONO} {server}", "file", kit.transported_rules())
    assert failed == []
    assert skipped.items() <= kit.SKIPPED.items()


def test_a_signal_ends_the_server_with_a_farewell(
    serve: Serve, server: Path, rendezvous: str, resets: Resets, commands: Commands
) -> None:
    """SIGTERM is told to the agent as what it is."""
    process = serve(server)
    with open_session(rendezvous) as session:
        session.reset(resets())
        process.send_signal(signal.SIGTERM)
        process.wait(PATIENCE_S)
        with pytest.raises(PeerLost, match=r"told to stop \(signal 15\)") as caught:
            session.step(commands())
        assert caught.value.verdict is Verdict.LEFT


def test_a_killed_server_is_noticed(
    serve: Serve, server: Path, rendezvous: str, resets: Resets, commands: Commands
) -> None:
    """Its agent gets a typed error, and no segment stays."""
    process = serve(server)
    with open_session(rendezvous) as session:
        session.reset(resets())
        process.kill()
        with pytest.raises(PeerLost) as caught:
            session.step(commands())
        assert caught.value.verdict is Verdict.EXITED


def test_the_server_of_a_killed_agent_clears_up(
    serve: Serve, server: Path, rendezvous: str, start: Start, eventually: Callable[..., None], tmp_path: Path
) -> None:
    """It ends with what happened, and removes the segments that the agent could not."""
    process = serve(server)
    agent = start("fly", rendezvous)
    notes = tmp_path / "fly.txt"
    eventually(lambda: notes.exists() and notes.read_text().startswith("step"))
    agent.kill()
    _, printed = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 3
    assert "its process is gone" in printed


def test_a_second_server_leaves_without_a_trace(
    serve: Serve, server: Path, rendezvous: str, resets: Resets, commands: Commands
) -> None:
    """The session that the first one serves goes on."""
    serve(server)
    with open_session(rendezvous) as session:
        session.reset(resets())
        second = serve(server)
        _, printed = second.communicate(timeout=PATIENCE_S)
        assert second.returncode == 3
        assert "another physics process" in printed
        assert session.step(commands()).step[0] == 1


def test_the_server_says_what_is_wrong_with_its_command_line(server: Path) -> None:
    """No rendezvous, or one that is none, is answered with what was expected."""
    for arguments, status, words in ((["shm:.x"], 3, "found shm:.x"), ([], 2, "usage:")):
        done = subprocess.run(
            [*MONO.split(), str(server), *arguments], capture_output=True, text=True, check=False, timeout=30
        )
        assert done.returncode == status
        assert words in done.stderr


def test_the_shipped_policy_flies_the_shipped_conduit(server: Path, name: str, tmp_path: Path) -> None:
    """`cosim launch --connect` against the C# server succeeds, says that it judges contact itself, leaves nothing."""
    with subprocess.Popen([*MONO.split(), str(server), f"shm:{name}"]) as process:
        try:
            done = run_cosim("launch", "--json", "--connect", f"shm:{name}", "--out", "run", cwd=tmp_path)
            assert done.status == 0, done.stderr
            assert process.wait(PATIENCE_S) == 0
        finally:
            process.kill()
    assert done.report["outcome"] == "success"
    assert "protocol.csharp" in done.stderr
    assert "the physics side has no walls" in done.stderr
