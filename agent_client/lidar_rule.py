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
    """The constants of the rule, all of them above 0."""

    centring: float = 4.0
    """Turn (rad) for a small front asymmetry, towards the side where the wall is further away: per range."""
    turning: float = 3.0
    """Turn (rad) for an asymmetry that is stronger at the front than at the rear, per range: the body stands across
    the tube, or the tube bends. In a round tube of 1 m the body's angle to the axis is about 4 rad a range."""
    saturation: float = 0.16
    """Front asymmetry (range) that more of hardly counts: the body never turns across the tube to get back to its
    middle."""


BEST_GAINS: Final = RuleGains()
"""Found on tubes of the domain "tune", mostly under hard conditions at level 2, where the best are equal over wide
ranges: 3 to 5, 2.5 to 3.5, 0.13 to 0.2. Slowing down in turns, or a constant turn upwards, gained nothing."""


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
        self._speed = settings.speed_max
        self._gains = np.array([gains.centring, gains.turning, gains.saturation])
        self._columns = np.array([FEATURE_NAMES.index(name) for name in ASYMMETRIES])
        self._history = ObservationHistory(1)
        # Loads compiled code before the first control step and not in it.
        nothing = np.zeros((1, len(ASYMMETRIES)), np.float32)
        _steer(nothing, np.eye(3)[None], self._gains, self._limits, self._speed, np.zeros((1, 8)))

    def act(self, step: TaskStep, commands: CommandBatch, actions: Ints) -> None:
        """Turn by the asymmetries that are seen now."""
        if len(actions) != self._history.lanes:
            self._history = ObservationHistory(len(actions))
        self._history.follow(step)
        seen = self._history.stack()[:, self._columns]
        _steer(seen, step.frame, self._gains, self._limits, self._speed, commands.raw)
        actions[:] = CONTINUOUS


@njit(cache=True, error_model="numpy")
def _steer(
    seen: Singles, frame: Floats, gains: Floats, limits: Floats, speed: float, commands: Floats
) -> None:
    """Command turns by asymmetries.

    Args:
        seen: (N, 4) h_f, v_f, h_r, v_r.
        frame: (N, 3, 3) local frames, rows f, u, r.
        gains: (3,) centring, turning, saturation.
        limits: (2,) greatest horizontal and vertical turn (rad).
        speed: commanded speed (m/s).
        commands: (N, 8) block of `protocol.plant.CommandBatch`; words 0 to 3 are written.
    """
    centring, turning, saturation = gains[0], gains[1], gains[2]
    turn = np.zeros(2)
    for i in range(frame.shape[0]):
        for k in range(2):
            front, rear = np.float64(seen[i, k]), np.float64(seen[i, 2 + k])
            wanted = centring * saturation * math.tanh(front / saturation) + turning * (front - rear)
            turn[k] = math.tan(min(max(wanted, -limits[k]), limits[k]))
        right, up = turn[0], turn[1]
        norm = math.sqrt(1.0 + right * right + up * up)
        for c in range(3):
            commands[i, c] = (frame[i, 0, c] + up * frame[i, 1, c] + right * frame[i, 2, c]) / norm
        commands[i, 3] = speed
