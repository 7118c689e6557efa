"""The camera's field of view, line of sight, and memory."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from agent_client.settings import MemorySettings, Settings
from agent_client.task import TubeTask

Maker = Callable[..., Any]


def begin(geometry: Any, poses: Any, settings: Settings | None = None) -> TubeTask:
    """A task whose episodes have just begun."""
    task = TubeTask(geometry, settings or Settings(), 0.1, clearance_contact=True)
    task.begin(np.arange(geometry.lanes), poses)
    return task


def test_the_target_is_a_point_of_the_axis_ahead(cylinder: Maker, poses_at: Maker) -> None:
    """3 m ahead of the nearest axis point; near the end it is the end."""
    step = begin(cylinder(lanes=2), poses_at([[5.0, 0.4, 0.0], [18.5, 0.0, 0.3]])).observe(
        poses_at([[5.0, 0.4, 0.0], [18.5, 0.0, 0.3]])
    )
    np.testing.assert_allclose(step.target_position, [[8.0, 0.0, 0.0], [20.0, 0.0, 0.0]])
    np.testing.assert_allclose(step.target_distance, [math.hypot(3.0, 0.4), math.hypot(1.5, 0.3)])
    np.testing.assert_allclose(step.target_direction[0], np.array([3.0, -0.4, 0.0]) / math.hypot(3.0, 0.4))


@pytest.mark.parametrize(
    ("yaw", "pitch", "seen"),
    [
        (44.0, 0, True),
        (-44.0, 0, True),
        (46.0, 0, False),
        (0, 34.0, True),
        (0, 36.0, False),
        (180.0, 0, False),
    ],
)
def test_the_field_of_view_is_a_pyramid(
    cylinder: Maker, poses_at: Maker, yaw: float, pitch: float, seen: bool
) -> None:
    """45 degrees to either side and 35 degrees up or down; nothing behind."""
    a, b = math.radians(yaw), math.radians(pitch)
    direction = (math.cos(a) * math.cos(b), math.sin(a) * math.cos(b), math.sin(b))
    poses = poses_at([5.0, 0.0, 0.0], direction)
    task = begin(cylinder(), poses)
    assert bool(task.observe(poses).target_visible[0]) is seen


def test_a_wall_between_hides_the_target(cylinder: Maker, poses_at: Maker) -> None:
    """Line of sight counts, not the field of view alone."""
    tube = cylinder()
    poses = poses_at([5.0, 0.0, 0.0])
    task = begin(tube, poses)
    assert task.observe(poses).target_visible[0]
    tube.wall_at = 6.0
    assert not task.observe(poses).target_visible[0]


def test_memory_is_kept_in_the_world_and_forgotten_with_age(cylinder: Maker, poses_at: Maker) -> None:
    """What was seen last stays where it was while the drone turns; after 20 steps unseen it is gone."""
    tube = cylinder()
    poses, turned = poses_at([5.0, 0.2, 0.0]), poses_at([5.0, 0.2, 0.0], (0.0, 1.0, 0.0))
    task = begin(tube, poses)
    seen = task.observe(poses).target_direction.copy()
    for age in range(1, 21):
        step = task.observe(turned)
        assert not step.target_visible[0]
        assert step.memory_available[0]
        assert step.memory_age[0] == age
        np.testing.assert_array_equal(step.memory_direction, seen)
    # Turned to the left, what was ahead is now on the right; age 20 of 20 is the ratio 1.
    np.testing.assert_allclose(step.observation[0, 30:33], [seen[0, 1], 0.0, seen[0, 0]], atol=1e-6)
    assert (step.observation[0, 29], step.observation[0, 33]) == (1.0, 1.0)
    for _ in range(2):
        step = task.observe(turned)
        assert not step.memory_available[0]
        assert (step.memory_direction == 0.0).all()
        np.testing.assert_array_equal(step.observation[0, 29:34], [1.0, 0.0, 0.0, 0.0, -1.0])


def test_seeing_again_renews_the_memory(cylinder: Maker, poses_at: Maker) -> None:
    """A target that comes back into sight is remembered anew from there."""
    poses, turned = poses_at([5.0, 0.2, 0.0]), poses_at([5.0, 0.2, 0.0], (0.0, 1.0, 0.0))
    task = begin(cylinder(), poses, Settings(memory=MemorySettings(steps=2)))
    for _ in range(4):
        step = task.observe(turned)
    assert not step.memory_available[0]
    step = task.observe(poses)
    assert step.memory_available[0]
    assert step.memory_age[0] == 0
    np.testing.assert_array_equal(step.memory_direction, step.target_direction)


def test_an_episode_begins_without_memory(cylinder: Maker, poses_at: Maker) -> None:
    """A start that does not see the target remembers nothing, whatever the lane saw before."""
    poses, turned = poses_at([5.0, 0.0, 0.0]), poses_at([5.0, 0.0, 0.0], (0.0, 1.0, 0.0))
    task = begin(cylinder(), poses)
    step = task.begin(np.array([0]), turned)
    assert not step.memory_available[0]
    assert (step.memory_direction == 0.0).all()
