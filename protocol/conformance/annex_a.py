"""An evaluation of Annex A of its own, in matrices, for the kit to compare with; no plant uses it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from protocol.plant import Floats

_MASK: Final = 2**64 - 1
_Z: Final = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Body:
    """The state of one body, in the world frame."""

    position: Floats  # (3,) m
    quaternion: Floats  # (4,) x y z w, body to world
    velocity: Floats  # (3,) m/s
    omega: Floats  # (3,) rad/s


@dataclass(frozen=True)
class Order:
    """One command."""

    direction: Floats  # (3,) unit vector, world frame
    speed: float
    compensation: float


def body(
    position: tuple[float, ...] = (0.0, 0.0, 0.0),
    quaternion: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0),
    velocity: tuple[float, ...] = (0.0, 0.0, 0.0),
    omega: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> Body:
    """Make a body out of plain numbers; as it is, at rest at the origin."""
    return Body(np.array(position), np.array(quaternion), np.array(velocity), np.array(omega))


def rotation(quaternion: Floats) -> Floats:
    """Return the matrix M (3, 3) that turns body into world."""
    x, y, z, w = quaternion
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix: Floats = np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross
    return matrix


def turned(quaternion: Floats, angle: Floats) -> Floats:
    """Return the attitude after a turn by the rotation vector `angle` (3,) of the world frame."""
    size = float(np.linalg.norm(angle))
    if size == 0.0:
        return quaternion
    axis = math.sin(size / 2.0) * angle / size
    w = math.cos(size / 2.0)
    vector = w * quaternion[:3] + quaternion[3] * axis + np.cross(axis, quaternion[:3])
    return np.array([*vector, w * quaternion[3] - axis @ quaternion[:3]])


def inertia(quaternion: Floats, parameters: Mapping[str, float]) -> Floats:
    """Return the inertia (3, 3) in the world frame."""
    turn = rotation(quaternion)
    moments = np.diag([parameters[f"inertia_{axis}"] for axis in "xyz"])
    tensor: Floats = turn @ moments @ turn.T
    return tensor


def inner_step(
    state: Body, order: Order, parameters: Mapping[str, float], h: float, late: bool = True
) -> Body:
    """Advance a body by h seconds; forces are those of the beginning.

    Args:
        state: at the beginning.
        order: the command.
        parameters: by name; gusts are left out.
        h: inner step (s).
        late: whether the pose follows the new velocities, as Bullet does, or the old ones.
    """
    p = parameters
    forward = rotation(state.quaternion)[:, 0]
    along = forward if p["force_along_body"] else order.direction
    force = p["mass"] * p["force_gain"] * (order.speed * along - state.velocity)
    force = force + order.compensation * p["mass"] * p["gravity"] * _Z - p["linear_drag"] * state.velocity
    force = force + [p[f"disturbance_{axis}"] for axis in "xyz"]
    tensor = inertia(state.quaternion, p)
    spring = p["torque_kp"] * np.cross(forward, order.direction) - p["torque_kd"] * state.omega
    torque = tensor @ spring - p["angular_drag"] * state.omega
    gyroscopic = np.cross(state.omega, tensor @ state.omega)

    velocity = state.velocity + h * (force / p["mass"] - p["gravity"] * _Z)
    omega = state.omega + h * np.linalg.solve(tensor, torque - gyroscopic)
    moving, turning = (velocity, omega) if late else (state.velocity, state.omega)
    return Body(state.position + h * moving, turned(state.quaternion, h * turning), velocity, omega)


def control_step(
    state: Body, order: Order, parameters: Mapping[str, float], h: float, n: int, late: bool = True
) -> Body:
    """Take n inner steps."""
    for _ in range(n):
        state = inner_step(state, order, parameters, h, late)
    return replace(state, quaternion=state.quaternion / np.linalg.norm(state.quaternion))


def gust(amplitude: float, seed: int, step: int) -> Floats:
    """Return the random force (3,) of a lane's control step; the first step is 1."""
    counters = (seed + 3 * (step - 1) + axis for axis in range(3))
    return np.array([amplitude * (2.0 * (splitmix64(counter) >> 11) / 2.0**53 - 1.0) for counter in counters])


def splitmix64(x: int) -> int:
    """Return the generator's 64 bits for the word x."""
    z = (x + 0x9E3779B97F4A7C15) & _MASK
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & _MASK
    return z ^ (z >> 31)
