"""The vector environment of training: the lanes of one session as environments for stable-baselines3.

The world behind the session decides the dynamics: `protocol.twin.open_twin` with the kinematic plant is the
paper's training world. Tubes come from pools drawn before the first step, `agent_client.tubes.POOL_SIZE` a
level, from training's own seed domain; every episode draws one of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from agent_client.actions import action_table, decode
from agent_client.curriculum import Curriculum
from agent_client.features import FEATURES
from agent_client.settings import Settings
from agent_client.start import draw_starts
from agent_client.task import Outcome, TaskStep, TubeTask
from meshes.swept import SweptTube
from meshes.swept_geometry import SweptGeometry
from protocol.agent import AgentSession
from protocol.plant import CommandBatch, ResetBatch

Singles = NDArray[np.float32]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

REWARD_SCALE: Final = 0.02
"""Factor of the rewards that the learner sees, for the value loss; episode returns are not scaled."""


class TubeVecEnv(VecEnv):
    """N kinematic episodes that are started anew as they end.

    The info of a lane that is done carries `terminal_observation`, `TimeLimit.truncated`, and `episode`:
    return `r`, steps `l`, `outcome` (its name in lower case), `level`, `quality`. Other lanes' infos are empty.
    """

    def __init__(
        self,
        session: AgentSession,
        pools: Sequence[Sequence[SweptTube]],
        curriculum: Curriculum,
        settings: Settings,
        seed: int,
        centring: float = 0.0,
    ) -> None:
        """Put the lanes of an open session into tubes.

        Args:
            session: an open session; its lanes are the environments, its plant knows no walls.
            pools: the tubes of each level, from `agent_client.tubes.draw_pool`.
            curriculum: draws the level of each episode, and is told how it ended.
            settings: constants of the task.
            seed: of starts and of the choice of tubes.
            centring: weight of S_center in what the learner is rewarded with, see `_shape`; 0 is the paper's.
        """
        self.render_mode = None
        lanes = session.lanes
        super().__init__(
            lanes,
            spaces.Box(-1.0, 1.0, (len(FEATURES),), np.float32),
            spaces.Discrete(len(action_table(settings))),
        )
        self.session: Final = session
        self.curriculum: Final = curriculum
        self._settings = settings
        self._centring = centring
        self._geometry = SweptGeometry([tube for pool in pools for tube in pool], lanes)
        self._sizes = [len(pool) for pool in pools]
        self._first = np.concatenate([[0], np.cumsum(self._sizes)]).tolist()
        self._task = TubeTask(self._geometry, settings, session.dt, clearance_contact=True)
        self._table = action_table(settings)
        self._commands = CommandBatch.zeros(lanes)
        self._commands.compensation[:] = settings.drone.compensation
        self._resets = ResetBatch.zeros(lanes)
        defaults = session.description.defaults
        self._resets.parameters[:, : len(defaults)] = defaults
        self._level: Ints = np.zeros(lanes, dtype=np.int64)
        self._returns = np.zeros(lanes)
        self._actions: Ints = np.zeros(lanes, dtype=np.int64)
        self._rng = np.random.default_rng(seed)
        self.last: TaskStep
        """Everything about the lanes after the last step or reset."""

    def reset(self) -> Singles:
        """Begin new episodes in all lanes; after `seed(n)` the same ones every time."""
        if self._seeds[0] is not None:
            self._rng = np.random.default_rng(self._seeds[0])
        self._reset_seeds()
        return self._begin(np.arange(self.num_envs))

    def step_async(self, actions: Ints) -> None:
        """Keep the actions (N,) for `step_wait`."""
        self._actions[:] = actions

    def step_wait(self) -> tuple[Singles, NDArray[np.float32], Bools, list[dict[str, Any]]]:
        """Step all lanes, and begin new episodes where one ended.

        Returns:
            Observations (N, 37), scaled rewards (N,), done (N,), infos.
        """
        decode(self._actions, self.last.frame, self._table.local, self._table.speed, self._commands.raw)
        poses = self.session.step(self._commands)
        step = self.last = self._task.observe(poses)
        self._returns += step.reward
        done = step.outcome != Outcome.RUNNING
        rewards = self._shape(step)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        ended = np.flatnonzero(done)
        if not len(ended):
            return step.observation.copy(), rewards, done, infos
        for lane in ended.tolist():
            infos[lane] = self._conclude(lane)
        return self._begin(ended), rewards, done, infos

    def close(self) -> None:
        """Leave the session to whoever opened it."""

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Read an attribute that all lanes share."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Set an attribute that all lanes share."""
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *args: Any, indices: int | Iterable[int] | None = None, **kwargs: Any
    ) -> list[Any]:
        """Refused: the lanes are rows of one environment, which has the methods."""
        raise NotImplementedError(
            f"{method_name}: expected a call on the vector environment, not on its lanes"
        )

    def env_is_wrapped(
        self, wrapper_class: type[Any], indices: int | Iterable[int] | None = None
    ) -> list[bool]:
        """No lane is wrapped."""
        return [False for _ in self._get_indices(indices)]

    def _shape(self, step: TaskStep) -> Singles:
        """The learner's rewards (N,): the task's, scaled, and on top what `centring` pays for flying mid-tube.

        Our departure from the paper, which defines S_traj = (S_center + S_align) / 2 and judges by it, but whose
        reward holds S_align alone: a policy that cuts corners loses 2 % of it. S_center is paid like the other
        terms by the way flown, though never by more than v_max dt, which a corner cut would exceed.
        """
        reward = step.reward
        if self._centring > 0.0:
            reward = reward + self._centring * step.centring * np.minimum(step.episodes["gain"], 1.0)
        return (REWARD_SCALE * reward).astype(np.float32)

    def _begin(self, lanes: Ints) -> Singles:
        """Draw level, tube and start of new episodes in `lanes`; returns the observations of all lanes."""
        rng = self._rng
        levels = [self.curriculum.draw(rng) for _ in lanes]
        self._level[lanes] = levels
        self._geometry.assign(lanes, [self._first[a] + int(rng.integers(self._sizes[a])) for a in levels])
        self._returns[lanes] = 0.0
        draw_starts(self._resets, lanes, self._geometry, self._settings.start, rng)
        poses = self.session.reset(self._resets)
        self.last = self._task.begin(lanes, poses)
        return self.last.observation.copy()

    def _conclude(self, lane: int) -> dict[str, Any]:
        """Tell the curriculum how the episode of a lane ended, and say it in an info."""
        step = self.last
        outcome = Outcome(int(step.outcome[lane]))
        level = int(self._level[lane])
        self.curriculum.record(level, outcome is Outcome.SUCCESS)
        return {
            "terminal_observation": step.observation[lane].copy(),
            "TimeLimit.truncated": outcome is Outcome.TIMEOUT,
            "episode": {
                "r": float(self._returns[lane]),
                "l": int(step.step[lane]),
                "outcome": outcome.name.lower(),
                "level": level,
                "quality": float(step.quality[lane]),
            },
        }
