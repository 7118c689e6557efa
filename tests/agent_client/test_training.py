"""Training, on tiny budgets: what it writes, that it repeats itself, and that the actor is torch's."""

from __future__ import annotations

import math
import tempfile
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="the extra 'train' is not installed")

import gymnasium
import torch
from gymnasium import spaces
from stable_baselines3 import DQN, PPO

from agent_client.checkpoint import read_checkpoint
from agent_client.contract import Normalisation, require_match, running_contract
from agent_client.errors import PolicyError
from agent_client.policy import load_policy
from agent_client.settings import Settings
from agent_client.training import Hyperparameters, Progress, TrainingOptions, fitting_minibatch, train
from agent_client.tubes import TubeRecipe
from agent_client.world import WorldOptions

SMALL = Hyperparameters(lanes=4, rollout=16, minibatch=32, epochs=2, hidden=(16, 8))


def options(out: Path, **changes: object) -> TrainingOptions:
    """Three batches of 64 steps in short tubes."""
    masked = Settings(masked_features=("progress",))
    return replace(
        TrainingOptions(
            out,
            steps=180,
            seed=5,
            world=WorldOptions(masked),
            hyperparameters=SMALL,
            tubes=(TubeRecipe((4.0,)),),
            pool=3,
        ),
        **changes,
    )


class Blank(gymnasium.Env):
    """An environment of given spaces in which nothing happens."""

    def __init__(self, features: int = 37, actions: int = 36) -> None:
        self.observation_space = spaces.Box(-1.0, 1.0, (features,), np.float32)
        self.action_space = spaces.Discrete(actions)

    def reset(self, *, seed=None, options=None):
        """Zeros."""
        return np.zeros(self.observation_space.shape, np.float32), {}

    def step(self, action):
        """Zeros, and over."""
        return np.zeros(self.observation_space.shape, np.float32), 0.0, True, False, {}


def torch_logits(model: PPO, x: np.ndarray) -> np.ndarray:
    """Logits of a model's actor as torch computes them; normalised by log-sum-exp."""
    with torch.no_grad():
        return model.policy.get_distribution(torch.as_tensor(x)).distribution.logits.numpy()


def normalised(logits: np.ndarray) -> np.ndarray:
    """Logits minus their log-sum-exp, as torch keeps them."""
    return logits - np.log(np.exp(logits.astype(np.float64)).sum(axis=1, keepdims=True))


def test_a_training_writes_a_checkpoint_with_its_contract(tmp_path: Path) -> None:
    """The .zip carries contract and actor, loads as our policy and as a stable-baselines3 model alike."""
    seen: list[Progress] = []
    path = train(options(tmp_path / "a.zip"), seen.append)
    policy = load_policy(path)
    assert policy.notes == ()
    assert policy.contract.masked == ("progress",)
    assert policy.contract.network.hidden == (16, 8)
    assert policy.contract.training["seed"] == 5
    assert policy.contract.training["steps"] == 192
    assert require_match(policy.contract, running_contract(), "a.zip") == ()
    assert [p.iteration for p in seen] == [1, 2, 3]
    assert seen[-1].total_steps == seen[-1].steps == 192
    assert seen[-1].seconds_left == 0.0
    assert math.isfinite(seen[-1].mean_return)
    assert [p.name for p in tmp_path.iterdir()] == ["a.zip"]

    model = PPO.load(path, device="cpu")
    x = np.random.default_rng(0).uniform(-1, 1, (64, 37)).astype(np.float32)
    norm = policy.contract.normalisation
    seen_by_network = np.clip(
        (x - norm.mean) / np.sqrt(np.array(norm.variance) + norm.epsilon), -norm.clip, norm.clip
    )
    seen_by_network[:, [name == "progress" for name in policy.contract.observations]] = 0.0
    expected = torch_logits(model, seen_by_network.astype(np.float32))
    np.testing.assert_allclose(normalised(policy.logits(x)), expected, atol=1e-5)


def test_a_training_leaves_nothing_in_the_temporary_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without TensorBoard no folder of logs is made anywhere."""
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    monkeypatch.delenv("SB3_LOGDIR")
    train(options(tmp_path / "a.zip", steps=64))
    assert list(temporary.iterdir()) == []


@pytest.mark.parametrize(
    ("lanes", "rollout", "minibatch", "expected"),
    [(65, 200, 1300, 1300), (64, 200, 1300, 1280), (1, 200, 1300, 200), (7, 1, 4, 7), (4, 16, 0, 64)],
)
def test_minibatches_divide_a_batch(lanes: int, rollout: int, minibatch: int, expected: int) -> None:
    """The largest divisor not above the size asked for; the whole batch where there is none but 1."""
    asked = Hyperparameters(lanes=lanes, rollout=rollout, minibatch=minibatch)
    assert fitting_minibatch(asked) == expected


def test_a_training_records_the_minibatch_that_it_used(tmp_path: Path) -> None:
    """A size that does not divide the batch trains without a warning, and the contract has the one used."""
    odd = replace(SMALL, minibatch=31)
    path = train(options(tmp_path / "a.zip", steps=64, hyperparameters=odd))
    assert load_policy(path).contract.training["hyperparameters"]["minibatch"] == 16


def test_the_same_seed_trains_the_same_policy(tmp_path: Path) -> None:
    """Two trainings with one seed end in the same weights and normalisation bit for bit; another seed differs."""
    paths = [train(options(tmp_path / f"{n}.zip", seed=seed)) for n, seed in enumerate((5, 5, 6))]
    one, same, other = (read_checkpoint(path) for path in paths)
    assert one.contract == same.contract
    for a, b in zip(one.layers or (), same.layers or (), strict=True):
        assert a.weight.tobytes() == b.weight.tobytes()
        assert a.bias.tobytes() == b.bias.tobytes()
    assert one.layers is not None
    assert other.layers is not None
    assert one.layers[0].weight.tobytes() != other.layers[0].weight.tobytes()


def test_a_plain_model_of_stable_baselines3_can_be_flown(tmp_path: Path) -> None:
    """A .zip without contract and actor acts as torch does, and its notes say what was assumed of it."""
    torch.manual_seed(0)
    model = PPO("MlpPolicy", Blank(), device="cpu")
    model.save(tmp_path / "plain.zip")
    policy = load_policy(tmp_path / "plain.zip")
    x = np.random.default_rng(1).uniform(-1, 1, (40, 37)).astype(np.float32)
    np.testing.assert_allclose(normalised(policy.logits(x)), torch_logits(model, x), atol=1e-5)
    np.testing.assert_array_equal(policy.act(x), model.predict(x, deterministic=True)[0])
    assert policy.contract.normalisation == Normalisation.identity(37)
    assert len(policy.notes) == 1
    assert "carries no contract: assumed the default settings" in policy.notes[0]


@pytest.mark.parametrize(("features", "actions"), [(84, 36), (37, 4)])
def test_a_plain_model_of_other_spaces_is_refused(tmp_path: Path, features: int, actions: int) -> None:
    """The refusal names the spaces expected and found."""
    PPO("MlpPolicy", Blank(features, actions), device="cpu").save(tmp_path / "other.zip")
    with pytest.raises(
        PolicyError, match=rf"Box\(37,\).*Discrete\(36\).*\({features},\).*Discrete\({actions}\)"
    ):
        load_policy(tmp_path / "other.zip")


def test_another_network_is_refused(tmp_path: Path) -> None:
    """An actor that is no chain of tanh or relu layers is refused with what is expected."""
    kwargs = {"activation_fn": torch.nn.ELU}
    PPO("MlpPolicy", Blank(), device="cpu", policy_kwargs=kwargs).save(tmp_path / "elu.zip")
    with pytest.raises(PolicyError, match="dense layers and one activation, tanh or relu"):
        load_policy(tmp_path / "elu.zip")


def test_what_only_looks_like_a_model_is_refused(tmp_path: Path) -> None:
    """A .zip with the right entries and nothing in them, and another algorithm's model, are refused."""
    with zipfile.ZipFile(tmp_path / "hollow.zip", "w") as archive:
        archive.writestr("data", "{}")
        archive.writestr("policy.pth", b"")
    DQN("MlpPolicy", Blank(), device="cpu", buffer_size=10).save(tmp_path / "dqn.zip")
    for name in ("hollow.zip", "dqn.zip"):
        with pytest.raises(PolicyError, match=rf"{name}: expected a PPO policy of stable-baselines3"):
            load_policy(tmp_path / name)


def test_tensorboard_logs_are_written_where_wanted(tmp_path: Path) -> None:
    """With a folder given, event files appear in it; without one, nothing but the checkpoint is written."""
    train(options(tmp_path / "a.zip", tensorboard=tmp_path / "logs", steps=64))
    assert list((tmp_path / "logs").rglob("events.out.tfevents.*"))


def test_a_training_that_fails_leaves_the_old_checkpoint(tmp_path: Path) -> None:
    """A run that is stopped keeps the last checkpoint whole, and leaves no half-written file beside it."""
    path = train(options(tmp_path / "a.zip"))
    before = path.read_bytes()

    def stop(progress: Progress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(options(tmp_path / "a.zip", seed=9), stop)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.zip"]


def test_a_plain_model_without_torch_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where torch is not installed, the message names the extra that brings it."""
    PPO("MlpPolicy", Blank(), device="cpu").save(tmp_path / "plain.zip")
    monkeypatch.setitem(__import__("sys").modules, "agent_client.sb3_policy", None)
    with pytest.raises(PolicyError, match="install the extra 'train'"):
        load_policy(tmp_path / "plain.zip")
