"""The C server passes the suite and repeats the toy bit for bit; its library serves a plant of one's own."""

from __future__ import annotations

import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import kit
import numpy as np
import pytest

from protocol import bindings
from protocol.agent import AgentSession, SessionSettings
from protocol.conformance.rule import Level
from protocol.conformance.run import select
from protocol.errors import PeerLost, Refusal, RefusalCode, Verdict
from protocol.plant import CommandBatch, ResetBatch, TubeReference
from protocol.toy import DEFAULTS, SPEED_MAX, ToyPlant
from protocol.twin import open_twin

C_FOLDER = bindings.C_HEADER.parent
LIBRARY = sorted(C_FOLDER.glob("tube_*.c"))
STRICT = ["-Wall", "-Wextra", "-Werror", "-pedantic", "-O2", "-ffp-contract=off", f"-I{C_FOLDER}"]
SANITIZERS = ["-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
PATIENCE_S = 20.0
DT, INNER_STEPS = 0.1, 4

pytestmark = pytest.mark.skipif(
    shutil.which("cc") is None, reason="no C compiler: apt-get install gcc libc6-dev"
)
needs_cxx = pytest.mark.skipif(shutil.which("c++") is None, reason="no C++ compiler: apt-get install g++")

Folder = pytest.TempPathFactory
Resets = Callable[..., ResetBatch]
Commands = Callable[..., CommandBatch]
Serve = Callable[[Path], "subprocess.Popen[str]"]


def compile_c(folder: Path, *flags: str) -> Path:
    """Compile the server and its library, every warning an error."""
    program = folder / "server"
    sources = [C_FOLDER / "server.c", *LIBRARY]
    subprocess.run(
        ["cc", "-std=c11", *STRICT, *flags, *map(str, sources), "-lm", "-o", program], check=True, timeout=120
    )
    return program


@pytest.fixture(scope="module")
def server(tmp_path_factory: Folder) -> Path:
    """The C server."""
    return compile_c(tmp_path_factory.mktemp("c"))


@pytest.fixture(scope="module")
def sanitized(tmp_path_factory: Folder) -> Path:
    """The C server, which ends with an error at the first access or operation that C does not define."""
    folder = tmp_path_factory.mktemp("sanitized")
    probe = folder / "probe.c"
    probe.write_text("int main(void) { return 0; }\n")
    tried = ["cc", *SANITIZERS, str(probe), "-o", str(folder / "probe")]
    if subprocess.run(tried, check=False, capture_output=True, timeout=60).returncode != 0:
        pytest.skip("the compiler has no sanitizers: apt-get install libasan8 libubsan1")
    return compile_c(folder, *SANITIZERS)


@pytest.fixture(scope="module")
def moody(tmp_path_factory: Folder) -> Path:
    """A plant in C++ on the C library."""
    folder = tmp_path_factory.mktemp("cpp")
    for source in LIBRARY:
        compiled = ["cc", "-std=c11", *STRICT, "-c", str(source), "-o", str(folder / f"{source.stem}.o")]
        subprocess.run(compiled, check=True, timeout=60)
    plant = Path(__file__).with_name("moody.cpp")
    objects = map(str, folder.glob("*.o"))
    program = folder / "moody"
    subprocess.run(
        ["c++", "-std=c++11", *STRICT, str(plant), *objects, "-o", program], check=True, timeout=60
    )
    return program


@pytest.fixture
def serve(rendezvous: str) -> Iterator[Serve]:
    """Start a program at the rendezvous; it has to end by itself within the test."""
    started: list[subprocess.Popen[str]] = []

    def run(program: Path) -> subprocess.Popen[str]:
        started.append(subprocess.Popen([program, rendezvous], stderr=subprocess.PIPE, text=True))
        return started[-1]

    yield run
    for process in started:
        try:
            process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()


def open_session(rendezvous: str, lanes: int = 1) -> AgentSession:
    """Open a session as its agent."""
    settings = SessionSettings(lanes, DT, DT / INNER_STEPS)
    return AgentSession.open(rendezvous, settings, attach_timeout=PATIENCE_S)


def test_the_server_passes_the_suite(server: Path) -> None:
    """Every rule that is not about speed holds, but for those that need walls or gusts; its page says how many."""
    rules = select("server", [Level.CORE, Level.ROBUSTNESS, Level.LANES])
    assert kit.run(str(server), "shm", rules) == ([], kit.SKIPPED)
    assert kit.count_in_words() in " ".join((C_FOLDER / "README.md").read_text().split())


def test_the_server_keeps_the_rules_over_files(server: Path) -> None:
    """Every rule that the transport could touch holds over ordinary mapped files too."""
    failed, skipped = kit.run(str(server), "file", kit.transported_rules())
    assert failed == []
    assert skipped.items() <= kit.SKIPPED.items()


def test_nonsense_makes_the_server_do_nothing_that_c_leaves_undefined(sanitized: Path) -> None:
    """Refusals and faults hold where every stray access and every undefined operation ends the process."""
    wrong = [rule for rule in select("server", [Level.CORE]) if rule.name.startswith(("refusal", "offer"))]
    faults = [rule for rule in select("server", [Level.ROBUSTNESS]) if "pause" not in rule.name]
    failed, skipped = kit.run(str(sanitized), "shm", wrong + faults)
    assert failed == []
    assert skipped.items() <= kit.SKIPPED.items()


def random_flight(lanes: int, seed: int) -> tuple[ResetBatch, Iterator[CommandBatch]]:
    """Resets with any state and parameters that fly, and commands without end."""
    rng = np.random.default_rng(seed)

    def unit(words: int) -> np.ndarray:
        values = rng.normal(size=(lanes, words))
        return np.asarray(values / np.linalg.norm(values, axis=1)[:, None])

    resets = ResetBatch.zeros(lanes)
    resets.selected[:] = 1
    resets.raw[:, :13] = rng.normal(size=(lanes, 13))
    resets.quaternion[:] = unit(4)
    resets.parameters[:, : len(DEFAULTS)] = DEFAULTS
    resets.parameters[:, 0] = rng.uniform(0.5, 3.0, lanes)
    resets.parameters[:, 1:4] = rng.uniform(0.005, 0.03, (lanes, 3))
    resets.parameters[:, 6] = rng.integers(0, 2, lanes)
    resets.parameters[:, 9] = rng.uniform(0.0, 1.0, lanes)
    resets.parameters[:, 10] = rng.uniform(0.0, 0.01, lanes)
    resets.parameters[:, 14:17] = rng.normal(size=(lanes, 3))

    def fly() -> Iterator[CommandBatch]:
        commands = CommandBatch.zeros(lanes)
        while True:
            commands.direction[:] = unit(3)
            commands.speed[:] = rng.uniform(0.0, SPEED_MAX, lanes)
            commands.compensation[:] = rng.uniform(0.0, 2.0, lanes)
            yield commands

    return resets, fly()


def test_the_server_repeats_the_toy_bit_for_bit(serve: Serve, server: Path, rendezvous: str) -> None:
    """Random flights of three bodies end every control step in the very bits of the toy plant in Python."""
    serve(server)
    settings = SessionSettings(3, DT, DT / INNER_STEPS)
    with open_session(rendezvous, 3) as there, open_twin(ToyPlant(), settings) as here:
        for seed in range(4):
            resets, flight = random_flight(3, seed)
            assert there.reset(resets).raw.tobytes() == here.reset(resets).raw.tobytes()
            for _ in range(150):
                commands = next(flight)
                assert there.step(commands).raw.tobytes() == here.step(commands).raw.tobytes()


def test_the_server_has_the_defaults_of_the_toy(serve: Serve, server: Path, rendezvous: str) -> None:
    """Who asks the C server for its plant gets the toy's parameters and largest speed."""
    serve(server)
    with open_session(rendezvous) as session:
        description = session.description
        assert (description.defaults, description.speed_max) == (DEFAULTS, SPEED_MAX)
        assert not description.walls


def test_a_signal_ends_the_server_with_a_farewell(
    serve: Serve, server: Path, rendezvous: str, resets: Resets, commands: Commands
) -> None:
    """SIGTERM is told to the agent as what it is, and the process ends with the farewell's number."""
    process = serve(server)
    with open_session(rendezvous) as session:
        session.reset(resets())
        process.send_signal(signal.SIGTERM)
        process.wait(PATIENCE_S)
        with pytest.raises(PeerLost, match=r"told to stop \(signal 15\)") as caught:
            session.step(commands())
        assert caught.value.verdict is Verdict.LEFT
    assert process.returncode == 1


@needs_cxx
def test_a_plant_in_cpp_refuses_half_way_and_nothing_moves(
    serve: Serve, moody: Path, rendezvous: str, resets: Resets, commands: Commands
) -> None:
    """A refusal of the plant's own comes with its words; poses that it had written already do not count."""
    serve(moody)
    with open_session(rendezvous, 2) as session:
        session.reset(resets(2))
        session.step(commands(2, speed=1.0))
        with pytest.raises(
            Refusal, match="engine in lane 1: expected a mood to step, found none at 9"
        ) as caught:
            session.step(commands(2, speed=9.0))
        assert (caught.value.code, caught.value.lane) == (RefusalCode.PLANT, 1)
        poses = session.step(commands(2, speed=2.0))
        assert poses.position[:, 0].tolist() == [3.0, 3.0]
        assert poses.contact_steps.tolist() == [2, 2]
        assert poses.step.tolist() == [2, 2]
        assert poses.sim_time.tolist() == [2 * DT, 2 * DT]


@needs_cxx
@pytest.mark.parametrize(
    ("speed", "text"), [(8.0, "the engine exploded"), (7.0, "lane 0: its state is no longer")]
)
def test_a_plant_in_cpp_fails_and_the_agent_hears_why(
    serve: Serve, moody: Path, rendezvous: str, resets: Resets, commands: Commands, speed: float, text: str
) -> None:
    """A failure, or a state that is no longer finite, ends the session with the text of it."""
    serve(moody)
    with open_session(rendezvous) as session:
        session.reset(resets())
        with pytest.raises(PeerLost, match=text) as caught:
            session.step(commands(speed=speed))
        assert caught.value.verdict is Verdict.FAILED


@needs_cxx
def test_a_plant_in_cpp_that_cannot_open_says_so(serve: Serve, moody: Path, rendezvous: str) -> None:
    """A plant that cannot make its worlds fails the handshake with its own words."""
    serve(moody)
    with pytest.raises(PeerLost, match="no room for 3 lanes"):
        open_session(rendezvous, 3)


@needs_cxx
@pytest.mark.parametrize("letter", ["x", "é", "中"])
def test_a_long_text_of_a_refusal_is_cut_at_a_character(
    serve: Serve, moody: Path, rendezvous: str, letter: str
) -> None:
    """A path that is longer than the field for what was found arrives as a whole number of characters."""
    serve(moody)
    path = "/" + letter * 1000
    with open_session(rendezvous) as session, pytest.raises(Refusal) as caught:
        session.register_tube(0, TubeReference(path, "zup", 1.0, "0" * 64))
    found = caught.value.found
    assert path.startswith(found)
    assert 505 <= len(found.encode()) <= 511
