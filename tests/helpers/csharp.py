"""Building and starting what is written in C#, and random flights to try it on."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import kit
import numpy as np
import pytest
from numpy.typing import NDArray

from protocol import bindings
from protocol.agent import AgentSession, SessionSettings
from protocol.conformance.rule import Level
from protocol.conformance.run import select
from protocol.plant import CommandBatch, ResetBatch
from protocol.toy import DEFAULTS, SPEED_MAX

needs_mono = pytest.mark.skipif(
    shutil.which("mcs") is None or shutil.which("mono") is None,
    reason="no Mono: apt-get install mono-mcs mono-runtime libmono-system-core4.0-cil",
)

MONO = "env MONO_DISABLE_SHARED_AREA=1 mono"
"""How to start a program: Mono's counters for tools stay in /dev/shm when it is killed, and nobody reads them."""
SOURCES = bindings.CSHARP_LAYOUT.parent
PATIENCE_S = 20.0
DT, INNER_STEPS = 0.1, 24

Floats = NDArray[np.float64]
Serve = Callable[[Path], "subprocess.Popen[str]"]


def build(program: Path, main: str, *sources: Path, defines: tuple[str, ...] = ()) -> Path:
    """Compile the library and more sources into a program, every warning an error."""
    files = map(str, [*sorted(SOURCES.glob("*.cs")), *sources])
    flags = ["-optimize+", "-warnaserror", "-r:System.Core", *(f"-d:{symbol}" for symbol in defines)]
    command = ["mcs", *flags, f"-main:{main}", f"-out:{program}", *files]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    return program


@contextmanager
def serving(rendezvous: str) -> Iterator[Serve]:
    """Start programs at a rendezvous; each has to end by itself before the `with` statement is over."""
    started: list[subprocess.Popen[str]] = []

    def run(program: Path) -> subprocess.Popen[str]:
        command = [*MONO.split(), str(program), rendezvous]
        started.append(subprocess.Popen(command, stderr=subprocess.PIPE, text=True))
        return started[-1]

    try:
        yield run
    finally:
        for process in started:
            try:
                process.communicate(timeout=PATIENCE_S)
            finally:
                process.kill()


def open_session(rendezvous: str, lanes: int = 1) -> AgentSession:
    """Open a session as its agent."""
    settings = SessionSettings(lanes, DT, DT / INNER_STEPS)
    return AgentSession.open(rendezvous, settings, attach_timeout=PATIENCE_S)


def run_rules(program: Path, transport: str, *levels: Level) -> tuple[list[str], dict[str, str]]:
    """Run the rules of some levels, as `kit.run` does."""
    return kit.run(f"{MONO} {program}", transport, select("server", levels))


def unit(rng: np.random.Generator, rows: int, words: int) -> Floats:
    """Draw unit vectors."""
    values = rng.normal(size=(rows, words))
    return np.asarray(values / np.linalg.norm(values, axis=1)[:, None])


def random_resets(rng: np.random.Generator, lanes: int) -> ResetBatch:
    """Draw states, and parameters that fly."""
    resets = ResetBatch.zeros(lanes)
    resets.raw[:, :13] = rng.normal(size=(lanes, 13))
    resets.quaternion[:] = unit(rng, lanes, 4)
    resets.parameters[:, : len(DEFAULTS)] = np.array(DEFAULTS) * rng.uniform(0.5, 1.5, (lanes, len(DEFAULTS)))
    resets.parameters[:, 6] = rng.integers(0, 2, lanes)  # force_along_body
    resets.parameters[:, 9:11] = rng.uniform(0.0, 0.1, (lanes, 2))  # drag
    resets.parameters[:, 14:17] = rng.normal(size=(lanes, 3))  # disturbance
    return resets


def random_commands(rng: np.random.Generator, lanes: int) -> CommandBatch:
    """Draw sound commands."""
    commands = CommandBatch.zeros(lanes)
    commands.direction[:] = unit(rng, lanes, 3)
    commands.speed[:] = rng.uniform(0.0, SPEED_MAX, lanes)
    commands.compensation[:] = rng.uniform(0.0, 2.0, lanes)
    return commands
