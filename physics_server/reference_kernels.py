"""The rigid body of `physics_server.reference`, compiled: law, inner steps and lanes in one call.

The law is that of `physics_server.law`, in a second form: that one serves an engine, one lane and one inner step
at a time on Python floats; here it stands inside of the innermost loop. `tests/physics_server/test_law.py` ties
the two, forces and torques to rounding and gusts bit for bit.

All rotation is reckoned in the body frame. An inner step turns the body about omega itself, which leaves the
components of omega in the body frame as they are: "omega in the world frame, then the pose", as annex A of
`protocol/README.md` and Bullet have it, is the same with the rotation of I left out.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from meshes.compiled import compiled
from physics_server.law import Quaternion, Vector
from protocol.plant import PARAMETER_INDEX

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Words = NDArray[np.uint64]

Coefficients = tuple[Vector, float, float, Vector, Vector, Vector]
"""What does not change over a control step: constant force (N, world), force along the body's x axis (N), linear
damping (N s/m), commanded direction (world), spring (N m) and damping (N m s) about the body's axes."""

_MASS: Final = PARAMETER_INDEX["mass"]
_INERTIA: Final = PARAMETER_INDEX["inertia_x"]
_FORCE_GAIN: Final = PARAMETER_INDEX["force_gain"]
_ALONG_BODY: Final = PARAMETER_INDEX["force_along_body"]
_TORQUE_KP: Final = PARAMETER_INDEX["torque_kp"]
_TORQUE_KD: Final = PARAMETER_INDEX["torque_kd"]
_LINEAR_DRAG: Final = PARAMETER_INDEX["linear_drag"]
_ANGULAR_DRAG: Final = PARAMETER_INDEX["angular_drag"]
_GRAVITY: Final = PARAMETER_INDEX["gravity"]
_DISTURBANCE: Final = PARAMETER_INDEX["disturbance_x"]
_GUST: Final = PARAMETER_INDEX["gust"]

_SMALL_RATE: Final = 0.001
"""Angular speed (rad/s) below which the sine is taken by its series, as Bullet does."""


@compiled
def advance(
    state: Floats,
    counts: Ints,
    parameters: Floats,
    seeds: Words,
    commands: Floats,
    dt: float,
    physics_dt: float,
    inner_steps: int,
) -> int:
    """Take one control step in every lane; the number of the first lane that is no longer finite, or -1.

    Args:
        state: (N, 16) block of `protocol.plant.PoseBatch`, in and out.
        counts: the same block as int64.
        parameters: (N, 18) in the order of `protocol.plant.PARAMETERS`.
        seeds: (N,) of the lanes' gusts.
        commands: (N, 8) block of `protocol.plant.CommandBatch`.
        dt: control step (s).
        physics_dt: inner step (s).
        inner_steps: how many make up a control step.
    """
    failed = -1
    for lane in range(state.shape[0]):
        p, row = state[lane], parameters[lane]
        counts[lane, 15] += 1
        gust = gust_force(row[_GUST], seeds[lane], counts[lane, 15])
        law = coefficients(row, commands[lane], gust)
        moments = (row[_INERTIA], row[_INERTIA + 1], row[_INERTIA + 2])
        position, q = (p[0], p[1], p[2]), (p[3], p[4], p[5], p[6])
        v, omega = (p[7], p[8], p[9]), to_body(q, (p[10], p[11], p[12]))
        for _ in range(inner_steps):
            force, torque = force_and_torque(law, q, v, omega)
            v = next_velocity(v, force, row[_MASS], row[_GRAVITY], physics_dt)
            omega = next_omega(omega, torque, moments, physics_dt)
            position = (
                position[0] + physics_dt * v[0],
                position[1] + physics_dt * v[1],
                position[2] + physics_dt * v[2],
            )
            q = turned(q, omega, physics_dt)
        p[0], p[1], p[2] = position
        p[3], p[4], p[5], p[6] = q
        p[7], p[8], p[9] = v
        p[10], p[11], p[12] = to_world(q, omega)
        p[13] = counts[lane, 15] * dt  # a product: a sum over the steps would drift
        if failed < 0 and not math.isfinite(p[:13].sum()):
            failed = lane
    return failed


@compiled
def coefficients(parameters: Floats, command: Floats, gust: Vector) -> Coefficients:
    """What of the law does not change over a control step.

    Args:
        parameters: (18,) in the order of `protocol.plant.PARAMETERS`.
        command: (8,) row of a `protocol.plant.CommandBatch`.
        gust: force (N) over this control step, world frame.
    """
    mass, kp, kd = parameters[_MASS], parameters[_TORQUE_KP], parameters[_TORQUE_KD]
    ix, iy, iz = parameters[_INERTIA], parameters[_INERTIA + 1], parameters[_INERTIA + 2]
    drag = parameters[_ANGULAR_DRAG]
    direction = (command[0], command[1], command[2])
    thrust = mass * parameters[_FORCE_GAIN] * command[3]
    along_body = thrust * parameters[_ALONG_BODY]
    along_command = thrust - along_body
    lift = command[4] * mass * parameters[_GRAVITY]
    constant = (
        along_command * direction[0] + parameters[_DISTURBANCE] + gust[0],
        along_command * direction[1] + parameters[_DISTURBANCE + 1] + gust[1],
        along_command * direction[2] + lift + parameters[_DISTURBANCE + 2] + gust[2],
    )
    linear = mass * parameters[_FORCE_GAIN] + parameters[_LINEAR_DRAG]
    spring = (ix * kp, iy * kp, iz * kp)
    damping = (ix * kd + drag, iy * kd + drag, iz * kd + drag)
    return constant, along_body, linear, direction, spring, damping


@compiled
def force_and_torque(
    law: Coefficients, quaternion: Quaternion, velocity: Vector, omega: Vector
) -> tuple[Vector, Vector]:
    """Force (N, world frame) and torque (N m, body frame) of one inner step; the weight is not part of them.

    Args:
        law: of `coefficients`.
        quaternion: x y z w, body to world.
        velocity: m/s, world frame.
        omega: rad/s, body frame.
    """
    constant, along_body, linear, (dx, dy, dz), spring, damping = law
    x, y, z, w = quaternion
    x2, y2, z2 = x + x, y + y, z + z
    fx, fy, fz = 1.0 - y * y2 - z * z2, x * y2 + w * z2, x * z2 - w * y2  # the body's x axis
    d_left = (x * y2 - w * z2) * dx + (1.0 - x * x2 - z * z2) * dy + (y * z2 + w * x2) * dz
    d_up = (x * z2 + w * y2) * dx + (y * z2 - w * x2) * dy + (1.0 - x * x2 - y * y2) * dz
    force = (
        constant[0] + along_body * fx - linear * velocity[0],
        constant[1] + along_body * fy - linear * velocity[1],
        constant[2] + along_body * fz - linear * velocity[2],
    )
    # In the body frame f = (1, 0, 0), so that f x d = (0, -d_z, d_y).
    torque = (
        -damping[0] * omega[0],
        -spring[1] * d_up - damping[1] * omega[1],
        spring[2] * d_left - damping[2] * omega[2],
    )
    return force, torque


@compiled
def next_velocity(velocity: Vector, force: Vector, mass: float, gravity: float, physics_dt: float) -> Vector:
    """V + h (F / m - g z), world frame."""
    return (
        velocity[0] + physics_dt * (force[0] / mass),
        velocity[1] + physics_dt * (force[1] / mass),
        velocity[2] + physics_dt * (force[2] / mass - gravity),
    )


@compiled
def next_omega(omega: Vector, torque: Vector, moments: Vector, physics_dt: float) -> Vector:
    """Euler's equations over one step, omega + h I^-1 (tau - omega x I omega), body frame."""
    p, q, r = omega
    ix, iy, iz = moments
    return (
        p + physics_dt * ((torque[0] - (iz - iy) * q * r) / ix),
        q + physics_dt * ((torque[1] - (ix - iz) * r * p) / iy),
        r + physics_dt * ((torque[2] - (iy - ix) * p * q) / iz),
    )


@compiled
def turned(quaternion: Quaternion, omega: Vector, physics_dt: float) -> Quaternion:
    """The attitude after turning at omega (rad/s, body frame) for one step: q exp(h omega / 2), of length 1."""
    x, y, z, w = quaternion
    p, q, r = omega
    rate = math.sqrt(p * p + q * q + r * r)
    half = 0.5 * physics_dt
    angle = half * rate
    scale = half * (1.0 - angle * angle / 6.0) if rate < _SMALL_RATE else math.sin(angle) / rate
    a, b, c, d = p * scale, q * scale, r * scale, math.cos(angle)
    tx = w * a + x * d + y * c - z * b
    ty = w * b - x * c + y * d + z * a
    tz = w * c + x * b - y * a + z * d
    tw = w * d - x * a - y * b - z * c
    shorten = 1.0 / math.sqrt(tx * tx + ty * ty + tz * tz + tw * tw)
    return tx * shorten, ty * shorten, tz * shorten, tw * shorten


@compiled
def to_world(quaternion: Quaternion, vector: Vector) -> Vector:
    """Rotate a vector from the body frame into the world's: v + 2 w (u x v) + 2 u x (u x v)."""
    x, y, z, w = quaternion
    a, b, c = vector
    tx, ty, tz = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return (
        a + w * tx + y * tz - z * ty,
        b + w * ty + z * tx - x * tz,
        c + w * tz + x * ty - y * tx,
    )


@compiled
def to_body(quaternion: Quaternion, vector: Vector) -> Vector:
    """Rotate a vector from the world frame into the body's."""
    x, y, z, w = quaternion
    return to_world((-x, -y, -z, w), vector)


@compiled
def gust_force(amplitude: float, seed: int, step: int) -> Vector:
    """Random force (N, world frame) of one control step, as `physics_server.law.gust_force` has it.

    Args:
        amplitude: newtons.
        seed: of the lane, as uint64.
        step: number of the control step since the reset; the first is 1.
    """
    if amplitude == 0.0:
        return 0.0, 0.0, 0.0
    first = np.uint64(seed) + np.uint64(3) * np.uint64(step - 1)
    return (
        amplitude * (2.0 * _uniform(first) - 1.0),
        amplitude * (2.0 * _uniform(first + np.uint64(1)) - 1.0),
        amplitude * (2.0 * _uniform(first + np.uint64(2)) - 1.0),
    )


@compiled
def _uniform(counter: np.uint64) -> float:
    """A number in [0, 1) from the top 53 bits of splitmix64(counter)."""
    return np.float64(splitmix64(counter) >> np.uint64(11)) * 2.0**-53


@compiled
def splitmix64(state: np.uint64) -> np.uint64:
    """The 64-bit output of the SplitMix64 generator in this state (uint64 throughout: it wraps around)."""
    z = np.uint64(state) + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))
