"""Scores over many tubes, and the policy that is shipped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import agent_client
from agent_client.contract import require_match, running_contract
from agent_client.controllers import PolicyController, PurePursuit
from agent_client.evaluation import Score, evaluate, summarise
from agent_client.flight import PHASES, FlightResult
from agent_client.kinematic import KinematicPlant
from agent_client.policy import load_policy
from agent_client.settings import Settings
from agent_client.task import Outcome
from agent_client.tubes import PAPER_TUBES, VARIED_TUBES, TubeRecipe, draw_tube
from protocol.agent import SessionSettings
from protocol.twin import open_twin

SHIPPED = Path(agent_client.__file__).parent / "policies" / "tube_ppo.zip"


def score_of(make_controller, level: int, episodes: int, recipe: TubeRecipe) -> Score:
    """Fly unseen tubes of a level in the kinematic world."""
    tubes = [draw_tube(level, (9, index), "evaluate", recipe) for index in range(episodes)]
    session_settings = SessionSettings(lanes=episodes, dt=0.1, physics_dt=0.1)
    with open_twin(KinematicPlant(), session_settings) as session:
        return evaluate(session, tubes, make_controller, Settings(), seed=4, clearance_contact=True)


def test_a_score_counts_outcomes_and_compares_lengths_of_successes_alone() -> None:
    """Two successes of 10 and 30 steps where 10 would do at best, one time-out and one collision."""
    result = FlightResult(
        outcome=(Outcome.SUCCESS, Outcome.TIMEOUT, Outcome.SUCCESS, Outcome.COLLISION),
        steps=np.array([10, 100, 30, 4]),
        progress=np.ones(4),
        quality=np.array([1.0, 0.5, 0.9, 0.6]),
        min_clearance=np.ones(4),
        contacts=np.zeros(4, dtype=np.int64),
        sim_time=np.ones(4),
        control_steps=100,
        wall_time=1.0,
        phases=np.zeros(len(PHASES), dtype=np.int64),
    )
    score = summarise(result, np.full(4, 2.0), top_step=0.2)
    assert score == Score(4, 0.5, 0.0, 0.25, 0.25, 0.75, 36.0, 2.0)


def test_pure_pursuit_flies_every_level() -> None:
    """With the exact centreline and a short look-ahead no unseen tube is failed, at nearly the top speed."""
    for level in range(3):
        score = score_of(lambda geometry: PurePursuit(geometry, Settings()), level, 10, PAPER_TUBES)
        assert score.success == 1.0
        assert 0.9 < score.length_ratio < 1.3


def test_the_shipped_policy_is_small_and_fits_the_default_settings() -> None:
    """It is below 1.5 MB, carries its contract, and was trained without knowledge of the tube."""
    policy = load_policy(SHIPPED)
    assert SHIPPED.stat().st_size < 1.5e6
    assert policy.notes == ()
    assert require_match(policy.contract, running_contract(), SHIPPED.name) == ()
    assert set(policy.contract.masked) == {"progress", "position_f", "position_u", "position_r"}
    assert policy.contract.training["preset"] == "shipped"


@pytest.mark.parametrize("level", [0, 1, 2])
def test_the_shipped_policy_flies_unseen_tubes(level: int) -> None:
    """In 40 unseen tubes of each level it arrives, in time and near the middle."""
    policy = load_policy(SHIPPED)
    score = score_of(lambda _: PolicyController(policy, Settings()), level, 40, PAPER_TUBES)
    assert score.success == 1.0
    assert score.quality >= 0.9
    assert score.length_ratio <= 1.3


def test_the_shipped_policy_flies_narrow_wide_and_long_tubes() -> None:
    """Radii of 0.8 to 1.2 m that change along the tube, and lengths up to 84 m, are flown too."""
    policy = load_policy(SHIPPED)
    score = score_of(lambda _: PolicyController(policy, Settings()), 2, 20, VARIED_TUBES)
    assert score.success >= 0.95
    assert score.timeout == 0.0
