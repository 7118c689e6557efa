"""From what the user named to the terms of a flight: conditions, parameters, and options that fit each other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from agent_client.conditions import NAMES, PARAMETERS_OF, Conditions, Records, draw_conditions
from agent_client.tubes import TubeRecipe
from cosim.errors import CosimError
from cosim.named_settings import idle_settings, option_name
from cosim.options import FlightOptions
from protocol.plant import PARAMETER_INDEX, PARAMETERS


@dataclass(frozen=True)
class FlightConditions:
    """The conditions of one flight: what they were drawn from, and what came of it."""

    ranges: Conditions
    named: frozenset[str]
    """Conditions that the user chose; of the others, those of the dynamics are the plant's own."""
    drawn: Records  # (1,)
    """For `agent_client.flight.fly`."""
    parameters: Mapping[str, float]
    """Plant parameters that the user named."""

    @property
    def chosen(self) -> dict[str, tuple[float, float]]:
        """The ranges that the user chose, by name."""
        return {name: span for name, span in self.ranges.ranges().items() if name in self.named}

    @property
    def drone(self) -> dict[str, float]:
        """The chosen ones among what a checkpoint's contract says of the drone."""
        chosen = self.named | {
            name for name, parameter in PARAMETERS_OF.items() if parameter in self.parameters
        }
        return {
            name: float(self.drawn[name][0]) for name in ("body_radius", "compensation") if name in chosen
        }

    @property
    def notes(self) -> tuple[str, ...]:
        """What the chosen conditions came to, to be said."""
        values = ", ".join(f"{name} {self.drawn[name][0]:.4g}" for name in NAMES if name in self.named)
        return (f"conditions: {values}",) if values else ()

    def over(self, defaults: Mapping[str, float]) -> Records:
        """What was drawn, with the plant's own values where neither a condition nor a parameter was chosen."""
        drawn = self.drawn.copy()
        for name, parameter in PARAMETERS_OF.items():
            if parameter not in self.parameters and name not in (*self.named, "body_radius"):
                drawn[name] = defaults[parameter]
        return drawn


def check_options(options: FlightOptions) -> None:
    """Refuse options that contradict each other.

    Raises:
        CosimError: names the two options.
    """
    if options.connect is not None and (options.server or options.session):
        raise CosimError(
            "--connect: a peer that you start has its own command and name; drop --server or --session"
        )
    for name in ("entry", "exit"):
        if options.centerline is not None and getattr(options, name) is not None:
            raise CosimError(f"--{name}: --centerline has its own ends; drop one of them")
    if options.tube is None:
        for name in options.settings.tubes:
            raise CosimError(f"{option_name(name)}: only a generated tube has it; add --tube level=L,seed=N")
    else:
        usual = FlightOptions()
        for name in ("mesh", "centerline", "axes", "scale", "start_end", "entry", "exit"):
            if getattr(options, name) != getattr(usual, name):
                raise CosimError(f"{option_name(name)}: --tube is a generated tube; drop one of them")
        if options.tube.length is not None and "lengths" in options.settings.tubes:
            raise CosimError("--lengths: --tube has a length= already; drop one of them")


def setting_notes(options: FlightOptions, conditions: Conditions, recipe: TubeRecipe) -> Iterator[str]:
    """What the user named and what changes nothing of this flight."""
    settings = options.settings
    if options.tube is None and settings.hard:
        yield "--hard: on a mesh the hard conditions alone; its bends are those of generated tubes (--tube)"
    names = {*settings.conditions, *settings.tubes}
    if options.parameters:  # a named disturbance or drag gives the mass its meaning
        names.discard("mass")
    levels = () if options.tube is None else (options.tube.level,)
    for name, why in idle_settings(names, conditions, recipe, levels):
        yield f"{option_name(name)}: {why}"


def draw_flight_conditions(
    options: FlightOptions, conditions: Conditions, parameters: Mapping[str, float]
) -> FlightConditions:
    """What a flight draws from its conditions, by its seed; a plant parameter that is named stands for itself.

    Raises:
        CosimError: a condition and the parameter that it stands for are both named.
    """
    for name, parameter in PARAMETERS_OF.items():
        if parameter in parameters and name in options.settings.conditions:
            raise CosimError(f"--parameter {parameter}: {option_name(name)} gives it too; drop one of them")
    drawn = draw_conditions(conditions, [(options.start_seed,)])
    for name, parameter in PARAMETERS_OF.items():
        if parameter in parameters:
            drawn[name] = parameters[parameter]
    return FlightConditions(
        conditions, frozenset({*conditions.changed(), *options.settings.conditions}), drawn, parameters
    )


def parse_parameters(pairs: tuple[str, ...]) -> dict[str, float]:
    """Plant parameters from NAME=VALUE pairs.

    Raises:
        CosimError: an unknown name, or a value out of its range.
    """
    values = {}
    for pair in pairs:
        name, _, text = pair.partition("=")
        if name not in PARAMETER_INDEX:
            known = ", ".join(PARAMETER_INDEX)
            raise CosimError(f"--parameter: expected NAME=VALUE with a name out of {known}; found {pair!r}")
        parameter = PARAMETERS[PARAMETER_INDEX[name]]
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        low, high = parameter.lowest, parameter.highest
        fits = low < value if parameter.above_lowest else low <= value
        if not (math.isfinite(value) and fits and value <= high and value in (parameter.either or (value,))):
            raise CosimError(f"--parameter {name}: expected a number, {parameter.range}; found {text!r}")
        values[name] = value
    return values
