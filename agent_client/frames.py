"""The drone's local frame: rows f (forward), u (up), r (right) in the world frame, with f x u = r."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agent_client.episodes import Records

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@njit(cache=True, error_model="numpy")
def take_poses(lanes: Ints, episodes: Records, poses: Floats) -> None:
    """Take position, local frame (f = M[:, 0], u = M[:, 2], r = -M[:, 1]) and speed along f from poses.

    Args:
        lanes: (K,) the lanes to compute.
        episodes: (N,) records; `position`, `frame`, `speed` and `speed_before` are written.
        poses: (N, 16) block of `protocol.plant.PoseBatch`.
    """
    for k in range(lanes.shape[0]):
        i = lanes[k]
        e = episodes[i]
        frame = e.frame
        x, y, z, w = poses[i, 3], poses[i, 4], poses[i, 5], poses[i, 6]
        s = 2.0 / (x * x + y * y + z * z + w * w)
        frame[0, 0] = 1.0 - s * (y * y + z * z)
        frame[0, 1] = s * (x * y + w * z)
        frame[0, 2] = s * (x * z - w * y)
        frame[1, 0] = s * (x * z + w * y)
        frame[1, 1] = s * (y * z - w * x)
        frame[1, 2] = 1.0 - s * (x * x + y * y)
        frame[2, 0] = -s * (x * y - w * z)
        frame[2, 1] = -(1.0 - s * (x * x + z * z))
        frame[2, 2] = -s * (y * z + w * x)
        e.speed_before, e.speed = e.speed, 0.0
        for c in range(3):
            e.position[c] = poses[i, c]
            e.speed += poses[i, 7 + c] * frame[0, c]


def frames_along(directions: Floats) -> Floats:
    """Local frames (N, 3, 3) that look along directions (N, 3), with up as near to world up as can be.

    Where a direction is within 18 degrees of the vertical, up is taken near world x instead: the roll of a
    start is a convention, and nothing later depends on it.
    """
    forward = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    steep = np.abs(forward[:, 2:3]) > 0.95
    hint = np.where(steep, np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    right = np.cross(forward, hint)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    frames: Floats = np.stack([forward, np.cross(right, forward), right], axis=1)
    return frames


def quaternions(frame: Floats) -> Floats:
    """Unit quaternions (N, 4), x y z w, body to world, w >= 0, of orthonormal local frames (N, 3, 3)."""
    m = np.stack([frame[:, 0], -frame[:, 2], frame[:, 1]], axis=2)  # columns f, left, u
    x2, y2, z2 = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    # 4 q q^T; its row of the largest diagonal element is q times a factor that is never small.
    outer = np.empty((len(m), 4, 4))
    outer[:, 0, 0], outer[:, 1, 1] = 1.0 + x2 - y2 - z2, 1.0 - x2 + y2 - z2
    outer[:, 2, 2], outer[:, 3, 3] = 1.0 - x2 - y2 + z2, 1.0 + x2 + y2 + z2
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        outer[:, i, j] = outer[:, j, i] = m[:, i, j] + m[:, j, i]
        outer[:, k, 3] = outer[:, 3, k] = m[:, j, i] - m[:, i, j]
    largest = np.argmax(np.diagonal(outer, axis1=1, axis2=2), axis=1)
    q: Floats = outer[np.arange(len(m)), largest]
    q /= np.linalg.norm(q, axis=1, keepdims=True) * np.where(q[:, 3:4] < 0.0, -1.0, 1.0)
    return q
