"""`cosim bench`: round trip, whole control loop and start-up on this machine, or the speed of training."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import click
import numpy as np

from agent_client.flight import PHASES
from agent_client.settings import Settings
from cosim.loop_limit import network_microseconds, physics_microseconds, rays_microseconds
from cosim.round_trip import Quantiles, measure
from cosim.runs import read_run
from cosim.train import load_training
from meshes.tube import INDUSTRIAL, read_tube

LAYERS: Final = (37, 256, 128, 36)
"""The paper's network."""


def bench(*, as_json: bool, quick: bool, training: bool = False, runs: bool = False) -> None:
    """Measure and print: a table for people, or one JSON object.

    Args:
        as_json: one JSON object on stdout and nothing else.
        quick: fewer samples and repeats.
        training: the speed of training instead of the loop's.
        runs: what looking at a flight, proving it and reporting it cost instead.
    """
    if training:
        bench_training(as_json=as_json, quick=quick)
        return
    if runs:
        bench_runs(as_json=as_json, quick=quick)
        return
    samples, repeats = (2_000, 1) if quick else (20_000, 5)

    def say(text: str) -> None:
        click.echo(text, err=True)

    say("round trips ...")
    figures: dict[str, Any] = {"round_trip": measure(samples, repeats)}
    # A flight takes a tenth of a second, in which a shared machine may run at any speed: many, in turn.
    flights = 1 if quick else 15
    figures |= measure_loop(flights, say)
    if as_json:
        click.echo(json.dumps(figures))
    else:
        click.echo(table(figures))


def bench_training(*, as_json: bool, quick: bool) -> None:
    """Measure training and print, as `bench` does."""
    load_training()  # says what to install before anything is measured
    from cosim.bench_training import LOOK, MEASUREMENT, measure_training, training_table

    figures = measure_training(LOOK if quick else MEASUREMENT, lambda text: click.echo(text, err=True))
    click.echo(json.dumps({"training": figures}) if as_json else training_table(figures))


def bench_runs(*, as_json: bool, quick: bool) -> None:
    """Measure what surrounds a flight and print, as `bench` does."""
    from cosim.bench_runs import LOOK, MEASUREMENT, measure_runs, runs_table

    figures = measure_runs(LOOK if quick else MEASUREMENT, lambda text: click.echo(text, err=True))
    click.echo(json.dumps({"runs": figures}) if as_json else runs_table(figures))


def measure_loop(repeats: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Fly the shipped conduit and, in turn, run the bare loop over the same states; medians over the repeats.

    Args:
        repeats: flights.
        say: is told which of them is next.
    """
    tube = read_tube(INDUSTRIAL)
    settings = Settings()
    rows: list[dict[str, float]] = []
    limits: list[dict[str, float]] = []
    startups: list[float] = []
    for seed in range(repeats):
        say(f"control loop, {seed + 1} of {repeats} ...")
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "run"
            report = _launch("--seed", str(seed), "--out", str(out))
            run = read_run(out)
            records = np.array(run.records)
            inner_steps, dt = run.manifest["session"]["inner_steps"], run.manifest["session"]["dt"]
        startups.append(report["startup_s"])
        phases = records["phases"][1:].mean(axis=0) / 1e3
        row = dict(zip(PHASES, phases.tolist(), strict=True))
        total = 1e6 * report["wall_time_s"] / report["steps"]
        # Recording runs while physics works on the next step, so that it is no part of the sum.
        other = total - sum(row.values())
        row |= {"recording": float(records["recording"][:-1].mean()) / 1e3, "other": other, "total": total}
        rows.append(row)
        limits.append(
            {
                "physics": physics_microseconds(tube, records, inner_steps, dt),
                "rays": rays_microseconds(tube, records, 2 * settings.lidar.rays, settings.lidar.reach),
                "network": network_microseconds(records, LAYERS),
            }
        )
    phases_us, limit_us = _medians(rows), _medians(limits)
    total = phases_us.pop("total")
    limit_us["total"] = statistics.median(sum(limit.values()) for limit in limits)
    ratio = statistics.median(
        row["total"] / sum(limit.values()) for row, limit in zip(rows, limits, strict=True)
    )
    return {
        "loop": {
            "steps_per_second": round(1e6 / total, 1),
            "ratio_to_limit": round(ratio, 3),
            "phases_us": phases_us,
            "limit_us": limit_us,
        },
        "startup_s": statistics.median(startups),
    }


def _launch(*arguments: str) -> dict[str, Any]:
    """One flight in a process of its own; returns its report."""
    command = [sys.executable, "-m", "cosim", "launch", "--json", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    report: dict[str, Any] = json.loads(done.stdout)
    return report


def _medians(rows: list[dict[str, float]]) -> dict[str, float]:
    return {key: round(statistics.median(row[key] for row in rows), 2) for key in rows[0]}


def table(figures: dict[str, Any]) -> str:
    """The figures as text."""
    lines = ["round trip of one command and one pose (us)      p50     p99   p99.9   p50 over UDP's"]
    trips: dict[str, Quantiles] = figures["round_trip"]
    for name, row in trips.items():
        base = trips["udp_one_core" if "one_core" in name else "udp"]["p50_us"]
        lines.append(
            f"  {name:<42}{row['p50_us']:8.2f}{row['p99_us']:8.2f}{row['p999_us']:8.2f}"
            f"{row['p50_us'] / base:10.2f}"
        )
    loop = figures["loop"]
    lines += [
        "",
        f"control loop on the shipped conduit: {loop['steps_per_second']:.0f} steps/s, "
        f"{loop['ratio_to_limit']:.2f} times the bare library calls",
        "  us a step       " + "".join(f"{name:>11}" for name in loop["phases_us"]),
        "                  " + "".join(f"{value:11.1f}" for value in loop["phases_us"].values()),
        "                  (recording runs while physics works on the next step)",
        "  bare calls      " + "".join(f"{name:>11}" for name in loop["limit_us"]),
        "                  " + "".join(f"{value:11.1f}" for value in loop["limit_us"].values()),
        "",
        f"start of cosim launch to the first step: {figures['startup_s']:.2f} s",
    ]
    return "\n".join(lines)
