"""What `cosim evaluate` is to fly: from the user's options to worlds, variants and pilots, or a refusal."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import click

from agent_client.conditions import INERTIA_ALONE, Conditions
from agent_client.settings import Settings
from agent_client.tubes import TubeRecipe
from agent_client.tuning import TUNING_EPISODES
from cosim.errors import CosimError
from cosim.named_settings import (
    NamedSettings,
    idle_settings,
    option_name,
    parse_setting,
    setting_names,
    take_settings,
)
from cosim.options import SHIPPED_POLICY
from cosim.pilots import (
    ANY_DRONE,
    LIDAR_RULE,
    PURE_PURSUIT,
    TUNED_PURSUIT,
    Pilot,
    PilotChoice,
    Terms,
    choose_pilot,
    read_pilot,
)
from cosim.workers import Engine

POLICIES: Final = (PURE_PURSUIT, TUNED_PURSUIT, LIDAR_RULE, SHIPPED_POLICY)
"""Who flies when nobody is named."""


@dataclass(frozen=True)
class MapGrid:
    """The cells of a map: every gain (1/s) with every compensation (weight)."""

    gains: tuple[float, ...] = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
    compensations: tuple[float, ...] = (0.7, 0.8, 0.9, 1.0, 1.1)


@dataclass(frozen=True)
class EvaluateOptions:
    """What the user asked to be evaluated."""

    policies: tuple[str, ...] = ()
    levels: tuple[int, ...] = (0, 1, 2)
    episodes: int = 100
    seed: int = 0
    dynamics: str = "kinematic"
    engine: str | None = None
    settings: NamedSettings = field(default_factory=NamedSettings)
    sweep: str | None = None
    grid: MapGrid | None = None
    """Draw a map over it in place of the table."""
    tuning_episodes: int = TUNING_EPISODES
    workers: int = 1
    out: Path | None = None


def read_options(arguments: dict[str, Any]) -> EvaluateOptions:
    """The options from a command's keyword arguments (`cosim.options.evaluate_options`).

    Raises:
        CosimError: a map without a folder to draw it into, or in a world without inertia; cells without a map.
    """
    settings = take_settings(arguments)
    wants_map = arguments.pop("draw_map")
    cells = {name: arguments.pop(f"map_{name}") for name in ("gains", "compensations")}
    cells = {name: values for name, values in cells.items() if values is not None}
    grid = MapGrid(**cells) if wants_map else None
    usual: dict[str, Any] = {
        "levels": (0, 1, 2),
        "episodes": 100,
        "dynamics": "kinematic",
        "tuning_episodes": TUNING_EPISODES,
    }
    if wants_map:
        if arguments["dynamics"] == "kinematic":
            raise CosimError("--map: gain and compensation need inertia; drop --dynamics kinematic")
        if arguments["out"] is None:
            raise CosimError("--map: expected --out DIR for the picture, found none")
        # There are many cells, and what is impossible is seen at the hardest level.
        usual = {
            "levels": (2,),
            "episodes": 40,
            "dynamics": "rigid-body",
            "engine": "reference",
            "tuning_episodes": 40,
        }
    elif cells:
        raise CosimError(f"{option_name(f'map_{min(cells)}')}: only --map has one; add --map --out DIR")
    usual["workers"] = len(os.sched_getaffinity(0))
    given: dict[str, Any] = {
        name: usual.get(name) if value is None else value for name, value in arguments.items()
    }
    return EvaluateOptions(settings=settings, grid=grid, **given)


@dataclass(frozen=True)
class Variant:
    """One set of conditions and tubes; a sweep or a map has several."""

    values: Mapping[str, Any]
    """The settings that tell it from the others, by name."""
    conditions: Conditions
    recipe: TubeRecipe


@dataclass(frozen=True)
class Plan:
    """What is flown: every pilot at every level of every variant."""

    engine: Engine
    pilots: Mapping[PilotChoice, Pilot]
    variants: tuple[Variant, ...]
    left_out: Mapping[str, tuple[float, float]]
    """Ranges of the hard conditions that have no meaning without inertia."""
    notes: tuple[str, ...] = ()
    """What the user should know before it is flown."""

    @property
    def dynamics(self) -> str:
        """The name of the dynamics."""
        return "kinematic" if self.engine == "kinematic" else "rigid-body"

    @property
    def tuning_engine(self) -> Engine:
        """Where Pure Pursuit is tuned: not in Bullet, which takes a hundred times as long and ends up the same."""
        return "reference" if self.engine == "bullet" else self.engine


def make_plan(options: EvaluateOptions) -> Plan:
    """What the options mean.

    Raises:
        CosimError: options that contradict each other, a setting without a meaning here, no such checkpoint.
        AgentError: a value out of its bounds, or a checkpoint that cannot be flown.
    """
    engine = _engine(options)
    conditions, recipe = options.settings.resolve()
    left_out = {}
    if engine == "kinematic":
        _refuse_without_inertia(options.settings.conditions)
        left_out = {name: span for name, span in conditions.changed().items() if name in INERTIA_ALONE}
        conditions = conditions.without_inertia()
    variants = [Variant({}, conditions, recipe)]
    if options.grid is not None:
        if options.sweep is not None:
            raise CosimError("--map and --sweep: expected one of them, found both")
        variants = _map_variants(options, options.grid, conditions, recipe)
    elif options.sweep is not None:
        variants = _sweep_variants(options, options.sweep, engine, conditions, recipe)
    notes = (*_repeats(options.sweep, variants), *_idle(options, variants))
    return Plan(engine, _pilots(options, conditions), tuple(variants), left_out, notes)


def _repeats(sweep: str | None, variants: Sequence[Variant]) -> Iterator[str]:
    """Whether a sweep names a value twice, which is flown once."""
    if sweep is not None and len(variants) < len(sweep.split(",")):
        yield f"--sweep {sweep}: values that are named twice are flown once"


def _idle(options: EvaluateOptions, variants: Sequence[Variant]) -> list[str]:
    """Settings that the user named and that change nothing in any variant."""
    names = {*options.settings.conditions, *options.settings.tubes, *variants[0].values}
    idle = [dict(idle_settings(names, v.conditions, v.recipe, options.levels)) for v in variants]
    return [f"{option_name(n)}: {why}" for n, why in idle[0].items() if all(n in other for other in idle)]


def _engine(options: EvaluateOptions) -> Engine:
    if options.dynamics != "kinematic":
        return "reference" if options.engine == "reference" else "bullet"
    if options.engine is not None:
        raise CosimError(f"--engine {options.engine}: it has a part in --dynamics rigid-body alone")
    return "kinematic"


def _refuse_without_inertia(names: Mapping[str, Any]) -> None:
    for name in names:
        if name in INERTIA_ALONE:
            raise CosimError(
                f"{option_name(name)}: it has no meaning in the kinematic world, which has no inertia; add "
                f"--dynamics rigid-body"
            )


def _map_variants(
    options: EvaluateOptions, grid: MapGrid, conditions: Conditions, recipe: TubeRecipe
) -> list[Variant]:
    for name in ("gain", "compensation"):
        if name in options.settings.conditions:
            raise CosimError(f"{option_name(name)}: --map has its own; name them by --map-{name}s")
    cells = [{"gain": gain, "compensation": c} for gain in grid.gains for c in grid.compensations]
    return [
        Variant(cell, conditions.with_ranges({name: (value, value) for name, value in cell.items()}), recipe)
        for cell in cells
    ]


def _sweep_variants(
    options: EvaluateOptions, sweep: str, engine: Engine, conditions: Conditions, recipe: TubeRecipe
) -> list[Variant]:
    name, _, text = sweep.partition("=")
    name = name.strip().lstrip("-").replace("-", "_")
    if name not in setting_names() or not text:
        raise CosimError(
            f"--sweep: expected NAME=V1,V2,... with a name out of {', '.join(setting_names())}; found {sweep!r}"
        )
    if engine == "kinematic":
        _refuse_without_inertia({name: None})
    if name in (*options.settings.conditions, *options.settings.tubes):
        raise CosimError(f"--sweep {name}: {option_name(name)} gives it too; drop one of them")
    try:
        values = list(dict.fromkeys(parse_setting(name, value.strip()) for value in text.split(",")))
    except click.BadParameter as error:
        raise CosimError(f"--sweep {name}: {error.message}") from error
    if name in conditions.ranges():
        return [Variant({name: value}, conditions.with_ranges({name: value}), recipe) for value in values]
    return [Variant({name: value}, conditions, replace(recipe, **{name: value})) for value in values]


def _pilots(options: EvaluateOptions, conditions: Conditions) -> dict[PilotChoice, Pilot]:
    """Who flies, each read once here so that nothing starts for a checkpoint that cannot be flown."""
    fixed = {name: span[0] for name, span in conditions.changed().items() if span[0] == span[1]}
    drone: dict[str, float] = {name: fixed[name] for name in ("body_radius", "compensation") if name in fixed}
    terms = Terms(allowed=ANY_DRONE, drone=drone)
    names = options.policies or POLICIES
    if options.grid is not None:
        names = (*(options.policies or (SHIPPED_POLICY,)), TUNED_PURSUIT)
    pilots = {}
    for name in dict.fromkeys(names):
        choice = choose_pilot(name)
        if name == PURE_PURSUIT:  # a fixed look-ahead: as far as the camera looks
            choice = replace(choice, lookahead=Settings().camera.target_distance)
        # What is found by tuning is not known yet; all else of that pilot is.
        known = replace(choice, name=PURE_PURSUIT) if name == TUNED_PURSUIT else choice
        pilots[choice] = read_pilot(known, terms)
    return pilots
