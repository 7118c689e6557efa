"""The three-level curriculum (paper, Curriculum Learning; Table "complexity and success thresholds")."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np

THRESHOLDS: Final = (0.85, 0.80, 0.80)
"""Success rate at which a level counts as passed, by level."""

WINDOW: Final = 300
"""Episodes over which the success rate is taken; the paper says "average" and no number."""


class Curriculum:
    """Which level the next episode is flown at.

    A level is left when the success rate over the last `window` episodes *at that level* reaches its
    threshold; a window must be full to count. The way leads upwards only, as in the paper. Episodes of an
    earlier level that end after the change count for nothing.

    The paper draws every episode from the current level. `replay` is our addition: the share of episodes
    drawn from the earlier levels, evenly, so that a long stay at the last level does not unlearn the first.
    """

    def __init__(
        self,
        thresholds: Sequence[float] = THRESHOLDS,
        window: int = WINDOW,
        replay: float = 0.0,
        level: int = 0,
    ) -> None:
        """Begin at `level`; 0 < thresholds <= 1, window >= 1, 0 <= replay < 1."""
        self.thresholds: Final = tuple(thresholds)
        self.replay: Final = replay
        self.level = level
        self.passed = False
        """Whether the last level's threshold has been reached."""
        self._results: deque[bool] = deque(maxlen=window)

    @property
    def success_rate(self) -> float:
        """Success rate over the last `window` episodes at the current level; NaN before the first."""
        return sum(self._results) / len(self._results) if self._results else math.nan

    @property
    def results(self) -> list[bool]:
        """The episodes that the success rate is taken over, oldest first."""
        return list(self._results)

    def restore(self, level: int, results: Sequence[bool], passed: bool) -> None:
        """Go on where another curriculum stood."""
        self.level, self.passed = level, passed
        self._results.clear()
        self._results.extend(results)

    def draw(self, rng: np.random.Generator) -> int:
        """Draw the level of the next episode."""
        if self.level > 0 and self.replay > 0.0 and rng.random() < self.replay:
            return int(rng.integers(self.level))
        return self.level

    def record(self, level: int, success: bool) -> bool:
        """Count a finished episode; True when it moved the curriculum to the next level."""
        if level != self.level:
            return False
        self._results.append(success)
        full = len(self._results) == self._results.maxlen
        if not full or self.success_rate < self.thresholds[self.level]:
            return False
        if self.level == len(self.thresholds) - 1:
            self.passed = True
            return False
        self.level += 1
        self._results.clear()
        return True
