"""The measurement of what an observer costs."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from cosim import round_trip
from cosim.observer_cost import RATES, measure_observer


def test_every_rate_is_measured_beside_none() -> None:
    """Each rate has times and ratios; the observer looked as often as it was told, and nothing is left behind."""
    figures = measure_observer(samples=40_000, repeats=1)  # long enough for the observer to get a core
    assert list(figures) == list(RATES)
    for row in figures.values():
        assert row["p50_us"] > 0.0
        assert row["p99_us"] >= row["p50_us"]
        assert row["p50_ratio"] == pytest.approx(row["p50_us"] / figures["none"]["p50_us"], rel=2e-3)
    assert figures["none"]["looks_per_s"] == 0.0
    assert figures["none"]["p50_ratio"] == 1.0
    assert figures["full_speed"]["looks_per_s"] > 0.0
    assert not list(Path("/dev/shm").glob(f"cosim-bench-{os.getpid()}-*"))


def test_a_ratio_is_one_of_neighbours(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine that becomes slower from repeat to repeat leaves the ratios as they are: each is within a repeat."""
    paces = iter([pace for pace in (9.0, 1.0, 2.0, 10.0) for _ in RATES])  # the first round warms up
    costs = iter([1.0, 1.1, 1.2, 1.5] * 4)
    monkeypatch.setattr(
        round_trip, "time_exchanges", lambda *_: np.full(10, next(paces) * next(costs), dtype=np.float64)
    )
    figures = measure_observer(samples=10, repeats=3)
    assert [row["p50_ratio"] for row in figures.values()] == [1.0, 1.1, 1.2, 1.5]
    assert [row["p50_us"] for row in figures.values()] == pytest.approx([2.0, 2.2, 2.4, 3.0])
