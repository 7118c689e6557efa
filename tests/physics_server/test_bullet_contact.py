"""Contacts of the sphere with the wall: when they are counted, how they bounce, and whatever the wall is cut into."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from physics_server.bullet_world import CONTACT_ERP
from physics_server.law import travel_bound
from physics_server.parameters import BodyParameters
from protocol.errors import Refusal

INNER = 1 / 240
LIMP = {"force_gain": 0.0, "torque_kp": 0.0, "torque_kd": 0.0}
FLOOR = -1.0 + 0.15
"""Height of the body's centre where it touches the floor of a tube of radius 1 (m)."""


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("start", [0.0, -0.31, 0.437])
def test_a_drop_touches_when_the_closed_form_says(
    rig: Callable[..., Any], tube_file: Callable[..., Any], inverted: bool, start: float
) -> None:
    """Contact is counted from the inner step that begins at or below the floor, for either winding."""
    world = rig()
    world.plant.register_tube(0, tube_file(inverted=inverted))
    world.reset(tube=0, position=(10.01, 0, start), restitution=0.0, **LIMP)
    n = np.arange(2000)
    height = start - 9.81 * INNER**2 * n * (n + 1) / 2
    first = int(np.argmax(height <= FLOOR))  # inner steps before the first that begins in contact
    rows = world.step(first // 24 + 3)
    touched = rows.view(np.int64)[:, 0, 14]
    assert not touched[: first // 24].any()
    # From there on it lies on the floor: with restitution 0 nearly every inner step is one of contact.
    assert 1 <= touched[first // 24] <= 24 - first % 24
    assert touched[first // 24 + 2] == 24


def test_the_first_contact_is_counted_to_the_inner_step(
    rig: Callable[..., Any], tube_file: Callable[..., Any]
) -> None:
    """With one inner step a control step, exactly the inner step that begins in contact is the first to count."""
    world = rig(inner_steps=1)
    world.plant.register_tube(0, tube_file())
    world.reset(tube=0, position=(10.01, 0, 0.2), **LIMP)
    rows = world.step(160)
    begins = np.concatenate([[0.2], rows[:-1, 0, 2]])  # height at the beginning of each inner step
    assert np.argmax(rows.view(np.int64)[:, 0, 14]) == np.argmax(begins <= FLOOR)


def test_a_body_at_rest_touches_in_every_inner_step(
    rig: Callable[..., Any], tube_file: Callable[..., Any]
) -> None:
    """A drone that lies on the floor is in contact in all inner steps, within a millimetre of the floor."""
    world = rig()
    world.plant.register_tube(0, tube_file())
    world.reset(tube=0, position=(10.01, 0, FLOOR + 0.01), **LIMP)
    rows = world.step(100)[-50:]
    assert (rows.view(np.int64)[:, 0, 14] == 24).all()
    np.testing.assert_allclose(rows[:, 0, 2], FLOOR, atol=1e-3)
    np.testing.assert_allclose(rows[:, 0, 7:10], 0, atol=1e-3)


def test_flight_along_the_axis_touches_nothing(
    rig: Callable[..., Any], tube_file: Callable[..., Any]
) -> None:
    """A drone that flies through the middle reports no contact at all, and leaves through the open end."""
    world = rig()
    world.plant.register_tube(0, tube_file())
    world.reset(tube=0, position=(1, 0, 0))
    world.command((1, 0, 0), speed=2.0, compensation=1.0)
    rows = world.step(120)
    assert not rows.view(np.int64)[:, 0, 14].any()
    assert rows[-1, 0, 0] > 20


@pytest.mark.parametrize("restitution", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("height", [0.1, 0.1037, 0.1068])
def test_a_bounce_has_the_restitution_of_the_parameters(
    rig: Callable[..., Any], tube_file: Callable[..., Any], restitution: float, height: float
) -> None:
    """The rebound is e times the speed of impact, and at most CONTACT_ERP of it more."""
    world = rig(inner_steps=1)
    world.plant.register_tube(0, tube_file())
    world.reset(
        tube=0, position=(10.01, 0, FLOOR + height), velocity=(0, 0, -2), gravity=0.0,
        restitution=restitution, **LIMP,
    )  # fmt: skip
    rebound = world.step(30)[-1, 0, 9]
    assert 2 * restitution - 1e-9 <= rebound <= 2 * (restitution + CONTACT_ERP)


@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_friction_slows_and_spins(
    rig: Callable[..., Any], tube_file: Callable[..., Any], friction: float
) -> None:
    """A body set down sliding keeps its speed without friction; with it, it loses mu g t, and rolls in the end.

    Rolling without slipping, angular momentum about the floor gives v = v_0 / (1 + I / (m r^2)).
    """
    world = rig()
    world.plant.register_tube(0, tube_file(sides=4, length=40.0, rings=3))
    world.reset(
        tube=0, position=(1, 0, FLOOR), velocity=(3, 0, 0), restitution=0.0, friction=friction, **LIMP
    )
    rows = world.step(60)[:, 0]
    if friction == 0.0:
        np.testing.assert_allclose(rows[:, 7], 3.0, rtol=1e-3)  # edges of triangles are felt by 1e-4
        return
    assert rows[0, 7] == pytest.approx(3 - friction * 9.81 * 0.1, rel=0.01)
    rolling = 3 / (1 + 0.004 / 0.15**2)
    assert rows[-1, 7] == pytest.approx(rolling, rel=0.01)
    assert rows[-1, 11] == pytest.approx(rolling / 0.15, rel=0.01)


def test_a_wall_in_pieces_is_the_same_wall(
    rig: Callable[..., Any], tube_file: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A wall that is split into many shapes stops the drone where the whole one does, all along the tube."""
    reference = tube_file()

    def heights(x: float) -> np.ndarray:
        world = rig()
        world.plant.register_tube(0, reference)
        world.reset(tube=0, position=(x, 0, -0.5), restitution=0.0, **LIMP)
        return world.step(15)[:, 0, 2]

    whole = {x: heights(x) for x in (0.6, 10.3, 19.4)}
    monkeypatch.setattr("physics_server.bullet.INDICES_MAX", 300)
    for x, expected in whole.items():
        np.testing.assert_allclose(heights(x), expected, atol=1e-3)


def test_a_wall_beyond_the_engines_limits_is_whole(
    rig: Callable[..., Any], tube_file: Callable[..., Any]
) -> None:
    """300,000 triangles of 150,000 vertices, more than one shape can take, still hold the drone everywhere."""
    world = rig()
    world.plant.register_tube(0, tube_file(sides=100, rings=1501, length=15.0))
    for x in (0.5, 7.5, 14.5):
        world.reset(tube=0, position=(x, 0.0, FLOOR + 0.05), **LIMP)
        assert world.step(20)[-1, 0, 2] == pytest.approx(FLOOR, abs=2e-3)


def test_a_fast_drone_does_not_pass_through_the_wall(
    rig: Callable[..., Any], tube_file: Callable[..., Any]
) -> None:
    """At the largest speed that may be commanded the drone stays inside and reports contact."""
    world = rig()
    world.plant.register_tube(0, tube_file())
    for direction in ((0.6, 0.8, 0.0), (0.6, 0.0, -0.8), (0.6, 0.48, 0.64)):
        world.reset(tube=0, position=(1, 0, 0))
        world.command(direction, speed=10.0, compensation=1.0)
        rows = world.step(25)
        assert np.hypot(rows[:, 0, 1], rows[:, 0, 2]).max() < 0.95
        assert rows.view(np.int64)[:, 0, 14].any()


def test_a_solid_tube_is_refused(
    rig: Callable[..., Any], tube_file: Callable[..., Any], fill_tubes: Callable[..., Any]
) -> None:
    """Where the engine takes the tube's convex hull its rays find no wall: the reset says both medians."""
    world = rig()
    world.plant.register_tube(0, tube_file())
    with (
        fill_tubes(),
        pytest.raises(
            Refusal, match=r"wall in lane 0: expected a median of 1\.00\d\d m.*found .* m by the engine"
        ),
    ):
        world.reset(tube=0, position=(5, 0, 0))


def test_contacts_are_the_same_whether_they_are_watched_all_the_time_or_not(
    rig: Callable[..., Any], tube_file: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A drone that is thrown about between the walls: every word of every pose agrees, contact counts too."""
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    flights = []
    for always in (False, True):
        if always:
            monkeypatch.setattr("physics_server.bullet_world.World.far_from_wall", lambda *_: False)
        world = rig()
        world.plant.register_tube(0, tube_file())
        world.reset(tube=0, position=(10.0, 0, 0), gust=3.0, seed=5)
        rows = []
        for x, y, z in directions:
            world.command((x, y, z), speed=4.0, compensation=0.9)
            rows.append(world.step(1)[0])
        flights.append(np.array(rows))
    assert np.array_equal(flights[0], flights[1])
    contacts = flights[0].view(np.int64)[:, 0, 14]
    assert (contacts > 0).sum() > 10
    assert (contacts == 0).sum() > 100


def test_no_flight_gets_further_than_its_bound(rig: Callable[..., Any]) -> None:
    """In free space, under any command and force, a control step's way stays within what was computed before it."""
    rng = np.random.default_rng(4)
    for _ in range(40):
        body = BodyParameters(
            mass=rng.uniform(0.3, 3.0), force_gain=rng.uniform(0.0, 20.0), linear_drag=rng.uniform(0.0, 2.0),
            disturbance_x=rng.normal(), disturbance_z=rng.normal(), gravity=rng.uniform(-5.0, 12.0),
        )  # fmt: skip
        velocity = tuple(rng.normal(size=3) * 2.0)
        direction = rng.normal(size=3)
        speed, compensation = rng.uniform(0.0, 5.0), rng.uniform(0.0, 2.0)
        world = rig()
        world.reset(velocity=velocity, **asdict(body))
        world.command(tuple(direction / np.linalg.norm(direction)), speed, compensation)
        bound = travel_bound(body, velocity, speed, compensation, (0.0, 0.0, 0.0), INNER, 24)
        assert np.linalg.norm(world.step(1)[0, 0, :3]) <= bound
