"""The tube task as Gymnasium environments: `TubeEnv` of one drone, `TubeVectorEnv` of N drones side by side.

Both are a `TubeWorld` over a session that a given function opens; it is closed with the environment, also when
that is garbage-collected or the program ends. Rewards are the task's own, not scaled. The infos say of every
step what came of it:

outcome         "running", "success", "exit", "collision" or "timeout"; a time-out truncates, the others terminate
level           of the tube
tube_seed       with the level, the domain and the recipe it names the tube (`agent_client.tubes.draw_tube`)
quality         Q of the episode so far
progress        arc length over the tube's length, 0 to 1
clearance       distance of the centre to the wall (m), negative outside
regime          of the reward: "visible", "memory" or "blind"
reward_terms    the reward's terms by their names (`agent_client.reward.TERMS`)
"""

from __future__ import annotations

import math
import weakref
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field
from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ClosedEnvironmentError, InvalidAction, ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from agent_client.actions import action_table
from agent_client.conditions import Conditions
from agent_client.curriculum import Curriculum
from agent_client.episodes import Records
from agent_client.errors import SettingsError
from agent_client.history import PRESENT
from agent_client.reward import TERMS, Regime
from agent_client.settings import DEFAULT_DT, Settings
from agent_client.start import RegisterWalls
from agent_client.task import Outcome
from agent_client.tubes import LEVELS, PAPER_TUBES, Domain, TubeRecipe, draw_tube
from agent_client.world import OpenSession, TubeWorld, WorldOptions
from meshes.swept import SweptTube
from protocol.agent import AgentSession, SessionSettings

Singles = NDArray[np.float32]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Info = dict[str, Any]

_OUTCOMES: Final = np.array([outcome.name.lower() for outcome in Outcome], dtype=object)
_REGIMES: Final = np.array([None, *(regime.name.lower() for regime in Regime)], dtype=object)


@dataclass(frozen=True)
class TubeEnvOptions:
    """What an environment flies.

    Raises:
        SettingsError: no such level, or an empty pool.
    """

    level: int = 0
    """Level of the tubes: 0, 1 or 2."""
    recipe: TubeRecipe = PAPER_TUBES
    """How the tubes are drawn."""
    domain: Domain = "train"
    """Of the tubes' seeds."""
    pool: int = 100
    """Number of different tubes that episodes draw from: those of the seeds from 0 on."""
    settings: Settings = field(default_factory=Settings)
    conditions: Conditions = field(default_factory=Conditions)
    lags: tuple[int, ...] = PRESENT
    """Ages of the observations that are stacked in one (`agent_client.history`)."""
    dt: float = DEFAULT_DT
    """Control step (s)."""
    physics_dt: float | None = None
    """Inner step (s); None for one a control step, as the kinematic world takes."""

    def __post_init__(self) -> None:
        _check_level(self.level)
        if self.pool < 1:
            raise SettingsError(f"pool: expected at least 1 tube, found {self.pool}")

    @property
    def world(self) -> WorldOptions:
        """The same, as far as a world needs it."""
        return WorldOptions(self.settings, self.conditions, lags=self.lags)

    def draw(self, level: int, seed: int) -> SweptTube:
        """The tube of a level and a seed."""
        return draw_tube(level, (seed,), self.domain, self.recipe)

    def open(self, lanes: int, open_session: OpenSession) -> AbstractContextManager[AgentSession]:
        """Open a session of so many lanes."""
        return open_session(SessionSettings(lanes, self.dt, self.physics_dt or self.dt))


class TubeEnv(gymnasium.Env[Singles, np.int64]):
    """One drone, one episode after each `reset`; once it is over, `step` wants a `reset` first.

    Args:
        open_session: opens the session that it flies in.
        options: what it flies.
        register_walls: for a plant with walls, see `TubeWorld`.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - declared so by the base class

    def __init__(
        self,
        open_session: OpenSession,
        options: TubeEnvOptions | None = None,
        register_walls: RegisterWalls | None = None,
    ) -> None:
        self.options: Final = options or TubeEnvOptions()
        self.observation_space, self.action_space, self._actions = _spaces(self.options.world)
        self._register_walls = register_walls
        self.session, self._close = _hold(self, self.options.open(1, open_session))
        self._tubes: dict[tuple[int, int], SweptTube] = {}
        self._world: TubeWorld | None = None
        """That of the episode, until it is over."""
        self._level = self._tube_seed = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Singles, Info]:
        """Begin an episode.

        Args:
            seed: begins all draws anew: the same seed, the same episodes.
            options: `level` and `tube_seed` of this episode's tube, where they are not to be the environment's
                own and drawn from its pool.

        Raises:
            SettingsError: another option, or no such level.
        """
        super().reset(seed=seed)
        _check_open(self._close)
        chosen = dict(options or {})
        level = _check_level(chosen.pop("level", self.options.level))
        tube_seed, world_seed = (int(self.np_random.integers(n)) for n in (self.options.pool, 2**63))
        tube_seed = chosen.pop("tube_seed", tube_seed)
        if chosen:
            raise SettingsError(f"options of reset: expected level and tube_seed, found {sorted(chosen)}")
        if not (isinstance(tube_seed, int | np.integer) and tube_seed >= 0):
            raise SettingsError(f"tube_seed: expected a whole number from 0 on, found {tube_seed!r}")
        self._level, self._tube_seed = level, tube_seed
        self._world = TubeWorld(
            self.session,
            _pools(level, [self._tube(level, tube_seed)]),
            _stay(level),
            self.options.world,
            world_seed,
            self._register_walls,
        )
        observation = self._world.restart()
        return observation[0], self._info(self._world)

    def step(self, action: np.int64) -> tuple[Singles, float, bool, bool, Info]:
        """Take a control step.

        Raises:
            InvalidAction: no action of the space.
            ResetNeeded: the episode is over, or none has begun.
            ProtocolError: the session failed; close the environment.
        """
        _check_open(self._close)
        world = self._world
        if world is None:
            raise ResetNeeded("the episode is over, or none has begun: call reset() before step()")
        observation = world.advance(_checked([action], self._actions, 1))
        state = world.state
        outcome = Outcome(int(state.outcome[0]))
        info = self._info(world)
        if outcome is not Outcome.RUNNING:
            self._world = None
        terminated = outcome not in (Outcome.RUNNING, Outcome.TIMEOUT)
        return observation[0], float(state.reward[0]), terminated, outcome is Outcome.TIMEOUT, info

    def close(self) -> None:
        """Close the session; may be called twice."""
        self._close()

    def _tube(self, level: int, seed: int) -> SweptTube:
        """A tube; those of the pool are kept once they are drawn."""
        tube = self._tubes.get((level, seed)) or self.options.draw(level, seed)
        if seed < self.options.pool:
            self._tubes[level, seed] = tube
        return tube

    def _info(self, world: TubeWorld) -> Info:
        infos = _describe(world.state.episodes, self._level, np.array([self._tube_seed]))
        terms = {name: float(values[0]) for name, values in infos.pop("reward_terms").items()}
        return {**{name: values.item() for name, values in infos.items()}, "reward_terms": terms}


class TubeVectorEnv(VectorEnv[Singles, Ints, NDArray[Any]]):
    """N drones, each of which begins a new episode in the step that ends one (`AutoresetMode.SAME_STEP`).

    The observations and infos of such a lane are then those of the new episode; the infos carry the last ones of
    the old under `final_obs` and `final_info`. Every entry of the infos is an array (N,) with a mask beside it
    under its name with an underscore, as in Gymnasium's own vector environments.

    Args:
        open_session: opens the session that it flies in.
        num_envs: N, the session's lanes.
        options: what it flies.
        register_walls: for a plant with walls, see `TubeWorld`.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self,
        open_session: OpenSession,
        num_envs: int = 1,
        options: TubeEnvOptions | None = None,
        register_walls: RegisterWalls | None = None,
    ) -> None:
        self.closed = True  # nothing to close yet, should opening fail
        self.options: Final = options or TubeEnvOptions()
        level = self.options.level
        self.num_envs = num_envs
        single = _spaces(self.options.world)
        self.single_observation_space, self.single_action_space, self._actions = single
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        pool = [self.options.draw(level, seed) for seed in range(self.options.pool)]
        self.session, self._close = _hold(self, self.options.open(num_envs, open_session))
        self.closed = False
        self._world = TubeWorld(
            self.session, _pools(level, pool), _stay(level), self.options.world, 0, register_walls
        )
        self._begun = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Singles, Info]:
        """Begin new episodes in all lanes.

        Args:
            seed: begins all draws anew: the same seed, the same episodes.
            options: none.

        Raises:
            SettingsError: an option.
        """
        super().reset(seed=seed)
        _check_open(self._close)
        if options:
            raise SettingsError(f"options of reset: expected none, found {sorted(options)}")
        self._world.seed(int(self.np_random.integers(2**63)))
        observation = self._world.restart()
        self._begun = True
        return observation, self._infos()

    def step(self, actions: Ints) -> tuple[Singles, Floats, Bools, Bools, Info]:
        """Take a control step in all lanes, and begin anew where an episode ended.

        Raises:
            InvalidAction: not one action of the space for each lane.
            ResetNeeded: no episode has begun.
            ProtocolError: the session failed; close the environment.
        """
        _check_open(self._close)
        if not self._begun:
            raise ResetNeeded("no episode has begun: call reset() before step()")
        tubes = self._world.geometry.assigned.copy()
        step = self._world.step(_checked(actions, self._actions, self.num_envs))
        infos = self._infos()
        if len(step.ended):
            final = np.full(self.num_envs, None, dtype=object)
            for lane, observation in zip(step.ended.tolist(), step.final, strict=True):
                final[lane] = observation
            described = _describe(step.episodes, self.options.level, tubes[step.ended])
            last = {"final_obs": final, "final_info": _spread(described, step.ended, self.num_envs)}
            infos |= _masked(last, step.ended, self.num_envs)
        truncated = step.outcome == Outcome.TIMEOUT
        terminated = (step.outcome != Outcome.RUNNING) & ~truncated
        return step.observation, step.reward, terminated, truncated, infos

    def close_extras(self) -> None:
        """Close the session."""
        self._close()

    def _infos(self) -> Info:
        """The infos of the present episodes of all lanes."""
        world = self._world
        # The pool has one level: the index of a tube in it is its seed.
        described = _describe(world.state.episodes, self.options.level, world.geometry.assigned)
        return _spread(described, np.arange(self.num_envs), self.num_envs)


def _spaces(options: WorldOptions) -> tuple[spaces.Space[Any], spaces.Space[Any], int]:
    """Spaces of one drone, the stacked observations and the actions; and the number of actions."""
    actions = len(action_table(options.settings))
    return spaces.Box(-1.0, 1.0, (options.width,), np.float32), spaces.Discrete(actions), actions


def _hold(
    owner: object, opened: AbstractContextManager[AgentSession]
) -> tuple[AgentSession, weakref.finalize[..., Any]]:
    """Enter a session; what leaves it is called at the latest when `owner` is collected or the program ends."""
    stack = ExitStack()
    session = stack.enter_context(opened)
    return session, weakref.finalize(owner, stack.close)


def _check_open(close: weakref.finalize[..., Any]) -> None:
    if not close.alive:
        raise ClosedEnvironmentError("the environment is closed: make a new one")


def _check_level(level: int) -> int:
    if level not in range(LEVELS):
        raise SettingsError(f"level: expected 0 to {LEVELS - 1}, found {level!r}")
    return level


def _checked(actions: ArrayLike, count: int, lanes: int) -> Ints:
    """The actions as an array (N,).

    Raises:
        InvalidAction: not one action of the space for each lane.
    """
    checked = np.asarray(actions)
    whole = np.issubdtype(checked.dtype, np.integer)
    if checked.shape != (lanes,) or not whole or checked.min() < 0 or checked.max() >= count:
        raise InvalidAction(
            f"actions: expected {lanes} whole numbers from 0 to {count - 1}, found {actions!r}"
        )
    return checked.astype(np.int64)


def _pools(level: int, tubes: list[SweptTube]) -> list[list[SweptTube]]:
    """Pools of all levels with tubes at one of them alone."""
    return [tubes if each == level else [] for each in range(LEVELS)]


def _stay(level: int) -> Curriculum:
    """A curriculum that never leaves a level."""
    return Curriculum(thresholds=(math.inf,) * LEVELS, level=level)


def _describe(episodes: Records, level: int, tube_seeds: Ints) -> Info:
    """The infos of K episodes as arrays (K,), from their records; copies."""
    terms = {name: episodes["reward_terms"][:, column].copy() for column, name in enumerate(TERMS)}
    return {
        "outcome": _OUTCOMES[episodes["outcome"]],
        "level": np.full(len(episodes), level),
        "tube_seed": tube_seeds.copy(),
        "quality": episodes["quality"].copy(),
        "progress": episodes["progress"].copy(),
        "clearance": episodes["clearance"].copy(),
        "regime": _REGIMES[episodes["regime"]],
        "reward_terms": terms,
    }


def _spread(infos: Info, lanes: Ints, count: int) -> Info:
    """Infos of some lanes, arrays (K,), as arrays over all lanes with masks."""
    spread: Info = {}
    for name, values in infos.items():
        if isinstance(values, dict):
            spread[name] = _spread(values, lanes, count)
        elif len(lanes) == count:
            spread[name] = values
        else:
            spread[name] = np.full(count, None if values.dtype == object else 0, dtype=values.dtype)
            spread[name][lanes] = values
    return _masked(spread, lanes, count)


def _masked(infos: Info, lanes: Ints, count: int) -> Info:
    """Infos with a mask of its lanes beside each entry."""
    mask = np.zeros(count, dtype=np.bool_)
    mask[lanes] = True
    return infos | {f"_{name}": mask.copy() for name in infos}
