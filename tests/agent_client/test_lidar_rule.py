"""The rule that flies by LiDAR alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from agent_client.conditions import HARD, Conditions
from agent_client.controllers import CONTINUOUS
from agent_client.evaluation import draw_episodes, fly_episodes, summarise
from agent_client.features import FEATURE_NAMES
from agent_client.kinematic import KinematicPlant
from agent_client.lidar_rule import ASYMMETRIES, BEST_GAINS, LidarRule, RuleGains
from agent_client.settings import Settings
from agent_client.task import TaskStep, TubeTask
from agent_client.tubes import HARD_TUBES, PAPER_TUBES
from physics_server.reference import ReferencePlant
from protocol.agent import SessionSettings
from protocol.plant import CommandBatch
from protocol.twin import open_twin

Maker = Callable[..., Any]

SETTINGS = Settings()


def first_look(geometry: Any, poses: Any) -> TaskStep:
    """The step of an episode that begins here."""
    return TubeTask(geometry, SETTINGS, 0.1, clearance_contact=True).begin(np.arange(geometry.lanes), poses)


def command(step: TaskStep, gains: RuleGains = BEST_GAINS) -> CommandBatch:
    """What the rule commands at a first look."""
    commands = CommandBatch.zeros(len(step.position))
    LidarRule(SETTINGS, gains).act(step, commands, np.zeros(len(step.position), dtype=np.int64))
    return commands


def test_in_the_middle_it_flies_straight_on_at_the_fastest_speed(cylinder: Maker, poses_at: Maker) -> None:
    """And writes nothing but direction, speed and that no action stands behind them."""
    commands, actions = CommandBatch.zeros(1), np.zeros(1, dtype=np.int64)
    commands.compensation[:] = 0.9
    LidarRule(SETTINGS).act(first_look(cylinder(), poses_at([5.0, 0.0, 0.0])), commands, actions)
    np.testing.assert_allclose(commands.direction, [[1.0, 0.0, 0.0]], atol=1e-6)
    assert (commands.speed[0], commands.compensation[0], actions[0]) == (2.0, 0.9, CONTINUOUS)
    assert (commands.raw[0, 5:] == 0.0).all()


@pytest.mark.parametrize("offset", [[0.3, 0.0], [-0.3, 0.0], [0.0, 0.3], [0.0, -0.3]])
def test_off_the_middle_it_turns_back_to_it(cylinder: Maker, poses_at: Maker, offset: list[float]) -> None:
    """Left, right, above and below, as strongly to each side."""
    direction = command(first_look(cylinder(), poses_at([5.0, *offset]))).direction[0]
    side = np.sign(offset) * math.hypot(*direction[1:])
    np.testing.assert_allclose(direction[1:], -side, atol=1e-6)
    assert 0.2 < math.hypot(*direction[1:]) < 0.6


@pytest.mark.parametrize("tilt", [[0.2, 0.0], [-0.2, 0.0], [0.0, 0.2], [0.0, -0.2]])
def test_across_the_tube_it_turns_along_it(cylinder: Maker, poses_at: Maker, tilt: list[float]) -> None:
    """In the middle of the tube the turn is about the angle between body and axis, the other way."""
    forward = np.array([1.0, *tilt])
    direction = command(first_look(cylinder(), poses_at([5.0, 0.0, 0.0], forward))).direction[0]
    before = math.atan2(math.hypot(*tilt), 1.0)
    after = math.atan2(float(np.sign(tilt) @ direction[1:]), direction[0])
    assert -0.5 * before < after < 0.5 * before


def test_a_drone_that_is_rolled_turns_to_the_same_side_of_the_world(cylinder: Maker, poses_at: Maker) -> None:
    """The rule lives in the drone's own frame, and there is no up in it."""
    level, rolled = (
        command(first_look(cylinder(), poses_at([5.0, 0.1, 0.0], roll=roll))).direction[0]
        for roll in (0.0, math.pi / 2)
    )
    np.testing.assert_allclose(level, rolled, atol=1e-6)


def test_no_turn_leaves_the_cone_of_the_actions(cylinder: Maker, poses_at: Maker) -> None:
    """However strong the gains: 0.75 of the camera's half-angles, horizontally and vertically."""
    wild = RuleGains(centring=100.0, turning=100.0, saturation=10.0)
    step = first_look(cylinder(), poses_at([5.0, 0.4, -0.3]))
    forward, up, right = command(step, wild).direction[0] @ step.frame[0].T
    assert math.degrees(math.atan2(right, forward)) == pytest.approx(0.75 * 45.0)
    assert math.degrees(math.atan2(up, forward)) == pytest.approx(0.75 * 35.0)


def test_it_sees_the_asymmetries_and_nothing_else(cylinder: Maker, poses_at: Maker) -> None:
    """Camera, memory, progress and place may read what they like; each of the four numbers counts."""
    step = first_look(cylinder(), poses_at([5.0, 0.2, -0.1]))
    before = command(step).raw.copy()
    columns = [FEATURE_NAMES.index(name) for name in ASYMMETRIES]
    others = np.setdiff1d(np.arange(len(FEATURE_NAMES)), columns)
    step.observation[:, others] = np.random.default_rng(0).uniform(-1.0, 1.0, len(others))
    np.testing.assert_array_equal(command(step).raw, before)
    for column in columns:
        step.observation[:, column] += 0.01
        assert not np.array_equal(command(step).raw, before)
        step.observation[:, column] -= 0.01


@pytest.mark.parametrize("level", [0, 1, 2])
def test_it_flies_the_kinematic_world(level: int) -> None:
    """All of 30 tubes of a level, near the middle and without loss of time."""
    with open_twin(KinematicPlant(), SessionSettings(30, 0.1, 0.1)) as session:
        episodes = draw_episodes(level, 30, 4, PAPER_TUBES)
        score = summarise(
            fly_episodes(session, episodes, lambda _: LidarRule(SETTINGS), SETTINGS, Conditions())
        )
    assert score.success == 1.0
    assert score.quality > 0.9
    assert score.length_ratio < 1.1


def test_inertia_and_noise_are_too_much_for_it_in_tight_bends() -> None:
    """Under hard conditions it flies most tubes of level 0, and at level 2 visibly fewer than all."""
    scores = []
    for level in (0, 2):
        with open_twin(ReferencePlant(), SessionSettings(40, 0.1, 1 / 240)) as session:
            episodes = draw_episodes(level, 40, 4, HARD_TUBES)
            scores.append(
                summarise(
                    fly_episodes(session, episodes, lambda _: LidarRule(SETTINGS), SETTINGS, HARD)
                ).success
            )
    assert scores[0] >= 0.95
    assert 0.6 < scores[1] < 1.0
