"""How episodes begin, stand and end, and their quality."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from agent_client.errors import SettingsError
from agent_client.settings import Settings
from agent_client.task import Outcome, TaskStep, TubeTask
from meshes.geometry import AxisPoints

Maker = Callable[..., Any]


def flown(geometry: Any, poses_at: Maker, path: list[list[float]], **options: Any) -> TaskStep:
    """One episode through the given positions, the first of them its start."""
    task = TubeTask(geometry, Settings(), 0.1, **{"clearance_contact": True, **options})
    task.begin(np.array([0]), poses_at(path[0]))
    for position in path[1:]:
        step = task.observe(poses_at(position))
    return step


def snapshot(step: TaskStep) -> dict[str, Any]:
    """A copy of all arrays of a step."""
    arrays: dict[str, Any] = {}
    for field in fields(step):
        value = getattr(step, field.name)
        if isinstance(value, AxisPoints):
            arrays |= {f"axis.{f.name}": getattr(value, f.name).copy() for f in fields(value)}
        else:
            arrays[field.name] = value.copy()
    return arrays


def test_success_is_within_half_a_radius_of_the_end(cylinder: Maker, poses_at: Maker) -> None:
    """Of the local radius, measured along the axis, off the axis too."""
    assert flown(cylinder(), poses_at, [[19.0, 0, 0], [19.49, 0, 0]]).outcome[0] == Outcome.RUNNING
    assert flown(cylinder(), poses_at, [[19.0, 0, 0], [19.51, 0, 0.8]]).outcome[0] == Outcome.SUCCESS
    assert flown(cylinder(radius=2.0), poses_at, [[18.0, 0, 0], [19.1, 0, 0]]).outcome[0] == Outcome.SUCCESS


def test_leaving_through_the_end_is_success_and_beside_it_is_not(cylinder: Maker, poses_at: Maker) -> None:
    """A step that jumps over a narrow success zone through the end's opening has arrived."""
    tube = cylinder(radius=0.3)
    assert flown(tube, poses_at, [[19.8, 0, 0], [20.05, 0, 0.1]]).outcome[0] == Outcome.SUCCESS
    beside = [[19.8, 0, 0], [20.05, 0, 0.4]]
    assert flown(tube, poses_at, beside, clearance_contact=False).outcome[0] == Outcome.EXIT
    assert flown(tube, poses_at, beside, clearance_contact=True).outcome[0] == Outcome.COLLISION


def test_leaving_through_the_start_or_the_wall_is_an_exit(cylinder: Maker, poses_at: Maker) -> None:
    """Where physics reported no contact: the centre is outside."""
    assert flown(cylinder(), poses_at, [[0.1, 0, 0], [-0.1, 0, 0]]).outcome[0] == Outcome.EXIT
    wall = [[5.0, 0, 0], [5.0, 1.1, 0]]
    assert flown(cylinder(), poses_at, wall, clearance_contact=False).outcome[0] == Outcome.EXIT


def test_kinematic_contact_is_a_clearance_below_the_body_radius(cylinder: Maker, poses_at: Maker) -> None:
    """0.15 m by default."""
    assert flown(cylinder(), poses_at, [[5.0, 0, 0], [5.0, 0.849, 0]]).outcome[0] == Outcome.RUNNING
    step = flown(cylinder(), poses_at, [[5.0, 0, 0], [5.0, 0.851, 0]])
    assert step.outcome[0] == Outcome.COLLISION
    assert (step.contact[0], step.contacts[0]) == (True, 1)


def test_physical_contact_is_what_physics_reports(cylinder: Maker, poses_at: Maker) -> None:
    """Contact in any inner step of the interval ends the episode, however near or far the wall is at its end."""
    task = TubeTask(cylinder(), Settings(), 0.1, clearance_contact=False)
    task.begin(np.array([0]), poses_at([5.0, 0, 0]))
    assert task.observe(poses_at([5.0, 0.9, 0])).outcome[0] == Outcome.RUNNING
    poses = poses_at([5.0, 0.0, 0])
    poses.contact_steps[:] = 1
    assert task.observe(poses).outcome[0] == Outcome.COLLISION


def test_contacts_are_counted_when_they_do_not_end_the_episode(cylinder: Maker, poses_at: Maker) -> None:
    """With on_contact "continue" control steps with contact are counted and the rest decides."""
    path = [[19.0, 0, 0], [19.1, 0.9, 0], [19.2, 0.9, 0], [19.3, 0, 0], [19.6, 0, 0]]
    step = flown(cylinder(), poses_at, path, on_contact="continue")
    assert step.outcome[0] == Outcome.SUCCESS
    assert step.contacts[0] == 2
    assert step.min_clearance[0] == pytest.approx(0.1)


def test_collision_comes_before_success_in_the_same_step(cylinder: Maker, poses_at: Maker) -> None:
    """Arriving with a touch is no success."""
    assert flown(cylinder(), poses_at, [[19.0, 0, 0], [19.6, 0.9, 0]]).outcome[0] == Outcome.COLLISION


def test_timeout_is_at_the_step_limit(cylinder: Maker, poses_at: Maker) -> None:
    """The limit's step is the last; success in that step is still success."""
    still = [[5.0, 0.0, 0.0]]
    assert flown(cylinder(), poses_at, still * 3, step_limit=3).outcome[0] == Outcome.RUNNING
    step = flown(cylinder(), poses_at, still * 4, step_limit=3)
    assert (step.outcome[0], step.step[0]) == (Outcome.TIMEOUT, 3)
    arrived = [*still, [19.7, 0.0, 0.0]]
    assert flown(cylinder(), poses_at, arrived, step_limit=1).outcome[0] == Outcome.SUCCESS


def test_the_step_limit_follows_each_tubes_length(cylinder: Maker, poses_at: Maker) -> None:
    """1.5 times the steps of the slowest passage."""
    task = TubeTask(cylinder(length=33.0), Settings(), 0.1, clearance_contact=True)
    assert task.begin(np.array([0]), poses_at([0.6, 0, 0])).max_steps[0] == 990


def test_quality_is_half_centring_half_alignment_inside_the_tube(cylinder: Maker, poses_at: Maker) -> None:
    """Q = (mean(1 - d/R) + mean((a + 1) / 2)) / 2 over control steps inside; the start does not count."""
    task = TubeTask(cylinder(), Settings(), 0.1, clearance_contact=False, on_contact="continue")
    assert task.begin(np.array([0]), poses_at([1.0, 0.5, 0.0])).quality[0] == 0.0
    centring, alignment = [], []
    for d, yaw in ((0.1, 0.0), (0.4, 0.3), (0.7, -0.5)):
        f = np.array([math.cos(yaw), math.sin(yaw), 0.0])
        position = np.array([5.0, d, 0.0])
        step = task.observe(poses_at(position, f))
        to = np.array([8.0, 0.0, 0.0]) - position
        centring.append(1.0 - d)
        alignment.append((f @ to / np.linalg.norm(to) + 1.0) / 2.0)
        assert step.quality[0] == pytest.approx(0.5 * np.mean(centring) + 0.5 * np.mean(alignment))
    before = step.quality[0]
    assert task.observe(poses_at([5.0, 1.2, 0.0])).quality[0] == before


def test_progress_is_arc_length_over_length(cylinder: Maker, poses_at: Maker) -> None:
    """Of the nearest axis point."""
    step = flown(cylinder(), poses_at, [[5.0, 0, 0], [7.0, 0.3, 0]])
    assert step.progress[0] == pytest.approx(0.35)
    assert step.axis.radial_distance[0] == pytest.approx(0.3)


def test_an_episode_that_is_over_stays_as_it_was_and_earns_nothing(cylinder: Maker, poses_at: Maker) -> None:
    """Other lanes go on."""
    task = TubeTask(cylinder(lanes=2), Settings(), 0.1, clearance_contact=True)
    task.begin(np.arange(2), poses_at([[5.0, 0, 0], [5.0, 0, 0]]))
    over = snapshot(task.observe(poses_at([[5.1, 0.9, 0], [5.1, 0, 0]])))
    step = task.observe(poses_at([[5.2, 0.0, 0], [5.2, 0, 0]]))
    np.testing.assert_array_equal(step.outcome, [Outcome.COLLISION, Outcome.RUNNING])
    np.testing.assert_array_equal(step.step, [1, 2])
    assert step.reward[0] == 0.0
    assert (step.reward_terms[0] == 0.0).all()
    assert step.reward[1] > 0.0
    assert step.position[0, 0] == over["position"][0, 0] == 5.1


def test_begin_touches_its_lanes_alone(cylinder: Maker, poses_at: Maker) -> None:
    """Rows of other lanes are bit for bit as they were, even where their poses are nonsense."""
    task = TubeTask(cylinder(lanes=3), Settings(), 0.1, clearance_contact=True)
    task.begin(np.arange(3), poses_at([[5.0, 0, 0.1], [6.0, 0.2, 0], [7.0, 0.3, 0]]))
    before = snapshot(task.observe(poses_at([[5.1, 0, 0], [6.1, 0.9, 0], [7.1, 0.3, 0]])))
    after = snapshot(task.begin(np.array([1]), poses_at([[999.0, 50, 0], [1.0, 0.1, 0], [-9.0, 0, 0]])))
    for name, array in before.items():
        np.testing.assert_array_equal(after[name][[0, 2]], array[[0, 2]], err_msg=name)
    assert (before["outcome"][1], after["outcome"][1]) == (Outcome.COLLISION, Outcome.RUNNING)
    assert (after["step"][1], after["contacts"][1], after["reward"][1]) == (0, 0, 0.0)
    assert after["min_clearance"][1] == pytest.approx(0.9)
    fresh = TubeTask(cylinder(), Settings(), 0.1, clearance_contact=True).begin(
        np.array([0]), poses_at([1.0, 0.1, 0])
    )
    np.testing.assert_array_equal(after["observation"][1], fresh.observation[0])


def test_rays_and_lines_of_sight_are_timed(cylinder: Maker, poses_at: Maker) -> None:
    """Their share of the last call is known in nanoseconds."""
    task = TubeTask(cylinder(), Settings(), 0.1, clearance_contact=True)
    task.begin(np.array([0]), poses_at([1.0, 0.1, 0]))
    assert task.ray_nanoseconds > 0


@pytest.mark.parametrize("dt", [0.0, -0.1, math.nan, math.inf])
def test_a_control_step_that_is_no_time_is_refused(cylinder: Maker, dt: float) -> None:
    """The message says what was expected and found."""
    with pytest.raises(SettingsError, match="dt: expected a time above 0 s, found"):
        TubeTask(cylinder(), Settings(), dt, clearance_contact=True)


def test_a_step_limit_below_one_is_refused(cylinder: Maker) -> None:
    """An episode has at least one step."""
    with pytest.raises(SettingsError, match="step_limit: expected at least 1 step, found 0"):
        TubeTask(cylinder(), Settings(), 0.1, clearance_contact=True, step_limit=0)
