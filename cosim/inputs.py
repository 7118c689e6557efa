"""From what the user named to what is flown through: a tube from files or a generated one, conditions, parameters."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

from agent_client.conditions import NAMES, PARAMETERS_OF, Conditions, Records, draw_conditions
from agent_client.tubes import TubeRecipe, draw_tube
from cosim.errors import CosimError, OutputError
from cosim.named_settings import idle_settings, option_name
from cosim.options import SHIPPED_MESH, FlightOptions
from cosim.pilots import existing_file
from meshes.formats import Axes
from meshes.geometry import Geometry
from meshes.mesh_geometry import MeshGeometry
from meshes.tube import INDUSTRIAL, read_tube
from protocol.plant import PARAMETER_INDEX, PARAMETERS, TubeReference

TUBE_FILES: Final = ("tube.obj", "tube_centerline.obj")
"""Wall and centreline of a generated tube, in the run folder."""


@dataclass(frozen=True)
class Conduit:
    """What is flown through."""

    geometry: Geometry
    """As perception sees it."""
    reference: TubeReference
    """Its wall, as physics is told of it."""
    length: float
    """Of the axis (m)."""
    description: dict[str, Any]
    """For the manifest: `mesh`, and `tube` where it was generated."""


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
    if options.tube is None:
        for name in options.settings.tubes:
            raise CosimError(f"{option_name(name)}: only a generated tube has it; add --tube level=L,seed=N")
    else:
        usual = FlightOptions()
        for name in ("mesh", "centerline", "axes", "scale", "start_end"):
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


def find_mesh(options: FlightOptions) -> Path | None:
    """The mesh that the options name, None for a generated tube.

    Raises:
        CosimError: no such file.
    """
    if options.tube is not None:
        return None
    return existing_file("mesh", options.mesh or SHIPPED_MESH, SHIPPED_MESH, INDUSTRIAL)


def read_conduit(options: FlightOptions, mesh: Path) -> Conduit:
    """The tube of a mesh and its centreline.

    Raises:
        MeshError: the mesh or its centreline cannot be used.
    """
    axes: Axes = "yup" if options.axes == "yup" else "zup"
    start_end: Literal["first", "last"] = "last" if options.start_end == "last" else "first"
    tube = read_tube(mesh, options.centerline, axes, options.scale, start_end)
    reference = TubeReference(str(tube.path.resolve()), tube.axes, tube.scale, tube.sha256)
    described = _describe(tube.path, reference, tube.centreline_path, tube.centreline_sha256, tube.length)
    return Conduit(MeshGeometry([tube]), reference, tube.length, {"mesh": described, "tube": None})


def generate_conduit(options: FlightOptions, recipe: TubeRecipe, folder: Path) -> Conduit:
    """The tube that `cosim evaluate` draws for this level and seed; its wall and centreline are written to `folder`.

    Physics reads the file, perception sees the swept curve itself: as in the evaluation, to the last bit.

    Raises:
        CurveError: no such tube was found.
        OutputError: the folder holds such files, or cannot be written.
    """
    from cosim.walls import write_wall
    from meshes.sweep import write_centreline_obj
    from meshes.swept_geometry import SweptGeometry

    chosen = options.tube
    assert chosen is not None
    if chosen.length is not None:
        recipe = replace(recipe, lengths=(chosen.length,))
    tube = draw_tube(chosen.level, (chosen.seed,), "evaluate", recipe)
    wall, centreline = (folder / name for name in TUBE_FILES)
    for path in (wall, centreline):
        if path.exists():
            raise OutputError(f"--out {folder}: expected a folder without {path.name}, found one")
    try:
        reference = write_wall(wall, tube)
        write_centreline_obj(centreline, tube.points)
    except OSError as error:
        wall.unlink(missing_ok=True)
        raise OutputError(f"{folder}: the tube cannot be written: {error.strerror}") from error
    sha256 = hashlib.sha256(centreline.read_bytes()).hexdigest()
    described = {"level": chosen.level, "seed": chosen.seed, "domain": "evaluate", "recipe": asdict(recipe)}
    mesh = _describe(wall, reference, centreline, sha256, tube.length)
    return Conduit(SweptGeometry([tube]), reference, tube.length, {"mesh": mesh, "tube": described})


def _describe(
    wall: Path, reference: TubeReference, centreline: Path | None, centreline_sha256: str, length: float
) -> dict[str, Any]:
    return {
        "path": str(wall),
        "sha256": reference.sha256,
        "axes": reference.axes,
        "scale": reference.scale,
        "centreline": None if centreline is None else str(centreline),  # found from the wall
        "centreline_sha256": centreline_sha256,
        "length_m": length,
    }


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
