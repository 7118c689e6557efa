"""What a policy sees of the past: several observations stacked, and all of them as old as the sensors' delay."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agent_client.conditions import DELAY_MAX
from agent_client.errors import SettingsError
from agent_client.features import FEATURES
from agent_client.task import TaskStep

Singles = NDArray[np.float32]
Ints = NDArray[np.int64]

LAG_MAX: Final = 1000
"""Greatest lag (control steps)."""

PRESENT: Final[tuple[int, ...]] = (0,)
"""Lags of a policy that sees the present alone: the paper's."""


class ObservationHistory:
    """A ring of the last observations of N lanes, and the stack of those that a policy sees.

    Args:
        lanes: N.
        lags: ages of the stacked observations in control steps, newest first. Before an episode is as old as a
            lag, its first observation stands in.

    Raises:
        SettingsError: no lags, or one that is negative or above LAG_MAX.
    """

    def __init__(self, lanes: int, lags: Sequence[int] = PRESENT) -> None:
        if not lags or min(lags) < 0 or max(lags) > LAG_MAX:
            raise SettingsError(f"lags: expected ages from 0 to {LAG_MAX} steps, found {tuple(lags)}")
        self.lanes: Final = lanes
        self._lags: Ints = np.array(lags, dtype=np.int64)
        self._ring: Singles = np.zeros((max(lags) + DELAY_MAX + 1, lanes, len(FEATURES)), np.float32)
        self._delay: Ints = np.zeros(lanes, dtype=np.int64)
        self._head = 0
        self._stack: Singles = np.zeros((lanes, len(lags) * len(FEATURES)), np.float32)

    def begin(self, lanes: Ints, observation: Singles, delay: Ints) -> None:
        """Start episodes in some lanes: the first observation fills the past.

        Args:
            lanes: (K,) lane indices.
            observation: (N, 37) of all lanes.
            delay: (N,) age of what the policy sees (control steps).
        """
        self._ring[:, lanes] = observation[lanes]
        self._delay[lanes] = delay[lanes]

    def push(self, observation: Singles) -> None:
        """Take in the observations (N, 37) of a control step."""
        self._head = (self._head + 1) % len(self._ring)
        self._ring[self._head] = observation

    def follow(self, step: TaskStep) -> None:
        """Take in a step of N episodes, each of which may have begun with it."""
        fresh = step.step == 0
        if not fresh.all():
            self.push(step.observation)
        if fresh.any():
            self.begin(np.flatnonzero(fresh), step.observation, step.episodes["observation_delay"])

    def stack(self) -> Singles:
        """What the policy sees, (N, 37 L): the observation of each lag, in the order of the lags.

        Overwritten by the next call.
        """
        _gather(self._ring, self._head, self._lags, self._delay, self._stack)
        return self._stack


@njit(cache=True)
def _gather(ring: Singles, head: int, lags: Ints, delay: Ints, stack: Singles) -> None:
    depth, lanes, width = ring.shape
    for i in range(lanes):
        for k in range(lags.shape[0]):
            row = ring[(head - lags[k] - delay[i]) % depth, i]
            for c in range(width):
                stack[i, k * width + c] = row[c]
