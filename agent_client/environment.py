"""The vector environment of training: the lanes of a `TubeWorld` as environments for stable-baselines3."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from agent_client.actions import action_table
from agent_client.task import Outcome
from agent_client.training_options import REWARD_SCALE
from agent_client.world import TubeWorld, WorldStep

Singles = NDArray[np.float32]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


class TubeVecEnv(VecEnv):
    """N episodes that are started anew as they end.

    The info of a lane that is done carries `terminal_observation`, `TimeLimit.truncated`, and `episode`:
    return `r`, steps `l`, `outcome` (its name in lower case), `level`, `quality`. Other lanes' infos are empty.

    Args:
        world: the lanes; its session stays open when this is closed.
    """

    def __init__(self, world: TubeWorld) -> None:
        self.render_mode = None
        bound = np.inf if world.options.privileged else 1.0
        super().__init__(
            world.session.lanes,
            spaces.Box(-bound, bound, (world.options.width,), np.float32),
            spaces.Discrete(len(action_table(world.options.settings))),
        )
        self.world: Final = world
        self._actions: Ints = np.zeros(self.num_envs, dtype=np.int64)

    def reset(self) -> Singles:
        """Begin new episodes in all lanes; a seed given by `seed` begins the draws anew."""
        if self._seeds[0] is not None:
            self.world.seed(int(self._seeds[0]))
        self._reset_seeds()
        return self.world.restart()

    def step_async(self, actions: Ints) -> None:
        """Keep the actions (N,) for `step_wait`."""
        self._actions[:] = actions

    def step_wait(self) -> tuple[Singles, Singles, Bools, list[dict[str, Any]]]:
        """Step all lanes, and begin new episodes where one ended.

        Returns:
            Observations (N, W), scaled rewards (N,), done (N,), infos.
        """
        step = self.world.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row, lane in enumerate(step.ended.tolist()):
            infos[lane] = episode_info(step, row)
        rewards = (REWARD_SCALE * step.reward).astype(np.float32)
        return step.observation, rewards, step.outcome != Outcome.RUNNING, infos

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


def episode_info(step: WorldStep, row: int) -> dict[str, Any]:
    """How episode `row` of those that ended in a step went, as stable-baselines3 wants to be told."""
    outcome = Outcome(int(step.episodes["outcome"][row]))
    return {
        "terminal_observation": step.final[row],
        "TimeLimit.truncated": outcome is Outcome.TIMEOUT,
        "episode": {
            "r": float(step.returns[row]),
            "l": int(step.episodes["step"][row]),
            "outcome": outcome.name.lower(),
            "level": int(step.levels[row]),
            "quality": float(step.episodes["quality"][row]),
        },
    }
