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


@njit(cache=True, error_model="numpy")
def frames_along(directions: Floats) -> Floats:
    """Local frames (N, 3, 3) that look along directions (N, 3), with up as near to world up as can be.

    Where a direction is within 18 degrees of the vertical, up is taken near world x instead: the roll of a
    start is a convention, and nothing later depends on it.
    """
    frames = np.empty((len(directions), 3, 3))
    for i in range(len(directions)):
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        norm = np.sqrt(x * x + y * y + z * z)
        x, y, z = x / norm, y / norm, z / norm
        # r = f x hint, u = r x f
        rx, ry, rz = (0.0, z, -y) if abs(z) > 0.95 else (y, -x, 0.0)
        norm = np.sqrt(rx * rx + ry * ry + rz * rz)
        rx, ry, rz = rx / norm, ry / norm, rz / norm
        frames[i, 0, 0], frames[i, 0, 1], frames[i, 0, 2] = x, y, z
        frames[i, 1, 0], frames[i, 1, 1], frames[i, 1, 2] = ry * z - rz * y, rz * x - rx * z, rx * y - ry * x
        frames[i, 2, 0], frames[i, 2, 1], frames[i, 2, 2] = rx, ry, rz
    return frames


@njit(cache=True, error_model="numpy")
def quaternions(frames: Floats) -> Floats:
    """Unit quaternions (N, 4), x y z w, body to world, w >= 0, of orthonormal local frames (N, 3, 3)."""
    found = np.empty((len(frames), 4))
    for i in range(len(frames)):
        # The rotation's columns are f, -r, u. The largest component is found first, so that no root of a
        # small difference is taken (Shepperd's method).
        m00, m10, m20 = frames[i, 0, 0], frames[i, 0, 1], frames[i, 0, 2]
        m01, m11, m21 = -frames[i, 2, 0], -frames[i, 2, 1], -frames[i, 2, 2]
        m02, m12, m22 = frames[i, 1, 0], frames[i, 1, 1], frames[i, 1, 2]
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
        found[i, 0], found[i, 1], found[i, 2], found[i, 3] = x / norm, y / norm, z / norm, w / norm
    return found
