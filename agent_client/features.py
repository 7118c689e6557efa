"""The 37 features of the observation: one table that defines them, one compiled function that computes them.

Order, number and grouping are the paper's (section Observation Space). "2x - 1" maps a quantity of [0, 1] to
[-1, 1]. World frame: right-handed, Z up; local frame: (f, u, r).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agent_client.episodes import Records
from agent_client.errors import SettingsError

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Feature:
    """One entry of the observation."""

    index: int
    name: str
    formula: str
    low: float
    high: float
    section: str
    """Section of the paper."""


_LIDAR = "Derived LiDAR Features"
_KINEMATIC = "Orientation and Kinematics"
_CAMERA = "Visual Perception of the Target"
_MEMORY = "Memory Mechanism"
_CONTEXT = "Global Context"

_DEFINITIONS: Final = (
    ("h_f", "right - left of the front ring's sector means, distances over the range", _LIDAR),
    ("v_f", "top - bottom of the front ring's sector means", _LIDAR),
    ("h_r", "right - left of the rear ring's sector means", _LIDAR),
    ("v_r", "top - bottom of the rear ring's sector means", _LIDAR),
    ("s_f", "2x - 1 of S_F = 1 - (|h_f| + |v_f|) / 2", _LIDAR),
    ("s_r", "2x - 1 of S_R = 1 - (|h_r| + |v_r|) / 2", _LIDAR),
    ("m_f", "2x - 1 of the front ring's mean distance over the range", _LIDAR),
    ("m_r", "2x - 1 of the rear ring's mean distance over the range", _LIDAR),
    ("l_min", "2x - 1 of the smallest distance of both rings over the range", _LIDAR),
    ("f_x", "forward axis, world x", _KINEMATIC),
    ("f_y", "forward axis, world y", _KINEMATIC),
    ("f_z", "forward axis, world z", _KINEMATIC),
    ("u_x", "upward axis, world x", _KINEMATIC),
    ("u_y", "upward axis, world y", _KINEMATIC),
    ("u_z", "upward axis, world z", _KINEMATIC),
    ("r_x", "right axis, world x", _KINEMATIC),
    ("r_y", "right axis, world y", _KINEMATIC),
    ("r_z", "right axis, world z", _KINEMATIC),
    ("v", "2x - 1 of the velocity along f over v_max, clipped", _KINEMATIC),
    ("dv", "change of the velocity along f since the last control step over v_max, clipped", _KINEMATIC),
    ("progress", "2x - 1 of the nearest axis point's arc length over the tube's length", _KINEMATIC),
    ("position_f", "offset from the nearest axis point along f over R, clipped", _KINEMATIC),
    ("position_u", "offset from the nearest axis point along u over R, clipped", _KINEMATIC),
    ("position_r", "offset from the nearest axis point along r over R, clipped", _KINEMATIC),
    ("target_f", "direction to the target along f; 0 while it is not seen", _CAMERA),
    ("target_u", "direction to the target along u; 0 while it is not seen", _CAMERA),
    ("target_r", "direction to the target along r; 0 while it is not seen", _CAMERA),
    ("depth", "2x - 1 of the target's distance over the depth scale, clipped; 1 while not seen", _CAMERA),
    ("visible", "1 while the target is seen, else -1", _CAMERA),
    (
        "memory_age",
        "2x - 1 of the steps since the target was seen over the memory's length, clipped",
        _MEMORY,
    ),
    ("memory_f", "remembered direction along f; 0 without memory", _MEMORY),
    ("memory_u", "remembered direction along u; 0 without memory", _MEMORY),
    ("memory_r", "remembered direction along r; 0 without memory", _MEMORY),
    ("memory_available", "1 while a direction is remembered, else -1", _MEMORY),
    (
        "safety",
        "(smallest LiDAR distance - body radius) over the safety scale, clipped (our choice)",
        _CONTEXT,
    ),
    ("inside", "1 inside the tube, else -1", _CONTEXT),
    ("episode", "2x - 1 of the control step over the step limit, clipped", _CONTEXT),
)

FEATURES: Final[tuple[Feature, ...]] = tuple(
    Feature(index, name, formula, -1.0, 1.0, section)
    for index, (name, formula, section) in enumerate(_DEFINITIONS)
)
"""The observation, entry by entry."""

FEATURE_NAMES: Final = tuple(feature.name for feature in FEATURES)


def _names_of(section: str) -> tuple[str, ...]:
    return tuple(feature.name for feature in FEATURES if feature.section == section)


LIDAR_FEATURES: Final = _names_of(_LIDAR)
CAMERA_FEATURES: Final = _names_of(_CAMERA)
MEMORY_FEATURES: Final = _names_of(_MEMORY)


def feature_mask(masked: Sequence[str]) -> Singles:
    """Factors of the features, (37,): 0 for the named ones, 1 for the others.

    Raises:
        SettingsError: a name is no feature's.
    """
    unknown = sorted(set(masked) - set(FEATURE_NAMES))
    if unknown:
        raise SettingsError(f"masked_features: expected names out of {FEATURE_NAMES}, found {unknown}")
    return np.array([0.0 if name in masked else 1.0 for name in FEATURE_NAMES], dtype=np.float32)


@njit(cache=True, error_model="numpy")
def compute_features(
    lanes: Ints, episodes: Records, constants: Records, mask: Singles, observation: Singles
) -> None:
    """Write the observations of lanes.

    Args:
        lanes: (K,) the lanes to compute.
        episodes: (N,) records, complete but for the observation.
        constants: (1,) record of the task's constants.
        mask: (37,) from `feature_mask`.
        observation: (N, 37) output.
    """
    constant = constants[0]
    for k in range(lanes.shape[0]):
        i = lanes[k]
        e, o = episodes[i], observation[i]
        o[0], o[1], o[2], o[3] = e.h_f, e.v_f, e.h_r, e.v_r
        o[4], o[5] = 2.0 * e.S_F - 1.0, 2.0 * e.S_R - 1.0
        o[6], o[7], o[8] = 2.0 * e.mu_F - 1.0, 2.0 * e.mu_R - 1.0, 2.0 * e.l_min - 1.0
        for a in range(3):
            offset, seen, kept = 0.0, 0.0, 0.0
            for c in range(3):
                component = e.frame[a, c]
                o[9 + 3 * a + c] = component
                offset += (e.position[c] - e.axis_position[c]) * component
                seen += e.target_direction[c] * component
                kept += e.memory_direction[c] * component
            o[21 + a] = offset / e.radius
            o[24 + a] = seen if e.target_visible else 0.0
            o[30 + a] = kept
        o[18] = 2.0 * e.speed / constant.v_max - 1.0
        o[19] = (e.speed - e.speed_before) / constant.v_max
        o[20] = 2.0 * e.progress - 1.0
        o[27] = 2.0 * e.target_distance / constant.depth_scale - 1.0 if e.target_visible else 1.0
        o[28] = 1.0 if e.target_visible else -1.0
        o[29] = 2.0 * e.memory_age / max(constant.memory_steps, 1.0) - 1.0
        o[33] = 1.0 if e.memory_available else -1.0
        o[34] = (e.l_min * constant.lidar_reach - e.body_radius) / constant.safety_scale
        o[35] = 1.0 if e.inside else -1.0
        o[36] = 2.0 * e.step / e.max_steps - 1.0
        for c in range(o.shape[0]):
            o[c] = min(max(o[c], np.float32(-1.0)), np.float32(1.0)) * mask[c]
