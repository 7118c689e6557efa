"""Timing round trips of one command and one pose: through the protocol's session, a pipe and loopback UDP.

Every way carries the same payload, a command row of 8 and a pose row of 16 float64, packed and unpacked on both
sides. The protocol is measured through its whole session, with all its checks, against an engine that does nothing;
the others as bare as the standard library allows. On two cores each side of the protocol has a core of its own; the
others are left to the scheduler, which serves them better than cores of their own, unless their name says polling.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import statistics
import struct
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.supervise import PhysicsProcess, physics_command
from protocol.agent import AgentSession, SessionSettings
from protocol.compiled_choice import ENVIRONMENT
from protocol.plant import COMMAND_WORDS, POSE_WORDS, CommandBatch, ResetBatch

COMMAND: Final = struct.Struct(f"<{COMMAND_WORDS}d")
POSE: Final = struct.Struct(f"<{POSE_WORDS}d")
ROW: Final = (1.0, 0.0, 0.0, 1.0, 0.9, 0.0, 0.0, 0.0)
ZEROS: Final = (0.0,) * (POSE_WORDS - COMMAND_WORDS)
"""What a peer adds to a command to answer it."""

DT: Final = 0.1
LEAST: Final = 25
"""Round trips that a repeat has at least, however long they take: a median of fewer is an accident."""
PATIENCE_S: Final = 5.0
"""How long a peer may take to end by itself."""

Exchange = Callable[[], object]
Way = Callable[[], AbstractContextManager[Exchange]]
"""A way to make round trips; a peer that it starts lives as long as its context."""
Samples = NDArray[np.float64]
Quantiles = dict[str, float]


def measure(samples: int, repeats: int) -> dict[str, Quantiles]:
    """Round-trip quantiles in microseconds, each the median over interleaved repeats.

    Args:
        samples: round trips of one repeat.
        repeats: how often the ways are measured in turn.
    """
    both = two_cores()
    one = both[:1]
    ways: dict[str, tuple[Way, Sequence[int]]] = {
        "shm_two_cores": (partial(session, both), both),
        "pipe": (pipe, both),
        "udp": (udp, both),
        "shm_one_core": (partial(session, one), one),
        "udp_one_core": (udp, one),
    }
    found: dict[str, list[Quantiles]] = {name: [] for name in ways}
    for _ in range(repeats):
        for name, (way, cores) in ways.items():
            with pinned(cores), way() as exchange:
                found[name].append(quantiles(time_exchanges(exchange, samples)))
    return {name: medians(rows) for name, rows in found.items()}


def two_cores() -> list[int]:
    """The first two cores of this process, or its one."""
    return sorted(os.sched_getaffinity(0))[:2]


def time_exchanges(exchange: Exchange, samples: int, seconds: float = 1e6) -> Samples:
    """Time round trips (us), after a tenth of them to warm up.

    Args:
        exchange: makes one.
        samples: how many, at most.
        seconds: how long to measure, at most, and a fifth of that to warm up; LEAST round trips in any case.
    """
    clock = time.perf_counter_ns
    taken = np.empty(samples)
    until = clock() + int(0.2e9 * seconds)
    for _ in range(samples // 10):
        exchange()
        if clock() > until:
            break
    until = clock() + int(1e9 * seconds)
    for i in range(samples):
        started = clock()
        exchange()
        ended = clock()
        taken[i] = ended - started
        if ended > until and i + 1 >= LEAST:
            return taken[: i + 1] / 1e3
    return taken / 1e3


def quantiles(samples: Samples) -> Quantiles:
    """Median, 99th and 99.9th percentile of times in microseconds."""
    p50, p99, p999 = np.quantile(samples, (0.5, 0.99, 0.999))
    return {"p50_us": float(p50), "p99_us": float(p99), "p999_us": float(p999)}


def medians(rows: Sequence[Quantiles]) -> Quantiles:
    """The median of each figure over repeats."""
    return {key: round(statistics.median(row[key] for row in rows), 3) for key in rows[0]}


@contextmanager
def pinned(cores: Sequence[int]) -> Iterator[None]:
    """This process and the children that it starts on these cores alone."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@contextmanager
def session(
    cores: Sequence[int], exchange: str | None = None, command: Sequence[str] | None = None
) -> Iterator[Exchange]:
    """The protocol's whole session, one lane: the agent on the first core, the physics process on the last one.

    Args:
        cores: one or two of them.
        exchange: "stdlib" or "compiled" for every side in Python; None leaves it to them.
        command: of the physics process, but for the rendezvous; None is ours with an engine that does nothing.
    """
    with open_session(cores, 1, exchange, command) as (agent, _):
        commands = CommandBatch.zeros(1)
        sent = commands.raw.data.cast("B")
        received = agent.reset(sound_resets(agent)).raw.data.cast("B")

        def one() -> object:
            COMMAND.pack_into(sent, 0, *ROW)
            agent.step(commands)
            return POSE.unpack_from(received)

        yield one


@contextmanager
def open_session(
    cores: Sequence[int],
    lanes: int,
    exchange: str | None = None,
    command: Sequence[str] | None = None,
    rendezvous: str | None = None,
) -> Iterator[tuple[AgentSession, PhysicsProcess]]:
    """A session of so many lanes, as `session` has one, and its physics process; at a new rendezvous if at None."""
    rendezvous = rendezvous or new_rendezvous()
    # One inner step a control step: the time of an engine is not what is measured.
    settings = SessionSettings(lanes, DT, DT)
    command = command or (*physics_command(None), "--engine", "null")
    with (
        _exchanging_by(exchange),
        tempfile.TemporaryDirectory() as folder,
        PhysicsProcess(command, rendezvous, Path(folder)) as server,
        AgentSession.open(rendezvous, settings, watch=server.watch) as agent,
    ):
        server.serving = True
        before = os.sched_getaffinity(0)
        os.sched_setaffinity(0, cores[:1])
        os.sched_setaffinity(server.pid, cores[-1:])
        try:
            yield agent, server
        finally:
            os.sched_setaffinity(0, before)


def new_rendezvous() -> str:
    """A rendezvous that nobody has."""
    return f"shm:cosim-bench-{os.getpid()}-{time.monotonic_ns()}"


@contextmanager
def _exchanging_by(exchange: str | None) -> Iterator[None]:
    """Demand a way of exchanging steps of this process and of those that it starts."""
    before = os.environ.get(ENVIRONMENT)
    if exchange is not None:
        os.environ[ENVIRONMENT] = exchange
    try:
        yield
    finally:
        if exchange is not None:
            os.environ.pop(ENVIRONMENT)
            if before is not None:
                os.environ[ENVIRONMENT] = before


def sound_resets(agent: AgentSession) -> ResetBatch:
    """Resets of all lanes at the origin, with the plant's default parameters."""
    resets = ResetBatch.zeros(agent.lanes)
    resets.selected[:] = 1
    resets.parameters[:, : len(agent.description.defaults)] = agent.description.defaults
    return resets


def sound_commands(lanes: int) -> CommandBatch:
    """The payload's command in every lane."""
    commands = CommandBatch.zeros(lanes)
    commands.raw[:] = ROW
    return commands


@contextmanager
def pipe() -> Iterator[Exchange]:
    """`multiprocessing.Pipe` with the payload as bytes, not pickled."""
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    with child(_pipe_peer, theirs), ours:
        theirs.close()

        def exchange() -> object:
            ours.send_bytes(COMMAND.pack(*ROW))
            return POSE.unpack(ours.recv_bytes())

        exchange()
        yield exchange


def _pipe_peer(connection: Connection) -> None:
    with connection:
        try:
            while True:
                connection.send_bytes(POSE.pack(*COMMAND.unpack(connection.recv_bytes()), *ZEROS))
        except (EOFError, ConnectionError):
            return


@contextmanager
def udp() -> Iterator[Exchange]:
    """Connected UDP sockets on the loopback interface."""
    with udp_sockets() as (ours, theirs), child(_udp_peer, theirs):
        # A socket with a deadline polls before every call; the first exchange needs one, the others are bare.
        ours.send(COMMAND.pack(*ROW))
        ours.recv(POSE.size)
        ours.settimeout(None)

        def exchange() -> object:
            ours.send(COMMAND.pack(*ROW))
            return POSE.unpack(ours.recv(POSE.size))

        yield exchange
        ours.send(b"")


@contextmanager
def udp_sockets() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Two sockets that are connected to each other, with a deadline."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as theirs,
    ):
        for end in (ours, theirs):
            end.bind(("127.0.0.1", 0))
            end.settimeout(10.0)
        ours.connect(theirs.getsockname())
        theirs.connect(ours.getsockname())
        yield ours, theirs


def _udp_peer(ours: socket.socket) -> None:
    ours.settimeout(None)
    with ours:
        while len(datagram := ours.recv(POSE.size)) == COMMAND.size:
            ours.send(POSE.pack(*COMMAND.unpack(datagram), *ZEROS))


@contextmanager
def child(target: Callable[..., None], *arguments: Any, patience: float = 0.2) -> Iterator[None]:
    """A second process, which is expected to end by itself, and is made to if it does not.

    It never sees Ctrl-C, which reaches all processes of a terminal: ending it is left to us.
    """
    process = multiprocessing.get_context("spawn").Process(target=target, args=arguments, daemon=True)
    resource_tracker.ensure_running()  # starting it would unblock the signal
    usual = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, usual)
    try:
        yield
    finally:
        process.join(patience)
        if process.is_alive():
            process.terminate()
            process.join()
