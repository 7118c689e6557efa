"""The compiled actor and the checkpoint around it."""

from __future__ import annotations

import io
import itertools
import math
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agent_client.checkpoint import Layer, read_checkpoint, write_checkpoint
from agent_client.contract import Network, Normalisation, running_contract
from agent_client.errors import PolicyError
from agent_client.policy import Policy, load_policy

RNG = np.random.default_rng(7)
HIDDEN = (19, 11)


def make_layers(sizes: tuple[int, ...] = (37, *HIDDEN, 36)) -> tuple[Layer, ...]:
    """Random dense layers."""
    return tuple(
        Layer(
            RNG.normal(size=(n, m)).astype(np.float32) / math.sqrt(n), RNG.normal(size=m).astype(np.float32)
        )
        for n, m in itertools.pairwise(sizes)
    )


def make_contract(**changes: object):
    """A contract of the default settings with a normalisation that does something."""
    normalisation = Normalisation(
        tuple(RNG.uniform(-0.5, 0.5, 37).tolist()), tuple(RNG.uniform(0.0, 1.0, 37).tolist()), 3.0, 1e-8
    )
    contract = running_contract(normalisation=normalisation, network=Network(HIDDEN, "tanh"))
    return replace(contract, **changes)


def observations(lanes: int) -> np.ndarray:
    """Random observations in [-1, 1]."""
    return RNG.uniform(-1.0, 1.0, (lanes, 37)).astype(np.float32)


def oracle(policy_layers, contract, x, activation=np.tanh):
    """The network in float64 by matrix products."""
    norm = contract.normalisation
    h = (x.astype(np.float64) - np.array(norm.mean)) / np.sqrt(np.array(norm.variance) + norm.epsilon)
    h = np.clip(h, -norm.clip, norm.clip)
    for layer in policy_layers[:-1]:
        h = activation(h @ layer.weight.astype(np.float64) + layer.bias)
    return h @ policy_layers[-1].weight.astype(np.float64) + policy_layers[-1].bias


def sb3_zip(content: dict[str, bytes] | None = None) -> bytes:
    """A .zip with the given entries, in memory."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, data in (content or {"data": b"{}", "policy.pth": b""}).items():
            archive.writestr(name, data)
    return buffer.getvalue()


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """A checkpoint with its contract, written the way training writes it."""
    path = tmp_path / "policy.zip"
    write_checkpoint(path, sb3_zip(), make_contract(), make_layers())
    return path


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_the_actor_is_the_network_in_double_precision(activation: str) -> None:
    """Logits agree with matrix products in float64 to 1e-5, for both activations."""
    layers, contract = make_layers(), make_contract(network=Network(HIDDEN, activation))
    x = observations(50)
    function = np.tanh if activation == "tanh" else lambda h: np.maximum(h, 0.0)
    expected = oracle(layers, contract, x, function)
    np.testing.assert_allclose(Policy(contract, layers).logits(x), expected, atol=1e-5)


def test_an_action_does_not_depend_on_its_batch() -> None:
    """Each row's logits have the same bits alone, in a batch, and in the reversed batch."""
    policy = Policy(make_contract(), make_layers())
    x = observations(23)
    batch = policy.logits(x).copy()
    alone = np.concatenate([policy.logits(row[None]).copy() for row in x])
    backwards = policy.logits(np.ascontiguousarray(x[::-1])).copy()[::-1]
    assert batch.tobytes() == alone.tobytes() == np.ascontiguousarray(backwards).tobytes()


def test_the_chosen_action_is_the_most_likely_one() -> None:
    """`act` is the argmax of the log-probabilities, which sum to one; entropy is that of the distribution."""
    policy = Policy(make_contract(), make_layers())
    x = observations(40)
    log_p = policy.log_probabilities(x)
    np.testing.assert_array_equal(policy.act(x), log_p.argmax(axis=1))
    np.testing.assert_allclose(np.exp(log_p).sum(axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(policy.entropy(x), -(np.exp(log_p) * log_p).sum(axis=1), atol=1e-12)
    policy.act(x)
    np.testing.assert_allclose(policy.entropies, policy.entropy(x), atol=1e-12)


def test_sampled_actions_follow_their_probabilities() -> None:
    """Frequencies of 20,000 samples lie within 5 standard deviations of the probabilities."""
    policy = Policy(make_contract(), make_layers())
    x = observations(1)
    p = np.exp(policy.log_probabilities(x))[0]
    drawn = policy.sample(np.repeat(x, 20_000, axis=0), np.random.default_rng(3))
    frequency = np.bincount(drawn, minlength=36) / drawn.size
    assert np.all(np.abs(frequency - p) <= 5.0 * np.sqrt(p * (1.0 - p) / drawn.size) + 1e-4)


def test_masked_features_are_not_seen() -> None:
    """A masked feature changes nothing, whatever the sensors say; the same feature unmasked does."""
    layers, contract = make_layers(), make_contract()
    x = observations(1)
    y = x.copy()
    y[0, 20] = -x[0, 20] + 0.5
    blind = Policy(replace(contract, masked=(contract.observations[20],)), layers)
    seeing = Policy(contract, layers)
    assert blind.logits(x).tobytes() == blind.logits(y).copy().tobytes()
    assert seeing.logits(x).copy().tobytes() != seeing.logits(y).tobytes()


def test_a_checkpoint_comes_back_as_it_was_written(checkpoint: Path) -> None:
    """Contract and weights survive the file bit for bit, and the same policy is the same file."""
    layers, contract = make_layers(), make_contract()
    write_checkpoint(checkpoint, sb3_zip(), contract, layers)
    first = checkpoint.read_bytes()
    read = read_checkpoint(checkpoint)
    assert read.contract == contract
    assert read.layers is not None
    for a, b in zip(read.layers, layers, strict=True):
        assert a.weight.tobytes() == b.weight.tobytes()
        assert a.bias.tobytes() == b.bias.tobytes()
    write_checkpoint(checkpoint, sb3_zip(), contract, layers)
    assert checkpoint.read_bytes() == first
    assert [p.name for p in checkpoint.parent.iterdir()] == [checkpoint.name]


def test_a_checkpoint_with_its_actor_needs_no_torch(checkpoint: Path) -> None:
    """Loading and acting imports neither torch nor stable-baselines3 nor gymnasium."""
    code = (
        "import sys, numpy; from agent_client.policy import load_policy; "
        f"load_policy({str(checkpoint)!r}).act(numpy.zeros((1, 37), numpy.float32)); "
        "found = {'torch', 'stable_baselines3', 'gymnasium'} & set(sys.modules); "
        "sys.exit(str(found) if found else 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=100, check=False
    )
    assert done.returncode == 0, done.stderr


def damaged(checkpoint: Path, entry: str, content: bytes | None) -> bytes:
    """The checkpoint with one entry replaced, or left out."""
    with zipfile.ZipFile(checkpoint) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    entries.pop(entry)
    return sb3_zip(entries if content is None else entries | {entry: content})


def test_a_missing_checkpoint_is_refused(tmp_path: Path) -> None:
    """A path without a file is refused by its name."""
    with pytest.raises(PolicyError, match=r"nothing\.zip: expected a checkpoint .* found no such file"):
        load_policy(tmp_path / "nothing.zip")
    with pytest.raises(PolicyError, match=r"expected a checkpoint .* found a folder"):
        load_policy(tmp_path)


def test_a_checkpoint_that_may_not_be_read_is_refused(
    checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The reason is given in words, without the system's number for it."""

    def locked(self: Path) -> bytes:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "read_bytes", locked)
    with pytest.raises(PolicyError, match=r"found what cannot be read: Permission denied$"):
        load_policy(checkpoint)


def test_an_encrypted_checkpoint_is_refused(tmp_path: Path, checkpoint: Path) -> None:
    """Entries under a password are refused as what cannot be read."""
    content = bytearray(checkpoint.read_bytes())
    for mark, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        at = content.find(mark)
        while at >= 0:
            content[at + flags] |= 1
            at = content.find(mark, at + 4)
    path = tmp_path / "secret.zip"
    path.write_bytes(content)
    with pytest.raises(PolicyError, match=r"secret\.zip: expected a checkpoint .*encrypted"):
        load_policy(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "found an empty file"),
        (b"no archive", "found a file that is none"),
        (sb3_zip({"a.txt": b"x"}), r"found a foreign \.zip \(a\.txt\)"),
        (sb3_zip({"contract.json": b"{}"}), r"expected both contract\.json and actor\.npz"),
        (sb3_zip()[:-10], "found a file that is none"),
    ],
    ids=["empty", "text", "foreign", "half", "truncated"],
)
def test_what_is_no_checkpoint_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    """Empty, foreign and truncated files are refused in one sentence with the file's name."""
    path = tmp_path / "bad.zip"
    path.write_bytes(content)
    with pytest.raises(PolicyError, match=message) as caught:
        load_policy(path)
    assert "bad.zip" in str(caught.value)


@pytest.mark.parametrize(
    ("entry", "content", "message"),
    [
        ("contract.json", b"{", "not JSON"),
        ("contract.json", b"[]", "expected an object, found list"),
        ("contract.json", b'{"version": 99}', "contract version: expected 1, found 99"),
        ("contract.json", b'{"version": 1}', "expected the field"),
        ("actor.npz", b"x", r"actor\.npz is damaged"),
        ("actor.npz", None, r"expected both contract\.json and actor\.npz"),
    ],
)
def test_a_damaged_checkpoint_is_refused(
    tmp_path: Path, checkpoint: Path, entry: str, content: bytes | None, message: str
) -> None:
    """A damaged entry is refused with its name and what was expected."""
    path = tmp_path / "damaged.zip"
    path.write_bytes(damaged(checkpoint, entry, content))
    with pytest.raises(PolicyError, match=message):
        load_policy(path)


def test_weights_are_never_unpickled(tmp_path: Path, checkpoint: Path) -> None:
    """An actor.npz that holds pickled objects is refused."""
    buffer = io.BytesIO()
    np.savez(buffer, weight_0=np.array([object()]), bias_0=np.zeros(1, np.float32))
    path = tmp_path / "pickled.zip"
    path.write_bytes(damaged(checkpoint, "actor.npz", buffer.getvalue()))
    with pytest.raises(PolicyError, match="damaged"):
        load_policy(path)


@pytest.mark.parametrize("sizes", [(36, *HIDDEN, 36), (37, *HIDDEN, 6), (37, 19, 12, 36)])
def test_an_actor_of_other_spaces_is_refused(sizes: tuple[int, ...]) -> None:
    """Another observation or action space, or other hidden layers than the contract's, are refused."""
    with pytest.raises(PolicyError, match=r"expected .* found"):
        Policy(make_contract(), make_layers(sizes))
