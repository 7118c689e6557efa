"""Who flies: from what the user named to a controller, checked against what will run."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import agent_client
from agent_client.contract import Contract, require_match, running_contract
from agent_client.controllers import DEFAULT_LOOKAHEAD, PolicyController, PurePursuit
from agent_client.errors import ContractMismatch
from agent_client.policy import load_policy
from agent_client.settings import DEFAULT_DT, Settings
from cosim.errors import CosimError
from cosim.options import SHIPPED_POLICY

if TYPE_CHECKING:
    from agent_client.evaluation import MakeController

PURE_PURSUIT: Final = "pure-pursuit"
TUNED_PURSUIT: Final = "pure-pursuit-tuned"
LIDAR_RULE: Final = "lidar-rule"
OF_CENTRELINE: Final = ("progress", "position_f", "position_u", "position_r")
"""Features that are known from the centreline alone."""
PURSUIT_SEES: Final = (
    "exact centreline and position; no sensor noise, drop-out or delay of observations touches it"
)
SHIPPED_CHECKPOINT: Final = Path(agent_client.__file__).parent / "policies" / "tube_ppo.zip"


@dataclass(frozen=True)
class PilotChoice:
    """Who is to fly, as the user named it."""

    name: str
    """`pure-pursuit`, `pure-pursuit-tuned`, `lidar-rule`, or the checkpoint as given."""
    path: Path | None = None
    """The checkpoint."""
    lookahead: float | None = None
    """Of Pure Pursuit (m), None for the default."""
    speed: float | None = None
    """Of Pure Pursuit (m/s), None for the fastest speed level."""

    @property
    def label(self) -> str:
        """A name for a folder."""
        return self.name if self.path is None else self.path.stem


@dataclass(frozen=True)
class Pilot:
    """Who flies, under what settings and time step, and how a manifest describes it."""

    make_controller: MakeController
    settings: Settings
    dt: float
    description: dict[str, Any]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Terms:
    """What the user asks for although a checkpoint may have been made for something else."""

    dt: float | None = None
    """Control step (s), None for the checkpoint's."""
    allowed: Collection[str] = ()
    """Names of terms of the contract that may differ."""
    drone: Mapping[str, float] = field(default_factory=dict)
    """Fields of DroneSettings; naming one is allowing it."""


ANY_DRONE: Final = ("drone.body_radius", "drone.compensation")
"""Terms of the contract that an evaluation sets by its conditions, for every pilot alike."""


def choose_pilot(name: str, lookahead: float | None = None, speed: float | None = None) -> PilotChoice:
    """Who is meant by --policy.

    Raises:
        CosimError: a file that does not exist, or an option that this pilot does not have.
    """
    pursuit = {"--lookahead": lookahead, "--speed": speed}
    if name != PURE_PURSUIT:
        for option, value in pursuit.items():
            if value is not None:
                raise CosimError(f"{option}: only --policy {PURE_PURSUIT} has one")
    if name in (PURE_PURSUIT, TUNED_PURSUIT, LIDAR_RULE):
        return PilotChoice(name, None, lookahead, speed)
    try:
        path = existing_file("policy", name, SHIPPED_POLICY, SHIPPED_CHECKPOINT)
    except CosimError as error:
        known = ", ".join((SHIPPED_POLICY, PURE_PURSUIT, LIDAR_RULE))
        raise CosimError(f"{error}; without a file there are {known}") from error
    return PilotChoice(name, path)


def existing_file(what: str, name: str, shipped_name: str, shipped: Path) -> Path:
    """The file of this name; the shipped one where its name is given and no such file exists.

    Raises:
        CosimError: there is no such file.
    """
    path = Path(name)
    if name == shipped_name and not path.exists():
        path = shipped
    try:
        found = "a folder" if path.is_dir() else "" if path.is_file() else "no such file"
    except OSError as error:
        found = f"one that cannot be read: {error.strerror}"
    if found:
        raise CosimError(f"--{what} {name}: expected a file, found {found}")
    return path


def read_pilot(choice: PilotChoice, terms: Terms | None = None) -> Pilot:
    """The controller that was named, checked against what will run.

    Raises:
        AgentError: a checkpoint that cannot be read, or whose contract differs from what would run.
        CosimError: Pure Pursuit is to be tuned, and has not been.
    """
    terms = terms or Terms()
    base = replace(Settings(), drone=replace(Settings().drone, **terms.drone))
    if choice.path is not None:
        return _read_checkpoint(choice.name, choice.path, base, terms)
    dt = DEFAULT_DT if terms.dt is None else terms.dt
    if choice.name == LIDAR_RULE:
        from agent_client.lidar_rule import ASYMMETRIES, LidarRule  # not on the way of other flights' start

        sees = f"LiDAR alone ({', '.join(ASYMMETRIES)}), no centreline"
        return Pilot(lambda _: LidarRule(base), base, dt, {"name": LIDAR_RULE, "sees": sees}, ())
    if choice.name == TUNED_PURSUIT and choice.lookahead is None:
        raise CosimError(
            f"--policy {TUNED_PURSUIT}: it is tuned by `cosim evaluate`, which says look-ahead and speed; fly "
            f"--policy {PURE_PURSUIT} with these as --lookahead and --speed"
        )
    lookahead = DEFAULT_LOOKAHEAD if choice.lookahead is None else choice.lookahead
    speed = base.speed_max if choice.speed is None else choice.speed
    return Pilot(
        lambda geometry: PurePursuit(geometry, base, lookahead=lookahead, speed=speed),
        base,
        dt,
        {"name": choice.name, "lookahead": lookahead, "speed": speed, "sees": PURSUIT_SEES},
        (),
    )


def _read_checkpoint(name: str, path: Path, base: Settings, terms: Terms) -> Pilot:
    policy = load_policy(path)
    contract = policy.contract
    settings = replace(base, masked_features=contract.masked)
    dt = contract.dt if terms.dt is None else terms.dt
    allowed = {*terms.allowed, *(f"drone.{field}" for field in terms.drone)}
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
        "path": str(path.resolve()),
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "sees": _sees(contract),
        "training": dict(contract.training),
        "mismatch": [asdict(difference) for difference in mismatch],
    }
    return Pilot(
        lambda _: PolicyController(policy, settings, contract.lags),
        settings,
        dt,
        description,
        (*policy.notes, *notes),
    )


def _sees(contract: Contract) -> str:
    """How much a policy sees, and whether the centreline, which no drone in an unknown tube does, is part of it.

    A policy that learnt from a teacher has seen more in training than in flight, which is said too.
    """
    text = f"{len(contract.observations) - len(contract.masked)} features"
    if len(contract.lags) > 1:
        text += f" at {len(contract.lags)} times"
    known = [name for name in OF_CENTRELINE if name not in contract.masked]
    text += f", of the centreline {', '.join(known)}" if known else ", no centreline"
    if contract.training.get("imitation"):
        text += "; learnt by imitating a teacher that sees the axis and the dynamics"
    return text
