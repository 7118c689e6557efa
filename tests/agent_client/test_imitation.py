"""Imitation in place of PPO, on small budgets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="the extra 'train' is not installed")

import torch
from tensorboard.backend.event_processing import event_accumulator

from agent_client.checkpoint import read_checkpoint
from agent_client.imitation import Memory
from agent_client.settings import Settings
from agent_client.training import train
from agent_client.training_log import Progress
from agent_client.training_options import Hyperparameters, Imitation, TrainingOptions
from agent_client.tubes import TubeRecipe
from agent_client.world import TubeWorld, WorldOptions

HYPER = Hyperparameters(lanes=26, rollout=50, minibatch=650, epochs=2, hidden=(64, 32))


def options(out: Path, **changes: object) -> TrainingOptions:
    """Ten rounds of imitation in tubes of 8 m, with two observations and a hidden view."""
    return replace(
        TrainingOptions(
            out,
            steps=10 * HYPER.batch,
            seed=2,
            world=WorldOptions(Settings(), lags=(0, 2), privileged=True),
            hyperparameters=HYPER,
            tubes=(TubeRecipe((8.0,)),),
            pool=20,
            imitation=Imitation(takeover=2, minibatch=256, updates=40),
            threads=1,
        ),
        **changes,
    )


def weights(path: Path) -> list[np.ndarray]:
    """All weights of a checkpoint's actor."""
    layers = read_checkpoint(path).layers
    assert layers is not None
    return [part for layer in layers for part in (layer.weight, layer.bias)]


class CutError(Exception):
    """Raised to cut a training short."""


def cut_at(iteration: int) -> Callable[[Progress], None]:
    """A callback that cuts a training short when this round was flown, before it is saved."""

    def cut(progress: Progress) -> None:
        if progress.iteration == iteration:
            raise CutError

    return cut


def test_a_policy_learns_from_the_teacher(tmp_path: Path) -> None:
    """In the ninth round nearly every episode succeeds; all rounds imitate, and they repeat bit for bit."""
    seen: list[Progress] = []
    first = train(options(tmp_path / "a.zip"), seen.append)
    assert [p.iteration for p in seen] == list(range(1, 11))
    assert seen[-1].steps == 10 * HYPER.batch
    assert seen[8].batch_success > 0.9
    second = train(options(tmp_path / "b.zip"))
    for one, other in zip(weights(first), weights(second), strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_contract_has_the_numbers_that_were_used(tmp_path: Path) -> None:
    """Those of the imitation, the size of a round, the network and the normalisation; none of PPO's."""
    contract = read_checkpoint(train(options(tmp_path / "a.zip", steps=HYPER.batch))).contract
    assert contract is not None
    assert contract.training["imitation"]["updates"] == 40
    assert contract.training["hyperparameters"] == {
        "lanes": 26,
        "rollout": 50,
        "hidden": [64, 32],
        "activation": "tanh",
        "observation_clip": HYPER.observation_clip,
        "epsilon": HYPER.epsilon,
    }


def test_an_imitation_that_was_cut_short_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The rounds that are missing follow, with new draws and Adam's moments, and no worse than before the cut."""
    seeds: list[int] = []
    seed_world = TubeWorld.seed
    monkeypatch.setattr(TubeWorld, "seed", lambda world, n: (seeds.append(n), seed_world(world, n))[1])
    path = tmp_path / "a.zip"
    before: list[Progress] = []
    with pytest.raises(CutError):
        train(options(path), lambda p: (before.append(p), cut_at(8)(p))[0])
    begun = set(seeds)
    seeds.clear()
    state = torch.load(path.with_suffix(".state"), weights_only=True)
    assert {float(moments["step"]) for moments in state["optimiser"]["state"].values()} == {7 * 40.0}

    seen: list[Progress] = []
    train(options(path), seen.append, resume=True)
    assert [p.iteration for p in seen] == [8, 9, 10]
    assert [p.steps for p in seen] == [n * HYPER.batch for n in (8, 9, 10)]
    assert not begun & set(seeds)
    assert seen[0].batch_success > before[-1].batch_success - 0.1
    assert seen[-1].batch_success > 0.9
    state = torch.load(path.with_suffix(".state"), weights_only=True)
    assert {float(moments["step"]) for moments in state["optimiser"]["state"].values()} == {10 * 40.0}


def test_an_imitation_is_seen_in_tensorboard(tmp_path: Path) -> None:
    """The same values as of PPO, and the loss, one of each a round."""
    train(options(tmp_path / "a.zip", steps=2 * HYPER.batch, tensorboard=tmp_path / "logs"))
    events = event_accumulator.EventAccumulator(str(next((tmp_path / "logs").iterdir())))
    events.Reload()
    for name in ("level", "success_rate", "mean_return", "mean_steps", "timeout_rate", "imitation_loss"):
        assert [event.step for event in events.Scalars(f"tube/{name}")] == [HYPER.batch, 2 * HYPER.batch]


def test_the_memory_keeps_the_newest() -> None:
    """Of 10 samples in a memory for 6 the last 6 are drawn, all of them, each with its own command."""
    memory = Memory(6, 2)
    numbers = np.arange(10, dtype=np.float32)
    for number in numbers:
        memory.add(np.full((1, 2), number, np.float32), np.full((1, 3), -number, np.float32))
    observations, commands = memory.draw(np.random.default_rng(0), 300)
    assert set(observations[:, 0]) == set(numbers[4:])
    np.testing.assert_array_equal(commands[:, 0], -observations[:, 0])
