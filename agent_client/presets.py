"""The recipes of `cosim train`: `paper`, `quick` and `robust`, all of their values in one place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Final, Literal, TypeAlias

from agent_client.conditions import Conditions
from agent_client.settings import RewardSettings, Settings
from agent_client.training_options import Hyperparameters, Imitation, TrainingOptions
from agent_client.tubes import HARD_TUBES, PAPER_TUBES, VARIED_TUBES
from agent_client.world import WorldOptions

Dynamics: TypeAlias = Literal["kinematic", "rigid-body"]

UNKNOWN_TUBE: Final = ("progress", "position_f", "position_u", "position_r")
"""What a drone in an unknown tube cannot know: its progress along the tube, and its offset from the axis."""

_OUT: Final = Path("policy.zip")


@dataclass(frozen=True)
class Preset:
    """A recipe: what is trained, and under which dynamics unless told otherwise."""

    summary: str
    dynamics: Dynamics
    options: TrainingOptions


PAPER: Final = TrainingOptions(
    _OUT,
    preset="paper",
    steps=2_600_000,
    world=WorldOptions(Settings(reward=RewardSettings(per_metre=False))),
    hyperparameters=Hyperparameters(),
    tubes=(PAPER_TUBES,),
)
"""The paper's tubes, all of its 37 features, its literal reward, its curriculum and its hyperparameters; what it
leaves open stands in `agent_client.paper`."""

QUICK: Final = TrainingOptions(
    _OUT,
    preset="quick",
    steps=234_000,
    world=WorldOptions(Settings(reward=RewardSettings(per_metre=True))),
    hyperparameters=Hyperparameters(learning_rate=5e-4, final_learning_rate=1e-4, epochs=5),
    tubes=(PAPER_TUBES,),
)
"""Past the paper's table in the least time: the paper's task, with its reward paid per metre of progress, and half
the passes over each batch at a higher learning rate."""

_BROAD: Final = Conditions(
    body_radius=(0.15, 0.25),
    field_of_view=(0.6, 1.0),
    lidar_noise=(0.0, 0.03),
    lidar_dropout=(0.0, 0.03),
    camera_dropout=(0.0, 0.2),
    gain=(1.3, 8.0),
    compensation=(0.78, 1.07),
)

_SOFT: Final = replace(_BROAD, gain=(1.3, 3.0), compensation=(0.78, 0.92))
"""Every other episode: a soft drone that sinks, where flights fail first and which even draws seldom give."""

ROBUST: Final = TrainingOptions(
    _OUT,
    preset="robust",
    steps=1_300_000,
    seed=1,
    world=WorldOptions(
        Settings(masked_features=UNKNOWN_TUBE, reward=RewardSettings(per_metre=True, centring=3.0)),
        _BROAD,
        rotation=(_SOFT,),
        lags=(0, 1, 2, 3, 4, 6, 8, 12, 16),
    ),
    hyperparameters=Hyperparameters(lanes=130, rollout=100),
    tubes=(VARIED_TUBES, HARD_TUBES),
    replay=0.35,
    first_level=2,
    imitation=Imitation(),
)
"""The shipped policy's: inertia with randomised dynamics, noise, narrow view, tight bends and varied tubes. The
policy sees nine observations of the last 1.6 s, and neither its place in the tube nor its progress. It is no PPO:
it imitates a teacher that sees the axis and the hidden dynamics, in place of a curriculum at all levels at once.
Trials of PPO, alone (`robust-ppo`) or going on from here, ended lower on the hard tubes; the README has figures."""

ROBUST_PPO: Final = replace(
    ROBUST,
    preset="robust-ppo",
    steps=3_003_000,
    world=replace(ROBUST.world, rotation=(), privileged=True),
    hyperparameters=Hyperparameters(final_learning_rate=3e-5),
    replay=0.3,
    first_level=0,
    imitation=None,
)
"""The same task by PPO through the curriculum, with a value network that sees the axis and the hidden dynamics."""

PRESETS: Final[Mapping[str, Preset]] = MappingProxyType(
    {
        "paper": Preset("the paper's task, reward and hyperparameters", "kinematic", PAPER),
        "quick": Preset("above the paper's success rates in the least time", "kinematic", QUICK),
        "robust": Preset(
            "the shipped policy: inertia, noise, hard tubes; by imitation", "rigid-body", ROBUST
        ),
        "robust-ppo": Preset("the same task by PPO alone", "rigid-body", ROBUST_PPO),
    }
)


def without_inertia(options: TrainingOptions) -> TrainingOptions:
    """The options for the kinematic world: no conditions that need inertia, no teacher that lifts against gravity."""
    world, imitation = options.world, options.imitation
    conditions = world.conditions.without_inertia()
    rotation = tuple(other.without_inertia() for other in world.rotation)
    if imitation is not None:
        imitation = replace(imitation, teacher=replace(imitation.teacher, gravity=0.0))
    world = replace(world, conditions=conditions, rotation=rotation)
    return replace(options, world=world, imitation=imitation)


def preset_options(name: str, out: Path, *, seed: int | None = None) -> TrainingOptions:
    """The options of a preset, with a checkpoint to write and, unless None, a seed."""
    options = replace(PRESETS[name].options, out=out)
    return options if seed is None else replace(options, seed=seed)
