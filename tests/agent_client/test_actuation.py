"""Delays and near-wall air on the way of a command to the plant."""

from __future__ import annotations

import numpy as np
import pytest

from agent_client.actuation import CommandPath
from agent_client.conditions import DELAY_MAX, NEAR_WALL_REACH, Conditions, draw_conditions
from agent_client.episodes import episode_dtype
from agent_client.task import TaskStep
from protocol.plant import CommandBatch

LANES = 5
SPEED_MAX = 2.0


def drawn_of(name: str, values: list[float]) -> np.ndarray:
    """Conditions with one of them as given, lane by lane."""
    return np.concatenate([draw_conditions(Conditions().with_ranges({name: (v, v)}), [(0,)]) for v in values])


def state(lanes: int = LANES, gap: float = 1.0) -> TaskStep:
    """Drones that look along world y, with so much room between body and wall."""
    step = TaskStep.over(np.zeros(lanes, episode_dtype(4)))
    step.frame[:] = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    step.axis.radius[:] = 1.0
    step.episodes["body_radius"] = 0.15
    step.axis.radial_distance[:] = 1.0 - 0.15 - gap
    step.episodes["noise_seed"] = np.arange(lanes)
    return step


def commands_of(number: int, lanes: int = LANES) -> CommandBatch:
    """Commands that differ from step to step and from lane to lane."""
    commands = CommandBatch.zeros(lanes)
    angle = 0.1 * number + np.arange(lanes)
    commands.direction[:] = np.stack([np.cos(angle), np.sin(angle), np.zeros(lanes)], axis=1)
    commands.speed[:] = 0.5 + 0.01 * number
    commands.compensation[:] = 0.9
    return commands


def test_without_delay_and_air_the_commands_go_through_as_they_are() -> None:
    """The plant gets the very same batch."""
    path, step, commands = CommandPath(LANES, SPEED_MAX), state(), commands_of(1)
    path.begin(np.arange(LANES), drawn_of("action_delay", [0] * LANES), step, commands)
    assert path.send(commands, step) is commands


def test_the_plant_gets_the_command_of_so_many_steps_ago() -> None:
    """Until the first one arrives it is told not to move, looking ahead, under the episode's compensation."""
    delays = [0, 1, 2, 5, DELAY_MAX]
    path, step, commands = CommandPath(LANES, SPEED_MAX), state(), CommandBatch.zeros(LANES)
    path.begin(np.arange(LANES), drawn_of("action_delay", delays), step, commands)
    np.testing.assert_array_equal(commands.compensation, 0.9)
    for now in range(30):
        commands.raw[:] = commands_of(now).raw
        sent = path.send(commands, step)
        for lane, delay in enumerate(delays):
            if now >= delay:
                np.testing.assert_array_equal(sent.raw[lane], commands_of(now - delay).raw[lane])
            else:
                np.testing.assert_array_equal(sent.direction[lane], [0.0, 1.0, 0.0])
                assert sent.speed[lane] == 0.0
                assert sent.compensation[lane] == 0.9


def test_a_lane_that_begins_anew_waits_again_and_disturbs_no_other() -> None:
    """Commands of the episode before never arrive in the next; the other lanes' are still under way."""
    path, step = CommandPath(LANES, SPEED_MAX), state()
    path.begin(np.arange(LANES), drawn_of("action_delay", [2] * LANES), step, commands_of(0))
    for now in range(9):
        path.send(commands_of(now), step)
    path.begin(np.array([3]), drawn_of("action_delay", [1]), step, commands_of(9))
    sent = path.send(commands_of(9), step)
    assert sent.speed[3] == 0.0
    for lane in (0, 1, 2, 4):
        np.testing.assert_array_equal(sent.raw[lane], commands_of(7).raw[lane])
    np.testing.assert_array_equal(path.send(commands_of(10), step).raw[3], commands_of(9).raw[3])


def test_the_compensation_of_an_episode_is_written_for_its_lane_alone() -> None:
    """Beginning some lanes leaves the others' commands alone."""
    path, step, commands = CommandPath(LANES, SPEED_MAX), state(), CommandBatch.zeros(LANES)
    path.begin(np.array([1, 4]), drawn_of("compensation", [0.8, 1.05]), step, commands)
    np.testing.assert_array_equal(commands.compensation, [0.0, 0.8, 0.0, 0.0, 1.05])
    np.testing.assert_array_equal(np.delete(commands.raw, 4, axis=1), 0.0)


def air(amplitude: float, gap: float, lanes: int = 400, number: int = 3) -> np.ndarray:
    """What the air adds to the commanded velocities, (N, 3)."""
    path, step, commands = CommandPath(lanes, 100.0), state(lanes, gap), commands_of(1, lanes)
    step.step[:] = number
    path.begin(np.arange(lanes), drawn_of("near_wall", [amplitude]).repeat(lanes), step, commands)
    commands.raw[:] = commands_of(1, lanes).raw
    before = commands.direction * commands.speed[:, None]
    sent = path.send(commands, step)
    np.testing.assert_allclose(np.linalg.norm(sent.direction, axis=1), 1.0, atol=1e-12)
    np.testing.assert_array_equal(sent.compensation, 0.9)
    return sent.direction * sent.speed[:, None] - before


@pytest.mark.parametrize("gap", [NEAR_WALL_REACH, 0.7])
def test_away_from_the_wall_the_air_is_still(gap: float) -> None:
    """From a gap of 0.5 m on, commands are as they were."""
    np.testing.assert_allclose(air(0.5, gap), 0.0, atol=1e-15)


@pytest.mark.parametrize(("gap", "strength"), [(0.4, 0.2), (0.1, 0.8), (0.0, 1.0), (-0.3, 1.0)])
def test_the_air_is_even_in_a_cube_that_grows_towards_the_wall(gap: float, strength: float) -> None:
    """Each component is even within plus and minus the amplitude times 1 - gap / 0.5 m, no more at the wall."""
    blown = air(0.5, gap)
    bound = 0.5 * strength
    assert np.abs(blown).max() <= bound + 1e-12
    assert np.abs(blown).max() > 0.97 * bound
    assert np.abs(blown.mean(axis=0)).max() < 4.0 * bound / np.sqrt(3.0 * len(blown))
    np.testing.assert_allclose(blown.std(axis=0), bound / np.sqrt(3.0), rtol=0.12)


def test_the_air_depends_on_the_seed_and_the_step() -> None:
    """The same episode and step feel the same air in any lane; another step or seed another."""
    first = air(0.5, 0.1, lanes=6)
    np.testing.assert_array_equal(air(0.5, 0.1, lanes=3), first[:3])
    assert len({row.tobytes() for row in [*first, *air(0.5, 0.1, lanes=6, number=4)]}) == 12


def test_a_command_that_is_blown_about_stays_one_that_the_plant_takes() -> None:
    """The speed never passes the plant's largest; a lane that stands still is moved by the air."""
    path, step, commands = CommandPath(LANES, SPEED_MAX), state(gap=0.0), commands_of(1)
    path.begin(np.arange(LANES), drawn_of("near_wall", [10.0] * LANES), step, commands)
    commands.speed[:] = [2.0, 2.0, 2.0, 0.0, 0.0]
    sent = path.send(commands, step)
    np.testing.assert_allclose(np.linalg.norm(sent.direction, axis=1), 1.0, atol=1e-12)
    assert (sent.speed > 0.0).all()
    assert sent.speed.max() <= SPEED_MAX
