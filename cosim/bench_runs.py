"""`cosim bench --runs`: what looking at a flight, proving it and reporting it cost."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from cosim.errors import CosimError

MAX_PACE: Final = "1e6"
"""As fast as possible, where --view would fly at wall-clock pace."""
VIEWER_BAR: Final = 0.75
"""Of the step rate, what is to be left with a live viewer."""
VERIFY_BAR: Final = 1.2
"""Step loop of `cosim verify` over the run's own physics."""
REPORT_BAR_MB: Final = 10.0
BARS_FROM: Final = 10_000
"""Control steps from which on the bars hold: of a short flight, start-up is the larger part."""


@dataclass(frozen=True)
class Effort:
    """How much is measured."""

    length: float = 1850.0
    """Length of the generated tube in radii: some 10,000 control steps."""
    repeats: int = 5
    """Flights alone and viewed, in turn, and verifications."""


MEASUREMENT: Final = Effort()
LOOK: Final = Effort(length=40.0, repeats=1)


def measure_runs(effort: Effort, say: Callable[[str], None]) -> dict[str, Any]:
    """Fly one generated tube alone and with a live viewer in turn, then verify the run and write its report.

    The viewer draws pictures without a window, 10 a second at most, so that no display is needed.

    Args:
        effort: how much.
        say: is told what is being measured.

    Returns:
        steps: control steps of the flight
        viewer: steps_per_second_alone and steps_per_second_viewed (medians), ratio (median of neighbours; None where
            nothing can be drawn), pictures_per_second, same_hash: whether all flights had the same
        verify: loop_s, physics_s (medians), ratio (median), verified
        report: seconds to write it, megabytes
        bars: rows of name, found, bar, reached; none for flights shorter than `BARS_FROM`

    Raises:
        CosimError: a flight or a verification failed.
    """
    tube = ("--tube", f"level=1,seed=1,length={effort.length:g}")
    with tempfile.TemporaryDirectory(prefix="cosim-bench-") as scratch:
        folder = Path(scratch)
        viewer, steps = _viewer(tube, effort.repeats, folder, say)
        run = folder / "alone0"
        figures: dict[str, Any] = {"steps": steps, "viewer": viewer}
        say("verify ...")
        figures["verify"] = _verification([_cosim("verify", str(run)) for _ in range(effort.repeats)])
        say("report ...")
        figures["report"] = _report(run, folder / "report.html")
    figures["bars"] = judge(figures)
    return figures


def _viewer(
    tube: Sequence[str], repeats: int, folder: Path, say: Callable[[str], None]
) -> tuple[dict[str, Any], int]:
    """Flights alone and viewed, neighbours in time; behind them the control steps of one."""
    pairs: list[tuple[float, float]] = []
    hashes: set[str] = set()
    pictures, seconds = 0, 0.0
    for repeat in range(repeats):
        say(f"flights alone and viewed, {repeat + 1} of {repeats} ...")
        frames = folder / f"frames{repeat}"
        frames.mkdir()
        flights = [
            _cosim("launch", *tube, "--out", str(folder / f"{name}{repeat}"), *more)
            for name, more in (
                ("alone", ()),
                ("viewed", ("--view-frames", str(frames), "--realtime", MAX_PACE)),
            )
        ]
        pictures += sum(1 for _ in frames.iterdir())
        seconds += flights[1]["wall_time_s"]
        hashes |= {flight["trajectory_hash"] for flight in flights}
        pairs.append((flights[0]["steps_per_second"], flights[1]["steps_per_second"]))
    alone, viewed = (statistics.median(values) for values in zip(*pairs, strict=True))
    found = {
        "steps_per_second_alone": round(alone, 1),
        "steps_per_second_viewed": round(viewed, 1),
        "ratio": round(statistics.median(pair[1] / pair[0] for pair in pairs), 3) if pictures else None,
        "pictures_per_second": round(pictures / seconds, 1),
        "same_hash": len(hashes) == 1,
    }
    return found, flights[0]["steps"]


def _verification(reports: Sequence[dict[str, Any]]) -> dict[str, Any]:
    loops, physics = ([report["replay"][key] for report in reports] for key in ("loop_s", "physics_s"))
    return {
        "loop_s": round(statistics.median(loops), 3),
        "physics_s": round(statistics.median(physics), 3),
        "ratio": round(statistics.median(a / b for a, b in zip(loops, physics, strict=True)), 3),
        "verified": all(report["verified"] for report in reports),
    }


def _report(run: Path, page: Path) -> dict[str, float]:
    from cosim.report import report

    start = time.perf_counter()
    report([run], page)
    seconds = time.perf_counter() - start
    return {"seconds": round(seconds, 2), "megabytes": round(page.stat().st_size / 1e6, 2)}


def judge(figures: dict[str, Any]) -> list[dict[str, Any]]:
    """The project's own bars on what was measured: rows of name, found, bar, reached."""
    rows: list[dict[str, Any]] = []
    if figures["steps"] < BARS_FROM:
        return rows
    ratio = figures["viewer"]["ratio"]
    if ratio is not None:
        name = "step rate with a live viewer over that without"
        rows.append({"name": name, "found": ratio, "bar": VIEWER_BAR, "reached": ratio >= VIEWER_BAR})
    for name, found, bar in (
        ("step loop of verify over the run's physics", figures["verify"]["ratio"], VERIFY_BAR),
        ("size of the report (MB)", figures["report"]["megabytes"], REPORT_BAR_MB),
    ):
        rows.append({"name": name, "found": found, "bar": bar, "reached": found <= bar})
    return rows


def _cosim(*arguments: str) -> dict[str, Any]:
    """One command in a process of its own; returns its JSON object."""
    command = [sys.executable, "-m", "cosim", arguments[0], "--json", *arguments[1:]]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        why = (done.stderr.strip().splitlines() or ["nothing was said"])[-1]
        raise CosimError(f"cosim {arguments[0]}: expected exit status 0, found {done.returncode}: {why}")
    report: dict[str, Any] = json.loads(done.stdout)
    return report


def runs_table(figures: dict[str, Any]) -> str:
    """The figures as text."""
    viewer, verify, report = (figures[key] for key in ("viewer", "verify", "report"))
    lines = [
        f"a flight of {figures['steps']} control steps",
        f"  alone        {viewer['steps_per_second_alone']:10.0f} steps/s",
    ]
    if viewer["ratio"] is None:
        lines.append(
            "  viewed       not measured: the viewer could draw nothing (cosim launch --view says why)"
        )
    else:
        same = "the same" if viewer["same_hash"] else "NOT the same"
        lines.append(
            f"  viewed       {viewer['steps_per_second_viewed']:10.0f} steps/s, {viewer['ratio']:.2f} of it; "
            f"{viewer['pictures_per_second']:.1f} pictures/s; {same} trajectory"
        )
    lines += [
        f"  verify       {verify['loop_s']:10.2f} s in its step loop, {verify['ratio']:.2f} times the run's physics",
        f"  report       {report['seconds']:10.2f} s to write, {report['megabytes']:.2f} MB",
        "",
    ]
    if figures["steps"] < BARS_FROM:
        lines.append(f"  no bars: they hold for flights of {BARS_FROM} steps, without --quick")
    lines += [
        f"  {row['name']:<50}{row['found']:8.2f}   bar {row['bar']:<6g}{'reached' if row['reached'] else 'missed'}"
        for row in figures["bars"]
    ]
    return "\n".join(lines)
