"""What a training needs to go on after it was killed, as one file that is written anew after every iteration.

It holds numbers and tensors alone, and is read without unpickling anything else.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final

import torch

from agent_client.errors import TrainingError
from agent_client.training_log import Ended
from agent_client.training_options import TrainingOptions

FORMAT: Final = 1

_FREE: Final = ("out", "steps", "tensorboard")
"""Options that may change when a training is resumed."""


@dataclass(frozen=True)
class TrainingState:
    """Where a training stood after the update of an iteration.

    Episodes that were under way are not kept: a resumed training begins new ones. So it is no bit-for-bit copy
    of one that was never interrupted; resumed twice from the same state, it is the same twice.
    """

    options: str
    """The options that must stay the same, and the engine (JSON)."""
    iteration: int
    steps: int
    policy: Mapping[str, Any]
    """Tensors of the actor-critic policy."""
    optimiser: Mapping[str, Any]
    """Adam's moments and step counts, of PPO or of the imitation; the imitation's memory is too large to keep."""
    mean: torch.Tensor  # (W,)
    """Running mean of the observations, float64."""
    variance: torch.Tensor  # (W,)
    count: float
    """Observations behind them."""
    level: int
    passed: bool
    results: list[bool]
    """The curriculum's window."""
    recent: list[Ended]
    """The last episodes, for the log's running means."""
    format: int = FORMAT


def comparable(options: TrainingOptions, engine: str) -> str:
    """The options that a resumed training shares with the one that it goes on with, as JSON."""
    tree = {name: value for name, value in asdict(options).items() if name not in _FREE}
    return json.dumps(tree | {"engine": engine}, sort_keys=True)


def write_state(path: Path, state: TrainingState) -> None:
    """Write a state in one piece: after a kill the file is the old one or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.new")
    try:
        with temporary.open("wb") as file:
            torch.save({field.name: getattr(state, field.name) for field in fields(state)}, file)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def read_state(path: Path, options: TrainingOptions, engine: str) -> TrainingState:
    """Read the state of a training that is gone on with under these options.

    Raises:
        TrainingError: there is none, it is damaged, or it belongs to other options; says which.
    """
    try:
        content = torch.load(path, weights_only=True)
    except FileNotFoundError:
        raise TrainingError(
            f"{path}: expected the state of a training, found none: no iteration of it was completed; begin anew"
        ) from None
    except Exception as error:
        raise TrainingError(
            f"{path}: expected the state of a training, found a damaged file ({error})"
        ) from error
    names = {field.name for field in fields(TrainingState)}
    if not isinstance(content, dict) or content.get("format") != FORMAT or set(content) != names:
        raise TrainingError(f"{path}: expected a training's state of format {FORMAT}, found something else")
    state = TrainingState(**content)
    expected, found = json.loads(state.options), json.loads(comparable(options, engine))
    if differing := list(_differing(expected, found)):
        raise TrainingError(
            f"{path} belongs to a training with other options: {'; '.join(differing[:5])}; begin anew, or resume "
            "with the version and the options that it was begun with"
        )
    return state


def _differing(expected: Any, found: Any, name: str = "") -> list[str]:
    if isinstance(expected, dict) and isinstance(found, dict):
        keys = [*expected, *(key for key in found if key not in expected)]
        return [
            line
            for key in keys
            for line in _differing(expected.get(key), found.get(key), f"{name}.{key}" if name else key)
        ]
    return [] if expected == found else [f"{name}: expected {expected}, found {found}"]
