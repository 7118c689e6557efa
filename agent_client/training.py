"""Training by proximal policy optimisation, with stable-baselines3 and the paper's hyperparameters, or by imitation.

The paper trained with RLlib; what its table leaves to that library is stable-baselines3's default here: value
loss weight 0.5, gradients clipped to norm 0.5, advantages normalised, Adam with epsilon 1e-5, no KL penalty.

After every iteration the checkpoint and the state to go on from are written, so that a kill costs one iteration.
"""

from __future__ import annotations

import io
import platform
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import stable_baselines3
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import configure_logger
from stable_baselines3.common.vec_env import VecNormalize

from agent_client.checkpoint import write_checkpoint
from agent_client.contract import Normalisation, running_contract
from agent_client.curriculum import Curriculum
from agent_client.environment import TubeVecEnv
from agent_client.errors import TrainingOver
from agent_client.features import FEATURES
from agent_client.imitation import Imitator
from agent_client.kinematic import KinematicPlant
from agent_client.sb3_policy import ACTIVATIONS, AsymmetricPolicy, actor_of
from agent_client.start import RegisterWalls
from agent_client.training_log import EpisodeMeans, Progress, append_log, cut_log, writing
from agent_client.training_options import IMITATED, Hyperparameters, TrainingOptions, fitting_minibatch
from agent_client.training_state import TrainingState, comparable, read_state, write_state
from agent_client.tubes import LEVELS, draw_pool
from agent_client.world import OpenSession, TubeWorld
from protocol.agent import SessionSettings
from protocol.twin import open_twin

__all__ = ["Hyperparameters", "OpenSession", "Progress", "TrainingOptions", "log_path", "state_path", "train"]


def state_path(checkpoint: Path) -> Path:
    """Where the state of a training lies, given its checkpoint."""
    return checkpoint.with_suffix(".state")


def log_path(checkpoint: Path) -> Path:
    """Where the log of a training lies, given its checkpoint."""
    return checkpoint.with_suffix(".csv")


def train(
    options: TrainingOptions,
    on_progress: Callable[[Progress], None] | None = None,
    open_session: OpenSession | None = None,
    *,
    register_walls: RegisterWalls | None = None,
    resume: bool = False,
    on_note: Callable[[str], None] = warnings.warn,
) -> Path:
    """Train a policy and write its checkpoint; the same options give the same policy on the same machine.

    Args:
        options: what to train.
        on_progress: called after every batch.
        open_session: opens the session to train in; None for the kinematic world of the paper.
        register_walls: for a plant with walls, see `TubeWorld`.
        resume: go on from the state beside the checkpoint, with new episodes. More steps than before stretch
            the learning rate's schedule from there on. An imitation first flies a few rounds that fill its memory
            (`agent_client.imitation.Imitator.begin`).
        on_note: told what a resumed training goes on without.

    Returns:
        The path of the checkpoint.

    Raises:
        TrainingError: nothing to resume, a state of other options, or a file that cannot be written.
        TrainingOver: all steps of the training to resume are done.
    """
    _prepare_torch(options.threads)
    hyper = replace(options.hyperparameters, minibatch=fitting_minibatch(options.hyperparameters))
    options = replace(options, hyperparameters=hyper)  # so that the contract records what was trained with
    pools = [draw_pool(level, options.seed, options.pool, options.tubes) for level in range(LEVELS)]
    session_settings = SessionSettings(hyper.lanes, options.dt, options.physics_dt)
    opener = open_session or (lambda s: open_twin(KinematicPlant(options.world.settings), s))
    with opener(session_settings) as session:
        engine = session.description.engine
        state = read_state(state_path(options.out), options, engine) if resume else None
        curriculum = Curriculum(replay=options.replay, level=options.first_level)
        seed = _seed_of(options.seed, state.iteration if state else 0)
        world = TubeWorld(session, pools, curriculum, options.world, seed, register_walls)
        env = VecNormalize(
            TubeVecEnv(world),
            norm_reward=False,
            clip_obs=hyper.observation_clip,
            gamma=hyper.gamma,
            epsilon=hyper.epsilon,
        )
        model = _make_model(env, options, seed)
        model.set_logger(_make_logger(options, fresh=state is None))
        imitator = None
        if options.imitation is not None:
            rounds = options.iterations
            imitator = Imitator(world, env, model.policy, hyper, options.imitation, rounds, seed)
        optimiser = imitator.optimiser if imitator else model.policy.optimizer
        watcher = _Watcher(options, model, optimiser, curriculum, env, engine, on_progress)
        if state is not None:
            watcher.restore(state)
        else:
            with writing(options.out):
                state_path(options.out).unlink(missing_ok=True)
                options.out.parent.mkdir(parents=True, exist_ok=True)
        log = log_path(options.out)
        if missing := cut_log(log, watcher.iteration):
            on_note(
                f"{log}: {missing} of {watcher.iteration} iterations are missing; it goes on without them"
            )
        if imitator is not None:
            watcher.imitate(imitator)
        else:
            # With counters that go on, stable-baselines3 adds the steps to those done.
            left, fresh = options.steps - model.num_timesteps, model.num_timesteps == 0
            model.learn(left, callback=watcher, reset_num_timesteps=fresh)
            watcher.save()
    return options.out


def _prepare_torch(threads: int) -> None:
    torch.set_num_threads(threads)
    # As torch.use_deterministic_algorithms(True), which also loads torch's compiler and so takes two seconds.
    torch.set_deterministic_debug_mode("error")
    # Each distribution would check its logits, which takes 3 % of an update; NaN is noticed when an action is drawn.
    torch.distributions.Distribution.set_default_validate_args(False)


def _seed_of(seed: int, iteration: int) -> int:
    """The seed of a training that begins at an iteration: a resumed one must not draw its first episodes again."""
    return int(np.random.SeedSequence([seed, iteration]).generate_state(1)[0]) if iteration else seed


def _make_model(env: VecNormalize, options: TrainingOptions, seed: int) -> PPO:
    hyper = options.hyperparameters
    first, last = hyper.learning_rate, hyper.final_learning_rate
    layers = list(hyper.hidden)
    seen = len(options.world.lags) * len(FEATURES)
    return PPO(
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
            "optimizer_kwargs": {"eps": 1e-5, "fused": True},  # fused: 10 % less time in an update
            **({"seen": seen} if options.world.privileged else {}),
        },
        seed=seed,
        device="cpu",
    )


def _make_logger(options: TrainingOptions, *, fresh: bool) -> Logger:
    """TensorBoard's, in a folder of its own or, when resumed, in the last one; or one that writes nothing."""
    if options.tensorboard is None:
        # stable-baselines3's default, though it would write nothing, leaves a folder in the temporary directory.
        return Logger(folder=None, output_formats=[])
    name = "PPO" if options.imitation is None else "imitation"
    with writing(options.tensorboard):
        return configure_logger(0, str(options.tensorboard), name, fresh)


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
        model: PPO,
        optimiser: torch.optim.Optimizer,
        curriculum: Curriculum,
        env: VecNormalize,
        engine: str,
        on_progress: Callable[[Progress], None] | None,
    ) -> None:
        super().__init__()
        self.model = model
        self._optimiser = optimiser
        self._options, self._curriculum, self._env, self._engine = options, curriculum, env, engine
        self._on_progress = on_progress
        self._total = options.iterations * options.hyperparameters.batch
        self._means = EpisodeMeans()
        self.iteration = 0
        """Batches that were collected."""
        self._saved = 0
        """Iteration that the files hold."""
        self._begun = (time.perf_counter(), 0)
        """When training began or was resumed, and at which step."""

    def imitate(self, imitator: Imitator) -> None:
        """Take the rounds of imitation that are not done yet."""
        imitator.begin(self.iteration)
        self._begun = (time.perf_counter(), self.num_timesteps)
        while self.iteration < self._options.iterations:
            loss = imitator.round(self.iteration, self._means.add)
            self.num_timesteps += self._options.hyperparameters.batch
            self._report()
            self.logger.record("tube/imitation_loss", loss)
            self.logger.dump(self.num_timesteps)
            self.save()

    def restore(self, state: TrainingState) -> None:
        """Go on where a state stood.

        Raises:
            TrainingOver: all steps are done.
        """
        if state.steps >= self._options.steps:
            raise TrainingOver(
                f"{state_path(self._options.out)}: expected a training that is not over, found {state.steps} of "
                f"{self._options.steps} steps done; ask for more steps in all"
            )
        model = self.model
        model.policy.load_state_dict(state.policy)
        self._optimiser.load_state_dict(dict(state.optimiser))
        model.num_timesteps = self.num_timesteps = state.steps
        seen = self._env.obs_rms
        seen.mean, seen.var, seen.count = state.mean.numpy(), state.variance.numpy(), state.count
        self._curriculum.restore(state.level, state.results, state.passed)
        self._means = EpisodeMeans(state.recent)
        self.iteration = self._saved = state.iteration

    def _on_training_start(self) -> None:
        self._begun = (time.perf_counter(), self.num_timesteps)

    def _on_step(self) -> bool:
        dones = self.locals["dones"]
        if dones.any():
            infos = self.locals["infos"]
            for lane in np.flatnonzero(dones):
                self._means.add(infos[lane]["episode"])
        return True

    def _on_rollout_start(self) -> None:
        # Before a batch, not after it: then the update that belongs to the last batch is done.
        if self.iteration > self._saved:
            self.save()

    def _on_rollout_end(self) -> None:
        self._report()

    def _report(self) -> None:
        """Count an iteration, and tell the logs and the caller where training stands."""
        self.iteration += 1
        progress = self._progress()
        append_log(log_path(self._options.out), progress)
        for name in ("level", "success_rate", "mean_return", "mean_steps", "timeout_rate"):
            self.logger.record(f"tube/{name}", getattr(progress, name))
        if self._on_progress is not None:
            self._on_progress(progress)

    def _progress(self) -> Progress:
        then, before = self._begun
        rate = (self.num_timesteps - before) / (time.perf_counter() - then)
        return Progress(
            iteration=self.iteration,
            steps=self.num_timesteps,
            total_steps=self._total,
            level=self._curriculum.level,
            success_rate=self._curriculum.success_rate,
            steps_per_second=rate,
            seconds_left=(self._total - self.num_timesteps) / rate,
            **self._means.take(),
        )

    def save(self) -> None:
        """Write the checkpoint, and the state to go on from, as they stand between two batches."""
        out, seen, policy = self._options.out, self._env.obs_rms, self.model.policy
        self._write_policy()
        state = TrainingState(
            options=comparable(self._options, self._engine),
            iteration=self.iteration,
            steps=self.num_timesteps,
            policy=policy.state_dict(),
            optimiser=self._optimiser.state_dict(),
            mean=torch.from_numpy(seen.mean),
            variance=torch.from_numpy(seen.var),
            count=float(seen.count),
            level=self._curriculum.level,
            passed=self._curriculum.passed,
            results=self._curriculum.results,
            recent=list(self._means.recent),
        )
        with writing(state_path(out)):
            write_state(state_path(out), state)
        self._saved = self.iteration

    def _write_policy(self) -> None:
        """Write the checkpoint with the contract as it stands."""
        options, hyper, seen = self._options, self._options.hyperparameters, self._env.obs_rms
        layers, network = actor_of(self.model.policy, str(options.out))
        width = len(options.world.lags) * len(FEATURES)  # of what the policy sees
        used = asdict(hyper)
        if options.imitation is not None:  # PPO's numbers had no part in it
            used = {name: used[name] for name in IMITATED}
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
                "pool": options.pool,
                "conditions": [asdict(c) for c in (options.world.conditions, *options.world.rotation)],
                "privileged": options.world.privileged,
                "tubes": [asdict(recipe) for recipe in options.tubes],
                "hyperparameters": used,
                "imitation": options.imitation and asdict(options.imitation),
                "versions": _versions(),
            },
            lags=options.world.lags,
        )
        buffer = io.BytesIO()
        self.model.save(buffer, exclude=_NOT_THE_POLICY)
        with writing(options.out):
            write_checkpoint(options.out, buffer.getvalue(), contract, layers)


def _versions() -> dict[str, Any]:
    return {
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "stable_baselines3": stable_baselines3.__version__,
        "numpy": np.__version__,
    }
