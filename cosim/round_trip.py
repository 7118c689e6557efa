"""Round trips of one command and one pose: the protocol against a pipe and loopback UDP, in one run.

Every way carries the same payload, a command row of 8 and a pose row of 16 float64, packed and unpacked on
both sides, to a second process that does nothing else. The protocol is measured through its whole session,
with all its checks; the others as bare as the standard library allows. On two cores each side of the protocol
has a core of its own; the others are left to the scheduler, which serves them better than cores of their own.
"""

from __future__ import annotations

import multiprocessing
import os
import socket
import statistics
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.supervise import PhysicsProcess
from protocol.agent import AgentSession, SessionSettings
from protocol.plant import COMMAND_WORDS, POSE_WORDS, CommandBatch, ResetBatch

COMMAND: Final = struct.Struct(f"<{COMMAND_WORDS}d")
POSE: Final = struct.Struct(f"<{POSE_WORDS}d")
ROW: Final = (1.0, 0.0, 0.0, 1.0, 0.9, 0.0, 0.0, 0.0)

DT: Final = 0.1
PHYSICS_DT: Final = 1.0 / 240.0

Exchange = Callable[[], object]
Quantiles = dict[str, float]


def measure(samples: int, repeats: int) -> dict[str, Quantiles]:
    """Round-trip quantiles in microseconds, each the median over interleaved repeats.

    Args:
        samples: round trips of one repeat.
        repeats: how often the ways are measured in turn.
    """
    cores = sorted(os.sched_getaffinity(0))
    one = {cores[0]}
    ways: dict[str, tuple[Callable[[], AbstractContextManager[Exchange]], set[int]]] = {
        "shm_two_cores": (partial(_session, cores[:2]), set(cores[:2])),
        "pipe": (_pipe, set(cores[:2])),
        "udp": (_udp, set(cores[:2])),
        "shm_one_core": (partial(_session, cores[:1]), one),
        "udp_one_core": (_udp, one),
    }
    found: dict[str, list[Quantiles]] = {name: [] for name in ways}
    for _ in range(repeats):
        for name, (way, affinity) in ways.items():
            with _pinned(affinity), way() as exchange:
                found[name].append(_quantiles(exchange, samples))
    return {name: _medians(rows) for name, rows in found.items()}


def _medians(rows: list[Quantiles]) -> Quantiles:
    return {key: round(statistics.median(row[key] for row in rows), 3) for key in rows[0]}


def _quantiles(exchange: Exchange, samples: int) -> Quantiles:
    clock = time.perf_counter_ns
    taken = np.empty(samples)
    for _ in range(samples // 10):
        exchange()
    for i in range(samples):
        started = clock()
        exchange()
        taken[i] = clock() - started
    p50, p99, p999 = np.quantile(taken, (0.5, 0.99, 0.999)) / 1e3
    return {"p50_us": float(p50), "p99_us": float(p99), "p999_us": float(p999)}


@contextmanager
def _pinned(cores: set[int]) -> Iterator[None]:
    """This process and the children that it starts on these cores alone."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@contextmanager
def _session(cores: list[int]) -> Iterator[Exchange]:
    """The protocol's whole session, on the first core, against an engine that does nothing, on the last one."""
    rendezvous = f"shm:cosim-bench-{os.getpid()}-{time.monotonic_ns()}"
    command = [sys.executable, "-m", "physics_server", "--engine", "null"]
    with (
        tempfile.TemporaryDirectory() as folder,
        PhysicsProcess(command, rendezvous, Path(folder)) as server,
        AgentSession.open(rendezvous, SessionSettings(1, DT, PHYSICS_DT), watch=server.watch) as session,
    ):
        resets = ResetBatch.zeros(1)
        resets.selected[0] = 1
        resets.parameters[0, : len(session.description.defaults)] = session.description.defaults
        session.reset(resets)
        os.sched_setaffinity(0, cores[:1])
        os.sched_setaffinity(server.pid, cores[-1:])
        commands = CommandBatch.zeros(1)
        row = commands.raw[0]

        def exchange() -> object:
            row[:] = ROW
            return session.step(commands).raw[0].tolist()

        yield exchange


@contextmanager
def _pipe() -> Iterator[Exchange]:
    """`multiprocessing.Pipe` with the payload as bytes, not pickled."""
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    with _child(_pipe_peer, theirs), ours:
        theirs.close()

        def exchange() -> object:
            ours.send_bytes(COMMAND.pack(*ROW))
            return POSE.unpack(ours.recv_bytes())

        exchange()
        yield exchange


def _pipe_peer(connection: Connection) -> None:
    zeros = (0.0,) * (POSE_WORDS - COMMAND_WORDS)
    with connection:
        try:
            while True:
                connection.send_bytes(POSE.pack(*COMMAND.unpack(connection.recv_bytes()), *zeros))
        except EOFError:
            return


@contextmanager
def _udp() -> Iterator[Exchange]:
    """Connected UDP sockets on the loopback interface."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as theirs,
    ):
        for end in (ours, theirs):
            end.bind(("127.0.0.1", 0))
            end.settimeout(10.0)
        ours.connect(theirs.getsockname())
        theirs.connect(ours.getsockname())
        with _child(_udp_peer, theirs):
            ours.send(COMMAND.pack(*ROW))
            ours.recv(POSE.size)
            # A socket with a deadline polls before every call; measure bare calls.
            ours.settimeout(None)

            def exchange() -> object:
                ours.send(COMMAND.pack(*ROW))
                return POSE.unpack(ours.recv(POSE.size))

            yield exchange
            ours.send(b"")


def _udp_peer(ours: socket.socket) -> None:
    ours.settimeout(None)
    zeros = (0.0,) * (POSE_WORDS - COMMAND_WORDS)
    with ours:
        while len(datagram := ours.recv(POSE.size)) == COMMAND.size:
            ours.send(POSE.pack(*COMMAND.unpack(datagram), *zeros))


@contextmanager
def _child(target: Callable[[Any], None], end: object) -> Iterator[None]:
    process = multiprocessing.get_context("spawn").Process(target=target, args=(end,), daemon=True)
    process.start()
    try:
        yield
    finally:
        process.join(0.2)
        if process.is_alive():
            process.terminate()
            process.join()
