"""Where each drone is in its tube, how its episode stands, and how clean its flight has been."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agent_client.episodes import Records

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Outcome(IntEnum):
    """How an episode stands. The paper counts exits and collisions together as exits."""

    RUNNING = 0
    SUCCESS = 1
    """Within the success radius of the tube's end."""
    EXIT = 2
    """The centre left the tube other than through its end."""
    COLLISION = 3
    """The body touched the wall."""
    TIMEOUT = 4
    """The step limit was reached."""


@njit(cache=True)
def place(
    lanes: Ints,
    episodes: Records,
    arc_length: Floats,
    position: Floats,
    tangent: Floats,
    radial_distance: Floats,
    radius: Floats,
    free: Floats,
    near: Floats,
    fresh: bool,
) -> None:
    """Count the step, and take over what the geometry found.

    Args:
        lanes: (K,) the lanes to compute.
        episodes: (N,) records.
        arc_length: (N,), with the next four the fields of `meshes.geometry.AxisPoints`.
        position: (N, 3).
        tangent: (N, 3).
        radial_distance: (N,).
        radius: (N,).
        free: (N,) distance to the wall from the nearest axis point towards the centre (m).
        near: (N,) output: where the next search of the axis begins.
        fresh: whether an episode begins here, so that nothing came before.
    """
    for k in range(lanes.shape[0]):
        i = lanes[k]
        e = episodes[i]
        along = 0.0
        for c in range(3):
            e.axis_position[c], e.tangent[c] = position[i, c], tangent[i, c]
            along += (e.position[c] - position[i, c]) * tangent[i, c]
        e.step += 0 if fresh else 1
        if fresh:
            e.speed_before, e.arc_before = e.speed, arc_length[i]
        else:
            e.arc_before = e.arc_length
        e.arc_length, near[i] = arc_length[i], arc_length[i]
        e.radial_distance, e.radius = radial_distance[i], radius[i]
        e.progress = min(max(e.arc_length / e.length, 0.0), 1.0)
        # No wall on the way from the axis, and neither before the start nor behind the end.
        behind = along < 0.0 and e.arc_length <= 0.0
        beyond = along > 0.0 and e.arc_length >= e.length
        e.inside = free[i] >= e.radial_distance and not (behind or beyond)


@njit(cache=True)
def note_clearance(lanes: Ints, episodes: Records, clearance: Floats) -> None:
    """Take over the distance to the wall (m), (N,), negative outside of the tube, and the smallest so far."""
    for k in range(lanes.shape[0]):
        e = episodes[lanes[k]]
        e.clearance = clearance[lanes[k]]
        e.min_clearance = min(e.min_clearance, e.clearance)


@njit(cache=True)
def judge(lanes: Ints, episodes: Records, constants: Records, words: Ints) -> None:
    """Decide how each episode stands after its step, and renew its quality index.

    Several ends in one step rank collision, success, exit, timeout: a body that leaves through the wall has
    touched it. Success is measured along the axis and holds inside the tube, or past its end where the drone
    went through the end's opening. Q is the paper's Navigation Quality Index: half the mean centring, half
    the mean alignment normalised to [0, 1], over the steps inside the tube.

    Args:
        lanes: (K,) the lanes to compute.
        episodes: (N,) records after perception.
        constants: (1,) record of the task's constants.
        words: (N, 16) block of `protocol.plant.PoseBatch`, viewed as int64.
    """
    constant = constants[0]
    for k in range(lanes.shape[0]):
        i = lanes[k]
        e = episodes[i]
        along, square = 0.0, 0.0
        for c in range(3):
            offset = e.position[c] - e.axis_position[c]
            along += offset * e.tangent[c]
            square += offset * offset
        in_opening = square - along * along <= e.radius * e.radius
        through_end = in_opening and along > 0.0 and e.arc_length >= e.length - 1e-9
        through_start = in_opening and along < 0.0 and e.arc_length <= 1e-9
        near_end = e.length - e.arc_length <= constant.success_radius * e.radius
        touches = constant.clearance_contact > 0.0 and e.clearance < e.body_radius
        e.contact = words[i, 14] > 0 or (touches and not (through_end or through_start))
        if e.contact:
            e.contacts += 1
        if e.contact and constant.end_on_contact > 0.0:
            e.outcome = 3
        elif near_end and (e.inside or through_end):
            e.outcome = 1
        elif not e.inside:
            e.outcome = 2
        elif e.step >= e.max_steps:
            e.outcome = 4
        if constant.reward_length > 0.0:
            e.gain = (e.arc_length - e.arc_before) / constant.reward_length
        else:
            e.gain = 1.0
        if e.inside:
            e.steps_inside += 1
            e.sum_centring += e.centring
            e.sum_alignment += 0.5 * (e.alignment + 1.0)
            e.quality = 0.5 * (e.sum_centring + e.sum_alignment) / e.steps_inside
