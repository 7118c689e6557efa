"""The teacher that sees the axis and the hidden dynamics."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from agent_client.conditions import HARD, Conditions, draw_conditions
from agent_client.curriculum import Curriculum
from agent_client.settings import Settings
from agent_client.task import Outcome, TubeTask
from agent_client.teacher import GRAVITY, Teacher, TeacherOptions
from agent_client.tubes import HARD_TUBES, draw_tube
from agent_client.world import TubeWorld, WorldOptions
from meshes.geometry import Geometry
from physics_server.reference import ReferencePlant
from protocol.agent import SessionSettings
from protocol.plant import PoseBatch
from protocol.twin import open_twin

Maker = Callable[..., Geometry]


def commanded(tube: Geometry, velocity: tuple[float, float, float], z: float, **ranges: float) -> np.ndarray:
    """The teacher's command at x = 5, height z, with this velocity; the frame is f = x, u = z, r = -y."""
    poses = PoseBatch.zeros(1)
    poses.position[0] = (5.0, 0.0, z)
    poses.quaternion[0, 3] = 1.0
    poses.linear_velocity[0] = velocity
    step = TubeTask(tube, Settings(), 0.1, clearance_contact=True).begin(np.array([0]), poses)
    drawn = draw_conditions(Conditions(**{name: (value, value) for name, value in ranges.items()}), [(0,)])
    options = TeacherOptions(lookahead=1.0, speed=1.0, lead=2.0)
    return Teacher(tube, Settings(), options).command(step, poses, drawn)[0]


def test_it_wants_the_top_speed_towards_the_axis_ahead(cylinder: Maker) -> None:
    """Already at the wanted velocity and hovering, the command is that velocity: 45 degrees down from 1 m above."""
    wanted = 2.0 * np.array([1.0, 0.0, -0.5]) / np.hypot(1.0, 0.5)
    found = commanded(cylinder(), tuple(wanted), 0.5, gain=4.0, compensation=1.0)
    np.testing.assert_allclose(found, [wanted[0], wanted[2], 0.0], atol=1e-12)


def test_it_lifts_by_what_the_drone_would_sink(cylinder: Maker) -> None:
    """On the axis at speed, w is v* plus (1 - c) g / k_v upwards, cut to the top speed."""
    w = np.array([2.0, 0.1 * GRAVITY / 4.0, 0.0])
    found = commanded(cylinder(), (2.0, 0.0, 0.0), 0.0, gain=4.0, compensation=0.9)
    np.testing.assert_allclose(found, w * 2.0 / np.linalg.norm(w), atol=1e-12)


def test_it_leads_by_the_gain(cylinder: Maker) -> None:
    """A sideways velocity of 0.3 m/s is answered by lead / k_v times as much the other way."""
    found = commanded(cylinder(), (2.0, 0.3, 0.0), 0.0, gain=4.0, compensation=1.0)
    w = np.array([2.0, 0.0, 0.3 * 2.0 / 4.0])  # right is -y: moving to the left is answered to the right
    np.testing.assert_allclose(found, w * 2.0 / np.linalg.norm(w), atol=1e-12)


def test_it_flies_hard_tubes_under_hard_dynamics() -> None:
    """Choosing among the 36 actions, it takes all of 30 hard tubes of level 2 to their ends."""
    tubes = [draw_tube(2, (number,), "tune", HARD_TUBES) for number in range(30)]
    with open_twin(ReferencePlant(), SessionSettings(30, 0.1, 1.0 / 240.0)) as session:
        options = WorldOptions(conditions=HARD)
        world = TubeWorld(session, [tubes, tubes, tubes], Curriculum(level=2), options, 1)
        world.restart()
        teacher = Teacher(world.geometry, options.settings, TeacherOptions())
        while (world.state.outcome == Outcome.RUNNING).any():
            command = teacher.command(world.state, world.poses, world.drawn)
            miss = ((command[:, None] - teacher.velocities) ** 2).sum(axis=2)
            world.advance(miss.argmin(axis=1))
        assert (world.state.outcome == Outcome.SUCCESS).all()


def test_it_keeps_its_nose_within_the_cone(cylinder: Maker) -> None:
    """Falling fast down a tube it would command backwards: the command stays within 60 degrees of the way."""
    found = commanded(cylinder(), (4.0, 0.5, 0.0), 0.3, gain=1.5, compensation=0.8)
    way = np.array([1.0, -0.3, 0.0]) / np.hypot(1.0, 0.3)
    assert found @ way / np.linalg.norm(found) >= np.cos(np.radians(60.0)) - 1e-9
