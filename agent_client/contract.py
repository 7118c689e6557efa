"""The contract of a checkpoint: what its policy was made to see and to do, and the comparison with what runs.

A policy is a function of 37 numbers in one order, normalised in one way, made by one set of sensors every
`dt` seconds. Flown under anything else it still returns an action, only a wrong one; so a checkpoint carries
all of this as `contract.json`, and a difference is refused before the first step.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from agent_client.actions import action_table
from agent_client.errors import ContractMismatch, Difference, PolicyError
from agent_client.features import FEATURE_NAMES, MEMORY_FEATURES
from agent_client.history import LAG_MAX, PRESENT
from agent_client.settings import DEFAULT_DT, Settings

CONTRACT_VERSION: Final = 1

COMPARED: Final = ("drone", "lidar", "camera", "memory", "task.time_factor", "task.safety_scale")
"""Settings that change what a policy sees or does: whole groups, or single ones. The action table stands for
the group `actions`; the rest (motion, start, reward, ends of an episode) is recorded and not compared."""


@dataclass(frozen=True)
class ActionEntry:
    """One row of the action table: the two angles of the direction and the speed."""

    alpha: float
    """Horizontal angle from the forward direction (rad), positive to the right."""
    beta: float
    """Vertical angle from the forward direction (rad), positive upwards."""
    speed: float
    """Commanded speed (m/s)."""


@dataclass(frozen=True)
class Normalisation:
    """Observation normalisation: clip((o - mean) / sqrt(variance + epsilon), -clip, clip)."""

    mean: tuple[float, ...]  # (F,)
    variance: tuple[float, ...]  # (F,)
    clip: float
    epsilon: float

    @classmethod
    def identity(cls, features: int) -> Normalisation:
        """The normalisation that changes nothing: what a network sees that was trained without one."""
        return cls((0.0,) * features, (1.0,) * features, math.inf, 0.0)


@dataclass(frozen=True)
class Network:
    """Shape of the actor: dense hidden layers with one activation, then linear logits."""

    hidden: tuple[int, ...]
    activation: str  # "tanh" or "relu"


@dataclass(frozen=True)
class Contract:
    """Everything that a policy takes for granted; the content of `contract.json`."""

    observations: tuple[str, ...]  # (F,)
    """Names of the features, in the order of the observation."""
    masked: tuple[str, ...]
    """Features that stay in place and are zero."""
    actions: tuple[ActionEntry, ...]  # (A,)
    """The action table, in the order of the logits."""
    dt: float
    """Control step (s)."""
    normalisation: Normalisation
    """Of the stacked observation: one mean and one variance for each feature of each lag."""
    network: Network
    settings: Mapping[str, Mapping[str, Any]]
    """All settings by group and name, as in `agent_client.settings`; `COMPARED` says which must agree."""
    training: Mapping[str, Any] = field(default_factory=dict)
    """What the policy was trained with: preset, seed, steps, dynamics, versions. Recorded, never compared."""
    lags: tuple[int, ...] = PRESENT
    """Ages (control steps) of the observations that are stacked for the policy (`agent_client.history`)."""
    version: int = CONTRACT_VERSION


def running_contract(
    settings: Settings | None = None,
    dt: float = DEFAULT_DT,
    *,
    normalisation: Normalisation | None = None,
    network: Network | None = None,
    training: Mapping[str, Any] | None = None,
    lags: tuple[int, ...] = PRESENT,
) -> Contract:
    """The contract of what runs (or of what is trained) under these settings and this control step (s)."""
    settings = settings or Settings()
    table = action_table(settings)
    rows = zip(table.alpha.tolist(), table.beta.tolist(), table.speed.tolist(), strict=True)
    tree = json.loads(json.dumps(asdict(settings)))  # as it will be read: lists in place of tuples
    masked = tree.pop("masked_features")
    return Contract(
        observations=FEATURE_NAMES,
        masked=tuple(masked),
        actions=tuple(ActionEntry(*row) for row in rows),
        dt=dt,
        normalisation=normalisation or Normalisation.identity(len(FEATURE_NAMES) * len(lags)),
        network=network or Network((), "tanh"),
        settings=tree,
        training=json.loads(json.dumps(training or {})),
        lags=lags,
    )


def to_json(contract: Contract) -> str:
    """Write a contract as JSON; floats survive exactly."""
    tree = asdict(contract)
    tree["normalisation"]["clip"] = _finite_or_none(contract.normalisation.clip)
    return json.dumps(tree, indent=1, allow_nan=False)


def from_json(text: str, name: str) -> Contract:
    """Read a contract; `name` is the file's name for messages.

    Raises:
        PolicyError: this is no contract, or one of another version; says which field and what was found.
    """
    try:
        tree = json.loads(text)
    except json.JSONDecodeError as error:
        raise PolicyError(
            f"{name}: contract.json is not JSON ({error}); write the checkpoint again"
        ) from error
    if not isinstance(tree, dict):
        raise PolicyError(f"{name}: contract.json: expected an object, found {type(tree).__name__}")
    version = tree.get("version")
    if version != CONTRACT_VERSION:
        raise PolicyError(f"{name}: contract version: expected {CONTRACT_VERSION}, found {version}")
    try:
        contract = _from_tree(tree)
    except KeyError as error:
        raise PolicyError(f"{name}: contract.json: expected the field {error}, found none") from error
    except (TypeError, ValueError, AttributeError) as error:
        raise PolicyError(f"{name}: contract.json holds a field of the wrong form ({error})") from error
    _check_form(contract, name)
    return contract


def compare(contract: Contract, running: Contract) -> tuple[Difference, ...]:
    """Every disagreement between a checkpoint's contract and what runs, in the order of the contract.

    Normalisation, mask, network and training are the policy's own and are not compared. Neither is the memory where
    all of its features are masked, so that the policy sees nothing of it.
    """
    expected, found = _terms(contract), _terms(running)
    forgetful = set(MEMORY_FEATURES) <= set(contract.masked)
    differences = []
    for name in [*expected, *(n for n in found if n not in expected)]:
        if forgetful and name.startswith("memory."):
            continue
        wanted, got = expected.get(name, _ABSENT), found.get(name, _ABSENT)
        if not _same(wanted, got):
            differences.append(Difference(name, _show(wanted), _show(got)))
    return tuple(differences)


def require_match(
    contract: Contract, running: Contract, name: str, allow: Collection[str] = ()
) -> tuple[Difference, ...]:
    """Refuse a policy that was made for something else than what runs, before the first step.

    Args:
        contract: the checkpoint's contract.
        running: the contract of what runs, from `running_contract`.
        name: the checkpoint's name for the message.
        allow: names of terms that may differ, e.g. {"dt"}.

    Returns:
        The differences that were allowed, to be recorded.

    Raises:
        ContractMismatch: name, expected and found of every difference that is not allowed.
    """
    differences = compare(contract, running)
    refused = [d for d in differences if d.name not in allow]
    if refused:
        raise ContractMismatch(refused, name)
    return differences


def mask_of(contract: Contract) -> NDArray[np.bool_]:
    """Which entries of the stacked observation are masked, (F L,)."""
    masked = np.array([name in contract.masked for name in contract.observations], dtype=np.bool_)
    return np.tile(masked, len(contract.lags))


class _Absent:
    """Stands for a term that one side does not have."""


_ABSENT: Final = _Absent()


def _finite_or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _from_tree(tree: dict[str, Any]) -> Contract:
    """Build a contract from parsed JSON; KeyError, TypeError or ValueError where it has another form."""
    normalisation, network = tree["normalisation"], tree["network"]
    clip = normalisation["clip"]
    return Contract(
        observations=tuple(str(name) for name in tree["observations"]),
        masked=tuple(str(name) for name in tree["masked"]),
        actions=tuple(
            ActionEntry(float(a["alpha"]), float(a["beta"]), float(a["speed"])) for a in tree["actions"]
        ),
        dt=float(tree["dt"]),
        normalisation=Normalisation(
            mean=tuple(float(x) for x in normalisation["mean"]),
            variance=tuple(float(x) for x in normalisation["variance"]),
            clip=math.inf if clip is None else float(clip),
            epsilon=float(normalisation["epsilon"]),
        ),
        network=Network(tuple(int(n) for n in network["hidden"]), str(network["activation"])),
        settings={str(group): dict(values) for group, values in tree["settings"].items()},
        training=dict(tree.get("training", {})),
        lags=tuple(int(lag) for lag in tree.get("lags", PRESENT)),
    )


def _check_form(contract: Contract, name: str) -> None:
    """Refuse a contract that contradicts itself."""
    features = len(contract.observations) * len(contract.lags)
    norm, names = contract.normalisation, set(contract.observations)
    checks = (
        ("dt", "a number above 0", contract.dt, math.isfinite(contract.dt) and contract.dt > 0),
        ("lags", f"0, then rising ages up to {LAG_MAX} steps", contract.lags, _rising(contract.lags)),
        ("normalisation.mean", f"{features} finite numbers", len(norm.mean), _finite(norm.mean, features)),
        ("normalisation.variance", f"{features} numbers, at least 0 with epsilon above 0", len(norm.variance),
         _finite(norm.variance, features) and all(v >= 0 and v + norm.epsilon > 0 for v in norm.variance)),
        ("masked", "names of observations", contract.masked, set(contract.masked) <= names),
        ("network.activation", "tanh or relu", contract.network.activation,
         contract.network.activation in ("tanh", "relu")),
    )  # fmt: skip
    for field_name, expected, found, right in checks:
        if not right:
            raise PolicyError(f"{name}: contract.json: {field_name}: expected {expected}, found {found}")


def _rising(lags: tuple[int, ...]) -> bool:
    return lags[:1] == (0,) and lags[-1] <= LAG_MAX and all(a < b for a, b in itertools.pairwise(lags))


def _finite(values: tuple[float, ...], count: int) -> bool:
    return len(values) == count and all(math.isfinite(v) for v in values)


def _terms(contract: Contract) -> dict[str, object]:
    """Flatten what is compared into named terms."""
    terms: dict[str, object] = {"dt": contract.dt, "observations.count": len(contract.observations)}
    terms |= {f"observations[{i}]": name for i, name in enumerate(contract.observations)}
    terms["actions.count"] = len(contract.actions)
    for i, action in enumerate(contract.actions):
        terms |= {f"actions[{i}].{key}": value for key, value in asdict(action).items()}
    for group, values in contract.settings.items():
        for key, value in values.items():
            if group in COMPARED or f"{group}.{key}" in COMPARED:
                terms[f"{group}.{key}"] = value
    return terms


def _same(a: object, b: object) -> bool:
    """Equality up to the last bits of a float, which may differ between mathematical libraries."""
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, int | float) and isinstance(b, int | float) and bool not in (type(a), type(b)):
        return math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-12)
    return a == b


def _show(value: object) -> str:
    if isinstance(value, _Absent):
        return "no such term"
    return f"{value:.10g}" if isinstance(value, float) else str(value)
