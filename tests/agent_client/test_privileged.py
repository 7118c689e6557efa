"""What the value network alone sees, against closed forms in a straight tube."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from agent_client.conditions import Conditions, draw_conditions
from agent_client.privileged import AHEAD, WIDTH, privileged
from agent_client.settings import Settings
from agent_client.task import TubeTask
from meshes.geometry import Geometry
from protocol.plant import PoseBatch


def test_every_number_is_the_formula_of_a_straight_tube(
    cylinder: Callable[..., Geometry], poses_at: Callable[..., PoseBatch]
) -> None:
    """Velocity, offset, axis ahead in the local frame; way left, clock; and what the episode drew."""
    tubes = cylinder(2, radius=0.8, length=20.0)
    task = TubeTask(tubes, Settings(), 0.1, clearance_contact=True)
    # One looks along the tube, 0.2 m to its left and 0.1 m high; one back, near the end. Local axes f, u, r.
    poses = poses_at([[5.0, 0.2, 0.1], [18.0, 0.0, 0.0]], [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], speed=1.5)
    poses.linear_velocity[0] = [1.0, 0.3, -0.2]
    drawn = draw_conditions(Conditions(gain=(4.0, 4.0), mass=(2.0, 2.0), drag=(0.5, 0.5)), [(0,), (1,)])
    task.begin(np.arange(2), poses, drawn)
    step = task.observe(poses)
    seen = privileged(step, poses, drawn, tubes)
    assert seen.shape == (2, WIDTH)
    assert seen.dtype == np.float32
    limit = math.ceil(1.5 * 20.0 / 0.05)
    hidden = [math.log(4.0), 0.9, 0.25, 0.15, 1.0, 0.0]
    first = [1.0, -0.2, -0.3, 0.0, 0.1 / 0.8, -0.2 / 0.8, 0.8, 2.0 * 5.0 / 20.0 - 1.0]
    first += [number for ahead in AHEAD for number in (ahead, -0.1, 0.2)]
    first += [5.0, 1 / limit, *hidden]
    second = [1.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.8, 0.8]
    second += [number for ahead in AHEAD for number in (-min(ahead, 2.0), 0.0, 0.0)]
    second += [2.0, 1 / limit, *hidden]
    np.testing.assert_allclose(seen, [first, second], atol=1e-6)
