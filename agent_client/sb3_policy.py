"""The bridge from stable-baselines3's policies to ours: the actor's weights, out of torch's modules."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor

from agent_client.checkpoint import Layer
from agent_client.contract import Network, Normalisation, running_contract
from agent_client.errors import PolicyError
from agent_client.policy import ACTIONS, FEATURES, Policy

ACTIVATIONS: Final[dict[str, type[torch.nn.Module]]] = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}


class AsymmetricExtractor(torch.nn.Module):
    """Two towers: the policy's sees the first entries of the observation, the value's sees all of them.

    Args:
        width: entries of the whole observation.
        seen: entries that the policy sees.
        hidden: layers of either tower.
        activation: between them.
    """

    def __init__(
        self, width: int, seen: int, hidden: Sequence[int], activation: type[torch.nn.Module]
    ) -> None:
        super().__init__()
        self._seen = seen
        self.policy_net = _tower(seen, hidden, activation)
        self.value_net = _tower(width, hidden, activation)
        self.latent_dim_pi = self.latent_dim_vf = hidden[-1]

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Latent codes of policy and value."""
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """Latent code of the policy."""
        return cast(torch.Tensor, self.policy_net(features[:, : self._seen]))

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        """Latent code of the value."""
        return cast(torch.Tensor, self.value_net(features))


def _tower(inputs: int, hidden: Sequence[int], activation: type[torch.nn.Module]) -> torch.nn.Sequential:
    modules: list[torch.nn.Module] = []
    for outputs in hidden:
        modules += [torch.nn.Linear(inputs, outputs), activation()]
        inputs = outputs
    return torch.nn.Sequential(*modules)


class AsymmetricPolicy(ActorCriticPolicy):
    """An actor-critic policy whose value network sees more than the policy (`agent_client.privileged`).

    Args:
        seen: entries of the observation that the policy sees, the first ones.
        others: as for stable-baselines3's own.
    """

    def __init__(self, *arguments: Any, seen: int, **others: Any) -> None:
        self._seen = seen
        super().__init__(*arguments, **others)

    def _build_mlp_extractor(self) -> None:
        hidden = self.net_arch["pi"]
        self.mlp_extractor = AsymmetricExtractor(self.features_dim, self._seen, hidden, self.activation_fn)


def load_plain(path: Path) -> Policy:
    """Load a .zip that stable-baselines3's PPO wrote and that carries no contract.

    Raises:
        PolicyError: it is no PPO model, has other spaces, or another network than dense tanh or relu layers.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # remarks on versions and devices; the note below says what matters
            model = PPO.load(path, device="cpu")
    except Exception as error:
        raise PolicyError(
            f"{path}: expected a PPO policy of stable-baselines3, found what PPO.load cannot read ({error})"
        ) from error
    _check_spaces(model.observation_space, model.action_space, path)
    layers, network = actor_of(model.policy, str(path))
    contract = running_contract(normalisation=Normalisation.identity(FEATURES), network=network)
    note = (
        f"{path} carries no contract: assumed the default settings, dt {contract.dt} s, all {FEATURES} "
        "features in their order, and no observation normalisation"
    )
    return Policy(contract, layers, path, (note,))


def actor_of(policy: Any, name: str) -> tuple[tuple[Layer, ...], Network]:
    """Take the actor's dense layers and their shape out of an actor-critic policy of stable-baselines3.

    Raises:
        PolicyError: the actor is something else than dense layers with one activation, tanh or relu.
    """
    refused = PolicyError(
        f"{name}: expected an MlpPolicy with dense layers and one activation, {' or '.join(ACTIVATIONS)}; "
        f"found {type(policy).__name__}"
    )
    if not isinstance(policy, ActorCriticPolicy) or not isinstance(
        policy.features_extractor, FlattenExtractor
    ):
        raise refused
    modules = [*policy.mlp_extractor.policy_net, policy.action_net]
    kinds = {type(m) for m in modules[1:-1:2]}
    names = [key for key, kind in ACTIVATIONS.items() if kinds <= {kind}]
    if not names or not all(isinstance(m, torch.nn.Linear) for m in modules[0::2]):
        raise refused
    layers = tuple(Layer(_array(m.weight.T), _array(m.bias)) for m in modules[0::2])
    hidden = tuple(layer.bias.shape[0] for layer in layers[:-1])
    return layers, Network(hidden, names[0])


def _array(tensor: torch.Tensor) -> np.ndarray[Any, np.dtype[np.float32]]:
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype=np.float32).copy()


def _check_spaces(observation: spaces.Space[Any], action: spaces.Space[Any], path: Path) -> None:
    right = (
        isinstance(observation, spaces.Box)
        and observation.shape == (FEATURES,)
        and isinstance(action, spaces.Discrete)
        and int(action.n) == ACTIONS
    )
    if not right:
        raise PolicyError(
            f"{path}: expected observation space Box({FEATURES},) and action space Discrete({ACTIONS}), "
            f"found {observation} and {action}"
        )
