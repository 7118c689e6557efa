"""What an observer costs the session that it looks at: round trips with and without one, in one session.

One process looks on at a rate that is changed every few thousand round trips, in turn, so that whatever else the
machine does falls on all rates alike. Agent and physics process have a core each where there are two; the observer
is left to the scheduler, as `cosim watch` is. A part of `cosim bench --protocol`.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import statistics
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any, Final

import numpy as np

from cosim import round_trip as trips
from cosim.watch import step_back
from protocol.observer import Observer

RATES: Final = {"none": 0.0, "20_hz": 20.0, "60_hz": 60.0, "full_speed": math.inf}
"""Looks a second, by name."""
Figures = dict[str, float]

_BURST: Final = 50
"""Looks at full speed between two looks at what to do next."""


def measure_observer(
    samples: int, repeats: int, seconds: float = 1e6, exchange: str | None = None
) -> dict[str, Figures]:
    """Round-trip times by the observer's rate, medians over the repeats, and their ratio to those without.

    The median round trip tells what an observer costs; mean and p99 also hold what it takes of the cores.

    Args:
        samples: round trips of one repeat at one rate; they should last longer than 50 ms.
        repeats: how often the rates are gone through in turn.
        seconds: time for one repeat at one rate, at most.
        exchange: as `round_trip.session`.

    Returns:
        By the name of the rate: p50_us, p99_us, mean_us, looks_per_s, p50_ratio, p99_ratio, mean_ratio.
    """
    found: dict[str, list[Figures]] = {name: [] for name in RATES}
    cores = trips.two_cores()
    rendezvous = trips.new_rendezvous()
    everywhere = os.sched_getaffinity(0)
    with (
        trips.open_session(cores, 1, exchange, rendezvous=rendezvous) as (agent, _),
        _observer(rendezvous, sorted(everywhere)) as look_on,
    ):
        agent.reset(trips.sound_resets(agent))
        commands = trips.sound_commands(1)
        for repeat in range(repeats + 1):
            for name, rate in RATES.items():
                look_on(rate)
                times = trips.time_exchanges(lambda: agent.step(commands), samples, seconds)
                looks = look_on(0.0)
                if repeat > 0:  # the first round warms up
                    found[name].append(_figures(times, looks))
    return {name: _summary(rows, found["none"]) for name, rows in found.items()}


def _figures(times: trips.Samples, looks: int) -> Figures:
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
def _observer(rendezvous: str, cores: Sequence[int]) -> Iterator[Callable[[float], int]]:
    """A process that looks on; yields what sets its rate and returns its looks at the rate before."""
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    process = multiprocessing.get_context("spawn").Process(
        target=_look_on, args=(theirs, rendezvous, cores), daemon=True
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


def _look_on(connection: Connection[Any, Any], rendezvous: str, cores: Sequence[int]) -> None:
    looks = 0
    os.sched_setaffinity(0, cores)
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
