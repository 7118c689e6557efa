"""The reward against a transcription of the paper's equations, regime by regime."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agent_client.reward import TERMS, Regime
from agent_client.settings import MemorySettings, RewardSettings, Settings
from agent_client.task import Outcome, TaskStep, TubeTask

Maker = Callable[..., Any]

LITERAL = Settings(reward=RewardSettings(per_metre=False))


def paper_reward(step: TaskStep, regime: Regime, s_align: float, warmup: bool) -> float:
    """Section Reward Shaping, from the ranges of the two rings."""
    ranges = step.lidar[0].reshape(2, 36) / 3.0
    r = {}
    for name, ring in zip("FR", ranges, strict=True):
        r[f"{name}R"] = np.concatenate([ring[:5], ring[32:]]).mean()
        r[f"{name}T"], r[f"{name}L"], r[f"{name}B"] = (
            ring[5:14].mean(),
            ring[14:23].mean(),
            ring[23:32].mean(),
        )
    d_fh, d_fv, d_rh, d_rv = r["FR"] - r["FL"], r["FT"] - r["FB"], r["RR"] - r["RL"], r["RT"] - r["RB"]
    s_f, s_r = 1 - (abs(d_fh) + abs(d_fv)) / 2, 1 - (abs(d_rh) + abs(d_rv)) / 2
    mu_f, mu_r = ranges[0].mean(), ranges[1].mean()
    c_turn = np.clip((s_r - s_f) + max(mu_r - mu_f, 0), 0, 1)
    w_f, w_r = 0.6 * (1 - 0.4 * c_turn), 0.4 * (1 + 0.4 * c_turn)
    if regime is Regime.VISIBLE:
        reward = s_align + w_f * s_f + w_r * s_r + 0.4 * mu_f + 0.3 * (1 - abs(d_fh))
    elif regime is Regime.MEMORY:
        reward = s_align + w_f * s_f + w_r * s_r + 0.4 * (1 - abs(d_fh)) + 0.3 * (1 - abs(d_fv))
    else:
        reward = w_f * s_f + w_r * s_r + 0.4 * mu_f - 0.3 * abs(s_f - s_r)
    if warmup:
        reward += 0.5 * (0.7 * s_f + 0.3 * s_r) * (1 - abs(s_f - s_r)) * (1 - 0.5 * c_turn)
    return float(reward)


def test_the_three_regimes_follow_the_papers_equations(cylinder: Maker, poses_at: Maker) -> None:
    """Seen, then remembered, then blind: the reward is the paper's in each, with S_align of that regime."""
    settings = replace(LITERAL, memory=MemorySettings(steps=3))
    task = TubeTask(cylinder(), settings, 0.1, clearance_contact=True)
    ahead = np.array([0.9, 0.1, 0.2]) / np.linalg.norm([0.9, 0.1, 0.2])
    aside = np.array([0.5, 0.8, 0.1]) / np.linalg.norm([0.5, 0.8, 0.1])
    p = np.array([5.0, 0.25, -0.15])
    task.begin(np.array([0]), poses_at(p, ahead))
    seen = np.array([8.0, 0.0, 0.0]) - p
    seen /= np.linalg.norm(seen)
    expected = [(Regime.VISIBLE, ahead, ahead @ seen), *[(Regime.MEMORY, aside, aside @ seen)] * 3]
    expected += [(Regime.BLIND, aside, aside @ np.array([1.0, 0.0, 0.0]))] * 2
    for regime, direction, s_align in expected:
        step = task.observe(poses_at(p, direction))
        assert step.regime[0] == regime
        assert step.alignment[0] == pytest.approx(s_align, abs=1e-12)
        assert step.reward[0] == pytest.approx(paper_reward(step, regime, s_align, warmup=True), abs=1e-12)


def test_the_warmup_bonus_ends_after_its_steps(cylinder: Maker, poses_at: Maker) -> None:
    """The first 10 control steps earn it, the eleventh does not; an episode anew earns it again."""
    task = TubeTask(cylinder(), LITERAL, 0.1, clearance_contact=True)
    poses = poses_at([5.0, 0.2, 0.0], (1.0, 0.1, 0.0))
    bonus = TERMS.index("warmup")
    for _ in range(2):
        task.begin(np.array([0]), poses)
        paid = [bool(task.observe(poses).reward_terms[0, bonus] > 0.0) for _ in range(12)]
        assert paid == [True] * 10 + [False] * 2


def test_terms_sum_to_the_reward(cylinder: Maker, poses_at: Maker) -> None:
    """Every term is kept apart, the terminal one too."""
    task = TubeTask(cylinder(), LITERAL, 0.1, clearance_contact=True)
    task.begin(np.array([0]), poses_at([19.0, 0.1, 0.0]))
    for x in (19.2, 19.6):
        step = task.observe(poses_at([x, 0.1, 0.0]))
        assert step.reward[0] == pytest.approx(step.reward_terms[0].sum(), abs=1e-12)
    assert step.outcome[0] == Outcome.SUCCESS
    assert step.reward_terms[0, TERMS.index("terminal")] == 10.0


def test_per_metre_terms_are_the_literal_ones_times_progress_over_v_max_dt(
    cylinder: Maker, poses_at: Maker
) -> None:
    """Standing still earns nothing, top speed the literal reward, going back costs; the end pays in full."""
    tasks = [TubeTask(cylinder(), s, 0.1, clearance_contact=True) for s in (LITERAL, Settings())]
    for task in tasks:
        task.begin(np.array([0]), poses_at([5.0, 0.2, 0.0]))
    x = 5.0
    for moved in (0.0, 0.2, 0.05, -0.1):
        x += moved
        literal, metre = [task.observe(poses_at([x, 0.2, 0.0])) for task in tasks]
        np.testing.assert_allclose(metre.reward_terms, literal.reward_terms * moved / 0.2, atol=1e-12)
    metre = tasks[1].observe(poses_at([x, 0.9, 0.0]))
    assert metre.outcome[0] == Outcome.COLLISION
    assert metre.reward[0] == -10.0


@pytest.mark.parametrize(
    ("outcome", "position", "terminal"),
    [
        (Outcome.SUCCESS, [19.7, 0.0, 0.0], 10.0),
        (Outcome.COLLISION, [5.0, 0.9, 0.0], -10.0),
        (Outcome.EXIT, [-0.1, 0.0, 0.0], -10.0),
        (Outcome.TIMEOUT, [5.0, 0.0, 0.0], -1.0),
        (Outcome.RUNNING, [5.0, 0.0, 0.0], 0.0),
    ],
)
def test_terminal_rewards(
    cylinder: Maker, poses_at: Maker, outcome: Outcome, position: list[float], terminal: float
) -> None:
    """+10 for success, -10 for exit and collision alike, -1 for a time-out."""
    limit = 1 if outcome is Outcome.TIMEOUT else 100
    task = TubeTask(cylinder(), LITERAL, 0.1, clearance_contact=True, step_limit=limit)
    task.begin(np.array([0]), poses_at(position))
    step = task.observe(poses_at(position))
    assert step.outcome[0] == outcome
    assert step.reward_terms[0, TERMS.index("terminal")] == terminal
