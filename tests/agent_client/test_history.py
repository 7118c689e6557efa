"""Stacked and delayed observations, against plain lists of the past."""

from __future__ import annotations

import numpy as np
import pytest

from agent_client.conditions import DELAY_MAX
from agent_client.episodes import episode_dtype
from agent_client.errors import SettingsError
from agent_client.features import FEATURES
from agent_client.history import LAG_MAX, ObservationHistory
from agent_client.task import TaskStep

LANES, WIDTH = 4, len(FEATURES)


def numbered(step: int) -> np.ndarray:
    """Observations (N, 37) whose every number says which step and lane it is of."""
    return (step + 0.1 * np.arange(LANES)[:, None] + 0.001 * np.arange(WIDTH)).astype(np.float32)


@pytest.mark.parametrize("lags", [(0,), (0, 1), (0, 2, 5), (3, 0, 7)])
@pytest.mark.parametrize("delays", [[0, 0, 0, 0], [0, 1, 3, DELAY_MAX]])
def test_the_stack_holds_exactly_the_rows_of_its_lags_and_delays(
    lags: tuple[int, ...], delays: list[int]
) -> None:
    """Block k of a lane is its observation of lag plus delay steps ago, or its first one before that."""
    history = ObservationHistory(LANES, lags)
    history.begin(np.arange(LANES), numbered(0), np.array(delays))
    for now in range(1, 40):
        history.push(numbered(now))
        stack = history.stack().reshape(LANES, len(lags), WIDTH)
        for lane in range(LANES):
            for block, lag in enumerate(lags):
                then = max(now - lag - delays[lane], 0)
                np.testing.assert_array_equal(stack[lane, block], numbered(then)[lane])


def test_an_episode_that_begins_anew_forgets_the_one_before() -> None:
    """The new first observation fills the past of its lane, with its own delay; other lanes notice nothing."""
    history = ObservationHistory(LANES, (0, 4))
    history.begin(np.arange(LANES), numbered(0), np.full(LANES, 2))
    for now in range(1, 10):
        history.push(numbered(now))
    history.begin(np.array([1]), numbered(100), np.array([0, 1, 0, 0]))
    stack = history.stack().reshape(LANES, 2, WIDTH)
    np.testing.assert_array_equal(stack[1], [numbered(100)[1]] * 2)
    for lane in (0, 2, 3):
        np.testing.assert_array_equal(stack[lane], [numbered(7)[lane], numbered(3)[lane]])
    history.push(numbered(101))
    history.push(numbered(102))
    np.testing.assert_array_equal(history.stack().reshape(LANES, 2, WIDTH)[1, 0], numbered(101)[1])


def test_following_a_task_is_beginning_and_pushing() -> None:
    """Given steps of a task whose lanes begin at different times, it does the same as told by hand."""
    told, follows = (ObservationHistory(LANES, (0, 1, 3)) for _ in range(2))
    step = TaskStep.over(np.zeros(LANES, episode_dtype(4)))
    step.episodes["observation_delay"] = delays = np.array([0, 1, 2, 3])
    rng = np.random.default_rng(0)
    for now in range(30):
        step.observation[:] = numbered(now)
        fresh = np.full(LANES, now == 0) | (rng.random(LANES) < 0.1)
        step.step[:] = np.where(fresh, 0, step.step + 1)
        if now > 0:
            told.push(numbered(now))
        told.begin(np.flatnonzero(fresh), numbered(now), delays)
        follows.follow(step)
        np.testing.assert_array_equal(follows.stack(), told.stack())


@pytest.mark.parametrize("lags", [(), (0, -1), (0, LAG_MAX + 1)])
def test_lags_that_make_no_sense_are_refused(lags: tuple[int, ...]) -> None:
    """None at all, the future, or longer ago than anybody remembers."""
    with pytest.raises(SettingsError, match="lags"):
        ObservationHistory(LANES, lags)
