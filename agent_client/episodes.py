"""What is known of N episodes: one record a lane, and one record of the constants that the task is judged by.

The compiled functions of this package work on these two arrays. Their layout is part of the functions' types,
so that numba's cache compiles anew when a field changes here. A change in a compiled function of another file
it would not notice; therefore the record of the constants carries a digest of those files in its layout.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from agent_client.settings import Settings

Records: TypeAlias = NDArray[Any]
"""An array of records: typed by numba, opaque to static checkers."""

OnContact = Literal["end", "continue"]

LIDAR_SUMMARY = ("h_f", "v_f", "h_r", "v_r", "S_F", "S_R", "mu_F", "mu_R", "l_min", "C_turn")
"""Fields of an episode that sum up its LiDAR, by the names of the paper; distances are over the range."""


SENSED: Final = ("body_radius", "field_of_view", "lidar_noise", "lidar_dropout", "camera_dropout")
"""Conditions (`agent_client.conditions`) that perception works under, by their names."""

_COMPILED: Final = ("camera.py", "features.py", "frames.py", "judge.py", "lidar.py", "noise.py", "reward.py")
"""Files whose compiled functions `agent_client.perception` calls."""


def episode_dtype(rays: int) -> np.dtype[np.void]:
    """The record of one episode, for LiDAR rings of `rays` rays; `agent_client.task.TaskStep` explains it."""
    return np.dtype(
        [
            ("position", "f8", (3,)),
            ("frame", "f8", (3, 3)),
            ("arc_length", "f8"),
            ("axis_position", "f8", (3,)),
            ("tangent", "f8", (3,)),
            ("radial_distance", "f8"),
            ("radius", "f8"),
            ("progress", "f8"),
            ("clearance", "f8"),
            ("lidar", "f8", (2 * rays,)),
            *((name, "f8") for name in LIDAR_SUMMARY),
            ("target_position", "f8", (3,)),
            ("target_direction", "f8", (3,)),
            ("target_distance", "f8"),
            ("memory_direction", "f8", (3,)),
            ("centring", "f8"),
            ("alignment", "f8"),
            ("quality", "f8"),
            ("min_clearance", "f8"),
            ("reward", "f8"),
            ("reward_terms", "f8", (10,)),
            # Kept from step to step and shown to nobody: tube's length, arc length and velocity along f one
            # control step ago, velocity along f now, factor of the reward's per-step terms, sums for Q.
            ("length", "f8"),
            ("arc_before", "f8"),
            ("speed_before", "f8"),
            ("speed", "f8"),
            ("gain", "f8"),
            ("sum_centring", "f8"),
            ("sum_alignment", "f8"),
            ("steps_inside", "i8"),
            ("step", "i8"),
            ("max_steps", "i8"),
            ("memory_age", "i8"),
            ("contacts", "i8"),
            ("regime", "i1"),
            ("outcome", "i1"),
            ("inside", "?"),
            ("contact", "?"),
            ("target_visible", "?"),
            ("memory_available", "?"),
            # The conditions of the episode (`agent_client.conditions`) that perception needs, and the seed of
            # its sensors' noise.
            *((name, "f8") for name in SENSED),
            ("observation_delay", "i8"),
            ("noise_seed", "u8"),
        ],
        align=True,
    )


def constants(settings: Settings, dt: float, *, clearance_contact: bool, on_contact: OnContact) -> Records:
    """The constants of the task as an array of one record, (1,); arguments as for `TubeTask`."""
    s = settings
    values: dict[str, float] = {
        "v_max": s.speed_max,
        # 1: the body touches the wall where the clearance is below its radius; 0: where physics reports it.
        "clearance_contact": float(clearance_contact),
        "end_on_contact": float(on_contact == "end"),
        "lidar_offset": s.lidar.offset,
        "lidar_reach": s.lidar.reach,
        "half_width": s.camera.half_width,
        "half_height": s.camera.half_height,
        "depth_scale": s.camera.depth_scale,
        "memory_steps": s.memory.steps,
        "success_radius": s.task.success_radius,
        "safety_scale": s.task.safety_scale,
        "warmup_steps": s.reward.warmup_steps,
        # Length over which the per-step terms of the reward are paid; 0 for the literal reward.
        "reward_length": s.speed_max * dt if s.reward.per_metre else 0.0,
        "reward_regimes": float(s.reward.regimes),
        "reward_centring": s.reward.centring,
        "reward_success": s.reward.success,
        "reward_failure": s.reward.failure,
        "reward_timeout": s.reward.timeout,
    }
    values[f"sources_{_digest()}"] = 0.0
    record = np.zeros(1, dtype=np.dtype([(name, "f8") for name in values]))
    record[0] = tuple(values.values())
    return record


@cache
def _digest() -> str:
    """Digest of the files in _COMPILED, as hexadecimal digits."""
    digest = hashlib.blake2b(digest_size=8)
    for name in _COMPILED:
        digest.update(Path(__file__).with_name(name).read_bytes())
    return digest.hexdigest()
