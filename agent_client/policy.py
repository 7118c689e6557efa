"""A learned policy as a function of the observation: compiled loops over the actor's weights, no torch.

What holds of the numbers: every lane is computed by itself, in float32 and in one fixed order of additions,
so that a lane's logits depend, to the last bit, on its observation alone, never on the batch that it is in.
(A BLAS product is faster for large batches, but sums a row alone in another order than in a batch.) The same
machine returns the same bits every time; another one may differ in the last bit of `exp`. Torch's actor
agrees to 1e-5.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agent_client.checkpoint import Layer, read_checkpoint
from agent_client.contract import Contract, mask_of
from agent_client.errors import PolicyError

Floats32 = NDArray[np.float32]
Ints = NDArray[np.int64]

FEATURES: Final = 37
"""Of one observation; a policy with a history sees several, stacked."""
ACTIONS: Final = 36

_ACTIVATIONS: Final = {"tanh": 0, "relu": 1}


class Policy:
    """A deterministic or sampled policy over 36 discrete actions, batched over lanes.

    `notes` says in whole sentences what was assumed about it; a checkpoint with its contract has none.
    """

    def __init__(
        self,
        contract: Contract,
        layers: Sequence[Layer],
        path: Path | None = None,
        notes: Sequence[str] = (),
    ) -> None:
        """Put an actor together.

        Args:
            contract: what the policy was made for.
            layers: dense layers, logits last.
            path: where it was read from.
            notes: what was assumed.

        Raises:
            PolicyError: the layers or the contract have other spaces than 37 features and 36 actions.
        """
        name = str(path or "policy")
        _check_spaces(contract, layers, name)
        self.contract: Final = contract
        self.path: Final = path
        self.notes: Final = tuple(notes)
        norm = contract.normalisation
        self._mean = np.array(norm.mean, dtype=np.float64)
        # Zero scale is what masks a feature: it reads zero whatever the sensors say.
        scale = 1.0 / np.sqrt(np.array(norm.variance, dtype=np.float64) + norm.epsilon)
        self._scale = np.where(mask_of(contract), 0.0, scale)
        self._clip = float(norm.clip)
        self._weights = np.concatenate([part.ravel() for la in layers for part in (la.bias, la.weight)])
        self._sizes = np.array(
            [layers[0].weight.shape[0], *(la.weight.shape[1] for la in layers)], dtype=np.int64
        )
        self._activation = _ACTIVATIONS[contract.network.activation]
        self._work = np.zeros((2, int(self._sizes.max())), dtype=np.float32)
        self._logits = np.zeros((1, ACTIONS), dtype=np.float32)
        self._actions = np.zeros(1, dtype=np.int64)
        self.entropies = np.zeros(1)
        """Of the distributions that the last actions were chosen from (nat), (N,)."""
        # Loads compiled code now, which would else hold up the first control step by some ten milliseconds.
        self.act(np.zeros((1, len(self._mean)), dtype=np.float32))

    def act(self, observations: Floats32) -> Ints:
        """Choose the most likely action of each lane, (N,); the lowest index among equals.

        Args:
            observations: (N, 37 L) float32, as the task makes them, neither normalised nor masked: those of
                the contract's L lags, stacked by `agent_client.history`.

        Returns:
            Action indices (N,), overwritten by the next call.
        """
        self.logits(observations)
        _choose(self._logits, self._actions, self.entropies)
        return self._actions

    def logits(self, observations: Floats32) -> Floats32:
        """Compute the logits of the 36 actions, (N, 36) float32, overwritten by the next call."""
        lanes = observations.shape[0]
        if lanes != self._logits.shape[0]:
            self._logits = np.zeros((lanes, ACTIONS), dtype=np.float32)
            self._actions = np.zeros(lanes, dtype=np.int64)
            self.entropies = np.zeros(lanes)
        _forward(
            observations, self._mean, self._scale, self._clip,
            self._weights, self._sizes, self._activation, self._work, self._logits,
        )  # fmt: skip
        return self._logits

    def log_probabilities(self, observations: Floats32) -> NDArray[np.float64]:
        """Natural logarithms of the action probabilities, (N, 36)."""
        logits = self.logits(observations).astype(np.float64)
        logits -= logits.max(axis=1, keepdims=True)
        logits -= np.log(np.exp(logits).sum(axis=1, keepdims=True))
        return logits

    def entropy(self, observations: Floats32) -> NDArray[np.float64]:
        """Entropy of the action distribution (nat), (N,): 0 when certain, log 36 when indifferent."""
        log_p = self.log_probabilities(observations)
        return np.asarray(-(np.exp(log_p) * log_p).sum(axis=1), dtype=np.float64)

    def sample(self, observations: Floats32, rng: np.random.Generator) -> Ints:
        """Draw an action of each lane from its distribution, (N,)."""
        log_p = self.log_probabilities(observations)
        return np.asarray((log_p + rng.gumbel(size=log_p.shape)).argmax(axis=1), dtype=np.int64)


def load_policy(path: str | Path) -> Policy:
    """Load a checkpoint; torch is imported only for a plain stable-baselines3 .zip without `actor.npz`.

    Args:
        path: a .zip as `agent_client.training` writes it, or one of stable-baselines3's PPO with the
            observation space Box(37,) and the action space Discrete(36). Of the latter nothing is known but
            its network: the default contract is assumed, and the policy's `notes` say so. Reading unpickles
            its content, as stable-baselines3 does: open only what you trust.

    Raises:
        PolicyError: no such file, an empty or foreign one, other spaces, or torch missing where it is needed.
    """
    path = Path(path)
    checkpoint = read_checkpoint(path)
    if checkpoint.contract is None or checkpoint.layers is None:
        try:
            from agent_client.sb3_policy import load_plain
        except ImportError as error:
            raise PolicyError(
                f"{path} carries no actor.npz, so that reading it needs torch and stable-baselines3, and "
                f"{error.name} is missing: install the extra 'train' of tube-cosim, as `cosim doctor` says"
            ) from error
        return load_plain(path)
    return Policy(checkpoint.contract, checkpoint.layers, path)


def _check_spaces(contract: Contract, layers: Sequence[Layer], name: str) -> None:
    """Refuse an actor of other spaces than 37 features and 36 actions, or unlike its contract."""
    if not layers:
        raise PolicyError(f"{name}: expected an actor of at least one layer, found none")
    inputs, outputs = layers[0].weight.shape[0], layers[-1].weight.shape[1]
    expected = FEATURES * len(contract.lags)
    if (inputs, outputs) != (expected, ACTIONS):
        raise PolicyError(
            f"{name}: expected observation space Box({expected},) and action space Discrete({ACTIONS}), "
            f"found Box({inputs},) and Discrete({outputs})"
        )
    if (len(contract.observations), len(contract.actions)) != (FEATURES, ACTIONS):
        raise PolicyError(
            f"{name}: contract: expected {FEATURES} observations and {ACTIONS} actions, "
            f"found {len(contract.observations)} and {len(contract.actions)}"
        )
    hidden = tuple(layer.weight.shape[1] for layer in layers[:-1])
    if hidden != contract.network.hidden:
        raise PolicyError(f"{name}: hidden layers: expected {contract.network.hidden}, found {hidden}")


@njit(cache=True, error_model="numpy")
def _forward(
    observations: Floats32,
    mean: NDArray[np.float64],
    scale: NDArray[np.float64],
    clip: float,
    weights: Floats32,
    sizes: Ints,
    activation: int,
    work: Floats32,
    logits: Floats32,
) -> None:
    """Normalise and run the network row by row; `work` (2, widest) holds the activations of one row."""
    for row in range(observations.shape[0]):
        x, y = work[0], work[1]
        for i in range(sizes[0]):
            # In float64: a feature that hardly varies has a scale that would blow up float32 rounding.
            value = (np.float64(observations[row, i]) - mean[i]) * scale[i]
            x[i] = np.float32(min(max(value, -clip), clip))
        at = 0
        last = sizes.shape[0] - 2
        for layer in range(last + 1):
            n, m = sizes[layer], sizes[layer + 1]
            for j in range(m):
                y[j] = weights[at + j]
            at += m
            for i in range(n):
                xi = x[i]
                line = weights[at : at + m]
                for j in range(m):  # across the outputs, so that it vectorises without reordering a sum
                    y[j] += xi * line[j]
                at += m
            if layer < last:
                if activation == 0:
                    for j in range(m):
                        # tanh, by way of one exp in float64: twice as fast, and as exact in float32.
                        y[j] = np.float32(1.0 - 2.0 / (math.exp(2.0 * np.float64(y[j])) + 1.0))
                else:
                    for j in range(m):
                        y[j] = max(y[j], np.float32(0.0))
            x, y = y, x
        for j in range(logits.shape[1]):
            logits[row, j] = x[j]


@njit(cache=True)
def _choose(logits: Floats32, actions: Ints, entropies: NDArray[np.float64]) -> None:
    """Take the most likely action of each row, and the entropy of the distribution: log Z - sum of p l."""
    for row in range(logits.shape[0]):
        best = 0
        for j in range(1, logits.shape[1]):
            if logits[row, j] > logits[row, best]:
                best = j
        actions[row] = best
        total, mean = 0.0, 0.0
        for j in range(logits.shape[1]):
            below = np.float64(logits[row, j]) - np.float64(logits[row, best])
            weight = math.exp(below)
            total += weight
            mean += weight * below
        entropies[row] = math.log(total) - mean / total
