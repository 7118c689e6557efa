"""Learning from a teacher in place of PPO: the policy flies, the teacher says what it would have done (DAgger).

Source: Ross, Gordon, Bagnell, "A reduction of imitation learning and structured prediction to no-regret online
learning" (2011). Our addition; the paper's policy learns from its reward alone, and so do the presets `paper` and
`quick`. The teacher sees the exact axis and the hidden dynamics, the policy only its sensors' history.
PPO going on from an imitated policy was tried and ended lower (`agent_client.presets`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecNormalize

from agent_client.environment import episode_info
from agent_client.teacher import Teacher
from agent_client.training_options import Hyperparameters, Imitation
from agent_client.world import TubeWorld

Singles = NDArray[np.float32]

REFILL: Final = 10
"""Rounds at most that a resumed imitation flies to fill its memory before it learns on."""


class Memory:
    """The last observations and the teacher's commands, as many as fit; the oldest make room.

    Args:
        capacity: samples.
        width: entries of an observation.
    """

    def __init__(self, capacity: int, width: int) -> None:
        self._observations: Singles = np.zeros((capacity, width), np.float32)
        self._commands: Singles = np.zeros((capacity, 3), np.float32)
        self._written = 0

    def __len__(self) -> int:
        return min(self._written, len(self._observations))

    def add(self, observations: Singles, commands: Singles) -> None:
        """Keep samples (K, W) and (K, 3)."""
        rows = (self._written + np.arange(len(observations))) % len(self._observations)
        self._observations[rows], self._commands[rows] = observations, commands
        self._written += len(observations)

    def draw(self, rng: np.random.Generator, count: int) -> tuple[Singles, Singles]:
        """Draw samples evenly, with replacement."""
        rows = rng.integers(len(self), size=count)
        return self._observations[rows], self._commands[rows]


class Imitator:
    """Rounds of flying with the policy and learning from the teacher.

    Args:
        world: the lanes to fly in, before its first episode.
        env: whose normalisation the policy's observations go through; its statistics are set here.
        policy: stable-baselines3's actor-critic policy; its actor learns, its critic is left alone.
        hyper: `IMITATED` of them are taken.
        options: how to imitate.
        rounds: how many there will be.
        seed: of the draws from the memory and of the takeover.
    """

    def __init__(
        self,
        world: TubeWorld,
        env: VecNormalize,
        policy: Any,
        hyper: Hyperparameters,
        options: Imitation,
        rounds: int,
        seed: int,
    ) -> None:
        self._world, self._env, self._hyper, self._options = world, env, hyper, options
        self._rounds = rounds
        self._actor = torch.nn.Sequential(policy.mlp_extractor.policy_net, policy.action_net)
        self._seen = policy.mlp_extractor.policy_net[0].in_features
        self.optimiser = torch.optim.Adam(self._actor.parameters(), lr=options.learning_rate, fused=True)
        self._teacher = Teacher(world.geometry, world.options.settings, options.teacher)
        self._velocities = torch.from_numpy(self._teacher.velocities.astype(np.float32))
        self._memory = Memory(min(options.memory, rounds * hyper.batch), self._seen)
        self._rng = np.random.default_rng(seed)
        self._observation: Singles

    def begin(self, done: int = 0) -> None:
        """Begin episodes in all lanes, and after `done` rounds fill the memory, which is too large to be kept.

        The last of those rounds, up to `REFILL`, are flown once more, by the policy as it is and with new draws;
        nothing is learnt from them, and their episodes and steps count for nothing.
        """
        self._observation = self._world.restart()
        curriculum = self._world.curriculum
        level, results, passed = curriculum.level, curriculum.results, curriculum.passed
        for number in range(max(0, done - REFILL), done):
            self._fly(self._share(number), False, lambda _: None)
        curriculum.restore(level, results, passed)

    def _share(self, number: int) -> float:
        """Share of the lanes that the teacher flies in a round."""
        return max(0.0, 1.0 - number / self._options.takeover)

    def round(self, number: int, on_episode: Callable[[dict[str, Any]], None]) -> float:
        """Fly one batch, the teacher in a share of the lanes that falls to none, and learn from the memory.

        Args:
            number: of the round, from 0.
            on_episode: told of every episode that ended (`agent_client.environment.episode_info`).

        Returns:
            The mean loss of its updates.
        """
        self._fly(self._share(number), number < self._options.normalised_rounds, on_episode)
        spent = number / self._rounds
        first, last = self._options.learning_rate, self._options.final_learning_rate
        for group in self.optimiser.param_groups:
            group["lr"] = first + (last - first) * spent
        return float(np.mean([self._learn() for _ in range(self._options.updates)]))

    def _fly(self, share: float, normalising: bool, on_episode: Callable[[dict[str, Any]], None]) -> None:
        world, lanes = self._world, self._world.session.lanes
        batch = np.zeros((self._hyper.rollout, *self._observation.shape), np.float32)
        velocities = self._teacher.velocities
        for t in range(self._hyper.rollout):
            command = self._teacher.command(world.state, world.poses, world.drawn)
            batch[t] = self._observation
            knows = (world.state.frame[:, 0] * world.state.axis.tangent).sum(axis=1) > self._options.facing
            self._memory.add(self._observation[knows, : self._seen], command[knows].astype(np.float32))
            taught = ((command[:, None] - velocities[None]) ** 2).sum(axis=2).argmin(axis=1)
            actions = np.where(self._rng.random(lanes) < share, taught, self._decide())
            step = world.step(actions)
            for row in range(len(step.ended)):
                on_episode(episode_info(step, row)["episode"])
            self._observation = step.observation
        if normalising:
            self._env.obs_rms.update(batch.reshape(-1, batch.shape[2]))

    def _decide(self) -> NDArray[np.int64]:
        """The policy's most likely actions."""
        with torch.no_grad():
            logits = self._actor(self._normalised(self._observation[:, : self._seen]))
        chosen: NDArray[np.int64] = logits.argmax(dim=1).numpy()
        return chosen

    def _learn(self) -> float:
        """One step down the cross-entropy between the policy and the teacher's merit of the actions; the loss."""
        observations, commands = self._memory.draw(self._rng, self._options.minibatch)
        velocities = self._velocities
        # The squared distance between command and velocity, but for what is the same for all actions.
        merit = 2.0 * torch.from_numpy(commands) @ velocities.T - (velocities**2).sum(dim=1)
        wanted = torch.softmax(self._options.teacher.sharpness * merit, dim=1)
        found = torch.log_softmax(self._actor(self._normalised(observations)), dim=1)
        loss = -(wanted * found).sum(dim=1).mean()
        self.optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimiser.step()
        return float(loss.detach())

    def _normalised(self, observations: Singles) -> torch.Tensor:
        seen, clip = self._env.obs_rms, self._hyper.observation_clip
        scale = np.sqrt(seen.var[: self._seen] + self._hyper.epsilon)
        values = np.clip((observations - seen.mean[: self._seen]) / scale, -clip, clip)
        return torch.from_numpy(values.astype(np.float32))
