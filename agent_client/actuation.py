"""What becomes of a command between controller and plant: it is delayed, and blown about near a wall.

Both act on the command, so that they are the same for every plant. A wind w on a drone whose force is
m k_v (v_cmd d - V) is the same as w added to v_cmd d, which is how the air near a wall enters here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent_client.conditions import DELAY_MAX, NEAR_WALL_REACH
from agent_client.episodes import Records
from agent_client.noise import blow
from agent_client.task import TaskStep
from protocol.plant import CommandBatch

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class CommandPath:
    """The way of N lanes' commands to the plant.

    Args:
        lanes: N.
        speed_max: fastest speed that the plant takes (m/s).
    """

    def __init__(self, lanes: int, speed_max: float) -> None:
        self._ring: Floats = np.zeros((DELAY_MAX + 1, *CommandBatch.zeros(lanes).raw.shape))
        self._head = 0
        self._lanes = np.arange(lanes)
        self._delay: Ints = np.zeros(lanes, dtype=np.int64)
        self._near_wall: Floats = np.zeros(lanes)
        self._straight = True
        """Whether all commands go through as they are."""
        self._speed_max = speed_max
        self._sent = CommandBatch.zeros(lanes)

    def begin(self, lanes: Ints, drawn: Records, step: TaskStep, commands: CommandBatch) -> None:
        """Start episodes: their compensation, and until the first command arrives, none to move.

        Args:
            lanes: (K,) lane indices.
            drawn: (K,) conditions of the episodes (`agent_client.conditions.draw_conditions`).
            step: the first look of the episodes.
            commands: (N,) whose `compensation` is written, and nothing else.
        """
        commands.compensation[lanes] = drawn["compensation"]
        self._delay[lanes] = delay = drawn["action_delay"].astype(np.int64)
        self._near_wall[lanes] = drawn["near_wall"]
        self._straight = not (self._delay.any() or self._near_wall.any())
        if delay.any():
            waiting = commands.raw[lanes]
            waiting[:, :3] = step.frame[lanes, 0]
            waiting[:, 3] = 0.0
            self._ring[:, lanes] = waiting

    def send(self, commands: CommandBatch, step: TaskStep) -> CommandBatch:
        """What the plant gets in place of these commands; the same object without delay and disturbance.

        Args:
            commands: (N,) decided now.
            step: what they were decided on.
        """
        if self._straight:
            return commands
        self._head = (self._head + 1) % len(self._ring)
        self._ring[self._head] = commands.raw
        sent = self._sent.raw
        sent[:] = self._ring[(self._head - self._delay) % len(self._ring), self._lanes]
        blow(step.episodes, self._near_wall, NEAR_WALL_REACH, self._speed_max, sent)
        return self._sent
