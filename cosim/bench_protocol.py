"""`cosim bench --protocol`: round trips against the field, the machine's floor, idle cost, lanes, observers, bars.

Every figure is the median of interleaved repeats. What cannot be measured here (a library, a compiler or a core that
is missing) is named with the reason and what to install.
"""

from __future__ import annotations

import json
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import click
import numpy as np

from cosim import native, rivals
from cosim import round_trip as trips
from cosim.errors import CosimError
from cosim.idle import idle_percent
from cosim.observer_cost import measure_observer
from cosim.protocol_bars import EXCHANGES, ONE_CORE, WAYS, judge
from cosim.protocol_table import protocol_table
from cosim.requirements import install_command
from cosim.round_trip import Quantiles, Samples, Way
from protocol.errors import ProtocolError

LANES: Final = (1, 4, 16, 64, 256)
BASE: Final = "udp"


@dataclass(frozen=True)
class Effort:
    """How long to measure."""

    samples: int
    """Round trips of one repeat, at most."""
    seconds: float
    """Time for one way in one repeat, at most."""
    repeats: int
    idle_s: float
    observed: int = 200_000
    """Round trips at one rate of the observer, at most: it should look several times meanwhile."""


MEASUREMENT: Final = Effort(20_000, 1.0, 5, 2.0)
LOOK: Final = Effort(500, 0.15, 3, 0.3)


@dataclass(frozen=True)
class Entry:
    """A way to make round trips, and on which cores."""

    way: Way
    cores: Sequence[int]


def bench_protocol(*, as_json: bool, quick: bool, png: Path | None, only: Sequence[str] = ()) -> None:
    """Measure and print: a table for people, or one JSON object.

    Args:
        as_json: one JSON object on stdout and nothing else.
        quick: a look, not a measurement.
        png: where to draw the histogram of all round trips, or None.
        only: names of ways, where not all are wanted; neither lanes nor idle cost nor observers are measured then.

    Raises:
        CosimError: a name in `only` is unknown, or the histogram cannot be drawn.
    """
    if png is not None:
        from cosim.latency_figure import check_figure

        check_figure()  # says what to install before anything is measured

    def say(text: str) -> None:
        click.echo(text, err=True)

    figures, samples = measure_protocol(LOOK if quick else MEASUREMENT, only, say)
    if png is not None:
        from cosim.latency_figure import draw_histogram

        draw_histogram(samples, png)
        figures["png"] = str(png)
    click.echo(json.dumps(figures) if as_json else protocol_table(figures))


def measure_protocol(
    effort: Effort, only: Sequence[str], say: Callable[[str], None]
) -> tuple[dict[str, Any], dict[str, Samples]]:
    """Measure all that this machine can.

    Args:
        effort: how long.
        only: as `bench_protocol`.
        say: told what is being measured.

    Returns:
        The round trips of each way (us), behind the figures, which are ready for JSON:

        machine: system, processor, python, cores, load_average, date
        effort: samples, repeats
        round_trip: by way: p50_us, p99_us, p999_us, over_udp (its p50 over that of blocking UDP on as many cores)
            and, on two cores, over_fastest_udp (blocking or polling)
        floor: by number of lanes: quantiles of as many cache lines passed to and fro in C
        idle_percent: physics, agent: of a core, while each waits for the other
        lanes: for stdlib and compiled a row for each number: lanes, step_us, transport_us (without the engine's
            own time), transport_us_per_lane, steps_per_second_per_lane, transport_over_one_lane
        observer: by the observer's rate, what `measure_observer` returns
        bars: the project's own bars on what was measured, rows of name, found, bar, reached
        skipped: why a way or a part could not be measured, and what to do

    Raises:
        CosimError: a name in `only` is unknown.
    """
    unknown = [name for name in only if name not in WAYS]
    if unknown:
        raise CosimError(f"--only: expected some of {', '.join(WAYS)}, found {unknown[0]!r}")
    skipped: dict[str, str] = {}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cosim-bench-")))
        entries = _entries(folder, only, skipped)
        samples = _round_trips(entries, effort, skipped, say)
        figures: dict[str, Any] = {
            "machine": _machine(),
            "effort": {"samples": effort.samples, "repeats": effort.repeats},
            "round_trip": _over_udp({name: _medians(rows) for name, rows in samples.items()}),
        }
        if not only:
            say("machine's floor ...")
            figures["floor"] = _floor(folder, effort, skipped)
            say("idle pair ...")
            figures["idle_percent"] = idle_percent(effort.idle_s, skipped)
            say("lanes ...")
            figures["lanes"] = _lanes(effort, skipped)
            say("observers ...")
            exchange = "stdlib" if "session_compiled" in skipped else "compiled"
            figures["observer"] = measure_observer(effort.observed, effort.repeats, effort.seconds, exchange)
        figures["bars"] = [
            {"name": bar.name, "found": bar.found, "bar": bar.bar, "reached": bar.reached}
            for bar in judge(figures)
        ]
        figures["skipped"] = skipped
    return figures, {name: np.concatenate(rows) for name, rows in samples.items()}


def _entries(folder: Path, only: Sequence[str], skipped: dict[str, str]) -> dict[str, Entry]:
    """The ways that can be measured here; what cannot be built is noted."""
    both = trips.two_cores()
    one = both[:1]
    entries: dict[str, Entry] = {}
    for exchange in EXCHANGES:
        entries[f"session_{exchange}"] = Entry(partial(trips.session, both, exchange), both)
    entries[BASE] = Entry(trips.udp, both)
    entries["udp_polling"] = Entry(partial(rivals.udp_polling, both), both)
    entries["pipe"] = Entry(trips.pipe, both)
    for way in (rivals.semaphores, rivals.pyzmq, rivals.grpc_unary, rivals.iceoryx2, rivals.pybullet_server):
        entries[way.__name__] = Entry(way, both)
    for language, build in (("csharp", native.build_csharp_server), ("c", native.build_c_server)):
        names = [f"session_{language}_{exchange}" for exchange in EXCHANGES]
        if only and not set(names) & set(only):
            continue
        try:
            command = build(folder)
        except CosimError as error:
            skipped |= dict.fromkeys(names, str(error))
            continue
        for name, exchange in zip(names, EXCHANGES, strict=True):
            entries[name] = Entry(partial(trips.session, both, exchange, command), both)
    for exchange in EXCHANGES:
        entries[f"session_{exchange}{ONE_CORE}"] = Entry(partial(trips.session, one, exchange), one)
    for name in (BASE, "pipe", "semaphores"):
        entries[f"{name}{ONE_CORE}"] = Entry(entries[name].way, one)
    chosen = {name: entry for name, entry in entries.items() if not only or name in only}
    if len(both) < 2:
        for name in [name for name, entry in chosen.items() if entry.cores is both]:
            skipped[name] = "this process may use one core alone: taskset, or a machine with two"
            del chosen[name]
    return chosen


def _round_trips(
    entries: dict[str, Entry], effort: Effort, skipped: dict[str, str], say: Callable[[str], None]
) -> dict[str, list[Samples]]:
    """The round trips of each way in each repeat; all ways in turn, so that a busy moment hits none alone."""
    found: dict[str, list[Samples]] = {}
    for repeat in range(effort.repeats):
        say(f"round trips, repeat {repeat + 1} of {effort.repeats} ...")
        for name in [name for name in entries if name not in skipped]:
            entry = entries[name]
            try:
                with trips.pinned(entry.cores), entry.way() as exchange:
                    samples = trips.time_exchanges(exchange, effort.samples, effort.seconds)
            except ImportError as error:
                skipped[name] = f"{error.name} is not installed: {install_command('bench')}"
                continue
            except (CosimError, ProtocolError) as error:
                skipped[name] = str(error)
                continue
            found.setdefault(name, []).append(samples)
    return found


def _medians(repeats: Iterable[Samples]) -> Quantiles:
    return trips.medians([trips.quantiles(samples) for samples in repeats])


def _over_udp(rows: dict[str, Quantiles]) -> dict[str, Quantiles]:
    """Each way's median over that of UDP on as many cores, and over that of UDP as fast as it gets."""
    for name, row in rows.items():
        one_core = name.endswith(ONE_CORE)
        base = rows.get(BASE + ONE_CORE if one_core else BASE)
        if base is not None:
            row["over_udp"] = round(row["p50_us"] / base["p50_us"], 3)
        if not one_core and "udp_polling" in rows and BASE in rows:
            fastest = min(rows[BASE]["p50_us"], rows["udp_polling"]["p50_us"])
            row["over_fastest_udp"] = round(row["p50_us"] / fastest, 3)
    return rows


def _floor(folder: Path, effort: Effort, skipped: dict[str, str]) -> dict[str, Quantiles]:
    """What the machine itself takes to pass as many cache lines to and fro."""
    try:
        program = native.build_floor(folder)
    except native.MissingToolError as error:
        skipped["floor"] = str(error)
        return {}
    both = trips.two_cores()
    ways = {f"c_{lanes}_lanes": (both, lanes) for lanes in LANES} if len(both) == 2 else {}
    ways[f"c_1_lanes{ONE_CORE}"] = (both[:1], 1)
    rows: dict[str, list[Quantiles]] = {name: [] for name in ways}
    for _ in range(effort.repeats):
        for name, (cores, lanes) in ways.items():
            rows[name].append(native.run_floor(program, cores, lanes, effort.samples))
    return {name: trips.medians(found) for name, found in rows.items()}


def _lanes(effort: Effort, skipped: dict[str, str]) -> dict[str, list[dict[str, float]]]:
    """A step of many lanes: its time, what of it is transport, and the rate of one lane's steps."""
    both = trips.two_cores()
    rows: dict[tuple[str, int], list[tuple[float, float]]] = {}
    for _ in range(effort.repeats):
        for exchange in EXCHANGES:
            if f"session_{exchange}" not in skipped:
                for lanes in LANES:
                    rows.setdefault((exchange, lanes), []).append(_step_of(lanes, exchange, both, effort))
    table: dict[str, list[dict[str, float]]] = {}
    for (exchange, lanes), found in rows.items():
        total, transport = (statistics.median(values) for values in zip(*found, strict=True))
        row = {
            "lanes": lanes,
            "step_us": round(total, 3),
            "transport_us": round(transport, 3),
            "transport_us_per_lane": round(transport / lanes, 4),
            "steps_per_second_per_lane": round(1e6 / total, 1),
        }
        first = table.setdefault(exchange, [row])[0]
        row["transport_over_one_lane"] = round(transport / first["transport_us"], 3)
        if row is not first:
            table[exchange].append(row)
    return table


def _step_of(lanes: int, exchange: str, cores: Sequence[int], effort: Effort) -> tuple[float, float]:
    """Median time of a step of so many lanes, and of what is left of it without the engine's own time (us)."""
    with trips.pinned(cores), trips.open_session(cores, lanes, exchange) as (agent, _):
        agent.reset(trips.sound_resets(agent))
        commands = trips.sound_commands(lanes)
        agent.step(commands)
        engine: list[float] = []

        def step() -> None:
            agent.step(commands)
            engine.append(agent.engine_seconds)

        samples = trips.time_exchanges(step, effort.samples // 4, effort.seconds)
    total = float(np.median(samples))
    return total, total - 1e6 * statistics.median(engine)


def _machine() -> dict[str, Any]:
    return {
        "system": f"{platform.system()} {platform.release()}",
        "processor": platform.machine(),
        "python": platform.python_version(),
        "cores": len(os.sched_getaffinity(0)),
        "load_average": round(os.getloadavg()[0], 2),
        "date": time.strftime("%Y-%m-%d"),
    }
