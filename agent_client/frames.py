"""The drone's local frame: rows f (forward), u (up), r (right) in the world frame, with f x u = r."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agent_client.episodes import Records

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@njit(cache=True, error_model="numpy")
def local_frames(lanes: Ints, episodes: Records, poses: Floats) -> None:
    """Set the frames of lanes from their quaternions: f = M[:, 0], u = M[:, 2], r = -M[:, 1].

    Args:
        lanes: (K,) the lanes to compute.
        episodes: (N,) records; `frame` is written.
        poses: (N, 16) block of `protocol.plant.PoseBatch`.
    """
    for k in range(lanes.shape[0]):
        i = lanes[k]
        frame = episodes[i].frame
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


@njit(cache=True, error_model="numpy")
def quaternions(frame: Floats, quaternion: Floats) -> None:
    """Quaternions (N, 4), x y z w, body to world, w >= 0, of orthonormal local frames (N, 3, 3)."""
    for i in range(frame.shape[0]):
        # The rotation's columns are f, -r, u. The largest component is found first, so that no root of a
        # small difference is taken (Shepperd's method).
        m00, m10, m20 = frame[i, 0, 0], frame[i, 0, 1], frame[i, 0, 2]
        m01, m11, m21 = -frame[i, 2, 0], -frame[i, 2, 1], -frame[i, 2, 2]
        m02, m12, m22 = frame[i, 1, 0], frame[i, 1, 1], frame[i, 1, 2]
        trace = m00 + m11 + m22
        if trace >= m00 and trace >= m11 and trace >= m22:
            x, y, z, w = m21 - m12, m02 - m20, m10 - m01, 1.0 + trace
        elif m00 >= m11 and m00 >= m22:
            x, y, z, w = 1.0 + m00 - m11 - m22, m01 + m10, m02 + m20, m21 - m12
        elif m11 >= m22:
            x, y, z, w = m01 + m10, 1.0 - m00 + m11 - m22, m12 + m21, m02 - m20
        else:
            x, y, z, w = m02 + m20, m12 + m21, 1.0 - m00 - m11 + m22, m10 - m01
        norm = np.sqrt(x * x + y * y + z * z + w * w)
        if w < 0.0:
            norm = -norm
        quaternion[i, 0], quaternion[i, 1] = x / norm, y / norm
        quaternion[i, 2], quaternion[i, 3] = z / norm, w / norm


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
    return np.stack([forward, np.cross(right, forward), right], axis=1)
