"""The toy plant against closed forms of annex A."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from protocol.agent import AgentSession, SessionSettings
from protocol.errors import PeerLost, Refusal, Verdict
from protocol.plant import CommandBatch, ResetBatch
from protocol.toy import ToyPlant
from protocol.twin import open_twin

Resets = Callable[..., ResetBatch]
Commands = Callable[..., CommandBatch]
FREE = {"force_gain": 0.0, "torque_kp": 0.0, "torque_kd": 0.0}


@pytest.fixture
def session() -> Iterator[AgentSession]:
    """One lane, control steps of 0.1 s, fine inner steps."""
    with open_twin(ToyPlant(), SessionSettings(1, 0.1, 0.1 / 400)) as session:
        yield session


def fly(session: AgentSession, resets: ResetBatch, commands: CommandBatch, steps: int) -> np.ndarray:
    """Fly and return the last pose row."""
    session.reset(resets)
    for _ in range(steps):
        poses = session.step(commands)
    return poses.raw[0].copy()


def test_hover(session: AgentSession, resets: Resets, commands: Commands) -> None:
    """c = 1 holds a body still exactly, without any gain."""
    pose = fly(session, resets(**FREE), commands(speed=0.0), 10)
    assert pose[:3].tolist() == [0.0, 0.0, 0.0]


def test_speed_is_approached_exponentially(session: AgentSession, resets: Resets, commands: Commands) -> None:
    """V = v_cmd (1 - exp(-k_v t)) along the command, whatever the mass."""
    pose = fly(session, resets(force_gain=2.0, mass=3.0), commands(speed=1.5), 10)
    assert pose[7] == pytest.approx(1.5 * (1 - math.exp(-2.0)), rel=1e-3)
    assert pose[8:10].tolist() == [0.0, 0.0]


def test_drag_and_disturbance_balance(session: AgentSession, resets: Resets, commands: Commands) -> None:
    """A constant force against linear drag ends at F / drag."""
    start = resets(**FREE, linear_drag=4.0, disturbance_y=2.0)
    assert fly(session, start, commands(), 40)[8] == pytest.approx(0.5, rel=1e-6)


def test_torque_free_rotation_keeps_energy_and_momentum(
    session: AgentSession, resets: Resets, commands: Commands
) -> None:
    """Without torque the world angular momentum and the energy of a tumbling body stay, to first order in h."""
    inertia = np.array([0.01, 0.02, 0.03])
    start = resets(**FREE, inertia_x=0.01, inertia_y=0.02, inertia_z=0.03)
    start.angular_velocity[:] = [1.0, 2.0, 0.5]
    pose = fly(session, start, commands(), 10)
    x, y, z, w = pose[3:7]
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    body = matrix.T @ pose[10:13]
    assert matrix @ (inertia * body) == pytest.approx(inertia * [1.0, 2.0, 0.5], abs=2e-4)
    assert inertia @ body**2 == pytest.approx(inertia @ np.array([1.0, 4.0, 0.25]), rel=2e-3)


def test_the_body_turns_towards_the_direction_and_compensation_does_not_tilt_it(
    session: AgentSession, resets: Resets, commands: Commands
) -> None:
    """The torque aligns the body's x axis with d, for any c, and the quaternion agrees with the turn."""
    turned = []
    for compensation in (0.0, 2.0):
        batch = commands(compensation=compensation)
        batch.direction[:] = [0.0, 1.0, 0.0]
        turned.append(fly(session, resets(), batch, 20)[3:7])
    assert turned[0].tolist() == turned[1].tolist()
    assert turned[0] == pytest.approx([0, 0, math.sqrt(0.5), math.sqrt(0.5)], abs=1e-6)


def test_force_along_the_body_axis(session: AgentSession, resets: Resets, commands: Commands) -> None:
    """With force_along_body the force follows the body's x axis and not the direction."""
    batch = commands(speed=1.0)
    batch.direction[:] = [0.0, 1.0, 0.0]
    pose = fly(session, resets(force_along_body=1.0, torque_kp=0.0), batch, 20)
    assert pose[7:10] == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)


def test_it_has_no_gusts(session: AgentSession, resets: Resets) -> None:
    """What the toy cannot do it refuses."""
    with pytest.raises(Refusal, match="gust in lane 0"):
        session.reset(resets(gust=1.0))


def test_a_state_that_is_no_longer_finite_ends_the_session(
    session: AgentSession, resets: Resets, commands: Commands
) -> None:
    """A body too fast for its words is an error of the plant's, never a pose."""
    start = resets(force_gain=0.0)
    start.linear_velocity[:], start.position[:] = 1e308, 1.7e308
    session.reset(start)
    with pytest.raises(PeerLost, match="lane 0, control step 1: expected a finite state") as caught:
        session.step(commands())
    assert caught.value.verdict is Verdict.FAILED
