"""From what the user named to what is flown: tube, policy, time steps and plant parameters, or a refusal."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import agent_client
from agent_client.contract import require_match, running_contract
from agent_client.controllers import DEFAULT_LOOKAHEAD, Controller, PolicyController, PurePursuit
from agent_client.errors import ContractMismatch
from agent_client.policy import load_policy
from agent_client.settings import DEFAULT_DT, Settings
from cosim.errors import CosimError
from cosim.options import SHIPPED_MESH, SHIPPED_POLICY, FlightOptions
from meshes.mesh_geometry import MeshGeometry
from meshes.tube import INDUSTRIAL, Axes, Tube, read_tube
from protocol.plant import PARAMETER_INDEX, PARAMETERS

PURE_PURSUIT: Final = "pure-pursuit"
SHIPPED_CHECKPOINT: Final = Path(agent_client.__file__).parent / "policies" / "tube_ppo.zip"


@dataclass(frozen=True)
class Pilot:
    """Who flies: a controller, under what settings and time step, and how the manifest describes it."""

    controller: Controller
    settings: Settings
    dt: float
    description: dict[str, Any]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Named:
    """The files that the options name, before they are read."""

    mesh: Path
    policy: Path | None
    """None for Pure Pursuit."""
    notes: tuple[str, ...]
    """What was chosen for the user, to be said."""

    @property
    def label(self) -> str:
        """Names of tube and pilot for a folder."""
        pilot = PURE_PURSUIT if self.policy is None else self.policy.stem
        return f"{self.mesh.stem[:60]}-{pilot[:60]}"


def name_inputs(options: FlightOptions) -> Named:
    """Which mesh and policy are meant; the shipped ones where their names are given and no such file exists.

    Raises:
        CosimError: a file that does not exist.
    """
    notes = []
    paths: dict[str, Path | None] = {}
    for what, name, shipped_name, shipped in (
        ("mesh", options.mesh, SHIPPED_MESH, INDUSTRIAL),
        ("policy", options.policy, SHIPPED_POLICY, SHIPPED_CHECKPOINT),
    ):
        path = Path(name)
        if name == PURE_PURSUIT and what == "policy":
            paths[what] = None
            continue
        if name == shipped_name and not path.exists():
            path = shipped
            notes.append(f"{what}: {shipped_name} is the shipped one")
        try:
            found = "a folder" if path.is_dir() else "" if path.is_file() else "no such file"
        except OSError as error:
            found = f"one that cannot be read: {error.strerror}"
        if found:
            raise CosimError(f"--{what} {name}: expected a file, found {found}")
        paths[what] = path
    mesh = paths["mesh"]
    assert mesh is not None
    return Named(mesh, paths["policy"], tuple(notes))


def read_tube_input(options: FlightOptions, named: Named) -> Tube:
    """The tube that the options name.

    Raises:
        MeshError: the mesh or its centreline cannot be used.
    """
    axes: Axes = "yup" if options.axes == "yup" else "zup"
    start_end: Literal["first", "last"] = "last" if options.start_end == "last" else "first"
    return read_tube(named.mesh, options.centerline, axes, options.scale, start_end)


def read_pilot(
    options: FlightOptions, named: Named, geometry: MeshGeometry, parameters: Mapping[str, float]
) -> Pilot:
    """The controller that the options name, checked against what will run.

    Naming a compensation or a body radius is allowing it; that it differs from the checkpoint's is said.

    Raises:
        AgentError: a checkpoint that cannot be read, or whose contract differs from what would run.
        CosimError: an option that this controller does not have.
    """
    chosen = {"compensation": options.compensation, "body_radius": parameters.get("body_radius")}
    drone = {name: value for name, value in chosen.items() if value is not None}
    base = replace(Settings(), drone=replace(Settings().drone, **drone))
    if named.policy is None:
        lookahead = DEFAULT_LOOKAHEAD if options.lookahead is None else options.lookahead
        pursuit = PurePursuit(geometry, base, lookahead=lookahead)
        return Pilot(
            pursuit,
            base,
            DEFAULT_DT if options.dt is None else options.dt,
            {
                "name": PURE_PURSUIT,
                "lookahead": lookahead,
                "speed": pursuit.speed,
                "sees": "exact centreline",
            },
            (),
        )
    if options.lookahead is not None:
        raise CosimError("--lookahead: only --policy pure-pursuit has one")
    path = named.policy
    policy = load_policy(path)
    contract = policy.contract
    settings = replace(base, masked_features=contract.masked)
    dt = contract.dt if options.dt is None else options.dt
    allowed = {*options.allow_mismatch, *(f"drone.{name}" for name in drone)}
    try:
        mismatch = require_match(contract, running_contract(settings, dt), str(path), allowed)
    except ContractMismatch as error:
        if [difference.name for difference in error.differences] == ["dt"]:
            error.add_note("--allow-mismatch dt flies it all the same")
        raise
    notes = tuple(
        f"policy: {difference.name}: made for {difference.expected}, flown with {difference.found}"
        for difference in mismatch
    )
    description = {
        "name": path.stem,
        "path": str(path),
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "sees": f"{len(contract.observations) - len(contract.masked)} features, no centreline"
        if contract.masked
        else f"{len(contract.observations)} features",
        "training": dict(contract.training),
        "mismatch": [asdict(difference) for difference in mismatch],
    }
    return Pilot(PolicyController(policy, settings, contract.lags), settings, dt, description, (*policy.notes, *notes))


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
