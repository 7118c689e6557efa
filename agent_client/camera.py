"""The forward camera and its directional memory (paper, Visual Perception of the Target, Memory Mechanism).

The target is a point of the axis ahead of the drone. It is seen when it lies inside the pyramid of the field
of view and no wall stands between. The direction in which it was seen last is kept in the world frame, so
that it does not turn with the drone, and forgotten when it is older than the memory's length.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agent_client.episodes import Records
from agent_client.noise import blinded

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@njit(cache=True, error_model="numpy")
def look(lanes: Ints, episodes: Records, constants: Records, targets: Floats, free: Floats) -> None:
    """Where each drone's target is, and whether it is seen.

    Args:
        lanes: (K,) the lanes to compute.
        episodes: (N,) records; `position` and `frame` are read, the `target_...` fields are written.
        constants: (1,) record of the task's constants.
        targets: (N, 3) points of the axis, world frame (m).
        free: (N,) distance to the wall along the line of sight (m).
    """
    half_width, half_height = constants[0].half_width, constants[0].half_height
    for k in range(lanes.shape[0]):
        i = lanes[k]
        e = episodes[i]
        x = targets[i, 0] - e.position[0]
        y = targets[i, 1] - e.position[1]
        z = targets[i, 2] - e.position[2]
        distance = math.sqrt(x * x + y * y + z * z)
        if distance > 0.0:
            x, y, z = x / distance, y / distance, z / distance
        else:
            # The drone sits on its target: straight ahead, as far as anybody can tell.
            x, y, z = e.frame[0, 0], e.frame[0, 1], e.frame[0, 2]
        ahead = x * e.frame[0, 0] + y * e.frame[0, 1] + z * e.frame[0, 2]
        up = x * e.frame[1, 0] + y * e.frame[1, 1] + z * e.frame[1, 2]
        right = x * e.frame[2, 0] + y * e.frame[2, 1] + z * e.frame[2, 2]
        # Half-angles are below a right angle, so that nothing behind the camera passes.
        width, height = half_width * e.field_of_view, half_height * e.field_of_view
        in_view = abs(math.atan2(right, ahead)) <= width and abs(math.atan2(up, ahead)) <= height
        for c in range(3):
            e.target_position[c] = targets[i, c]
        e.target_direction[0], e.target_direction[1], e.target_direction[2] = x, y, z
        e.target_distance = distance
        e.target_visible = in_view and free[i] >= distance and not blinded(e)


@njit(cache=True)
def remember(lanes: Ints, episodes: Records, constants: Records) -> None:
    """Renew the memory of lanes that see their target, and let that of the others grow older.

    The age without any memory is one more than the memory's length.

    Args:
        lanes: (K,) the lanes to compute.
        episodes: (N,) records; `target_...` are read, `memory_...` are written.
        constants: (1,) record of the task's constants.
    """
    steps = np.int64(constants[0].memory_steps)
    for k in range(lanes.shape[0]):
        e = episodes[lanes[k]]
        if e.target_visible:
            e.memory_age = 0
            for c in range(3):
                e.memory_direction[c] = e.target_direction[c]
        else:
            e.memory_age = min(e.memory_age + 1, steps + 1)
            if e.memory_age > steps:
                for c in range(3):
                    e.memory_direction[c] = 0.0
        e.memory_available = e.memory_age <= steps
