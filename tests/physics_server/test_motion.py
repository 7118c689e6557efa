"""Free motion in both engines against closed forms of their integration scheme, and against exact solutions."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from physics_server.bullet import BulletPlant
from physics_server.errors import EngineError
from physics_server.law import gust_force
from physics_server.reference import ReferencePlant
from protocol.plant import CommandBatch

INNER = 1 / 240
LIMP = {"force_gain": 0.0, "torque_kp": 0.0, "torque_kd": 0.0}
"""No commanded force or torque."""
TILTED = tuple(Rotation.from_euler("xyz", [0.3, 0.5, 1.2]).as_quat().tolist())


@pytest.fixture(params=[BulletPlant, ReferencePlant])
def rig(rig: Callable[..., Any], request: pytest.FixtureRequest) -> Callable[..., Any]:
    """Every test of this file is one of both engines."""
    return partial(rig, plant=request.param)


def test_a_fall_is_the_semi_implicit_sum(rig: Callable[..., Any]) -> None:
    """After n inner steps v = -g n dt and z = -g dt^2 n (n + 1) / 2, to rounding."""
    world = rig()
    world.reset(**LIMP)
    rows = world.step(50)
    n = 24 * np.arange(1, 51)
    np.testing.assert_allclose(rows[:, 0, 9], -9.81 * n * INNER, rtol=1e-12)
    np.testing.assert_allclose(rows[:, 0, 2], -9.81 * INNER**2 * n * (n + 1) / 2, rtol=1e-12)
    assert not rows[:, 0, [0, 1, 7, 8, 10, 11, 12]].any()


def test_speed_is_not_cut_off(rig: Callable[..., Any]) -> None:
    """A body falls faster than 100 m/s, where the engine would cut off by default."""
    world = rig()
    world.reset(velocity=(150, 0, -200), **LIMP)
    np.testing.assert_allclose(world.step()[0, 0, 7:10], [150, 0, -200 - 0.981], rtol=1e-12)


def test_full_compensation_hovers(rig: Callable[..., Any]) -> None:
    """With c = 1 and speed 0 the drone stands still for a minute."""
    world = rig()
    world.reset(position=(1, 2, 3))
    world.command(compensation=1.0)
    last = world.step(600)[-1, 0]
    np.testing.assert_allclose(last[:3], [1, 2, 3], atol=1e-10)
    np.testing.assert_allclose(last[7:13], 0, atol=1e-11)


def test_a_constant_force_accelerates(rig: Callable[..., Any]) -> None:
    """A disturbance F moves a mass m by F / m, summed semi-implicitly, and turns it by nothing at all."""
    world = rig()
    world.reset(
        position=(1.1, -2.2, 3.3), quaternion=TILTED, mass=2.5, gravity=0.0,
        disturbance_x=0.5, disturbance_y=-1.0, disturbance_z=2.0, **LIMP,
    )  # fmt: skip
    last = world.step(20)[-1, 0]
    a, n = np.array([0.5, -1.0, 2.0]) / 2.5, 480
    np.testing.assert_allclose(last[7:10], a * n * INNER, rtol=1e-12)
    np.testing.assert_allclose(last[:3] - [1.1, -2.2, 3.3], a * INNER**2 * n * (n + 1) / 2, rtol=1e-12)
    assert not last[10:13].any()


def test_velocity_follows_the_command(rig: Callable[..., Any]) -> None:
    """The law is evaluated at each inner step: v_n = v_cmd (1 - (1 - k_v dt)^n), and v_cmd in the end."""
    world = rig()
    world.reset(gravity=0.0)
    direction = np.array([0.6, 0.0, 0.8])
    world.command(tuple(direction), speed=1.5)
    rows = world.step(60)
    n = 24 * np.arange(1, 61)[:, None]
    np.testing.assert_allclose(rows[:, 0, 7:10], 1.5 * direction * (1 - (1 - 8 * INNER) ** n), atol=1e-12)


def test_drag_gives_a_terminal_velocity(rig: Callable[..., Any]) -> None:
    """A limp body with linear drag c falls at m g / c in the end, and at its semi-implicit speed before."""
    world = rig()
    world.reset(linear_drag=4.0, mass=2.0, **LIMP)
    rows = world.step(100)
    terminal = 2.0 * 9.81 / 4.0
    n = 24 * np.arange(1, 101)
    np.testing.assert_allclose(rows[:, 0, 9], -terminal * (1 - (1 - 4.0 / 2.0 * INNER) ** n), rtol=1e-11)
    assert rows[-1, 0, 9] == pytest.approx(-terminal, rel=1e-8)


def test_gust_is_constant_over_a_control_step(rig: Callable[..., Any]) -> None:
    """Over each control step the velocity changes by the published gust of that step times dt / m."""
    world = rig()
    world.reset(gravity=0.0, gust=3.0, seed=42, mass=1.5, **LIMP)
    velocity = np.vstack([np.zeros(3), world.step(10)[:, 0, 7:10]])
    expected = [np.array(gust_force(3.0, 42, step)) * 0.1 / 1.5 for step in range(1, 11)]
    np.testing.assert_allclose(np.diff(velocity, axis=0), expected, rtol=1e-10)


def test_force_along_the_body_axis(rig: Callable[..., Any]) -> None:
    """With force_along_body the drone is pushed where its x axis points, not where the command does."""
    world = rig(inner_steps=1)
    world.reset(quaternion=TILTED, gravity=0.0, force_along_body=1.0)
    world.command((0, 0, 1), speed=2.0)
    forward = Rotation.from_quat(TILTED).as_matrix()[:, 0]
    np.testing.assert_allclose(world.step()[0, 0, 7:10], 8 * 2 * forward * INNER, rtol=1e-12)


@pytest.mark.parametrize("moments", [(0.004, 0.004, 0.004), (0.002, 0.004, 0.006)])
def test_torque_acts_in_the_right_frame(rig: Callable[..., Any], moments: tuple[float, ...]) -> None:
    """From rest the first inner step turns a tilted body by k_p (f x d) dt, whatever its moments are."""
    world = rig(inner_steps=1)
    world.reset(
        position=(5, -3, 2), quaternion=TILTED,
        inertia_x=moments[0], inertia_y=moments[1], inertia_z=moments[2],
    )  # fmt: skip
    direction = np.array([-0.36, 0.48, 0.8])
    world.command(tuple(direction))
    forward = Rotation.from_quat(TILTED).as_matrix()[:, 0]
    expected = 120 * np.cross(forward, direction) * INNER
    np.testing.assert_allclose(world.step()[0, 0, 10:13], expected, rtol=1e-12, atol=1e-14)


def test_the_body_turns_to_the_command(rig: Callable[..., Any]) -> None:
    """The x axis reaches the commanded direction and stays there."""
    world = rig()
    world.reset(quaternion=TILTED)
    direction = np.array([-0.36, 0.48, 0.8])
    world.command(tuple(direction), compensation=1.0)
    last = world.step(30)[-1, 0]
    np.testing.assert_allclose(Rotation.from_quat(last[3:7]).as_matrix()[:, 0], direction, atol=1e-6)
    np.testing.assert_allclose(last[10:13], 0, atol=1e-5)


def test_equal_moments_rotate_freely_without_error(rig: Callable[..., Any]) -> None:
    """A free body of equal moments keeps omega and turns about it by |omega| t, as the exact solution does."""
    world = rig()
    omega = np.array([1.0, -2.0, 3.0])
    world.reset(quaternion=TILTED, omega=tuple(omega), gravity=0.0, **LIMP)
    rows = world.step(100)[:, 0]
    np.testing.assert_allclose(rows[:, 10:13], np.tile(omega, (100, 1)), rtol=1e-11)
    exact = Rotation.from_rotvec(omega * 10.0) * Rotation.from_quat(TILTED)
    assert (exact.inv() * Rotation.from_quat(rows[-1, 3:7])).magnitude() < 1e-10


def free_rotation_error(make: Callable[..., Any], physics_dt: float) -> float:
    """Largest error of the body-frame omega over 2 s of free rotation, moments 1 : 2 : 3 (rad/s)."""
    moments, omega, seconds = np.array([0.002, 0.004, 0.006]), np.array([1.0, 2.0, 3.0]), 2.0
    world = make(inner_steps=round(0.1 / physics_dt), physics_dt=physics_dt)
    world.reset(
        omega=tuple(omega), gravity=0.0, inertia_x=0.002, inertia_y=0.004, inertia_z=0.006, **LIMP
    )  # fmt: skip
    rows = world.step(20)[:, 0]
    body = Rotation.from_quat(rows[:, 3:7]).inv().apply(rows[:, 10:13])
    euler = solve_ivp(
        lambda _, w: -np.cross(w, moments * w) / moments,
        (0, seconds), omega, t_eval=np.linspace(0.1, seconds, 20), rtol=1e-11, atol=1e-12,
    )  # fmt: skip
    return float(np.abs(body - euler.y.T).max())


def test_unequal_moments_follow_eulers_equations_to_first_order(rig: Callable[..., Any]) -> None:
    """Free rotation departs from Euler's equations by less than 0.1 of 3.7 rad/s in 2 s, half of it at half dt."""
    errors = [free_rotation_error(rig, physics_dt) for physics_dt in (1 / 240, 1 / 480, 1 / 960)]
    assert errors[0] < 0.1
    np.testing.assert_allclose(np.array(errors[:-1]) / errors[1:], 2.0, rtol=0.05)


def test_steps_and_time_are_counted(rig: Callable[..., Any]) -> None:
    """A reset answers with step 0 and time 0; after k steps they are k and exactly k dt."""
    world = rig()
    world.reset(position=(1, 2, 3), quaternion=TILTED, velocity=(4, 5, 6), omega=(7, 8, 9))
    poses = world.poses
    np.testing.assert_allclose(poses.raw[0, :13], [1, 2, 3, *TILTED, 4, 5, 6, 7, 8, 9], rtol=1e-14)
    assert (poses.step[0], poses.sim_time[0], poses.contact_steps[0]) == (0, 0.0, 0)
    world.step(7)
    assert (poses.step[0], poses.sim_time[0]) == (7, 7 * (24 * INNER))


def test_nothing_integrates_without_a_command(rig: Callable[..., Any]) -> None:
    """As many inner steps as were commanded are taken, and none before the first command."""
    world = rig()
    world.reset(**LIMP)
    before = world.poses.raw.copy()
    zero = CommandBatch.zeros(1)
    zero.direction[0] = [1, 0, 0]
    world.plant.step(zero, world.poses)
    assert before[0, 9] == 0.0
    assert world.poses.linear_velocity[0, 2] == pytest.approx(-9.81 * 24 * INNER, rel=1e-13)


def test_stiff_gains_are_reported(rig: Callable[..., Any]) -> None:
    """A state that overflows ends in an error that names lane, step and what to look at, not in NaN poses."""
    world = rig()
    world.reset(linear_drag=1e6, velocity=(1, 0, 0))
    with pytest.raises(EngineError, match=r"lane 0, control step \d+: expected a finite state.*too stiff"):
        world.step(100)
