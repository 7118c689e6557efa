"""The 36 actions: nine directions inside the camera's cone times four speeds (paper, Action Space).

The action's index is `direction * len(speeds) + speed`. Directions are ordered straight, right, left, up,
down, then the corners right-up, right-down, left-up, left-down. A pair of angles (alpha, beta) becomes the
unit vector along f + tan(alpha) r + tan(beta) u, with f, u, r the drone's own axes: the point that the camera
sees under those angles. The paper excludes backward-facing directions; below a right angle none of these
faces backward, so that its constraint holds for every action and nothing is left to check.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agent_client.settings import Settings

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_SIGNS = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1))


@dataclass(frozen=True)
class ActionTable:
    """All actions, one a row."""

    alpha: Floats  # (A,)
    """Horizontal angle from the forward axis (rad), positive to the right."""
    beta: Floats  # (A,)
    """Vertical angle from the forward axis (rad), positive upwards."""
    speed: Floats  # (A,)
    """Commanded speed (m/s)."""
    local: Floats  # (A, 3)
    """Unit direction in the local frame (f, u, r)."""

    def __len__(self) -> int:
        return len(self.speed)


def action_table(settings: Settings) -> ActionTable:
    """The actions that the settings describe: 9 directions x 4 speeds = 36 by default."""
    signs = np.array(_SIGNS, dtype=np.float64)
    speeds = np.array(settings.actions.speeds, dtype=np.float64)
    half_angles = np.array([settings.camera.half_width, settings.camera.half_height])
    angles = np.repeat(signs * settings.actions.spread * half_angles, len(speeds), axis=0)
    alpha, beta = np.ascontiguousarray(angles[:, 0]), np.ascontiguousarray(angles[:, 1])
    local = np.stack([np.ones_like(alpha), np.tan(beta), np.tan(alpha)], axis=1)
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    return ActionTable(alpha, beta, np.tile(speeds, len(signs)), local)


@njit(cache=True)
def decode(actions: Ints, frame: Floats, local: Floats, speed: Floats, commands: Floats) -> None:
    """Write the direction and the speed of each lane's action into the rows of a command block.

    Args:
        actions: (N,) action indices, each within the table.
        frame: (N, 3, 3) local frames, rows f, u, r.
        local: (A, 3) directions of the table, local frame.
        speed: (A,) speeds of the table (m/s).
        commands: (N, 8) block of `protocol.plant.CommandBatch`; words 0 to 3 are written.
    """
    for i in range(actions.shape[0]):
        a = actions[i]
        norm = 0.0
        for c in range(3):
            commands[i, c] = (
                local[a, 0] * frame[i, 0, c] + local[a, 1] * frame[i, 1, c] + local[a, 2] * frame[i, 2, c]
            )
            norm += commands[i, c] ** 2
        for c in range(3):
            commands[i, c] /= np.sqrt(norm)
        commands[i, 3] = speed[a]
