"""From what the user named to what is flown: mesh, policy, time steps and plant parameters, or a clear refusal."""

from __future__ import annotations

import math
import os
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import agent_client
from agent_client.controllers import Controller, PolicyController, PurePursuit
from agent_client.policy import Policy, load_policy
from agent_client.settings import DEFAULT_DT, Settings
from cosim.errors import CosimError, OutputError
from cosim.options import SHIPPED_MESH, SHIPPED_POLICY, FlightOptions
from meshes.mesh_geometry import MeshGeometry
from meshes.tube import INDUSTRIAL, Tube, read_tube
from protocol.plant import PARAMETER_INDEX

PURE_PURSUIT: Final = "pure-pursuit"
SHIPPED_CHECKPOINT: Final = Path(agent_client.__file__).parent / "policies" / "tube_ppo.zip"


@dataclass(frozen=True)
class Inputs:
    """Everything that one flight needs, read and checked, before any process is started."""

    tube: Tube
    geometry: MeshGeometry
    controller: Controller
    policy: Policy | None
    settings: Settings
    dt: float
    parameters: dict[str, float]
    notes: tuple[str, ...]
    """What was chosen for the user, to be said."""


def resolve(name: str, shipped_name: str, shipped: Path, what: str) -> tuple[Path, str | None]:
    """The path of a mesh or policy; the shipped one where it is named and no such file exists."""
    path = Path(name)
    if name == shipped_name and not path.exists():
        return shipped, f"{what}: {shipped_name} is the shipped one"
    return path, None


def parse_parameters(pairs: tuple[str, ...]) -> dict[str, float]:
    """Plant parameters from NAME=VALUE pairs."""
    values = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals or name not in PARAMETER_INDEX:
            known = ", ".join(PARAMETER_INDEX)
            raise CosimError(f"--parameter: expected NAME=VALUE with a name of {known}; found {pair!r}")
        try:
            values[name] = float(text)
        except ValueError:
            raise CosimError(f"--parameter {name}: expected a number, found {text!r}") from None
        if not math.isfinite(values[name]):
            raise CosimError(f"--parameter {name}: expected a finite number, found {text!r}")
    return values
