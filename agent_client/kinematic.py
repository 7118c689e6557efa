"""The kinematic world of training behind the same contract as a physics engine: headings and speeds that blend.

In every control step the heading goes a share of the way to the commanded direction and the speed a share of
the way to the commanded speed; then the drone moves along its heading. The local frame is carried along by the
smallest rotation, with no world-up, so that vertical flight is like any other. There are no walls here: contact
is known from the clearance (`agent_client.task`).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agent_client.settings import DEFAULT_DT, Settings
from protocol.plant import (
    PARAMETERS,
    CommandBatch,
    Plant,
    PlantDescription,
    PoseBatch,
    ResetBatch,
    TubeReference,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

VERSION = "1"
"""Changes when the same commands would give other poses."""


class KinematicPlant(Plant):
    """N drones that go where they are told, a little late. Tubes are accepted and ignored, so are parameters.

    The shares of `settings.motion` hold for a control step of DEFAULT_DT; for another dt they are those that
    pass the same share of the way in the same time.
    """

    def __init__(self, settings: Settings | None = None) -> None:
        self._settings = settings or Settings()
        self._state = PoseBatch.zeros(0)

    def describe(self) -> PlantDescription:
        """Say what this plant is; the default parameters are those of a body of unit mass, and unused."""
        unused = {"mass": 1.0, "inertia_x": 1.0, "inertia_y": 1.0, "inertia_z": 1.0}
        unused["body_radius"] = self._settings.drone.body_radius
        return PlantDescription(
            name="agent_client.kinematic",
            version=VERSION,
            engine="kinematic",
            speed_max=self._settings.speed_max,
            defaults=tuple(unused.get(parameter.name, 0.0) for parameter in PARAMETERS),
        )

    def open(self, lanes: int, dt: float, physics_dt: float, inner_steps: int) -> None:
        """Prepare `lanes` drones; inner steps have no part in this world."""
        motion = self._settings.motion
        self._state = PoseBatch.zeros(lanes)
        self._dt = dt
        self._heading_share = 1.0 - (1.0 - motion.heading_blend) ** (dt / DEFAULT_DT)
        self._speed_share = 1.0 - (1.0 - motion.speed_blend) ** (dt / DEFAULT_DT)

    def register_tube(self, index: int, tube: TubeReference) -> None:
        """Accept any tube: there are no walls."""

    def release_tube(self, index: int) -> None:
        """Forget nothing."""

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Put the selected lanes into their initial states.

        Of the velocity only the part along the heading is kept for later steps.
        """
        state = self._state
        for lane in np.flatnonzero(resets.selected):
            state.raw[lane] = 0.0
            state.raw[lane, :13] = resets.raw[lane, :13]
            poses.raw[lane] = state.raw[lane]

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Move every drone by one control step."""
        raw = self._state.raw
        advance(raw, raw.view(np.int64), commands.raw, self._dt, self._heading_share, self._speed_share)
        poses.raw[:] = raw

    def close(self) -> None:
        """Nothing to give up."""


@njit(cache=True, error_model="numpy")
def advance(
    poses: Floats, words: Ints, commands: Floats, dt: float, heading_share: float, speed_share: float
) -> None:
    """Move drones by one control step.

    Args:
        poses: (N, 16) block of `protocol.plant.PoseBatch`, in and out.
        words: the same block as int64.
        commands: (N, 8) block of `protocol.plant.CommandBatch`.
        dt: control step (s).
        heading_share: share of the way to the commanded direction, blended linearly and normalised.
        speed_share: share of the way to the commanded speed.
    """
    for i in range(poses.shape[0]):
        p = poses[i]
        x, y, z, w = p[3], p[4], p[5], p[6]
        fx, fy, fz = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)
        speed = p[7] * fx + p[8] * fy + p[9] * fz
        gx = fx + heading_share * (commands[i, 0] - fx)
        gy = fy + heading_share * (commands[i, 1] - fy)
        gz = fz + heading_share * (commands[i, 2] - fz)
        norm = math.sqrt(gx * gx + gy * gy + gz * gz)
        if norm > 1e-9:
            gx, gy, gz = gx / norm, gy / norm, gz / norm
        else:  # halfway to the opposite direction there is no heading to take
            gx, gy, gz = fx, fy, fz
        # The smallest rotation from f to g as a quaternion: axis f x g, scalar part 1 + f . g.
        ax, ay, az, aw = (
            fy * gz - fz * gy,
            fz * gx - fx * gz,
            fx * gy - fy * gx,
            1.0 + fx * gx + fy * gy + fz * gz,
        )
        sine = math.sqrt(ax * ax + ay * ay + az * az)
        if aw < 1e-12:  # straight back: half a turn about the up axis
            ax, ay, az = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
            aw, sine = 0.0, 1.0
        rate = 2.0 * math.atan2(sine, aw) / (sine * dt) if sine > 0.0 else 0.0
        p[10], p[11], p[12] = rate * ax, rate * ay, rate * az
        qx = aw * x + ax * w + ay * z - az * y
        qy = aw * y - ax * z + ay * w + az * x
        qz = aw * z + ax * y - ay * x + az * w
        qw = aw * w - ax * x - ay * y - az * z
        norm = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
        p[3], p[4], p[5], p[6] = qx / norm, qy / norm, qz / norm, qw / norm
        speed += speed_share * (commands[i, 3] - speed)
        p[7], p[8], p[9] = speed * gx, speed * gy, speed * gz
        p[0], p[1], p[2] = p[0] + p[7] * dt, p[1] + p[8] * dt, p[2] + p[9] * dt
        words[i, 14] = 0
        words[i, 15] += 1
        p[13] = words[i, 15] * dt
