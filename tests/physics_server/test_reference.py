"""The batched rigid body against Bullet on the same commands, and what it owes its lanes (more: test_motion.py).

Measured over 24 lanes and 100 control steps: positions are Bullet's within 6e-15 m, attitudes within 7e-15,
angular velocities within 6e-14 rad/s. The bounds leave room for another machine's sine.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from physics_server.bullet import BulletPlant
from physics_server.parameters import BodyParameters
from physics_server.reference import ReferencePlant
from protocol.agent import SessionSettings
from protocol.errors import Refusal
from protocol.plant import CommandBatch, Plant, PoseBatch, ResetBatch, TubeReference
from protocol.twin import open_twin

Floats = NDArray[np.float64]
STEPS = 100


def bodies() -> list[BodyParameters]:
    """Slow and quick, pushed along command and body, with and without gusts, of equal and unequal moments."""
    return [
        BodyParameters(
            force_gain=gain,
            force_along_body=along,
            gust=gust,
            inertia_x=moments[0],
            inertia_y=moments[1],
            inertia_z=moments[2],
            linear_drag=0.1,
            angular_drag=1e-3,
            disturbance_y=0.2,
        )
        for gain, along, gust, moments in itertools.product(
            (1.5, 2.0, 8.0), (0.0, 1.0), (0.0, 0.5), ((0.004, 0.004, 0.004), (0.002, 0.004, 0.006))
        )
    ]


def flight(bodies: list[BodyParameters], steps: int = STEPS) -> tuple[ResetBatch, list[CommandBatch]]:
    """Tumbling starts, and commands whose directions swing and whose speeds and compensations change."""
    lanes, rng = len(bodies), np.random.default_rng(5)
    resets = ResetBatch.zeros(lanes)
    resets.selected[:] = 1
    resets.seed[:] = rng.integers(-(2**62), 2**62, lanes)
    resets.position[:] = rng.normal(size=(lanes, 3))
    resets.quaternion[:] = unit(rng.normal(size=(lanes, 4)))
    resets.linear_velocity[:] = rng.normal(size=(lanes, 3))
    resets.angular_velocity[:] = rng.normal(size=(lanes, 3))
    for lane, body in enumerate(bodies):
        row = body.row()
        resets.parameters[lane, : len(row)] = row
    commands, swing = [], rng.normal(size=(lanes, 3))
    for _ in range(steps):
        swing = 0.8 * swing + 0.6 * rng.normal(size=(lanes, 3))
        command = CommandBatch.zeros(lanes)
        command.direction[:] = unit(swing)
        command.speed[:] = rng.uniform(0.5, 2.0, lanes)
        command.compensation[:] = rng.uniform(0.8, 1.05, lanes)
        commands.append(command)
    return resets, commands


def unit(vectors: Floats) -> Floats:
    """Rows of length 1."""
    rows: Floats = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return rows


def fly(plant: Plant, resets: ResetBatch, commands: list[CommandBatch], lanes: slice = slice(None)) -> Floats:
    """The pose rows (steps + 1, N, 16) of some lanes of a flight, through a session."""
    mine = ResetBatch(resets.raw[lanes].copy())
    settings = SessionSettings(lanes=len(mine.raw), dt=0.1, physics_dt=1 / 240)
    with open_twin(plant, settings) as session:
        rows = [session.reset(mine).raw.copy()]
        rows += [session.step(CommandBatch(command.raw[lanes].copy())).raw.copy() for command in commands]
    return np.array(rows)


def test_it_follows_bullet_on_the_same_commands() -> None:
    """Over 10 s of swinging commands every pose and velocity is Bullet's to rounding; nothing is ever touched."""
    resets, commands = flight(bodies())
    bullet, reference = (fly(plant, resets, commands) for plant in (BulletPlant(), ReferencePlant()))
    # The flights are no small matter: bodies fly metres and turn fast.
    assert np.abs(reference[-1, :, :3] - reference[0, :, :3]).max() > 3.0
    assert np.abs(reference[:, :, 10:13]).max() > 3.0
    np.testing.assert_allclose(reference[..., :3], bullet[..., :3], rtol=0, atol=1e-13)
    np.testing.assert_allclose(reference[..., 7:10], bullet[..., 7:10], rtol=0, atol=1e-13)
    np.testing.assert_allclose(reference[..., 10:13], bullet[..., 10:13], rtol=0, atol=1e-12)
    sign = np.sign((reference[..., 3:7] * bullet[..., 3:7]).sum(-1, keepdims=True))
    np.testing.assert_allclose(sign * reference[..., 3:7], bullet[..., 3:7], rtol=0, atol=1e-13)
    assert np.array_equal(reference[..., 13:].view(np.int64), bullet[..., 13:].view(np.int64))
    assert not reference[..., 14].view(np.int64).any()


def test_lanes_are_independent_of_each_other_and_of_their_number() -> None:
    """Each lane flies alone, among some and among all the same flight bit for bit; and so it does twice."""
    resets, commands = flight(bodies(), steps=20)
    together = fly(ReferencePlant(), resets, commands)
    assert fly(ReferencePlant(), resets, commands).tobytes() == together.tobytes()
    for lanes in (slice(0, 1), slice(7, 8), slice(5, 18), slice(None, None, -1)):
        assert fly(ReferencePlant(), resets, commands, lanes).tobytes() == together[:, lanes].tobytes()


def test_a_reset_moves_no_other_lane() -> None:
    """Lanes that are not selected fly on as if nothing had been; the selected one begins anew, gusts and all."""
    resets, commands = flight(bodies()[:4], steps=10)
    undisturbed = fly(ReferencePlant(), resets, commands)
    plant, poses = ReferencePlant(), PoseBatch.zeros(4)
    plant.open(4, 0.1, 1 / 240, 24)
    plant.reset(resets, poses)
    for command in commands[:6]:
        plant.step(command, poses)
    resets.selected[:] = [0, 0, 1, 0]
    before = poses.raw.copy()
    plant.reset(resets, poses)
    assert np.array_equal(poses.raw[[0, 1, 3]], before[[0, 1, 3]])
    assert np.array_equal(poses.raw[2, :13], resets.raw[2, :13])
    for again, command in zip(commands, commands[6:], strict=False):
        command.raw[2] = again.raw[2]
        plant.step(command, poses)
    assert poses.step.tolist() == [10, 10, 4, 10]
    expected = np.where(poses.step[:, None] == 10, undisturbed[10], undisturbed[4])
    assert poses.raw.tobytes() == expected.tobytes()


def test_it_refuses_walls_and_says_what_to_do(rig: Callable[..., Any]) -> None:
    """A tube is not taken, and a reset into one moves no lane; the message names the two ways out."""
    world = rig(lanes=2, plant=ReferencePlant)
    way_out = "no walls .*NO_TUBE.*clearance.*--engine bullet.*found"
    with pytest.raises(Refusal, match=f"{way_out} bend.obj"):
        world.plant.register_tube(0, TubeReference("bend.obj", "zup", 1.0, ""))
    world.set(0)
    world.set(1)
    world.plant.reset(world.resets, world.poses)
    world.command((0, 1, 0), speed=1.0, compensation=1.0)
    world.set(0, position=(9, 9, 9))
    world.set(1, position=(9, 9, 9), tube=3)
    with pytest.raises(Refusal, match=f"lane 1.*{way_out} index 3"):
        world.plant.reset(world.resets, world.poses)
    assert np.abs(world.step()[-1, :, :3]).max() < 0.1


def test_it_says_what_it_is() -> None:
    """The description names the engine with its version, and the defaults and speeds are the Bullet server's."""
    reference, bullet = ReferencePlant().describe(), BulletPlant().describe()
    assert reference.engine == "reference 1"
    assert (reference.defaults, reference.speed_max) == (bullet.defaults, bullet.speed_max)
