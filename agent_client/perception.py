"""The two compiled calls of a control step: before the geometry is asked, and after it has answered.

Each strings together the compiled functions of its neighbours, because a call from Python costs more than most
of them take.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agent_client.camera import look, remember
from agent_client.episodes import Records
from agent_client.features import compute_features
from agent_client.frames import take_poses
from agent_client.judge import judge, place
from agent_client.lidar import place_rays, read_rings
from agent_client.noise import disturb
from agent_client.reward import choose_regimes, score

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]


@njit(cache=True, error_model="numpy")
def aim(
    lanes: Ints,
    episodes: Records,
    constants: Records,
    poses: Floats,
    circle: Floats,
    targets: Floats,
    feet: Floats,
    origins: Floats,
    directions: Floats,
) -> None:
    """Take poses, and say where the rays of the LiDAR start and go.

    Args:
        lanes: (K,) the lanes to compute.
        episodes: (N,) records.
        constants: (1,) record of the task's constants.
        poses: (N, 16) block of `protocol.plant.PoseBatch`.
        circle: (rays, 2) from `agent_client.lidar.ring_circle`.
        targets: (N, 3) points of the axis to look at (m).
        feet: (N, 3) nearest points of the axis (m).
        origins: (N, 4 + 2 rays, 3) output, see `agent_client.lidar.place_rays`.
        directions: (N, 4 + 2 rays, 3) output.
    """
    take_poses(lanes, episodes, poses)
    place_rays(lanes, episodes, constants, circle, targets, feet, origins, directions)


@njit(cache=True, error_model="numpy")
def assess(
    lanes: Ints,
    episodes: Records,
    constants: Records,
    words: Ints,
    arc_length: Floats,
    axis_position: Floats,
    tangent: Floats,
    radial_distance: Floats,
    radius: Floats,
    distances: Floats,
    targets: Floats,
    sectors: Ints,
    mask: Singles,
    fresh: bool,
    near: Floats,
    observation: Singles,
) -> None:
    """From the geometry's answers to sensors, verdict, reward and observation.

    Args:
        lanes: (K,) the lanes to compute.
        episodes: (N,) records.
        constants: (1,) record of the task's constants.
        words: (N, 16) block of `protocol.plant.PoseBatch`, viewed as int64.
        arc_length: (N,), with the next four the fields of `meshes.geometry.AxisPoints`.
        axis_position: (N, 3).
        tangent: (N, 3).
        radial_distance: (N,).
        radius: (N,).
        distances: (N, 4 + 2 rays) along the rays (m).
        targets: (N, 3) points of the axis to look at (m).
        sectors: (rays,) from `agent_client.lidar.ring_sectors`.
        mask: (37,) from `agent_client.features.feature_mask`.
        fresh: whether episodes begin here: nothing is judged then.
        near: (N,) output: where the next search of the axis begins.
        observation: (N, 37) output.
    """
    sight = distances.shape[1] - 2
    place(
        lanes, episodes, arc_length, axis_position, tangent, radial_distance, radius, distances[:, sight + 1],
        near, fresh,
    )  # fmt: skip
    disturb(lanes, episodes, constants, distances, sectors.shape[0])
    read_rings(lanes, episodes, constants, distances, sectors)
    look(lanes, episodes, constants, targets, distances[:, sight])
    remember(lanes, episodes, constants)
    choose_regimes(lanes, episodes)
    if not fresh:
        judge(lanes, episodes, constants, words)
        score(lanes, episodes, constants)
    compute_features(lanes, episodes, constants, mask, observation)
