"""Imitation before PPO, on small budgets."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="the extra 'train' is not installed")

from agent_client.checkpoint import read_checkpoint
from agent_client.imitation import Memory
from agent_client.settings import Settings
from agent_client.training import train
from agent_client.training_log import Progress
from agent_client.training_options import Hyperparameters, Imitation, TrainingOptions
from agent_client.tubes import TubeRecipe
from agent_client.world import WorldOptions

HYPER = Hyperparameters(lanes=26, rollout=50, minibatch=650, epochs=2, hidden=(64, 32))


def options(out: Path, **changes: object) -> TrainingOptions:
    """Ten rounds of imitation and two batches of PPO in tubes of 8 m, with two observations and a hidden view."""
    return replace(
        TrainingOptions(
            out,
            steps=12 * HYPER.batch,
            seed=2,
            world=WorldOptions(Settings(), lags=(0, 2), privileged=True),
            hyperparameters=HYPER,
            tubes=(TubeRecipe((8.0,)),),
            pool=20,
            imitation=Imitation(rounds=10, takeover=2, minibatch=256, updates=40, critic_rounds=1),
            threads=1,
        ),
        **changes,
    )


def weights(path: Path) -> list[np.ndarray]:
    """All weights of a checkpoint's actor."""
    layers = read_checkpoint(path).layers
    assert layers is not None
    return [part for layer in layers for part in (layer.weight, layer.bias)]


def test_a_policy_learns_from_the_teacher_and_ppo_goes_on(tmp_path: Path) -> None:
    """In the ninth round nearly every episode succeeds; PPO's batches are counted on, and repeat bit for bit."""
    seen: list[Progress] = []
    first = train(options(tmp_path / "a.zip"), seen.append)
    assert [p.iteration for p in seen] == list(range(1, 13))
    assert seen[-1].steps == 12 * HYPER.batch
    assert seen[8].batch_success > 0.9
    second = train(options(tmp_path / "b.zip"))
    for one, other in zip(weights(first), weights(second), strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_critic_learns_alone_at_first(tmp_path: Path) -> None:
    """In the first rounds of PPO the policy stays as imitation left it; afterwards it moves."""
    imitated = weights(train(options(tmp_path / "a.zip", steps=10 * HYPER.batch)))
    alone = weights(train(options(tmp_path / "b.zip", steps=11 * HYPER.batch)))
    moved = weights(train(options(tmp_path / "c.zip", steps=12 * HYPER.batch)))
    assert all(np.array_equal(a, b) for a, b in zip(imitated, alone, strict=True))
    assert not any(np.array_equal(a, b) for a, b in zip(imitated, moved, strict=True))


def test_an_imitation_that_was_cut_short_goes_on(tmp_path: Path) -> None:
    """A state left by a round is resumed with the rounds that are missing, to the same number of steps."""

    class CutError(Exception):
        pass

    def cut(progress: Progress) -> None:
        if progress.iteration == 5:
            raise CutError

    path = tmp_path / "a.zip"
    with pytest.raises(CutError):
        train(options(path), cut)
    seen: list[Progress] = []
    train(options(path), seen.append, resume=True)
    assert [p.iteration for p in seen] == list(range(5, 13))
    assert seen[-1].steps == 12 * HYPER.batch


def test_the_memory_keeps_the_newest() -> None:
    """Of 10 samples in a memory for 6 the last 6 are drawn, all of them, each with its own command."""
    memory = Memory(6, 2)
    numbers = np.arange(10, dtype=np.float32)
    for number in numbers:
        memory.add(np.full((1, 2), number, np.float32), np.full((1, 3), -number, np.float32))
    observations, commands = memory.draw(np.random.default_rng(0), 300)
    assert set(observations[:, 0]) == set(numbers[4:])
    np.testing.assert_array_equal(commands[:, 0], -observations[:, 0])
