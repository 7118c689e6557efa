"""The other commands: help, training, benchmarks."""

from __future__ import annotations

from pathlib import Path

import pytest
from flights import run_cosim

ROUND_TRIPS = {"shm_two_cores", "shm_one_core", "pipe", "udp", "udp_one_core"}
QUANTILES = {"p50_us", "p99_us", "p999_us"}
PHASES = {"wait", "physics", "rays", "features", "policy", "recording", "other"}


@pytest.mark.parametrize("command", ["launch", "train", "figures", "export", "bench", "conformance"])
def test_help_says_how_to_call_a_command(command: str, tmp_path: Path) -> None:
    """Every command has a page of help that fits a screen's width."""
    done = run_cosim(command, "--help", cwd=tmp_path)
    assert done.status == 0
    assert done.stdout.startswith("Usage:")
    assert max(map(len, done.stdout.splitlines())) <= 110


def test_an_unknown_command_is_bad_usage(tmp_path: Path) -> None:
    """Usage errors exit with 2 and name what was not understood."""
    done = run_cosim("fly", cwd=tmp_path)
    assert done.status == 2
    assert "fly" in done.stderr


def test_bench_reports_every_figure(tmp_path: Path) -> None:
    """`cosim bench --json` prints one object with the promised keys, all of them positive times and ratios."""
    done = run_cosim("bench", "--json", "--quick", cwd=tmp_path)
    assert done.status == 0, done.stderr
    assert len(done.stdout.splitlines()) == 1
    report = done.report
    assert set(report["round_trip"]) == ROUND_TRIPS
    for row in report["round_trip"].values():
        assert set(row) == QUANTILES
        assert 0.0 < row["p50_us"] <= row["p99_us"] <= row["p999_us"]
    assert set(report["loop"]["phases_us"]) == PHASES
    assert report["loop"]["steps_per_second"] > 0.0
    assert report["loop"]["ratio_to_limit"] > 0.0
    assert report["startup_s"] > 0.0
