"""Resets are a clean slate, lanes are worlds of their own, and a refused request changes nothing."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from protocol.errors import Refusal

LIMP = {"force_gain": 0.0, "torque_kp": 0.0, "torque_kd": 0.0}
"""No commanded force or torque."""
START = {
    "position": (1.0, 0.2, -0.1),
    "quaternion": (0.1, -0.2, 0.3, np.sqrt(1 - 0.14)),
    "omega": (0.3, 0.2, -1),
}


def crooked_flight(world: Any, lane: int, steps: int, seed: int) -> np.ndarray:
    """Fly at random directions for a while, hitting the wall again and again; the lane's pose rows."""
    random = np.random.default_rng(seed)
    rows = []
    for _ in range(steps):
        direction = random.normal(size=3) * [1, 2, 2]
        world.command(tuple(direction / np.linalg.norm(direction)), random.uniform(0, 4), 0.9, lane=lane)
        rows.append(world.step()[0, lane])
    return np.array(rows)


@pytest.fixture(params=[524_288, 900], ids=["one piece", "many pieces"])
def pieces(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run with a wall in one shape and with one in many."""
    monkeypatch.setattr("physics_server.bullet.INDICES_MAX", request.param)


@pytest.mark.usefixtures("pieces")
def test_an_episode_after_others_is_the_episode_alone(
    rig: Callable[..., Any], tube_file: Callable[..., Any]
) -> None:
    """Episode k after episodes with contacts, other tubes, other parameters and none is bit-identical to k alone."""
    wide, narrow = tube_file(), tube_file(radius=0.6, sides=20)

    def opened() -> Any:
        world = rig()
        world.plant.register_tube(0, wide)
        world.plant.register_tube(1, narrow)
        return world

    def episode(world: Any) -> np.ndarray:
        world.reset(tube=0, seed=5, gust=0.5, restitution=0.7, **START)
        return np.vstack([world.poses.raw.copy(), crooked_flight(world, 0, 60, seed=1)])

    alone = episode(opened())
    assert alone.view(np.int64)[:, 14].any(), "the episode is meant to touch the wall"

    world = opened()
    assert np.array_equal(episode(world), alone)
    assert np.array_equal(episode(world), alone), "the same tube again, after an episode with contacts"
    world.reset(tube=0, position=(1, 0, -0.85), force_gain=0.0, restitution=0.0)
    world.step(3)
    assert world.poses.contact_steps[0] > 0
    assert np.array_equal(episode(world), alone), "after an episode that ended in contact"
    world.reset(
        tube=1, mass=3.0, inertia_x=0.1, body_radius=0.2, gravity=1.6, restitution=1.0, friction=2.0, gust=1.0
    )
    crooked_flight(world, 0, 20, seed=2)
    assert np.array_equal(episode(world), alone), "after another tube with other parameters"
    world.reset(velocity=(3, 2, 1), gravity=0.0)
    world.step(5)
    assert np.array_equal(episode(world), alone), "after free space"


def test_the_same_flight_twice_is_bit_identical(
    rig: Callable[..., Any], tube_file: Callable[..., Any]
) -> None:
    """Two plants given the same requests answer with the same bytes, contacts included."""
    reference = tube_file()
    flights = []
    for _ in range(2):
        world = rig()
        world.plant.register_tube(3, reference)
        world.reset(tube=3, **START)
        flights.append(crooked_flight(world, 0, 100, seed=3))
    assert np.array_equal(*flights)
    assert flights[0].view(np.int64)[:, 14].any()


def test_lanes_do_not_notice_each_other(rig: Callable[..., Any], tube_file: Callable[..., Any]) -> None:
    """Each of four lanes, in tubes of their own or none, flies as it would alone, while others are reset."""
    tubes = [tube_file(), tube_file(radius=0.7)]

    def opened(lanes: int) -> Any:
        world = rig(lanes)
        for index, tube in enumerate(tubes):
            world.plant.register_tube(index, tube)
        return world

    def settings(lane: int) -> dict[str, Any]:
        return {"tube": (0, 1, 0, -1)[lane], "seed": lane, "gust": 1.0, "mass": 1.0 + lane, **START}

    alone = []
    for lane in range(4):
        world = opened(1)
        world.reset(**settings(lane))
        alone.append(world.step(40)[:, 0])
    assert alone[0].view(np.int64)[:, 14].any()

    world = opened(4)
    for lane in range(4):
        world.set(lane, **settings(lane))
    world.plant.reset(world.resets, world.poses)
    first = world.step(15)
    before = world.poses.raw.copy()
    world.reset(2, **settings(2))
    assert np.array_equal(world.poses.raw[[0, 1, 3]], before[[0, 1, 3]]), "a reset writes its own rows alone"
    second = world.step(25)
    for lane in (0, 1, 3):
        assert np.array_equal(np.concatenate([first, second])[:, lane], alone[lane]), lane
    assert np.array_equal(first[:, 2], alone[2][:15])
    assert np.array_equal(second[:, 2], alone[2][:25]), "the lane that was reset begins anew"


def test_sixty_four_lanes_share_one_tube(rig: Callable[..., Any], tube_file: Callable[..., Any]) -> None:
    """64 lanes in one tube fly alike where they are told alike."""
    world = rig(64)
    world.plant.register_tube(0, tube_file())
    for lane in range(64):
        world.set(lane, tube=0, **START)
    world.plant.reset(world.resets, world.poses)
    rows = world.step(15)
    assert rows.view(np.int64)[:, 0, 14].any()
    assert (rows == rows[:, :1]).all()


def test_a_tube_is_registered_between_steps_unnoticed(
    rig: Callable[..., Any], tube_file: Callable[..., Any]
) -> None:
    """A tube that comes, or goes and comes back as another, between two steps changes nothing for who flies."""
    first, second = tube_file(), tube_file(radius=0.5)
    flights = []
    for disturbed in (False, True):
        world = rig()
        world.plant.register_tube(0, first)
        world.reset(tube=0, **START)
        rows = [world.step(10)]
        if disturbed:
            world.plant.register_tube(1, first)
            world.plant.release_tube(1)
            world.plant.register_tube(1, second)
        flights.append(np.concatenate([*rows, world.step(30)]))
    assert np.array_equal(*flights)
    world.reset(tube=1, position=(5, 0, 0), force_gain=0.0)
    assert world.step(10)[-1, 0, 2] == pytest.approx(-0.35, abs=5e-3), "the other tube's floor"


def test_another_file_than_the_agents_is_refused(
    rig: Callable[..., Any], tube_file: Callable[..., Any]
) -> None:
    """A mesh that changed since the agent read it is refused with both hashes."""
    tube = tube_file()
    with Path(tube.path).open("a") as file:
        file.write("# one more line\n")
    with pytest.raises(Refusal, match=f"sha256: expected {tube.sha256}.* found [0-9a-f]{{64}}"):
        rig().plant.register_tube(0, tube)


@pytest.mark.parametrize("content", [None, b"", b"v 0 0 0\n", b"\x00\xff\x13"])
def test_an_unreadable_mesh_is_refused(
    rig: Callable[..., Any], tube_file: Callable[..., Any], tmp_path: Path, content: bytes | None
) -> None:
    """A missing file, an empty one, one without faces and one that is no mesh are refused by name."""
    path = tmp_path / "nothing.obj"
    if content is not None:
        path.write_bytes(content)
    reference = dataclasses.replace(tube_file(), path=str(path))
    with pytest.raises(Refusal, match=f"expected a readable mesh at {path}"):
        rig().plant.register_tube(0, reference)


def test_the_wall_is_checked_past_the_drone_itself(
    rig: Callable[..., Any], tube_file: Callable[..., Any]
) -> None:
    """A reset in the same tube, to where the drone stands or near it, sees the wall and not the drone."""
    world = rig()
    world.plant.register_tube(0, tube_file())
    for offset in (0.0, 0.0, 0.1, 0.25):
        world.reset(tube=0, position=(5, 0, offset), **LIMP)
        assert not world.step()[0, 0, 10:13].any()


def test_a_refused_reset_moves_no_lane(
    rig: Callable[..., Any], tube_file: Callable[..., Any], fill_tubes: Callable[..., Any]
) -> None:
    """Where the wall of one lane's new tube is refused, all lanes fly on as if nothing had been asked."""
    tubes = [tube_file(), tube_file(radius=0.8)]
    flights = []
    for refused in (False, True):
        world = rig(2)
        for index, tube in enumerate(tubes):
            world.plant.register_tube(index, tube)
        world.set(0, tube=0, **START)
        world.set(1, tube=0, **START)
        world.plant.reset(world.resets, world.poses)
        rows = [world.step(10)]
        if refused:
            world.set(0, tube=0, position=(9, 0, 0))
            world.set(1, tube=1, position=(9, 0, 0))
            with fill_tubes(), pytest.raises(Refusal, match="wall in lane 1"):
                world.plant.reset(world.resets, world.poses)
        flights.append(np.concatenate([*rows, world.step(30)]))
    assert np.array_equal(*flights)
