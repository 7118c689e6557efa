"""What is taken away from a recipe, one thing at a time, to see what it was good for.

The paper argues for its memory, its rear LiDAR, its curriculum and the regimes of its reward, and shows no training
without them. Each ablation is a change of the options of a training; its policy is flown as it was trained, with the
same features masked and the same sensors off.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Final, TypeAlias

from agent_client.conditions import Range
from agent_client.features import CAMERA_FEATURES, LIDAR_FEATURES, MEMORY_FEATURES
from agent_client.presets import UNKNOWN_TUBE
from agent_client.settings import MemorySettings
from agent_client.training_log import Progress
from agent_client.training_options import TrainingOptions
from agent_client.tubes import LEVELS

Change: TypeAlias = Callable[[TrainingOptions], TrainingOptions]

REAR_LIDAR: Final = ("h_r", "v_r", "s_r", "m_r")
"""What the policy sees of the rear ring alone."""

WALLS: Final = (*LIDAR_FEATURES, "safety", "position_f", "position_u", "position_r")
"""What the policy knows of how near the walls are."""


@dataclass(frozen=True)
class Ablation:
    """One thing taken away, or put in another's place."""

    name: str
    changed: str
    """What is changed, and what stays."""
    claim: str
    """The paper's claim in a word; a dash where it makes none."""
    change: Change
    """Of the options of the recipe as a whole."""
    conditions: Mapping[str, Range] = field(default_factory=lambda: MappingProxyType({}))
    """Conditions that it is both trained and flown under, in place of the recipe's."""

    def apply(self, base: TrainingOptions) -> TrainingOptions:
        """The options of the recipe with this change; the same ones where it has nothing to change."""
        options = self.change(base)
        world = replace(options.world, conditions=options.world.conditions.with_ranges(self.conditions))
        return replace(options, world=world)


def masked(options: TrainingOptions, names: Sequence[str]) -> TrainingOptions:
    """The options with these features hidden from the policy too."""
    before = options.world.settings.masked_features
    return _with_settings(options, masked_features=tuple(dict.fromkeys((*before, *names))))


def _with_settings(options: TrainingOptions, **changes: Any) -> TrainingOptions:
    settings = replace(options.world.settings, **changes)
    return replace(options, world=replace(options.world, settings=settings))


def _with_reward(options: TrainingOptions, **changes: Any) -> TrainingOptions:
    return _with_settings(options, reward=replace(options.world.settings.reward, **changes))


def _without_memory(options: TrainingOptions) -> TrainingOptions:
    """Masking alone would go on to reward what the memory holds."""
    return _with_settings(masked(options, MEMORY_FEATURES), memory=MemorySettings(steps=0))


def _without_curriculum(options: TrainingOptions) -> TrainingOptions:
    """All levels evenly from the first episode; level 2 alone would also change what the policy is trained for."""
    if options.first_level > 0:
        return options
    return replace(options, first_level=LEVELS - 1, replay=(LEVELS - 1) / LEVELS)


ABLATIONS: Final = (
    Ablation("full", "nothing", "84/71/87", lambda options: options),
    Ablation(
        "no-memory",
        "nothing is remembered: the 5 features of the memory are masked, and the reward's case 2 never holds",
        "essential",
        _without_memory,
    ),
    Ablation(
        "no-camera",
        "the target is never seen, in training and in flight: camera and memory are masked, and the reward's case 3 "
        "always holds",
        "essential",
        lambda options: masked(options, (*CAMERA_FEATURES, *MEMORY_FEATURES)),
        MappingProxyType({"camera_dropout": (1.0, 1.0)}),
    ),
    Ablation(
        "no-rear-lidar",
        "h_r, v_r, s_r and m_r are masked; l_min and the safety metric still hold the nearest of both rings, and the "
        "reward its rear terms",
        "stabilises",
        lambda options: masked(options, REAR_LIDAR),
    ),
    Ablation(
        "no-lidar",
        "all LiDAR features, the safety metric and the offset from the axis are masked, so that the camera is alone",
        "essential",
        lambda options: masked(options, WALLS),
    ),
    Ablation(
        "no-position",
        "progress and offset from the axis are masked, which no drone in an unknown tube knows",
        "unknown",
        lambda options: masked(options, UNKNOWN_TUBE),
    ),
    Ablation(
        "no-curriculum",
        "every episode is drawn from all three levels evenly, from the first one on",
        "key",
        _without_curriculum,
    ),
    Ablation(
        "literal-reward",
        "the reward as the paper writes it, per step",
        "its own",
        lambda options: _with_reward(options, per_metre=False),
    ),
    Ablation(
        "per-metre",
        "the reward of a step times its progress over v_max dt",
        "-",
        lambda options: _with_reward(options, per_metre=True),
    ),
    Ablation(
        "one-regime",
        "the reward's case 3, LiDAR alone, whatever is seen: nothing is paid for alignment",
        "required",
        lambda options: _with_reward(options, regimes=False),
    ),
)
"""All ablations, in the order of the table; `full` is what they are compared with.

The paper's words: visibility, memory and LiDAR cues together prove "essential" (abstract); the rear LiDAR "plays a
stabilizing role"; curriculum learning "serves as a key mechanism"; the reward "must encode each step of the process".
It says that its agent has "no information about the true geometry", and lists progress and position among the
features all the same.
"""


def first_passed(log: Sequence[Progress], success: float) -> int | None:
    """Control steps after which the success rate in training at the last level was first above `success`.

    The rate is over the last 300 episodes at that level, with actions drawn and not the most likely ones. An
    iteration counts when the one before was at that level already, so that the rate is not one of a few episodes.

    Returns:
        None where it never was.
    """
    for before, row in itertools.pairwise(log):
        if before.level == LEVELS - 1 and row.success_rate > success:
            return row.steps
    return None
