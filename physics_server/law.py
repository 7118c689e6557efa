"""From command to force and torque (`protocol/README.md`, annex A), for one lane at a time.

Written on Python floats: the engine is called once an inner step, and an array of three costs more to make
than the whole law.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from physics_server.parameters import BodyParameters

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Law = Callable[[Quaternion, Vector, Vector], tuple[Vector, Vector]]
"""Quaternion, linear and angular velocity (world) -> force (N, world), torque (N m, frame of `torque_in_world`)."""

_MASK: Final = 2**64 - 1


def torque_in_world(body: BodyParameters) -> bool:
    """Whether the law of this body gives its torque in the world frame; else it is in the body frame.

    With three equal moments I is the same in every frame, and the world frame needs a third of the arithmetic.
    """
    return body.inertia_x == body.inertia_y == body.inertia_z


def control_law(
    body: BodyParameters, direction: Vector, speed: float, compensation: float, gust: Vector = (0.0, 0.0, 0.0)
) -> Law:
    """Law of one control step; what does not change over its inner steps is computed here, once.

        F   = m k_v (v_cmd a - V) + c m g z - linear_drag V + F_disturbance + F_gust
        tau = I (k_p (f x d) - k_d omega) - angular_drag omega

    with f the body's x axis, d the commanded direction, and a = d, or a = f with `force_along_body`. The
    compensation c acts along world z and tilts neither d nor the torque. The paper ("Description of the Unity
    Physical Model") names F_cmd and tau_cmd and leaves their form open; this form is our choice.

    In the body frame f = (1, 0, 0), so that f x d = (0, -d_z, d_y) and I is diagonal: the torque is given in
    that frame, or where I is the same in all frames in the world's (`torque_in_world`), and the rotation of I
    into the world is never made.

    Args:
        body: the lane's parameters.
        direction: unit vector d, world frame.
        speed: v_cmd (m/s).
        compensation: c, upward force as a fraction of the weight.
        gust: force (N) over this control step, world frame.
    """
    dx, dy, dz = direction
    thrust = body.mass * body.force_gain * speed
    along_body = thrust * body.force_along_body
    along_command = thrust - along_body
    fx = along_command * dx + body.disturbance_x + gust[0]
    fy = along_command * dy + body.disturbance_y + gust[1]
    fz = along_command * dz + compensation * body.mass * body.gravity + body.disturbance_z + gust[2]
    linear = body.mass * body.force_gain + body.linear_drag
    spring_y, spring_z = body.inertia_y * body.torque_kp, body.inertia_z * body.torque_kp
    damp_x = body.inertia_x * body.torque_kd + body.angular_drag
    damp_y = body.inertia_y * body.torque_kd + body.angular_drag
    damp_z = body.inertia_z * body.torque_kd + body.angular_drag

    if torque_in_world(body):

        def isotropic(quaternion: Quaternion, velocity: Vector, omega: Vector) -> tuple[Vector, Vector]:
            x, y, z, w = quaternion
            vx, vy, vz = velocity
            ox, oy, oz = omega
            y2, z2 = y + y, z + z
            ax, ay, az = 1.0 - y * y2 - z * z2, x * y2 + w * z2, x * z2 - w * y2  # the body's x axis
            force = (
                fx + along_body * ax - linear * vx,
                fy + along_body * ay - linear * vy,
                fz + along_body * az - linear * vz,
            )
            torque = (
                spring_y * (ay * dz - az * dy) - damp_x * ox,
                spring_y * (az * dx - ax * dz) - damp_x * oy,
                spring_y * (ax * dy - ay * dx) - damp_x * oz,
            )
            return force, torque

        return isotropic

    def law(quaternion: Quaternion, velocity: Vector, omega: Vector) -> tuple[Vector, Vector]:
        x, y, z, w = quaternion
        vx, vy, vz = velocity
        ox, oy, oz = omega
        # Rotation matrix M, body to world, row by row; its columns are the body's axes.
        x2, y2, z2 = x + x, y + y, z + z
        xx, yy, zz, xy, xz, yz = x * x2, y * y2, z * z2, x * y2, x * z2, y * z2
        wx, wy, wz = w * x2, w * y2, w * z2
        m00, m01, m02 = 1.0 - yy - zz, xy - wz, xz + wy
        m10, m11, m12 = xy + wz, 1.0 - xx - zz, yz - wx
        m20, m21, m22 = xz - wy, yz + wx, 1.0 - xx - yy
        force = (
            fx + along_body * m00 - linear * vx,
            fy + along_body * m10 - linear * vy,
            fz + along_body * m20 - linear * vz,
        )
        torque = (
            -damp_x * (m00 * ox + m10 * oy + m20 * oz),
            -spring_y * (m02 * dx + m12 * dy + m22 * dz) - damp_y * (m01 * ox + m11 * oy + m21 * oz),
            spring_z * (m01 * dx + m11 * dy + m21 * dz) - damp_z * (m02 * ox + m12 * oy + m22 * oz),
        )
        return force, torque

    return law


def travel_bound(
    body: BodyParameters,
    velocity: Vector,
    speed: float,
    compensation: float,
    gust: Vector,
    physics_dt: float,
    inner_steps: int,
) -> float:
    """How far the body can get in one control step without touching anything (m).

    What pushes is at most A = (thrust + disturbance + gust) / m + |c - 1| g, and what brakes only slows down, as
    long as it takes no more than twice the speed away in one inner step h: then |v_k| <= |v_0| + k h A, and the
    way of n semi-implicit steps is at most n h |v_0| + A h^2 n (n + 1) / 2. Infinite where braking is stiffer.

    Args:
        body: the lane's parameters.
        velocity: at the beginning (m/s).
        speed: commanded (m/s).
        compensation: c of the command.
        gust: force (N) over this control step.
        physics_dt: h (s).
        inner_steps: n.
    """
    mass = body.mass
    if (mass * body.force_gain + body.linear_drag) * physics_dt > 2.0 * mass:
        return math.inf
    disturbance = abs(body.disturbance_x) + abs(body.disturbance_y) + abs(body.disturbance_z)
    push = mass * body.force_gain * speed + disturbance + abs(gust[0]) + abs(gust[1]) + abs(gust[2])
    acceleration = push / mass + abs((compensation - 1.0) * body.gravity)
    start = math.sqrt(velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2)
    n, h = inner_steps, physics_dt
    return n * h * start + acceleration * h * h * n * (n + 1) / 2.0


def gust_force(amplitude: float, seed: int, step: int) -> Vector:
    """Random force (N, world frame) of one control step, each component uniform in +-amplitude.

    Args:
        amplitude: newtons.
        seed: the lane's seed.
        step: number of the control step since the reset; the first is 1.
    """
    if amplitude == 0.0:
        return (0.0, 0.0, 0.0)
    first = seed + 3 * (step - 1)
    x, y, z = (amplitude * (2.0 * _uniform(first + axis) - 1.0) for axis in range(3))
    return (x, y, z)


def _uniform(counter: int) -> float:
    """A number in [0, 1) from the top 53 bits of splitmix64(counter); any language can repeat it exactly."""
    return (splitmix64(counter) >> 11) * 2.0**-53


def splitmix64(state: int) -> int:
    """The 64-bit output of the SplitMix64 generator in this state (Steele, Lea, Flood 2014)."""
    z = (state + 0x9E3779B97F4A7C15) & _MASK
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & _MASK
    return z ^ (z >> 31)
