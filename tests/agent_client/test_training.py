"""Training, on tiny budgets: what it writes, that it repeats itself, and that the actor is torch's."""

from __future__ import annotations

import math
import shutil
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

import agent_client.paper
from agent_client.checkpoint import read_checkpoint
from agent_client.contract import Normalisation, require_match, running_contract
from agent_client.errors import PolicyError, TrainingError, TrainingOver
from agent_client.paper import CHOICES, to_markdown
from agent_client.policy import load_policy
from agent_client.presets import PRESETS, UNKNOWN_TUBE, without_inertia
from agent_client.settings import Settings
from agent_client.training import log_path, state_path, train
from agent_client.training_log import Progress, read_log
from agent_client.training_options import Hyperparameters, TrainingOptions, fitting_minibatch
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
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.csv", "a.state", "a.zip"]

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
    """Without TensorBoard no folder of logs is made anywhere; torch keeps one of its own, made once in a process."""
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    monkeypatch.delenv("SB3_LOGDIR")
    train(options(tmp_path / "a.zip", steps=64))
    assert [path for path in temporary.iterdir() if not path.name.startswith("torchinductor_")] == []


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
    """A run that is stopped in its first iteration leaves the old checkpoint whole, and no state of another."""
    path = train(options(tmp_path / "a.zip"))
    before = path.read_bytes()

    def stop(progress: Progress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(options(tmp_path / "a.zip", seed=9), stop)
    assert path.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.csv", "a.zip"]


class Killed(BaseException):
    """Raised to end a training as a kill would: nothing of ours runs after it."""


def stopped_after(iterations: int, *arguments: object, **options: object) -> None:
    """Train until so many iterations are done, and one more has been collected."""

    def stop(progress: Progress) -> None:
        if progress.iteration > iterations:
            raise Killed

    with pytest.raises(Killed):
        train(*arguments, stop, **options)


def test_a_killed_training_is_resumed_where_it_stood(tmp_path: Path) -> None:
    """At most one iteration is lost: counters, schedule, normalisation and curriculum go on from the last one."""
    falling = replace(SMALL, final_learning_rate=0.0)
    asked = options(tmp_path / "a.zip", steps=320, hyperparameters=falling)
    stopped_after(2, asked)
    assert load_policy(asked.out).contract.training["steps"] == 128
    before = torch.load(state_path(asked.out), weights_only=True)
    assert (before["iteration"], before["steps"]) == (2, 128)
    assert [row.iteration for row in read_log(log_path(asked.out))] == [1, 2, 3]

    seen: list[Progress] = []
    train(asked, seen.append, resume=True)
    assert [(row.iteration, row.steps) for row in seen] == [(3, 192), (4, 256), (5, 320)]
    assert [row.iteration for row in read_log(log_path(asked.out))] == [1, 2, 3, 4, 5]
    after = torch.load(state_path(asked.out), weights_only=True)
    assert (after["iteration"], after["steps"]) == (5, 320)
    assert after["count"] > before["count"] + 3 * 64 - 1
    # Adam counts its steps: two epochs of two minibatches in each of five iterations.
    assert {float(moments["step"]) for moments in after["optimiser"]["state"].values()} == {20.0}
    assert after["optimiser"]["param_groups"][0]["lr"] == 0.0
    policy = load_policy(asked.out)
    assert policy.contract.training["steps"] == 320
    assert np.isfinite(policy.logits(np.zeros((1, 37), np.float32))).all()


def test_a_resumed_training_repeats_itself(tmp_path: Path) -> None:
    """Resumed twice from the same state, a training ends in the same weights bit for bit."""
    stopped_after(1, options(tmp_path / "a.zip"))
    for suffix in (".zip", ".csv", ".state"):
        shutil.copy(tmp_path / f"a{suffix}", tmp_path / f"b{suffix}")
    one, same = (train(options(tmp_path / name), resume=True) for name in ("a.zip", "b.zip"))
    assert [layer.weight.tobytes() for layer in read_checkpoint(one).layers or ()] == [
        layer.weight.tobytes() for layer in read_checkpoint(same).layers or ()
    ]


def test_a_training_goes_on_without_the_rows_that_its_log_lost(tmp_path: Path) -> None:
    """What is missing is said once; the rows that follow have their own numbers, and no half row stays."""
    stopped_after(2, options(tmp_path / "a.zip"))
    log = tmp_path / "a.csv"
    head, first, *_ = log.read_text().splitlines()
    log.write_text(f"{head}\n{first}\n2,12")
    notes: list[str] = []
    train(options(tmp_path / "a.zip"), resume=True, on_note=notes.append)
    assert len(notes) == 1
    assert "1 of 2 iterations are missing" in notes[0]
    assert [row.iteration for row in read_log(log)] == [1, 3]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.csv", "a.state", "a.zip"]


def test_a_training_without_a_state_cannot_be_resumed(tmp_path: Path) -> None:
    """The message says that no iteration was completed, or that the file is damaged."""
    with pytest.raises(
        TrainingError, match=r"a\.state: expected .* found none: no iteration of it was completed"
    ):
        train(options(tmp_path / "a.zip"), resume=True)
    (tmp_path / "a.state").write_bytes(b"half a fi")
    with pytest.raises(TrainingError, match=r"a\.state: expected .* found a damaged file"):
        train(options(tmp_path / "a.zip"), resume=True)


def test_a_training_is_not_resumed_with_other_options(tmp_path: Path) -> None:
    """Whatever changes the learning is refused by its name; more steps are not."""
    train(options(tmp_path / "a.zip"))
    with pytest.raises(
        TrainingError, match=r"other options: hyperparameters\.gamma: expected 0\.99, found 0\.5;"
    ):
        train(options(tmp_path / "a.zip", hyperparameters=replace(SMALL, gamma=0.5)), resume=True)
    with pytest.raises(TrainingOver, match="found 192 of 180 steps done; ask for more steps"):
        train(options(tmp_path / "a.zip"), resume=True)
    train(options(tmp_path / "a.zip", steps=256), resume=True)
    assert load_policy(tmp_path / "a.zip").contract.training["steps"] == 256


def test_a_critic_that_sees_more_is_resumed_whole(tmp_path: Path) -> None:
    """The statistics of what the value network alone sees are kept too, though the contract leaves them out."""
    world = WorldOptions(privileged=True, lags=(0, 2))
    asked = options(tmp_path / "a.zip", world=world)
    stopped_after(1, asked)
    before = torch.load(state_path(asked.out), weights_only=True)
    train(asked, resume=True)
    policy = load_policy(asked.out)
    assert len(policy.contract.normalisation.mean) == 2 * 37
    assert len(before["mean"]) > 2 * 37


def test_a_log_is_read_while_it_is_written(tmp_path: Path) -> None:
    """A last row that is half written is left out; a file that is no log is refused."""
    train(options(tmp_path / "a.zip"))
    path = log_path(tmp_path / "a.zip")
    rows = read_log(path)
    assert [row.steps for row in rows] == [64, 128, 192]
    assert sum(row.batch_episodes for row in rows) > 0
    path.write_text(path.read_text()[:-3])
    assert read_log(path) == rows[:2]
    path.write_text("a,b\n1,2\n")
    with pytest.raises(TrainingError, match="expected the columns iteration, steps"):
        read_log(path)


def test_the_presets_are_what_they_are_called() -> None:
    """`paper` is literal and unmasked with the paper's batch; `robust` hides what no drone in a tube can know."""
    paper = PRESETS["paper"].options
    assert not paper.world.settings.reward.per_metre
    assert paper.world.settings.reward.centring == 0.0
    assert paper.world.settings.masked_features == ()
    assert paper.world.lags == (0,)
    assert not paper.world.privileged
    assert paper.replay == 0.0
    hyper = paper.hyperparameters
    assert (hyper.batch, hyper.minibatch, hyper.gamma, hyper.entropy, hyper.clip) == (
        13_000,
        1300,
        0.99,
        0.003,
        0.3,
    )
    assert hyper.learning_rate == hyper.final_learning_rate == 3e-4
    assert (hyper.hidden, hyper.activation) == ((256, 128), "tanh")
    robust = PRESETS["robust"]
    assert set(robust.options.world.settings.masked_features) == set(UNKNOWN_TUBE)
    assert robust.dynamics == "rigid-body"
    assert all(preset.options.preset == name for name, preset in PRESETS.items())


def test_a_recipe_without_inertia_is_taught_without_gravity() -> None:
    """In the kinematic world no episode draws what only inertia gives a meaning to, and the teacher lifts nothing."""
    options = without_inertia(PRESETS["robust"].options)
    for conditions in (options.world.conditions, *options.world.rotation):
        assert (conditions.gain, conditions.compensation) == ((8.0, 8.0), (0.9, 0.9))
        assert conditions.body_radius == (0.15, 0.25)
    assert options.imitation is not None
    assert options.imitation.teacher.gravity == 0.0
    assert without_inertia(PRESETS["paper"].options) == PRESETS["paper"].options


def test_the_papers_open_values_are_in_the_document() -> None:
    """PAPER.md is the table of `agent_client.paper`, which has no empty cell and nothing that breaks a table."""
    document = Path(agent_client.paper.__file__).with_name("PAPER.md")
    assert document.read_text() == to_markdown(), "write PAPER.md anew from agent_client.paper.to_markdown()"
    for choice in CHOICES:
        cells = (choice.section, choice.name, choice.paper, choice.taken, choice.why)
        assert all(cells)
        assert not any("|" in cell or "\n" in cell for cell in cells)


def test_a_plain_model_without_torch_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where torch is not installed, the message names the extra that brings it."""
    PPO("MlpPolicy", Blank(), device="cpu").save(tmp_path / "plain.zip")
    monkeypatch.setitem(__import__("sys").modules, "agent_client.sb3_policy", None)
    with pytest.raises(PolicyError, match="install the extra 'train'"):
        load_policy(tmp_path / "plain.zip")
