"""`cosim bench --training` on a small effort: the keys, and that what is not reached is not claimed."""

from __future__ import annotations

from pathlib import Path

import pytest
from flights import run_cosim

pytest.importorskip("stable_baselines3", reason="the extra 'train' is not installed")


def test_the_speed_of_training_is_reported(tmp_path: Path) -> None:
    """One object on stdout with positive rates; a policy below the paper's table has no time and a reason."""
    done = run_cosim("bench", "--training", "--quick", "--json", cwd=tmp_path)
    assert done.status == 0, done.stderr
    assert len(done.stdout.splitlines()) == 1
    assert set(done.report) == {"training"}
    training = done.report["training"]
    for name in ("env_steps_per_second", "env_random_steps_per_second", "ppo_steps_per_second"):
        assert training[name] > 0
    assert len(training["success"]) == 3
    assert training["seconds_to_beat_paper"] is None  # 1,600 steps teach nothing
    assert "is not above the paper's [0.84, 0.71, 0.87]" in training["reason"]
    assert list(tmp_path.iterdir()) == []
