"""The kinematic world."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from agent_client.kinematic import KinematicPlant
from agent_client.settings import MotionSettings, Settings
from protocol.plant import PARAMETERS, CommandBatch, PoseBatch, ResetBatch, TubeReference


class World:
    """A plant with its batches, for tests that step it by hand."""

    def __init__(self, lanes: int = 1, dt: float = 0.1, settings: Settings | None = None) -> None:
        self.plant = KinematicPlant(settings)
        self.plant.open(lanes, dt, dt, 1)
        self.commands, self.poses = CommandBatch.zeros(lanes), PoseBatch.zeros(lanes)
        self.resets = ResetBatch.zeros(lanes)
        self.resets.selected[:] = 1

    def reset(self) -> None:
        """Apply `resets`."""
        self.plant.reset(self.resets, self.poses)

    def step(self, direction: object, speed: object) -> PoseBatch:
        """One control step of all lanes."""
        self.commands.direction[:], self.commands.speed[:] = direction, speed
        self.plant.step(self.commands, self.poses)
        return self.poses


def axes(poses: PoseBatch) -> np.ndarray:
    """Rotation matrices (N, 3, 3)."""
    return Rotation.from_quat(poses.quaternion).as_matrix()


def test_straight_flight_blends_the_speed_by_half() -> None:
    """Speed is v (1 - 2^-k) after k steps, the way its sum times dt, the attitude unchanged."""
    world = World()
    world.reset()
    way = 0.0
    for k in range(1, 11):
        poses = world.step([1.0, 0.0, 0.0], 2.0)
        speed = 2.0 * (1.0 - 0.5**k)
        way += 0.1 * speed
        np.testing.assert_allclose(poses.linear_velocity[0], [speed, 0.0, 0.0], atol=1e-14)
        np.testing.assert_allclose(poses.position[0], [way, 0.0, 0.0], atol=1e-14)
        assert (poses.step[0], poses.sim_time[0], poses.contact_steps[0]) == (k, k * 0.1, 0)
    np.testing.assert_array_equal(poses.quaternion[0], [0.0, 0.0, 0.0, 1.0])
    np.testing.assert_array_equal(poses.angular_velocity[0], 0.0)


def test_the_heading_goes_its_share_towards_the_command() -> None:
    """The heading is (1 - 0.35) f + 0.35 d, normalised; the angular velocity says how far it turned."""
    world = World()
    world.reset()
    d = np.array([0.0, 0.6, 0.8])
    poses = world.step(d, 1.0)
    f = 0.65 * np.array([1.0, 0.0, 0.0]) + 0.35 * d
    f /= np.linalg.norm(f)
    np.testing.assert_allclose(axes(poses)[0, :, 0], f, atol=1e-14)
    np.testing.assert_allclose(poses.linear_velocity[0], 0.5 * f, atol=1e-14)
    turned = Rotation.from_rotvec(0.1 * poses.angular_velocity[0]).as_matrix()
    np.testing.assert_allclose(turned, axes(poses)[0], atol=1e-14)


def test_commands_turned_with_the_drone_give_a_constant_turn() -> None:
    """A direction fixed in the body turns heading and track by the same angle every step, in one plane."""
    world = World()
    world.reset()
    angle = math.radians(20.0)
    turns, before = [], np.array([1.0, 0.0, 0.0])
    for _ in range(30):
        f = axes(world.poses)[0, :, 0]
        poses = world.step(Rotation.from_euler("z", angle).apply(f), 1.0)
        after = axes(poses)[0, :, 0]
        turns.append(math.atan2(np.cross(before, after)[2], before @ after))
        before = after
    expected = math.atan2(0.35 * math.sin(angle), 0.65 + 0.35 * math.cos(angle))
    np.testing.assert_allclose(turns, expected, atol=1e-12)
    assert abs(poses.position[0, 2]) < 1e-12
    np.testing.assert_allclose(axes(poses)[0, :, 2], [0.0, 0.0, 1.0], atol=1e-12)


def test_the_frame_stays_orthonormal_over_10000_random_steps() -> None:
    """No drift of the quaternion's length, no NaN, whatever is commanded, straight back included."""
    world = World(lanes=4)
    world.reset()
    rng = np.random.default_rng(2)
    for k in range(10_000):
        d = rng.normal(size=(4, 3))
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        if k % 50 == 0:
            d = -axes(world.poses)[:, :, 0]
        world.step(d, rng.uniform(0.0, 2.0, 4))
    assert np.isfinite(world.poses.raw[:, :14]).all()
    np.testing.assert_allclose(np.linalg.norm(world.poses.quaternion, axis=1), 1.0, atol=1e-14)


def test_the_frame_is_carried_by_the_smallest_rotation() -> None:
    """The rotation of a step has no part about the heading: nothing rolls."""
    world = World(lanes=16)
    world.resets.quaternion[:] = Rotation.random(16, random_state=1).as_quat()
    world.reset()
    rng = np.random.default_rng(3)
    for _ in range(20):
        before = axes(world.poses)
        d = rng.normal(size=(16, 3))
        after = axes(world.step(d / np.linalg.norm(d, axis=1, keepdims=True), 1.0))
        turn = Rotation.from_matrix(after @ before.transpose(0, 2, 1)).as_rotvec()
        np.testing.assert_allclose(np.einsum("ij,ij->i", turn, before[:, :, 0]), 0.0, atol=1e-9)
        np.testing.assert_allclose(np.einsum("ij,ij->i", turn, after[:, :, 0]), 0.0, atol=1e-9)


def test_vertical_flight_has_no_special_direction() -> None:
    """From level through the vertical and over the top, the frame turns by small steps all the way."""
    world = World()
    world.reset()
    for k in range(120):
        before = axes(world.poses)[0]
        a = math.radians(3.0 * k)
        after = axes(world.step([math.cos(a), 0.0, math.sin(a)], 1.0))[0]
        assert np.trace(after @ before.T) > 1.0 + 2.0 * math.cos(math.radians(3.5))
        np.testing.assert_allclose(after[:, 1], [0.0, 1.0, 0.0], atol=1e-12)


def test_a_full_blend_takes_the_commanded_heading_at_once() -> None:
    """Blend 1 obeys in one step, straight back too."""
    world = World(settings=Settings(motion=MotionSettings(heading_blend=1.0, speed_blend=1.0)))
    world.reset()
    poses = world.step([-1.0, 0.0, 0.0], 1.5)
    np.testing.assert_allclose(axes(poses)[0, :, 0], [-1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(poses.linear_velocity[0], [-1.5, 0.0, 0.0], atol=1e-12)


def test_shares_hold_for_the_default_step_and_scale_with_time() -> None:
    """Two steps of half the length blend the speed as far as one whole step."""
    whole, half = World(dt=0.1), World(dt=0.05)
    for world in (whole, half):
        world.reset()
    whole.step([1.0, 0.0, 0.0], 2.0)
    half.step([1.0, 0.0, 0.0], 2.0)
    half.step([1.0, 0.0, 0.0], 2.0)
    assert half.poses.linear_velocity[0, 0] == pytest.approx(whole.poses.linear_velocity[0, 0])


def test_reset_takes_the_whole_state_of_the_selected_lanes_alone() -> None:
    """Pose and velocity come back exactly as sent, time and step start anew, other lanes are not disturbed."""
    world = World(lanes=2)
    world.reset()
    world.step([1.0, 0.0, 0.0], 1.0)
    other = world.poses.raw[0].copy()
    world.resets.selected[:] = [0, 1]
    world.resets.position[:] = [7.0, 8.0, 9.0]
    world.resets.quaternion[:] = Rotation.random(2, random_state=9).as_quat()
    world.resets.linear_velocity[:] = [0.1, 0.2, 0.3]
    world.resets.angular_velocity[:] = [0.4, 0.5, 0.6]
    world.reset()
    np.testing.assert_array_equal(world.poses.raw[0], other)
    np.testing.assert_array_equal(world.poses.raw[1, :13], world.resets.raw[1, :13])
    assert (world.poses.step[1], world.poses.sim_time[1]) == (0, 0.0)
    world.step([1.0, 0.0, 0.0], 1.0)
    np.testing.assert_array_equal(world.poses.step, [2, 1])


def test_lanes_do_not_depend_on_the_batch() -> None:
    """Three lanes are bit for bit three runs of one lane."""
    rng = np.random.default_rng(5)
    directions = rng.normal(size=(50, 3, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    together = World(lanes=3)
    together.resets.quaternion[:] = Rotation.random(3, random_state=6).as_quat()
    together.reset()
    alone = [World() for _ in range(3)]
    for i, world in enumerate(alone):
        world.resets.quaternion[0] = together.resets.quaternion[i]
        world.reset()
    for d in directions:
        together.step(d, [0.5, 1.0, 2.0])
        for i, world in enumerate(alone):
            world.step(d[i], [0.5, 1.0, 2.0][i])
            np.testing.assert_array_equal(world.poses.raw[0], together.poses.raw[i])


def test_it_describes_itself_with_a_default_for_every_parameter() -> None:
    """The fastest command is the fastest level; tubes are accepted without being read."""
    plant = KinematicPlant()
    description = plant.describe()
    assert description.speed_max == 2.0
    assert len(description.defaults) == len(PARAMETERS)
    plant.open(1, 0.1, 0.1, 1)
    plant.register_tube(0, TubeReference("no/such/file.obj", "zup", 1.0, "0" * 64))
    plant.release_tube(0)
    plant.close()
    plant.close()
