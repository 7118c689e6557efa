"""N lanes of one session as episodes that begin anew as they end: the core of every training environment.

The world behind the session decides the dynamics. Tubes come from pools drawn before the first step,
`agent_client.tubes.POOL_SIZE` a level; every episode draws one of them, a start, and its conditions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from agent_client.actions import action_table, decode
from agent_client.actuation import CommandPath
from agent_client.conditions import DRAWN, Conditions, Records, apply_parameters, draw_conditions
from agent_client.curriculum import Curriculum
from agent_client.features import FEATURES
from agent_client.history import PRESENT, ObservationHistory
from agent_client.privileged import WIDTH, privileged
from agent_client.settings import Settings
from agent_client.start import RegisterWalls, draw_starts
from agent_client.task import Outcome, TaskStep, TubeTask
from meshes.swept import SweptTube
from meshes.swept_geometry import SweptGeometry
from protocol.agent import AgentSession, SessionSettings
from protocol.plant import CommandBatch, PoseBatch, ResetBatch

Singles = NDArray[np.float32]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

OpenSession: TypeAlias = Callable[[SessionSettings], AbstractContextManager[AgentSession]]
"""Opens a session to fly in."""


@dataclass(frozen=True)
class WorldOptions:
    """What the lanes are flown under, and what is seen of them."""

    settings: Settings = field(default_factory=Settings)
    conditions: Conditions = field(default_factory=Conditions)
    rotation: tuple[Conditions, ...] = ()
    """Further conditions that episodes take in turn with `conditions`, so that rare ones are met more often."""
    lags: tuple[int, ...] = PRESENT
    """Ages of the observations that the policy sees (`agent_client.history`)."""
    privileged: bool = False
    """Whether the observation ends with what the value network alone may see (`agent_client.privileged`)."""

    @property
    def width(self) -> int:
        """Numbers in an observation."""
        return len(self.lags) * len(FEATURES) + (WIDTH if self.privileged else 0)


@dataclass(frozen=True)
class WorldStep:
    """What came of a control step."""

    observation: Singles  # (N, W)
    """Of the episodes that go on or begin."""
    reward: Floats  # (N,)
    outcome: NDArray[np.int8]  # (N,)
    """Values of Outcome, of the episodes before any began anew."""
    ended: Ints  # (E,)
    """Lanes whose episode ended in this step."""
    final: Singles  # (E, W)
    """The last observations of those episodes."""
    episodes: Records  # (E,)
    """The last records of those episodes (`agent_client.episodes`)."""
    levels: Ints  # (E,)
    """Their levels."""
    returns: Floats  # (E,)
    """Sums of their rewards."""


class TubeWorld:
    """The lanes of a session, flying.

    Args:
        session: an open session; its lanes are the environments.
        pools: the tubes of each level, from `agent_client.tubes.draw_pool`.
        curriculum: draws the level of each episode, and is told how it ended.
        options: what the lanes are flown under.
        seed: of starts, conditions and the choice of tubes.
        register_walls: for a plant with walls, which then reports contact; None for one without, where contact
            is judged from the clearance.
    """

    def __init__(
        self,
        session: AgentSession,
        pools: Sequence[Sequence[SweptTube]],
        curriculum: Curriculum,
        options: WorldOptions,
        seed: int,
        register_walls: RegisterWalls | None = None,
    ) -> None:
        lanes, settings = session.lanes, options.settings
        self.session: Final = session
        self.curriculum: Final = curriculum
        self.options: Final = options
        self._tubes = [tube for pool in pools for tube in pool]
        self.geometry: Final = SweptGeometry(self._tubes, lanes)
        self._register_walls = register_walls
        self._sizes = [len(pool) for pool in pools]
        self._first = np.concatenate([[0], np.cumsum(self._sizes)]).tolist()
        self._task = TubeTask(self.geometry, settings, session.dt, clearance_contact=register_walls is None)
        self._table = action_table(settings)
        self._commands = CommandBatch.zeros(lanes)
        self._path = CommandPath(lanes, session.description.speed_max)
        self._history = ObservationHistory(lanes, options.lags)
        self._resets = ResetBatch.zeros(lanes)
        defaults = session.description.defaults
        self._resets.parameters[:, : len(defaults)] = defaults
        self.drawn: Final[Records] = np.zeros(lanes, DRAWN)
        """Conditions of the lanes' episodes."""
        self._level: Ints = np.zeros(lanes, dtype=np.int64)
        self._returns = np.zeros(lanes)
        self.seed(seed)
        self.state: TaskStep
        """The task's last step, after `restart`."""
        self.poses: PoseBatch
        """The poses that it came from."""

    def seed(self, seed: int) -> None:
        """Begin the draws anew, with a whole number from 0 to 2^64 - 1."""
        self._seed, self._episode = seed, 0
        self._rng = np.random.default_rng(seed)

    def restart(self) -> Singles:
        """Begin new episodes in all lanes; returns their first observations (N, W)."""
        lanes = np.arange(self.session.lanes)
        return self._begin(lanes)

    def step(self, actions: Ints) -> WorldStep:
        """Take a control step in every lane, and begin anew where an episode ended.

        Args:
            actions: (N,) indices into the action table.
        """
        observation = self.advance(actions)
        state = self.state
        outcome, reward = state.outcome.copy(), state.reward.copy()
        ended = np.flatnonzero(outcome)
        if not len(ended):
            return WorldStep(
                observation, reward, outcome, ended, observation[:0], state.episodes[:0],
                self._level[:0], self._returns[:0],
            )  # fmt: skip
        final, episodes = observation[ended], state.episodes[ended]
        levels, returns = self._level[ended], self._returns[ended]
        for level, how in zip(levels.tolist(), outcome[ended].tolist(), strict=True):
            self.curriculum.record(level, how == Outcome.SUCCESS)
        return WorldStep(self._begin(ended), reward, outcome, ended, final, episodes, levels, returns)

    def advance(self, actions: Ints) -> Singles:
        """Take a control step in every lane and begin nothing anew: an episode that is over stays as it ended.

        Returns:
            Observations (N, W); everything else is in `state`.
        """
        decode(actions, self.state.frame, self._table.local, self._table.speed, self._commands.raw)
        poses = self.poses = self.session.step(self._path.send(self._commands, self.state))
        state = self.state = self._task.observe(poses)
        self._history.push(state.observation)
        self._returns += state.reward
        return self._look(poses)

    def _begin(self, lanes: Ints) -> Singles:
        """Draw level, tube, start and conditions of new episodes in `lanes`; returns all lanes' observations."""
        rng, options = self._rng, self.options
        levels = [self.curriculum.draw(rng) for _ in lanes]
        self._level[lanes] = levels
        tubes = [self._first[a] + int(rng.integers(self._sizes[a])) for a in levels]
        self.geometry.assign(lanes, tubes)
        if self._register_walls is not None:
            flown = [self._tubes[tube] for tube in self.geometry.assigned.tolist()]
            self._resets.tube[:] = self._register_walls(self.session, flown)
        self._returns[lanes] = 0.0
        seeds = np.full((len(lanes), 2), self._seed, dtype=np.uint64)
        seeds[:, 1] = np.arange(self._episode, self._episode + len(lanes))
        self._episode += len(lanes)
        drawn = np.zeros(len(lanes), DRAWN)
        choices = (options.conditions, *options.rotation)
        turn = seeds[:, 1] % np.uint64(len(choices))
        for number, conditions in enumerate(choices):
            drawn[turn == number] = draw_conditions(conditions, seeds[turn == number])
        self.drawn[lanes] = drawn
        apply_parameters(self._resets, lanes, drawn)
        draw_starts(self._resets, lanes, self.geometry, options.settings.start, rng)
        poses = self.poses = self.session.reset(self._resets)
        state = self.state = self._task.begin(lanes, poses, drawn)
        self._path.begin(lanes, drawn, state, self._commands)
        self._history.begin(lanes, state.observation, state.episodes["observation_delay"])
        return self._look(poses)

    def _look(self, poses: PoseBatch) -> Singles:
        """A copy of what is seen of all lanes, (N, W)."""
        self._task.measure_clearance()
        seen = self._history.stack()
        if not self.options.privileged:
            return seen.copy()
        hidden = privileged(self.state, poses, self.drawn, self.geometry)
        return np.concatenate([seen, hidden], axis=1)
