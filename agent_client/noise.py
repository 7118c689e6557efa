"""Noise and drop-outs of the sensors: drawn from the episode's seed and step, and from nothing else.

Every number is a hash of (seed, step, index), so that an episode sees the same noise in any lane, beside any
others, and flown again alone.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agent_client.episodes import Records

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Words = NDArray[np.uint64]

CAMERA: Final = 0x10000
"""Index of the camera's draw, behind those of all rays."""

COMMAND: Final = 0x20000
"""First index of the draws of the air that moves near a wall (`agent_client.actuation`)."""


@njit(cache=True)
def uniform(seed: int, step: int, index: int) -> float:
    """A number in (0, 1): SplitMix64's mixing (Steele, Lea, Flood 2014) of seed, step and index."""
    z = np.uint64(seed) + np.uint64(step) * np.uint64(0xD1342543DE82EF95)
    z = _mix(z + np.uint64(index + 1) * np.uint64(0x9E3779B97F4A7C15))
    return (np.float64(z >> np.uint64(12)) + 0.5) * 2.0**-52


@njit(cache=True)
def _mix(z: Any) -> Any:
    """SplitMix64's finaliser: a permutation of the 64-bit numbers after which every bit depends on all."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(cache=True)
def spread_seeds(seeds: Words, tag: int, shares: Floats, fresh: Words) -> None:
    """Make of each seed, a few whole numbers, a row of numbers in (0, 1) and one new seed.

    Args:
        seeds: (K, S) seeds.
        tag: enters all of them, so that whoever has another tag gets other numbers from the same seed.
        shares: (K, C) output.
        fresh: (K,) output, below 2^63.
    """
    for k in range(seeds.shape[0]):
        key = np.uint64(tag)
        for part in seeds[k]:
            key = _mix(key + np.uint64(0x9E3779B97F4A7C15)) ^ part
        key = _mix(key + np.uint64(0x9E3779B97F4A7C15))
        for c in range(shares.shape[1]):
            shares[k, c] = uniform(key, 0, c)
        fresh[k] = _mix(key) >> np.uint64(1)


@njit(cache=True)
def disturb(lanes: Ints, episodes: Records, constants: Records, distances: Floats, rays: int) -> None:
    """Add noise to the rings' readings and drop some: a ray that is dropped reads the full range.

    Args:
        lanes: (K,) the lanes to compute.
        episodes: (N,) records; `lidar_noise` (m), `lidar_dropout`, `noise_seed` and `step` are read.
        constants: (1,) record of the task's constants.
        distances: (N, 4 + 2 rays) along the rays of `agent_client.lidar.place_rays` (m), in and out.
        rays: of one ring.
    """
    reach = constants[0].lidar_reach
    for k in range(lanes.shape[0]):
        i = lanes[k]
        e = episodes[i]
        if e.lidar_noise > 0.0:
            for j in range(0, 2 * rays, 2):  # Box and Muller (1958): two normal numbers from two uniform ones
                scale = e.lidar_noise * math.sqrt(-2.0 * math.log(uniform(e.noise_seed, e.step, j)))
                angle = 2.0 * math.pi * uniform(e.noise_seed, e.step, j + 1)
                distances[i, 2 + j] = max(distances[i, 2 + j] + scale * math.cos(angle), 0.0)
                distances[i, 3 + j] = max(distances[i, 3 + j] + scale * math.sin(angle), 0.0)
        if e.lidar_dropout > 0.0:
            for j in range(2 * rays):
                if uniform(e.noise_seed, e.step, 2 * rays + j) < e.lidar_dropout:
                    distances[i, 2 + j] = reach


@njit(cache=True)
def blinded(episode: Any) -> bool:
    """Whether the camera of an episode (one record) sees nothing in this step."""
    if episode.camera_dropout <= 0.0:
        return False
    return bool(uniform(episode.noise_seed, episode.step, CAMERA) < episode.camera_dropout)


@njit(cache=True, error_model="numpy")
def blow(episodes: Records, near_wall: Floats, reach: float, speed_max: float, commands: Floats) -> None:
    """Add the air's motion, uniform in a cube and growing as the gap to the mean wall closes, to commands.

    Args:
        episodes: (N,) records.
        near_wall: (N,) amplitude at the wall (m/s).
        reach: gap between body and wall from which on the air is still (m).
        speed_max: fastest speed that the plant takes (m/s).
        commands: (N, 8) block of `protocol.plant.CommandBatch`, in and out.
    """
    for i in range(commands.shape[0]):
        if near_wall[i] <= 0.0:
            continue
        e = episodes[i]
        gap = e.radius - e.radial_distance - e.body_radius
        strength = near_wall[i] * min(max(1.0 - gap / reach, 0.0), 1.0)
        if strength <= 0.0:
            continue
        command = commands[i]
        norm = 0.0
        for c in range(3):
            air = strength * (2.0 * uniform(e.noise_seed, e.step, COMMAND + c) - 1.0)
            command[c] = command[3] * command[c] + air
            norm += command[c] ** 2
        norm = math.sqrt(norm)
        for c in range(3):
            command[c] = command[c] / norm if norm > 1e-9 else e.frame[0, c]
        command[3] = min(norm, speed_max)
