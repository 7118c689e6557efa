"""What travels between the two processes, as arrays over lanes, and the contract of whatever integrates it.

Every array is a view of one contiguous block of 8-byte words with one row a lane, laid out as it stands on
the wire (`protocol/README.md`), so that sending is one copy. World frame right-handed, Z up; metres, seconds,
radians, kilograms, newtons; quaternions x, y, z, w. Body frame: x forward, y left, z up.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

COMMAND_WORDS: Final = 8
POSE_WORDS: Final = 16
RESET_WORDS: Final = 48

NO_TUBE: Final = -1
"""Tube index of a lane that flies in free space."""


@dataclass(frozen=True)
class Parameter:
    """One entry of the fixed table of plant parameters that a reset carries."""

    name: str
    unit: str
    meaning: str
    lowest: float = -math.inf
    """Smallest value that a reset may carry; finite values alone are taken."""
    highest: float = math.inf
    above_lowest: bool = False
    """Whether the value must be greater than `lowest`, not just as great."""
    either: tuple[float, ...] = ()
    """The values that are taken, where it is one of a few."""

    @property
    def range(self) -> str:
        """The values that are taken, in words."""
        if self.either:
            return " or ".join(f"{value:g}" for value in self.either)
        if self.highest < math.inf:
            return f"{self.lowest:g} to {self.highest:g}"
        if self.lowest > -math.inf:
            return f"{'>' if self.above_lowest else '>='} {self.lowest:g}"
        return "finite"


PARAMETERS: Final[tuple[Parameter, ...]] = (
    Parameter("mass", "kg", "mass m", 0.0, above_lowest=True),
    Parameter("inertia_x", "kg m^2", "principal moment Ix about the body's x axis", 0.0, above_lowest=True),
    Parameter("inertia_y", "kg m^2", "principal moment Iy about the body's y axis", 0.0, above_lowest=True),
    Parameter("inertia_z", "kg m^2", "principal moment Iz about the body's z axis", 0.0, above_lowest=True),
    Parameter("body_radius", "m", "radius of the collision sphere", 0.0, above_lowest=True),
    Parameter("force_gain", "1/s", "k_v of the force law", 0.0),
    Parameter("force_along_body", "1", "0: force along d; 1: along the body's x axis", either=(0.0, 1.0)),
    Parameter("torque_kp", "1/s^2", "k_p of the torque law, per unit of inertia", 0.0),
    Parameter("torque_kd", "1/s", "k_d of the torque law, per unit of inertia", 0.0),
    Parameter("linear_drag", "N s/m", "force -drag * V", 0.0),
    Parameter("angular_drag", "N m s", "torque -drag * omega", 0.0),
    Parameter("gravity", "m/s^2", "acceleration g along world -Z, applied by the engine"),
    Parameter("restitution", "1", "coefficient of restitution of body and wall", 0.0, 1.0),
    Parameter("friction", "1", "coefficient of friction of body and wall", 0.0),
    Parameter("disturbance_x", "N", "constant force on the body, world frame"),
    Parameter("disturbance_y", "N", "constant force on the body, world frame"),
    Parameter("disturbance_z", "N", "constant force on the body, world frame"),
    Parameter("gust", "N", "amplitude of a random force from the lane's seed, new every control step", 0.0),
)
"""The parameters in the order of their words in a reset row; the words up to `PARAMETER_SLOTS` are reserved."""

PARAMETER_SLOTS: Final = 32
PARAMETER_INDEX: Final[dict[str, int]] = {p.name: i for i, p in enumerate(PARAMETERS)}


@dataclass(frozen=True)
class CommandBatch:
    """The commands of one control step, one row a lane; the fields are views of `raw`."""

    raw: Floats  # (N, 8)
    direction: Floats = field(init=False)  # (N, 3)
    """Unit vector of the commanded direction, world frame."""
    speed: Floats = field(init=False)  # (N,)
    """Commanded speed along it (m/s), 0 to the plant's `speed_max`."""
    compensation: Floats = field(init=False)  # (N,)
    """Vertical compensation c: upward force as a fraction of the weight; 1 hovers. It never tilts `direction`."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "direction", self.raw[:, 0:3])
        object.__setattr__(self, "speed", self.raw[:, 3])
        object.__setattr__(self, "compensation", self.raw[:, 4])

    @classmethod
    def zeros(cls, lanes: int) -> Self:
        """Commands of `lanes` drones, every word zero; a zero direction is refused until it is filled in."""
        return cls(np.zeros((lanes, COMMAND_WORDS)))


@dataclass(frozen=True)
class PoseBatch:
    """The poses that answer a command or a reset, one row a lane; the fields are views of `raw`."""

    raw: Floats  # (N, 16)
    position: Floats = field(init=False)  # (N, 3)
    """Centre of mass (m), world frame."""
    quaternion: Floats = field(init=False)  # (N, 4)
    """Rotation of body to world, x y z w."""
    linear_velocity: Floats = field(init=False)  # (N, 3)
    """Velocity of the centre of mass (m/s), world frame."""
    angular_velocity: Floats = field(init=False)  # (N, 3)
    """Angular velocity (rad/s), world frame."""
    sim_time: Floats = field(init=False)  # (N,)
    """Simulated time since the lane's reset (s)."""
    contact_steps: Ints = field(init=False)  # (N,)
    """Inner steps of this control step in which the body touched the wall; 0 means no contact."""
    step: Ints = field(init=False)  # (N,)
    """Control steps since the lane's reset; a reset answers with 0."""

    def __post_init__(self) -> None:
        raw, words = self.raw, self.raw.view(np.int64)
        object.__setattr__(self, "position", raw[:, 0:3])
        object.__setattr__(self, "quaternion", raw[:, 3:7])
        object.__setattr__(self, "linear_velocity", raw[:, 7:10])
        object.__setattr__(self, "angular_velocity", raw[:, 10:13])
        object.__setattr__(self, "sim_time", raw[:, 13])
        object.__setattr__(self, "contact_steps", words[:, 14])
        object.__setattr__(self, "step", words[:, 15])

    @classmethod
    def zeros(cls, lanes: int) -> Self:
        """Poses of `lanes` drones, every word zero."""
        return cls(np.zeros((lanes, POSE_WORDS)))


@dataclass(frozen=True)
class ResetBatch:
    """Initial states and plant parameters, one row a lane; the fields are views of `raw`."""

    raw: Floats  # (N, 48)
    position: Floats = field(init=False)  # (N, 3)
    quaternion: Floats = field(init=False)  # (N, 4)
    linear_velocity: Floats = field(init=False)  # (N, 3)
    angular_velocity: Floats = field(init=False)  # (N, 3)
    tube: Ints = field(init=False)  # (N,)
    """Index of a registered tube, or NO_TUBE."""
    seed: Ints = field(init=False)  # (N,)
    """Seed of the lane's random disturbance."""
    selected: Ints = field(init=False)  # (N,)
    """1 where the lane is reset, 0 where it is left alone."""
    parameters: Floats = field(init=False)  # (N, 32)
    """Plant parameters in the order of PARAMETERS; the reserved words are zero."""

    def __post_init__(self) -> None:
        raw, words = self.raw, self.raw.view(np.int64)
        object.__setattr__(self, "position", raw[:, 0:3])
        object.__setattr__(self, "quaternion", raw[:, 3:7])
        object.__setattr__(self, "linear_velocity", raw[:, 7:10])
        object.__setattr__(self, "angular_velocity", raw[:, 10:13])
        object.__setattr__(self, "tube", words[:, 13])
        object.__setattr__(self, "seed", words[:, 14])
        object.__setattr__(self, "selected", words[:, 15])
        object.__setattr__(self, "parameters", raw[:, 16:48])

    @classmethod
    def zeros(cls, lanes: int) -> Self:
        """Resets of `lanes` drones: no lane selected, no tube, quaternion identity, every parameter zero."""
        batch = cls(np.zeros((lanes, RESET_WORDS)))
        batch.quaternion[:, 3] = 1.0
        batch.tube[:] = NO_TUBE
        return batch


@dataclass(frozen=True)
class TubeReference:
    """A tube as it is named to the physics process: a mesh file, how to read it, and what it must hash to."""

    path: str
    axes: str  # "zup" or "yup": which axis of the file points up
    scale: float  # factor from file units to metres
    sha256: str  # of the file's bytes, lower-case hexadecimal


@dataclass(frozen=True)
class PlantDescription:
    """What a plant says of itself in the handshake; recorded with every run."""

    name: str
    """Implementation, e.g. "physics_server"."""
    version: str
    engine: str
    """Engine and its version, e.g. "bullet 3.2.7"."""
    speed_max: float
    """Largest speed that a command may carry (m/s)."""
    defaults: tuple[float, ...]
    """Default plant parameters, in the order of PARAMETERS."""
    walls: bool = False
    """Whether registered tubes stop the body and contact with them is reported."""


class Plant(ABC):
    """Whatever integrates rigid bodies behind the protocol: a physics engine, a simple model, a toy.

    A method refuses what it cannot do by raising `protocol.errors.Refusal`; the session reports that to the
    agent and goes on living, and no lane has moved. Lanes are independent worlds.
    """

    @abstractmethod
    def describe(self) -> PlantDescription:
        """Say what this plant is; called once, before the session opens."""

    @abstractmethod
    def open(self, lanes: int, dt: float, physics_dt: float, inner_steps: int) -> None:
        """Prepare `lanes` worlds; every later step takes `inner_steps` inner steps of `physics_dt` = dt / n."""

    @abstractmethod
    def register_tube(self, index: int, tube: TubeReference) -> None:
        """Read a tube's wall so that lanes can be reset into it; other lanes do not notice."""

    @abstractmethod
    def release_tube(self, index: int) -> None:
        """Forget a tube; refused while a lane flies in it."""

    @abstractmethod
    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Put the selected lanes into their initial states and write the poses of those lanes, step 0."""

    @abstractmethod
    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Integrate every lane over one control step, exactly `inner_steps` inner steps, and write all poses.

        The force and torque laws are evaluated at every inner step (`protocol/README.md`, annex A).
        """

    @abstractmethod
    def close(self) -> None:
        """Give up engine and worlds; may be called twice."""
