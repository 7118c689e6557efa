"""Training by proximal policy optimisation, with stable-baselines3 and the paper's hyperparameters.

The paper trained with RLlib; what its table leaves to that library is stable-baselines3's default here: value
loss weight 0.5, gradients clipped to norm 0.5, advantages normalised, Adam with epsilon 1e-5, no KL penalty.
"""

from __future__ import annotations

import io
import math
import platform
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import stable_baselines3
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecNormalize

from agent_client.checkpoint import write_checkpoint
from agent_client.contract import Normalisation, running_contract
from agent_client.curriculum import Curriculum
from agent_client.environment import TubeVecEnv
from agent_client.features import FEATURES
from agent_client.kinematic import KinematicPlant
from agent_client.sb3_policy import ACTIVATIONS, AsymmetricPolicy, actor_of
from agent_client.settings import DEFAULT_DT, RewardSettings, Settings
from agent_client.tubes import LEVELS, PAPER_TUBES, POOL_SIZE, VARIED_TUBES, TubeRecipe, draw_pool
from agent_client.world import TubeWorld, WorldOptions
from protocol.agent import AgentSession, SessionSettings
from protocol.twin import open_twin

UNKNOWN_TUBE: Final = ("progress", "position_f", "position_u", "position_r")
"""What a drone in an unknown tube cannot know: its progress along the tube, and its offset from the axis."""


@dataclass(frozen=True)
class Hyperparameters:
    """PPO's numbers. The paper's Table "Training hyperparameters" unless a line says otherwise."""

    learning_rate: float = 3e-4
    final_learning_rate: float = 3e-4
    """Learning rate at the last step, reached linearly. Our addition; the paper's stays the same."""
    gamma: float = 0.99
    lanes: int = 65
    """Environments. The paper's 13 with fragments of 200 steps make 2,600; 65 make its batch of 13,000."""
    rollout: int = 200
    """Steps of each environment in a batch: the paper's fragment length."""
    minibatch: int = 1300
    """At most; training takes the largest size not above it that divides a batch (`fitting_minibatch`)."""
    epochs: int = 10
    """Passes over a batch. Our choice."""
    gae_lambda: float = 0.95
    """Our choice."""
    entropy: float = 0.003
    clip: float = 0.3
    hidden: tuple[int, ...] = (256, 128)
    activation: str = "tanh"
    observation_clip: float = 10.0
    """Normalised observations are clipped to this. Our choice, as is how they are normalised at all."""
    epsilon: float = 1e-4
    """Added to the variance of an observation, so that one that hardly varies is not blown up. Our choice."""


@dataclass(frozen=True)
class TrainingOptions:
    """What to train, for how long, and where to put it."""

    out: Path
    """The checkpoint to write."""
    steps: int = 2_000_000
    """Control steps of all lanes together, rounded up to whole batches."""
    seed: int = 0
    preset: str = "custom"
    """Name for the contract."""
    world: WorldOptions = field(default_factory=WorldOptions)
    """Settings, conditions, and what policy and value network see."""
    dt: float = DEFAULT_DT
    physics_dt: float = DEFAULT_DT
    """Inner step (s); the kinematic world has none and takes dt."""
    hyperparameters: Hyperparameters = field(default_factory=Hyperparameters)
    tubes: tuple[TubeRecipe, ...] = (PAPER_TUBES,)
    """Recipes that the tubes of a pool are drawn from in turn."""
    pool: int = POOL_SIZE
    """Tubes of each level, drawn from training's domain before the first step."""
    replay: float = 0.0
    """Share of episodes from earlier levels (`agent_client.curriculum`)."""
    threads: int = 1
    """Torch's threads. The policy's bits depend on it."""
    save_every: int = 10
    """Batches between two writes of the checkpoint."""
    tensorboard: Path | None = None
    """Folder for TensorBoard's logs."""


@dataclass(frozen=True)
class Progress:
    """Where a training stands after a batch."""

    iteration: int
    steps: int
    total_steps: int
    level: int
    success_rate: float
    """Over the last 300 episodes at this level; NaN before the first ended."""
    mean_return: float
    """Of the last 300 episodes at any level, not scaled; NaN before the first ended."""
    mean_steps: float
    """Length of those episodes (control steps)."""
    timeout_rate: float
    """Share of time-outs among those episodes: it rises when a policy begins to loiter."""
    steps_per_second: float
    seconds_left: float


OpenSession = Callable[[SessionSettings], AgentSession]


def shipped_options(out: Path, steps: int = 2_000_000, seed: int = 1) -> TrainingOptions:
    """The recipe of the shipped policy: tubes of many widths and lengths, mid-tube, without knowing the tube."""
    return TrainingOptions(
        out,
        steps=steps,
        seed=seed,
        preset="shipped",
        hyperparameters=Hyperparameters(final_learning_rate=3e-5),
        world=WorldOptions(
            replace(Settings(masked_features=UNKNOWN_TUBE), reward=RewardSettings(centring=3.0))
        ),
        tubes=(VARIED_TUBES,),
        replay=0.3,
    )


def train(
    options: TrainingOptions,
    on_progress: Callable[[Progress], None] | None = None,
    open_session: OpenSession | None = None,
) -> Path:
    """Train a policy and write its checkpoint; the same options give the same policy on the same machine.

    Args:
        options: what to train.
        on_progress: called after every batch.
        open_session: opens the session to train in; None for the kinematic world of the paper.

    Returns:
        The path of the checkpoint.
    """
    torch.set_num_threads(options.threads)
    torch.use_deterministic_algorithms(True)
    hyper = options.hyperparameters
    hyper = replace(hyper, minibatch=fitting_minibatch(hyper))
    options = replace(options, hyperparameters=hyper)  # so that the contract records what was trained with
    session_settings = SessionSettings(lanes=hyper.lanes, dt=options.dt, physics_dt=options.physics_dt)
    opener = open_session or (lambda s: open_twin(KinematicPlant(options.world.settings), s))
    pools = [draw_pool(level, options.seed, options.pool, options.tubes) for level in range(LEVELS)]
    curriculum = Curriculum(replay=options.replay)
    with opener(session_settings) as session:
        world = TubeWorld(session, pools, curriculum, options.world, options.seed)
        env = VecNormalize(
            TubeVecEnv(world),
            norm_reward=False,
            clip_obs=hyper.observation_clip,
            gamma=hyper.gamma,
            epsilon=hyper.epsilon,
        )
        model = _make_model(env, options)
        watcher = _Watcher(options, curriculum, env, session.description.engine, on_progress)
        model.learn(options.steps, callback=watcher)
        watcher.save()
    return options.out


def fitting_minibatch(hyper: Hyperparameters) -> int:
    """Size of the minibatches that training uses: the largest divisor of a batch not above `hyper.minibatch`.

    A batch is lanes x rollout samples. A last minibatch of fewer samples would weigh these more than the others.
    Where only single samples divide it, whose advantages cannot be normalised, it is the whole batch.
    """
    batch = hyper.lanes * hyper.rollout
    sizes = range(2, min(hyper.minibatch, batch) + 1)
    return max((size for size in sizes if batch % size == 0), default=batch)


def _make_model(env: VecNormalize, options: TrainingOptions) -> PPO:
    hyper = options.hyperparameters
    first, last = hyper.learning_rate, hyper.final_learning_rate
    layers = list(hyper.hidden)
    seen = len(options.world.lags) * len(FEATURES)
    model = PPO(
        AsymmetricPolicy if options.world.privileged else "MlpPolicy",
        env,
        learning_rate=first if first == last else _LinearRate(first, last),
        n_steps=hyper.rollout,
        batch_size=hyper.minibatch,
        n_epochs=hyper.epochs,
        gamma=hyper.gamma,
        gae_lambda=hyper.gae_lambda,
        clip_range=hyper.clip,
        ent_coef=hyper.entropy,
        policy_kwargs={
            "net_arch": {"pi": layers, "vf": layers},
            "activation_fn": ACTIVATIONS[hyper.activation],
            **({"seen": seen} if options.world.privileged else {}),
        },
        tensorboard_log=str(options.tensorboard) if options.tensorboard else None,
        seed=options.seed,
        device="cpu",
    )
    if options.tensorboard is None:
        # The default logger, though it would write nothing, leaves a folder in the temporary directory.
        model.set_logger(Logger(folder=None, output_formats=[]))
    return model


@dataclass(frozen=True)
class _LinearRate:
    """A learning rate that goes linearly from `first` to `last`."""

    first: float
    last: float

    def __call__(self, remaining: float) -> float:
        """The rate when this share of the training, 1 to 0, remains."""
        return self.last + (self.first - self.last) * remaining


_NOT_THE_POLICY: Final = (
    "ep_info_buffer", "ep_success_buffer", "tensorboard_log", "start_time",
    "_last_obs", "_last_original_obs", "_last_episode_starts", "learning_rate", "lr_schedule",
)  # fmt: skip
"""Attributes of the model that are no part of a checkpoint: statistics, clocks, paths, the last step, and the
schedule of the learning rate, whose class a reader might not have (the contract has its numbers)."""


class _Watcher(BaseCallback):
    """Counts episodes, reports progress and writes checkpoints, between stable-baselines3's batches."""

    def __init__(
        self,
        options: TrainingOptions,
        curriculum: Curriculum,
        env: VecNormalize,
        engine: str,
        on_progress: Callable[[Progress], None] | None,
    ) -> None:
        super().__init__()
        self._options, self._curriculum, self._env, self._engine = options, curriculum, env, engine
        self._on_progress = on_progress
        batch = options.hyperparameters.lanes * options.hyperparameters.rollout
        self._total = math.ceil(options.steps / batch) * batch
        self._episodes: deque[dict[str, Any]] = deque(maxlen=300)
        self._iteration = 0
        self._started = time.perf_counter()

    def _on_training_start(self) -> None:
        self._started = time.perf_counter()

    def _on_step(self) -> bool:
        dones = self.locals["dones"]
        if dones.any():
            infos = self.locals["infos"]
            self._episodes.extend(infos[lane]["episode"] for lane in np.flatnonzero(dones))
        return True

    def _on_rollout_start(self) -> None:
        # Before a batch, not after it: then the update that belongs to the last batch is done.
        if self._iteration and self._iteration % self._options.save_every == 0:
            self.save()

    def _on_rollout_end(self) -> None:
        self._iteration += 1
        progress = self._progress()
        for name in ("level", "success_rate", "mean_return", "mean_steps", "timeout_rate"):
            self.logger.record(f"tube/{name}", getattr(progress, name))
        if self._on_progress is not None:
            self._on_progress(progress)

    def _progress(self) -> Progress:
        rate = self.num_timesteps / (time.perf_counter() - self._started)
        episodes = self._episodes or [{"r": math.nan, "l": math.nan, "outcome": ""}]
        return Progress(
            iteration=self._iteration,
            steps=self.num_timesteps,
            total_steps=self._total,
            level=self._curriculum.level,
            success_rate=self._curriculum.success_rate,
            mean_return=float(np.mean([e["r"] for e in episodes])),
            mean_steps=float(np.mean([e["l"] for e in episodes])),
            timeout_rate=float(np.mean([e["outcome"] == "timeout" for e in episodes])),
            steps_per_second=rate,
            seconds_left=(self._total - self.num_timesteps) / rate,
        )

    def save(self) -> None:
        """Write the checkpoint with the contract as it stands."""
        options, hyper, seen = self._options, self._options.hyperparameters, self._env.obs_rms
        layers, network = actor_of(self.model.policy, str(options.out))
        width = len(options.world.lags) * len(FEATURES)  # of what the policy sees
        contract = running_contract(
            options.world.settings,
            options.dt,
            normalisation=Normalisation(
                tuple(seen.mean[:width].tolist()),
                tuple(seen.var[:width].tolist()),
                hyper.observation_clip,
                hyper.epsilon,
            ),
            network=network,
            training={
                "preset": options.preset,
                "seed": options.seed,
                "steps": self.num_timesteps,
                "dynamics": self._engine,
                "level": self._curriculum.level,
                "replay": options.replay,
                "conditions": asdict(options.world.conditions),
                "privileged": options.world.privileged,
                "tubes": [asdict(recipe) for recipe in options.tubes],
                "hyperparameters": asdict(hyper),
                "versions": {
                    "python": platform.python_version(),
                    "torch": str(torch.__version__),
                    "stable_baselines3": stable_baselines3.__version__,
                    "numpy": np.__version__,
                },
            },
            lags=options.world.lags,
        )
        buffer = io.BytesIO()
        self.model.save(buffer, exclude=_NOT_THE_POLICY)
        write_checkpoint(options.out, buffer.getvalue(), contract, layers)
