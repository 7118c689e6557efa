"""`cosim bench --runs` on a small effort: what it measured is what the commands say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from flights import run_cosim

from cosim.bench_runs import judge


def test_what_surrounds_a_flight_is_reported(tmp_path: Path) -> None:
    """A verified run, one trajectory with and without a viewer, and no bars for a look."""
    done = run_cosim("bench", "--runs", "--quick", "--json", cwd=tmp_path)
    assert done.status == 0, done.stderr
    assert len(done.stdout.splitlines()) == 1
    assert set(done.report) == {"runs"}
    runs = done.report["runs"]
    assert runs["steps"] > 100
    assert runs["verify"]["verified"] is True
    assert runs["viewer"]["same_hash"] is True
    assert runs["report"]["megabytes"] > 0.5  # the drawing library alone
    assert (runs["viewer"]["ratio"] is None) == (runs["viewer"]["pictures_per_second"] == 0)
    assert runs["bars"] == []  # of flights of thousands of steps
    assert list(tmp_path.iterdir()) == []


def test_a_bar_is_reached_on_its_own_side() -> None:
    """More of the step rate is better, more time and more bytes are worse."""
    figures: dict[str, Any] = {
        "steps": 10_283,
        "viewer": {"ratio": 0.74},
        "verify": {"ratio": 1.19},
        "report": {"megabytes": 10.1},
    }
    assert [row["reached"] for row in judge(figures)] == [False, True, False]
    figures["viewer"]["ratio"] = None
    assert [row["found"] for row in judge(figures)] == [1.19, 10.1]
