"""Flight without learning and without a camera: turn by how unevenly far away the walls are.

The reference that shows how far the LiDAR alone goes: `LidarRule(settings)`, made anew for every flight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agent_client.controllers import CONTINUOUS, Controller
from agent_client.features import FEATURE_NAMES
from agent_client.history import ObservationHistory
from agent_client.settings import Settings
from agent_client.task import TaskStep
from protocol.plant import CommandBatch

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]

ASYMMETRIES: Final = ("h_f", "v_f", "h_r", "v_r")
"""The features that the rule sees, in this order."""


@dataclass(frozen=True)
class RuleGains:
    """The constants of the rule."""

    centring: float = 1.5
    """Turn (rad) for a front asymmetry of one range: towards the side where the wall is further away."""
    turning: float = 1.5
    """Turn (rad) for an asymmetry that is one range stronger at the front than at the rear: the body stands
    across the tube, or the tube bends."""
    slowing: float = 0.0
    """Share of the fastest speed given up when the turn is as wide as the cone of the actions."""


BEST_GAINS: Final = RuleGains()
"""Found by hand on tubes of the domain "tune"."""


class LidarRule(Controller):
    """Turns towards the side where the walls are further away, and along the tube as front and rear differ.

    It sees h_f, v_f, h_r and v_r of the observation, so that the sensors' noise and the observation's delay act
    on it; it knows neither camera nor memory nor centreline. Directions are continuous, within the cone of the
    36 actions.

    Args:
        settings: constants of the task.
        gains: constants of the rule.
    """

    def __init__(self, settings: Settings, gains: RuleGains = BEST_GAINS) -> None:
        spread = settings.actions.spread
        self._limits = np.array([spread * settings.camera.half_width, spread * settings.camera.half_height])
        self._speeds = np.array([settings.actions.speeds[0], settings.speed_max])
        self._gains = np.array([gains.centring, gains.turning, gains.slowing])
        self._columns = np.array([FEATURE_NAMES.index(name) for name in ASYMMETRIES])
        self._history = ObservationHistory(1)
        # Loads compiled code before the first control step and not in it.
        _steer(
            np.zeros((1, 4), np.float32),
            np.eye(3)[None],
            self._gains,
            self._limits,
            self._speeds,
            np.zeros((1, 8)),
        )

    def act(self, step: TaskStep, commands: CommandBatch, actions: Ints) -> None:
        """Turn by the asymmetries that are seen now."""
        if len(actions) != self._history.lanes:
            self._history = ObservationHistory(len(actions))
        self._history.follow(step)
        seen = self._history.stack()[:, self._columns]
        _steer(seen, step.frame, self._gains, self._limits, self._speeds, commands.raw)
        actions[:] = CONTINUOUS


@njit(cache=True, error_model="numpy")
def _steer(
    seen: Singles, frame: Floats, gains: Floats, limits: Floats, speeds: Floats, commands: Floats
) -> None:
    """Command a turn by asymmetries.

    Args:
        seen: (N, 4) h_f, v_f, h_r, v_r.
        frame: (N, 3, 3) local frames, rows f, u, r.
        gains: (3,) centring, turning, slowing.
        limits: (2,) greatest horizontal and vertical turn (rad).
        speeds: (2,) slowest and fastest speed (m/s).
        commands: (N, 8) block of `protocol.plant.CommandBatch`; words 0 to 3 are written.
    """
    centring, turning, slowing = gains[0], gains[1], gains[2]
    turn = np.zeros(2)
    for i in range(frame.shape[0]):
        width = 0.0
        for k in range(2):
            front, rear = np.float64(seen[i, k]), np.float64(seen[i, 2 + k])
            wanted = centring * front + turning * (front - rear)
            turn[k] = min(max(wanted, -limits[k]), limits[k])
            width = max(width, abs(turn[k]) / limits[k])
        right, up = math.tan(turn[0]), math.tan(turn[1])
        norm = math.sqrt(1.0 + right * right + up * up)
        for c in range(3):
            commands[i, c] = (frame[i, 0, c] + up * frame[i, 1, c] + right * frame[i, 2, c]) / norm
        commands[i, 3] = max(speeds[1] * (1.0 - slowing * width), speeds[0])
