"""What a training can be told: hyperparameters and options, as data that needs no torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from agent_client.settings import DEFAULT_DT
from agent_client.teacher import TeacherOptions
from agent_client.tubes import PAPER_TUBES, POOL_SIZE, TubeRecipe
from agent_client.world import WorldOptions

REWARD_SCALE: Final = 0.02
"""Factor of the rewards that the learner sees, for the value loss; episode returns are not scaled. Our choice."""


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

    @property
    def batch(self) -> int:
        """Samples of one iteration."""
        return self.lanes * self.rollout


IMITATED: Final = ("lanes", "rollout", "hidden", "activation", "observation_clip", "epsilon")
"""The hyperparameters that imitation takes: the size of a round, the network, and the normalisation."""


@dataclass(frozen=True)
class Imitation:
    """How a policy imitates the teacher (`agent_client.imitation`) in place of PPO. Our addition.

    Each iteration is a round: it flies one batch of control steps, then learns from the samples kept so far.
    """

    teacher: TeacherOptions = field(default_factory=TeacherOptions)
    takeover: int = 8
    """Rounds over which the share of lanes that the teacher flies falls from all to none."""
    memory: int = 600_000
    """Samples kept."""
    facing: float = -0.5
    """Samples are kept where the cosine between heading and axis is above this. Nobody can tell by its sensors that
    it flies back in a tube: to be taught to turn there is to be taught to turn anywhere."""
    minibatch: int = 2048
    updates: int = 80
    """Minibatches a round."""
    learning_rate: float = 1e-3
    final_learning_rate: float = 2e-5
    normalised_rounds: int = 5
    """Rounds that the observation's statistics are taken from; afterwards they stay."""


@dataclass(frozen=True)
class TrainingOptions:
    """What to train, for how long, and where to put it."""

    out: Path
    """The checkpoint to write; beside it, under the same stem, `.state` to go on from and `.csv`, the log."""
    steps: int = 2_000_000
    """Control steps of all lanes together, rounded up to whole batches."""
    seed: int = 0
    preset: str = "custom"
    """Name for the contract."""
    world: WorldOptions = field(default_factory=WorldOptions)
    """Settings, conditions, and what policy and value network see."""
    dt: float = DEFAULT_DT
    physics_dt: float = 1.0 / 240.0
    """Inner step (s) of rigid bodies; the kinematic world has none."""
    hyperparameters: Hyperparameters = field(default_factory=Hyperparameters)
    tubes: tuple[TubeRecipe, ...] = (PAPER_TUBES,)
    """Recipes that the tubes of a pool are drawn from in turn."""
    pool: int = POOL_SIZE
    """Tubes of each level, drawn from training's domain before the first step."""
    replay: float = 0.0
    """Share of episodes from earlier levels (`agent_client.curriculum`)."""
    imitation: Imitation | None = None
    """How it imitates a teacher; None to learn by PPO. Of the hyperparameters it takes `IMITATED` alone."""
    first_level: int = 0
    """Level that the curriculum begins at."""
    threads: int = 2
    """Torch's threads. The policy's bits depend on it."""
    tensorboard: Path | None = None
    """Folder for TensorBoard's logs."""

    @property
    def iterations(self) -> int:
        """Batches of control steps."""
        return -(-self.steps // self.hyperparameters.batch)


def fitting_minibatch(hyper: Hyperparameters) -> int:
    """Size of the minibatches that training uses: the largest divisor of a batch not above `hyper.minibatch`.

    A last minibatch of fewer samples would weigh these more than the others. Where only single samples divide the
    batch, whose advantages cannot be normalised, it is the whole batch.
    """
    sizes = range(2, min(hyper.minibatch, hyper.batch) + 1)
    return max((size for size in sizes if hyper.batch % size == 0), default=hyper.batch)
