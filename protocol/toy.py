"""A plant that needs no engine: one free body a lane under annex A's law, in semi-implicit Euler steps.

For tests, and for implementers who want something to compare with: plain float64 arithmetic in a fixed order,
so that another language can repeat it bit for bit. It has no walls and no gusts.
"""

from __future__ import annotations

import math
from typing import Final

from protocol.errors import Refusal
from protocol.plant import (
    PARAMETER_INDEX,
    CommandBatch,
    Plant,
    PlantDescription,
    PoseBatch,
    ResetBatch,
    TubeReference,
)

DEFAULTS: Final = (
    *(1.0, 0.01, 0.01, 0.02, 0.15),  # mass, inertia, body radius
    *(8.0, 0.0, 120.0, 18.0),  # gains of force and torque
    *(0.0, 0.0, 9.81),  # drag, gravity
    *(0.2, 0.5),  # restitution, friction
    *(0.0, 0.0, 0.0, 0.0),  # disturbance, gust
)
SPEED_MAX: Final = 10.0


class ToyPlant(Plant):
    """Free bodies without walls; accepts any tube and never touches it."""

    def describe(self) -> PlantDescription:
        """Say what this plant is."""
        return PlantDescription("protocol.toy", "1", "semi-implicit Euler", SPEED_MAX, DEFAULTS)

    def open(self, lanes: int, dt: float, physics_dt: float, inner_steps: int) -> None:
        """Remember the time steps; the state of a lane is its pose."""
        self._dt, self._physics_dt, self._inner_steps = dt, dt / inner_steps, inner_steps
        self._parameters: list[list[float]] = [[]] * lanes

    def register_tube(self, index: int, tube: TubeReference) -> None:
        """Accept any tube: there are no walls here."""

    def release_tube(self, index: int) -> None:
        """Accept any index."""

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Put the selected lanes into their initial states."""
        selected = [lane for lane, chosen in enumerate(resets.selected.tolist()) if chosen]
        for lane in selected:
            gust = resets.parameters[lane, PARAMETER_INDEX["gust"]]
            if gust != 0.0:
                raise Refusal("gust", "0, since this plant has no gusts", repr(float(gust)), lane)
        for lane in selected:
            self._parameters[lane] = resets.parameters[lane].tolist()
            poses.raw[lane, :13] = resets.raw[lane, :13]
            poses.sim_time[lane], poses.contact_steps[lane], poses.step[lane] = 0.0, 0, 0

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Integrate every lane over one control step.

        Raises:
            FloatingPointError: a state is no longer finite.
        """
        for lane, parameters in enumerate(self._parameters):
            command, state = commands.raw[lane].tolist(), poses.raw[lane, :13].tolist()
            for _ in range(self._inner_steps):
                state = inner_step(state, command, parameters, self._physics_dt)
            if not all(map(math.isfinite, state)):
                raise FloatingPointError(
                    f"lane {lane}, control step {int(poses.step[lane]) + 1}: expected a finite state, "
                    f"found {state}; are the parameters too stiff for inner steps of {self._physics_dt:g} s?"
                )
            poses.raw[lane, :13] = state
            poses.step[lane] += 1
            poses.sim_time[lane] = poses.step[lane] * self._dt

    def close(self) -> None:
        """Nothing to give up."""


def inner_step(state: list[float], command: list[float], parameters: list[float], h: float) -> list[float]:
    """Advance one body by `h` seconds; force and torque are those of the state at the beginning.

    Args:
        state: position, quaternion, linear and angular velocity: the first 13 words of a pose row.
        command: direction, speed, compensation: a command row.
        parameters: in the order of PARAMETERS.
        h: inner step (s).
    """
    px, py, pz, x, y, z, w, vx, vy, vz, ox, oy, oz = state
    dx, dy, dz, speed, compensation = command[:5]
    mass, ix, iy, iz, _, gain, along_body, kp, kd, drag, angular_drag, gravity = parameters[:12]
    disturbance_x, disturbance_y, disturbance_z = parameters[14:17]
    forward = (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y))
    left = (2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x))
    up = (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y))

    ax, ay, az = forward if along_body else (dx, dy, dz)
    thrust = mass * gain
    vx1 = vx + h * ((thrust * (speed * ax - vx) - drag * vx + disturbance_x) / mass)
    vy1 = vy + h * ((thrust * (speed * ay - vy) - drag * vy + disturbance_y) / mass)
    lift = compensation * mass * gravity
    vz1 = vz + h * ((thrust * (speed * az - vz) + lift - drag * vz + disturbance_z) / mass - gravity)

    # In the body frame f = (1, 0, 0), so f x d = (0, -d_up, d_left), and the inertia is diagonal.
    bx, by, bz = _along(forward, ox, oy, oz), _along(left, ox, oy, oz), _along(up, ox, oy, oz)
    tx = ix * (-kd * bx) - angular_drag * bx
    ty = iy * (kp * -_along(up, dx, dy, dz) - kd * by) - angular_drag * by
    tz = iz * (kp * _along(left, dx, dy, dz) - kd * bz) - angular_drag * bz
    gx = (tx - (iz - iy) * by * bz) / ix
    gy = (ty - (ix - iz) * bz * bx) / iy
    gz = (tz - (iy - ix) * bx * by) / iz
    ox1 = ox + h * (forward[0] * gx + left[0] * gy + up[0] * gz)
    oy1 = oy + h * (forward[1] * gx + left[1] * gy + up[1] * gz)
    oz1 = oz + h * (forward[2] * gx + left[2] * gy + up[2] * gz)

    half = 0.5 * h  # q' = q + h/2 (omega, 0) q
    x1 = x + half * (ox1 * w + oy1 * z - oz1 * y)
    y1 = y + half * (oy1 * w + oz1 * x - ox1 * z)
    z1 = z + half * (oz1 * w + ox1 * y - oy1 * x)
    w1 = w - half * (ox1 * x + oy1 * y + oz1 * z)
    norm = math.sqrt(x1 * x1 + y1 * y1 + z1 * z1 + w1 * w1)
    return [
        *(px + h * vx1, py + h * vy1, pz + h * vz1),
        *(x1 / norm, y1 / norm, z1 / norm, w1 / norm),
        *(vx1, vy1, vz1, ox1, oy1, oz1),
    ]


def _along(axis: tuple[float, float, float], x: float, y: float, z: float) -> float:
    return axis[0] * x + axis[1] * y + axis[2] * z
