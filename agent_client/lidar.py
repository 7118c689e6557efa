"""Front and rear perimeter LiDAR: where the rays start, what they read, and the paper's summary of it.

Two rings of rays stand perpendicular to the body, `offset` ahead of the centre and behind it. Ray j of a ring
of K points along cos(phi) r + sin(phi) u with phi = 2 pi j / K: a ring goes from right over top to left and
bottom. The nose may reach further than the body's radius and poke through a wall; two more rays, the
spokes, run from the centre along +f and -f, and a ring whose spoke is blocked reads zero.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agent_client.episodes import Records

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SPOKES: Final = 2
"""Rays before the rings in a batch: along +f, then along -f."""

LINES: Final = 2
"""Lines of sight behind the rings in a batch: from the centre to the camera's target, and from the nearest
axis point to the centre. One batch asks the geometry less often than one question each."""


def ring_circle(rays: int) -> Floats:
    """Directions of a ring's rays in its plane, (rays, 2): components along r and u."""
    phi = 2.0 * np.pi * np.arange(rays) / rays
    return np.stack([np.cos(phi), np.sin(phi)], axis=1)


def ring_sectors(rays: int) -> Ints:
    """Sector of each ray of a ring, (rays,): 0 right, 1 top, 2 left, 3 bottom, each 90 degrees wide."""
    return ((np.arange(rays) * 8 + rays) // (2 * rays) % 4).astype(np.int64)


@njit(cache=True, error_model="numpy")
def place_line(start: Floats, end: Floats, otherwise: Floats, origin: Floats, direction: Floats) -> None:
    """A ray from `start` towards `end`, all (3,); along `otherwise` where they are the same place."""
    square = 0.0
    for c in range(3):
        origin[c], direction[c] = start[c], end[c] - start[c]
        square += direction[c] * direction[c]
    length = math.sqrt(square)
    for c in range(3):
        direction[c] = direction[c] / length if length > 0.0 else otherwise[c]


@njit(cache=True, error_model="numpy")
def place_rays(
    lanes: Ints,
    episodes: Records,
    constants: Records,
    circle: Floats,
    targets: Floats,
    feet: Floats,
    origins: Floats,
    directions: Floats,
) -> None:
    """Origins and directions of all rays: the two spokes, the front ring, the rear ring, the two lines of sight.

    Args:
        lanes: (K,) the lanes to compute.
        episodes: (N,) records; `position` and `frame` are read.
        constants: (1,) record of the task's constants.
        circle: (rays, 2) from `ring_circle`.
        targets: (N, 3) points that the camera looks at (m).
        feet: (N, 3) nearest points of the axis (m).
        origins: (N, 4 + 2 rays, 3) output, world frame (m).
        directions: (N, 4 + 2 rays, 3) output, unit vectors.
    """
    rays, offset = circle.shape[0], constants[0].lidar_offset
    for k in range(lanes.shape[0]):
        i = lanes[k]
        frame, position = episodes[i].frame, episodes[i].position
        for c in range(3):
            f, u, r, p = frame[0, c], frame[1, c], frame[2, c], position[c]
            origins[i, 0, c], origins[i, 1, c] = p, p
            directions[i, 0, c], directions[i, 1, c] = f, -f
            front, rear = p + offset * f, p - offset * f
            for j in range(rays):
                d = circle[j, 0] * r + circle[j, 1] * u
                directions[i, 2 + j, c], directions[i, 2 + rays + j, c] = d, d
                origins[i, 2 + j, c], origins[i, 2 + rays + j, c] = front, rear
        sight = 2 + 2 * rays
        place_line(position, targets[i], frame[0], origins[i, sight], directions[i, sight])
        place_line(feet[i], position, frame[1], origins[i, sight + 1], directions[i, sight + 1])


@njit(cache=True)
def read_rings(lanes: Ints, episodes: Records, constants: Records, distances: Floats, sectors: Ints) -> None:
    """What the rings read, and the asymmetries, scores and turn confidence made of it.

    Paper, LiDAR Features and Turn Detection, with distances over the range and a sector's value the mean of
    its rays: h = right - left and v = top - bottom and S = 1 - (|h| + |v|) / 2 of each ring, and of both
    C_turn = clip(S_R - S_F + max(mu_R - mu_F, 0), 0, 1).

    Args:
        lanes: (K,) the lanes to compute.
        episodes: (N,) records; `lidar` (m) and the fields LIDAR_SUMMARY are written.
        constants: (1,) record of the task's constants.
        distances: (N, 4 + 2 rays) along the rays of `place_rays` (m).
        sectors: (rays,) from `ring_sectors`.
    """
    rays = sectors.shape[0]
    offset, reach = constants[0].lidar_offset, constants[0].lidar_reach
    sums = np.zeros((2, 4))
    for k in range(lanes.shape[0]):
        i = lanes[k]
        e = episodes[i]
        nearest = reach
        sums[:, :] = 0.0
        for ring in range(2):
            blocked = distances[i, ring] < offset
            for j in range(rays):
                d = 0.0 if blocked else min(distances[i, 2 + ring * rays + j], reach)
                e.lidar[ring * rays + j] = d
                nearest = min(nearest, d)
                sums[ring, sectors[j]] += d
        sums *= 4.0 / (rays * reach)
        e.h_f, e.v_f = sums[0, 0] - sums[0, 2], sums[0, 1] - sums[0, 3]
        e.h_r, e.v_r = sums[1, 0] - sums[1, 2], sums[1, 1] - sums[1, 3]
        e.S_F = 1.0 - 0.5 * (abs(e.h_f) + abs(e.v_f))
        e.S_R = 1.0 - 0.5 * (abs(e.h_r) + abs(e.v_r))
        e.mu_F = 0.25 * (sums[0, 0] + sums[0, 1] + sums[0, 2] + sums[0, 3])
        e.mu_R = 0.25 * (sums[1, 0] + sums[1, 1] + sums[1, 2] + sums[1, 3])
        e.l_min = nearest / reach
        e.C_turn = min(max(e.S_R - e.S_F + max(e.mu_R - e.mu_F, 0.0), 0.0), 1.0)
