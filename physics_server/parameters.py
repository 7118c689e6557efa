"""The drone's plant parameters and their defaults, and what this process says of itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Final, Self

from protocol.plant import PARAMETERS, PlantDescription

VERSION: Final = "0.1.0"
"""Of this package's physics: a change of law, defaults or engine settings changes trajectories, and this."""

SPEED_MAX: Final = 10.0
"""Largest speed that a command may carry (m/s): five times the fastest of the task, for sweeps.

An inner step of 1/240 s at this speed moves the body by 42 mm, less than a third of its radius."""


@dataclass(frozen=True, slots=True)
class BodyParameters:
    """One lane's plant parameters: names, units and order as in `protocol.plant.PARAMETERS`.

    The paper gives no values for the drone of its rigid-body flights; all of these are our choice.
    """

    mass: float = 1.0
    # A drone of 0.15 m in a spherical cage, as inspection drones in conduits are: a light shell (0.2 kg at
    # 0.15 m, 2/3 m r^2 = 3.0e-3) around a compact body (0.8 kg within 0.06 m, 2/5 m r^2 = 1.2e-3). Equal
    # moments also leave no gyroscopic coupling, so that a turn in pitch and yaw does not roll the drone.
    inertia_x: float = 0.004
    inertia_y: float = 0.004
    inertia_z: float = 0.004
    body_radius: float = 0.15
    # A time constant of 1/8 s: a policy that was trained without inertia flies at this gain, not at 2.
    force_gain: float = 8.0
    force_along_body: float = 0.0
    # Per unit of inertia: natural frequency sqrt(120) = 11 rad/s, damping ratio 18 / (2 * 11) = 0.82.
    torque_kp: float = 120.0
    torque_kd: float = 18.0
    linear_drag: float = 0.0
    angular_drag: float = 0.0
    gravity: float = 9.81
    restitution: float = 0.3
    friction: float = 0.5
    disturbance_x: float = 0.0
    disturbance_y: float = 0.0
    disturbance_z: float = 0.0
    gust: float = 0.0

    @classmethod
    def from_row(cls, row: Sequence[float]) -> Self:
        """Read the parameter words of a reset row; the session has checked their ranges."""
        return cls(*row[: len(PARAMETERS)])

    def row(self) -> tuple[float, ...]:
        """The values in the order of `protocol.plant.PARAMETERS`."""
        return astuple(self)


def description(engine: str, *, walls: bool) -> PlantDescription:
    """What this process publishes of itself with an engine of this name and version."""
    return PlantDescription(
        name="physics_server",
        version=VERSION,
        engine=engine,
        speed_max=SPEED_MAX,
        defaults=BodyParameters().row(),
        walls=walls,
    )
