"""Faults of frames and of the law: pieces put around the toy's inner step."""

from __future__ import annotations

import math
from collections.abc import Callable

from fault import fault

from protocol import toy
from protocol.conformance.annex_a import rotation
from protocol.plant import PARAMETER_INDEX, CommandBatch, Plant, PoseBatch, ResetBatch
from protocol.toy import ToyPlant

State = list[float]
Inner = Callable[[State, State, State, float], State]
INDEX = PARAMETER_INDEX
QUATERNION, VELOCITY, OMEGA = slice(3, 7), slice(7, 10), slice(10, 13)


def inner(rule: str, wrap: Callable[[Inner, State, State, State, float], State]) -> None:
    """Register the fault that `wrap(inner_step, state, command, parameters, h)` takes the inner steps."""

    @fault(rule)
    def make() -> Plant:
        usual = toy.inner_step
        toy.inner_step = lambda state, command, parameters, h: wrap(usual, state, command, parameters, h)
        return ToyPlant()


def parameter(rule: str, change: Callable[[dict[str, float]], dict[str, float]]) -> None:
    """Register the fault that some parameters are taken for others."""

    def wrap(step: Inner, state: State, command: State, parameters: State, h: float) -> State:
        values = {name: parameters[index] for name, index in INDEX.items()}
        changed = [*{**values, **change(values)}.values(), *parameters[len(values) :]]
        return step(state, command, changed, h)

    inner(rule, wrap)


parameter("gravity", lambda p: {"gravity": 9.81})
parameter("free-fall", lambda p: {"gravity": 1.01 * p["gravity"]})
parameter("angular-momentum", lambda p: {f"inertia_{axis}": p["inertia_x"] for axis in "xyz"})
parameter("force-law", lambda p: {"force_gain": p["force_gain"] * 1.01})
parameter("linear-drag", lambda p: {"linear_drag": p["linear_drag"] * p["mass"]})
parameter(
    "disturbance", lambda p: {f"disturbance_{axis}": p[f"disturbance_{axis}"] * p["mass"] for axis in "xyz"}
)
parameter("force-along-body", lambda p: {"force_along_body": 0.0})
parameter("torque-law", lambda p: {"torque_kp": -p["torque_kp"]})
parameter("torque-inertia", lambda p: {"torque_kp": p["torque_kp"] / p["inertia_y"]})
parameter("angular-drag", lambda p: {"angular_drag": p["angular_drag"] * p["inertia_x"] / p["inertia_z"]})


def _quaternion_inverted(step: Inner, state: State, command: State, parameters: State, h: float) -> State:
    def inverted(state: State) -> State:
        x, y, z, w = state[QUATERNION]
        return [*state[:3], -x, -y, -z, w, *state[7:]]

    return inverted(step(inverted(state), command, parameters, h))


def _damped(step: Inner, state: State, command: State, parameters: State, h: float) -> State:
    state = step(state, command, parameters, h)
    return [*state[:7], *(0.999 * v for v in state[VELOCITY]), *state[OMEGA]]


def _tilting(step: Inner, state: State, command: State, parameters: State, h: float) -> State:
    """The compensation acts along the direction."""
    dx, dy, dz, speed, c = command[:5]
    lift = c * parameters[INDEX["gravity"]] * h
    state = step(state, [dx, dy, dz, speed, 0.0], parameters, h)
    velocity = (v + lift * d for v, d in zip(state[VELOCITY], (dx, dy, dz), strict=True))
    return [*state[:7], *velocity, *state[OMEGA]]


inner("quaternion-order", _quaternion_inverted)
inner("no-damping", _damped)
inner("compensation", _tilting)


@fault("inner-steps")
class OneLess(ToyPlant):
    """Takes one inner step less, and makes them longer."""

    def open(self, lanes: int, dt: float, physics_dt: float, inner_steps: int) -> None:
        """Open with one less."""
        super().open(lanes, dt, physics_dt, max(1, inner_steps - 1))


@fault("spin")
class BodyRates(ToyPlant):
    """Shows and takes the angular velocity in the body frame."""

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Turn it into the world for the toy and back."""
        for quaternion, omega in zip(poses.quaternion, poses.angular_velocity, strict=True):
            omega[:] = rotation(quaternion) @ omega
        super().step(commands, poses)
        for quaternion, omega in zip(poses.quaternion, poses.angular_velocity, strict=True):
            omega[:] = rotation(quaternion).T @ omega


@fault("quaternion-length")
class Longer(ToyPlant):
    """Quaternions are a little too long."""

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Lengthen."""
        super().step(commands, poses)
        poses.quaternion[:] *= 1.00001


@fault("gusts")
class Calm(ToyPlant):
    """Takes gusts, and has none."""

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Ignore them."""
        resets.parameters[:, INDEX["gust"]] = 0.0
        super().reset(resets, poses)


@fault("not-finite-state")
class AnswersNan(ToyPlant):
    """A state that is not finite is a reply."""

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Go on."""
        try:
            super().step(commands, poses)
        except FloatingPointError:
            poses.raw[:, :13] = math.nan
