"""Pure Pursuit and the wrapper of policies."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from agent_client.actions import action_table
from agent_client.controllers import CONTINUOUS, PolicyController, PurePursuit
from agent_client.errors import SettingsError
from agent_client.settings import Settings
from agent_client.task import TaskStep, TubeTask
from protocol.plant import CommandBatch

Maker = Callable[..., Any]


def first_look(geometry: Any, poses: Any) -> TaskStep:
    """The step of an episode that begins here."""
    return TubeTask(geometry, Settings(), 0.1, clearance_contact=True).begin(np.arange(geometry.lanes), poses)


def test_pure_pursuit_heads_for_the_axis_point_ahead(cylinder: Maker, poses_at: Maker) -> None:
    """1 m ahead of the nearest axis point, at the fastest speed; the rest of the command is untouched."""
    tube = cylinder(lanes=2)
    commands, actions = CommandBatch.zeros(2), np.zeros(2, dtype=np.int64)
    commands.compensation[:] = 0.9
    step = first_look(tube, poses_at([[5.0, 0.3, 0.0], [6.0, 0.0, -0.4]], (0.6, 0.8, 0.0)))
    PurePursuit(tube, Settings()).act(step, commands, actions)
    expected = np.array([[1.0, -0.3, 0.0], [1.0, 0.0, 0.4]])
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(commands.direction, expected, atol=1e-15)
    assert (commands.speed == 2.0).all()
    assert (commands.compensation == 0.9).all()
    assert (actions == CONTINUOUS).all()


def test_pure_pursuit_prolongs_the_axis_beyond_its_end(cylinder: Maker, poses_at: Maker) -> None:
    """Close to the end the aim does not collapse onto the end point."""
    tube = cylinder()
    commands, actions = CommandBatch.zeros(1), np.zeros(1, dtype=np.int64)
    step = first_look(tube, poses_at([19.9, 0.5, 0.0]))
    PurePursuit(tube, Settings(), lookahead=1.0, speed=1.5).act(step, commands, actions)
    np.testing.assert_allclose(commands.direction[0], np.array([1.0, -0.5, 0.0]) / math.hypot(1.0, 0.5))
    assert commands.speed[0] == 1.5


@pytest.mark.parametrize("bad", [{"lookahead": 0.0}, {"lookahead": math.nan}, {"speed": -1.0}])
def test_pure_pursuit_refuses_what_it_cannot_fly(cylinder: Maker, bad: dict[str, float]) -> None:
    """Named, with what was expected."""
    with pytest.raises(SettingsError, match=f"{next(iter(bad))} of Pure Pursuit: expected a number above 0"):
        PurePursuit(cylinder(), Settings(), **bad)


def test_a_policy_sees_the_observation_and_its_actions_become_commands(
    cylinder: Maker, poses_at: Maker
) -> None:
    """Action indices are looked up in the table and turned into the world by each drone's own frame."""
    seen = []

    class Fixed:
        entropies = math.nan

        def act(self, observations: np.ndarray) -> np.ndarray:
            seen.append(observations)
            return np.array([2, 7])

    tube = cylinder(lanes=2)
    step = first_look(tube, poses_at([[5.0, 0.0, 0.0]] * 2, [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    commands, actions = CommandBatch.zeros(2), np.zeros(2, dtype=np.int64)
    PolicyController(Fixed(), Settings()).act(step, commands, actions)
    np.testing.assert_array_equal(seen[0], step.observation)
    np.testing.assert_array_equal(actions, [2, 7])
    np.testing.assert_allclose(commands.direction[0], [1.0, 0.0, 0.0], atol=1e-15)  # straight
    right = action_table(Settings()).alpha[7]
    np.testing.assert_allclose(  # to the right of +y is +x
        commands.direction[1], [math.sin(right), math.cos(right), 0.0], atol=1e-12
    )
    np.testing.assert_array_equal(commands.speed, [1.5, 2.0])


def test_a_policy_with_a_history_sees_its_lags_side_by_side(cylinder: Maker, poses_at: Maker) -> None:
    """Blocks of 37, newest first; the first observation stands in for what was before it."""
    seen = []

    class Straight:
        entropies = math.nan

        def act(self, observations: np.ndarray) -> np.ndarray:
            seen.append(observations.copy())
            return np.zeros(len(observations), dtype=np.int64)

    tube = cylinder()
    task = TubeTask(tube, Settings(), 0.1, clearance_contact=True)
    controller = PolicyController(Straight(), Settings(), (0, 2))
    commands, actions = CommandBatch.zeros(1), np.zeros(1, dtype=np.int64)
    observations = []
    for k in range(5):
        poses = poses_at([1.0 + 0.1 * k, 0.1 * k, 0.0])
        step = task.observe(poses) if k else task.begin(np.arange(1), poses)
        observations.append(step.observation[0].copy())
        controller.act(step, commands, actions)
    for k in range(5):
        np.testing.assert_array_equal(
            seen[k][0], np.concatenate([observations[k], observations[max(k - 2, 0)]])
        )
