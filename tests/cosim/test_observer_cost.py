"""The measurement of what an observer costs."""

from __future__ import annotations

from pathlib import Path

from cosim.observer_cost import RATES, measure_observer


def test_every_rate_is_measured_beside_none() -> None:
    """Each rate has times and ratios; the observer looked as often as it was told, and nothing is left behind."""
    before = set(Path("/dev/shm").glob("cosim-observed-*"))
    figures = measure_observer(samples=2000, repeats=1)
    assert list(figures) == list(RATES)
    for row in figures.values():
        assert row["p50_us"] > 0.0
        assert row["p99_us"] >= row["p50_us"]
    assert figures["none"]["looks_per_s"] == 0.0
    assert figures["none"]["p50_ratio"] == 1.0
    assert figures["full_speed"]["looks_per_s"] > 0.0
    assert set(Path("/dev/shm").glob("cosim-observed-*")) <= before
