"""What an observer costs the session that it looks at: round trips with and without one, in one session.

One process looks on at a rate that is changed every few thousand round trips, in turn, so that whatever else the
machine does falls on all rates alike. Agent and physics process have a core each where there are two; the observer
is left to the scheduler, as `cosim watch` is.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.supervise import PhysicsProcess
from cosim.watch import step_back
from protocol.agent import AgentSession, SessionSettings
from protocol.observer import Observer
from protocol.plant import CommandBatch, Floats, ResetBatch

RATES: Final = {"none": 0.0, "20_hz": 20.0, "60_hz": 60.0, "full_speed": math.inf}
"""Looks a second, by name."""
Figures = dict[str, float]

_BURST: Final = 50
"""Looks at full speed between two looks at what to do next."""


def measure_observer(samples: int, repeats: int) -> dict[str, dict[str, float]]:
    """Round-trip times by the observer's rate, medians over the repeats, and their ratio to those without.

    The median round trip tells what an observer costs; mean and p99 also hold what it takes of the cores.

    Args:
        samples: round trips of one repeat at one rate; they should last longer than 50 ms.
        repeats: how often the rates are gone through in turn.
    """
    found: dict[str, list[Figures]] = {name: [] for name in RATES}
    with _session() as (exchange, rendezvous, server), _observer(rendezvous) as look_on, _apart(server):
        for repeat in range(repeats + 1):
            for name, rate in RATES.items():
                look_on(rate)
                times = _times(exchange, samples)
                looks = look_on(0.0)
                if repeat > 0:  # the first round warms up
                    found[name].append(_figures(times, looks))
    return {name: _summary(rows, found["none"]) for name, rows in found.items()}


def _times(exchange: Callable[[], object], samples: int) -> Floats:
    """Round-trip times (us), (samples,)."""
    clock = time.perf_counter_ns
    taken = np.empty(samples)
    for i in range(samples):
        started = clock()
        exchange()
        taken[i] = clock() - started
    return taken / 1e3


def _figures(times: Floats, looks: int) -> Figures:
    p50, p99 = np.quantile(times, (0.5, 0.99))
    per_second = 1e6 * looks / float(times.sum())
    return {
        "p50_us": float(p50),
        "p99_us": float(p99),
        "mean_us": float(times.mean()),
        "looks_per_s": per_second,
    }


def _summary(rows: list[Figures], alone: list[Figures]) -> Figures:
    """Medians over the repeats: of the figures, and of their ratios to those of the same repeat without observer."""
    pairs = list(zip(rows, alone, strict=True))
    ratios = {
        f"{name}_ratio": statistics.median(row[f"{name}_us"] / base[f"{name}_us"] for row, base in pairs)
        for name in ("p50", "p99", "mean")
    }
    figures = {name: statistics.median(row[name] for row in rows) for name in rows[0]}
    return {name: round(value, 3) for name, value in (figures | ratios).items()}


@contextmanager
def _session() -> Iterator[tuple[Callable[[], object], str, int]]:
    """A session with an engine that does nothing; yields one exchange, the rendezvous, and the server's pid."""
    rendezvous = f"shm:cosim-observed-{os.getpid()}-{time.monotonic_ns()}"
    command = [sys.executable, "-m", "physics_server", "--engine", "null"]
    with (
        tempfile.TemporaryDirectory(prefix="cosim-bench-") as folder,
        PhysicsProcess(command, rendezvous, Path(folder)) as server,
        AgentSession.open(rendezvous, SessionSettings(1, 0.1, 1.0 / 240.0), watch=server.watch) as session,
    ):
        resets, commands = ResetBatch.zeros(1), CommandBatch.zeros(1)
        resets.selected[0] = 1
        resets.parameters[0, : len(session.description.defaults)] = session.description.defaults
        commands.direction[0, 0], commands.speed[0], commands.compensation[0] = 1.0, 1.0, 1.0
        session.reset(resets)
        yield lambda: session.step(commands), rendezvous, server.pid


@contextmanager
def _apart(server: int) -> Iterator[None]:
    """This process and the server on a core each, where there are two."""
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(server, cores[-1:])
    os.sched_setaffinity(0, cores[:1])
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


@contextmanager
def _observer(rendezvous: str) -> Iterator[Callable[[float], int]]:
    """A process that looks on; yields what sets its rate and returns its looks at the rate before."""
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    process = multiprocessing.get_context("spawn").Process(
        target=_look_on, args=(theirs, rendezvous), daemon=True
    )
    process.start()
    theirs.close()

    def set_rate(rate: float) -> int:
        ours.send(rate)
        return int(ours.recv())

    try:
        yield set_rate
    finally:
        ours.close()
        process.join(5.0)
        if process.is_alive():
            process.terminate()
            process.join()


def _look_on(connection: Connection[Any, Any], rendezvous: str) -> None:
    looks = 0
    step_back()
    with connection, Observer.attach(rendezvous) as observer:
        try:
            while True:
                rate = connection.recv()
                connection.send(looks)
                looks = 0
                while not connection.poll(None if rate == 0.0 else 0.0 if math.isinf(rate) else 1.0 / rate):
                    for _ in range(_BURST if math.isinf(rate) else 1):
                        looks += observer.latest() is not None
        except EOFError:
            return
