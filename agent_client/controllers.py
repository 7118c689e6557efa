"""Who flies: a controller turns what is known of each drone into the direction and the speed that it commands."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Final, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agent_client.actions import action_table, decode
from agent_client.errors import SettingsError
from agent_client.history import PRESENT, ObservationHistory
from agent_client.settings import Settings
from agent_client.task import TaskStep
from meshes.geometry import Geometry
from protocol.plant import CommandBatch

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]

CONTINUOUS: Final = -1
"""Action index of a command that comes from no action table."""

DEFAULT_LOOKAHEAD: Final = 1.0
"""Look-ahead of Pure Pursuit (m): our choice, in the middle of the 0.5 to 2 R that fly every tube."""


class Controller(ABC):
    """Chooses the commands of N lanes."""

    entropy: Floats | float = math.nan
    """Of the distributions that the last actions were chosen from (nat), (N,); NaN where there are none."""

    @abstractmethod
    def act(self, step: TaskStep, commands: CommandBatch, actions: Ints) -> None:
        """Fill in direction and speed of every lane, and nothing else of the command.

        Args:
            step: what is known now; not to be changed.
            commands: (N,) `direction` (unit vectors, world frame) and `speed` (m/s) are written.
            actions: (N,) output: indices into the action table, or CONTINUOUS.
        """


class ActingPolicy(Protocol):
    """Whatever maps observations to actions."""

    @property
    def entropies(self) -> Floats | float:
        """Of the distributions that the last actions were chosen from (nat), (N,); NaN where there are none."""
        ...

    def act(self, observations: Singles) -> Ints:
        """Action indices (N,) for observations (N, 37 L)."""
        ...


class PolicyController(Controller):
    """A policy over the 36 discrete actions; it sees the observation alone, the present one or some past ones.

    Args:
        policy: who decides.
        settings: constants of the task.
        lags: ages of the observations that the policy sees stacked (`agent_client.history`).
    """

    def __init__(self, policy: ActingPolicy, settings: Settings, lags: Sequence[int] = PRESENT) -> None:
        self.policy: Final = policy
        self._lags = lags
        self._history = ObservationHistory(1, lags)
        self._table = table = action_table(settings)
        # Loads compiled code before the first control step and not in it.
        decode(np.zeros(1, np.int64), np.eye(3)[None], table.local, table.speed, np.zeros((1, 8)))

    def act(self, step: TaskStep, commands: CommandBatch, actions: Ints) -> None:
        """Ask the policy, and turn its actions from the local frame into the world's."""
        if len(actions) != self._history.lanes:
            self._history = ObservationHistory(len(actions), self._lags)
        self._history.follow(step)
        actions[:] = self.policy.act(self._history.stack())
        self.entropy = self.policy.entropies
        decode(actions, step.frame, self._table.local, self._table.speed, commands.raw)


class PurePursuit(Controller):
    """Flies towards the point of the exact axis that lies a fixed arc length ahead, at one speed.

    It knows the centreline, which no drone in an unknown tube does: the reference of the paper's comparison.
    Beyond the end of the tube the axis is prolonged straight. Where it is and where the axis is it knows from the
    simulation and not from sensors: their noise and drop-outs and the observation's delay do not touch it, while
    an action's delay and everything that acts on the body do.

    Args:
        geometry: the tubes.
        settings: constants of the task.
        lookahead: arc length ahead (m).
        speed: commanded speed (m/s), None for the fastest speed level.

    Raises:
        SettingsError: a look-ahead or speed that is not above 0.
    """

    def __init__(
        self,
        geometry: Geometry,
        settings: Settings,
        *,
        lookahead: float = DEFAULT_LOOKAHEAD,
        speed: float | None = None,
    ) -> None:
        self.lookahead: Final = lookahead
        self.speed: Final = settings.speed_max if speed is None else speed
        for name, value in (("lookahead", lookahead), ("speed", self.speed)):
            if not (math.isfinite(value) and value > 0.0):
                raise SettingsError(f"{name} of Pure Pursuit: expected a number above 0, found {value}")
        self._geometry = geometry
        self._ahead = np.zeros(geometry.lanes)

    def act(self, step: TaskStep, commands: CommandBatch, actions: Ints) -> None:
        """Head for the points ahead."""
        np.add(step.axis.arc_length, self.lookahead, out=self._ahead)
        targets, tangents = self._geometry.axis(self._ahead)
        excess = self._ahead - self._geometry.length
        pursue(step.position, step.frame, targets, tangents, excess, self.speed, commands.raw)
        actions[:] = CONTINUOUS


@njit(cache=True, error_model="numpy")
def pursue(
    position: Floats,
    frame: Floats,
    targets: Floats,
    tangents: Floats,
    excess: Floats,
    speed: float,
    commands: Floats,
) -> None:
    """Command flight towards targets.

    Args:
        position: (N, 3) of the drones (m).
        frame: (N, 3, 3) local frames; a drone that sits on its target flies on along f.
        targets: (N, 3) points of the axis (m).
        tangents: (N, 3) of the axis there.
        excess: (N,) how far beyond the axis' end the target lies (m), negative before it.
        speed: commanded speed (m/s).
        commands: (N, 8) block of `protocol.plant.CommandBatch`; words 0 to 3 are written.
    """
    for i in range(position.shape[0]):
        beyond = max(excess[i], 0.0)
        norm = 0.0
        for c in range(3):
            commands[i, c] = targets[i, c] + beyond * tangents[i, c] - position[i, c]
            norm += commands[i, c] ** 2
        norm = math.sqrt(norm)
        for c in range(3):
            commands[i, c] = commands[i, c] / norm if norm > 1e-9 else frame[i, 0, c]
        commands[i, 3] = speed
