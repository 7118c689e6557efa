"""The inference loop, through the in-process twin and the kinematic world."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from agent_client.conditions import HARD, Conditions, draw_conditions
from agent_client.controllers import CONTINUOUS, Controller, PolicyController, PurePursuit
from agent_client.flight import PHASES, FlightResult, FlightStep, fly
from agent_client.kinematic import KinematicPlant
from agent_client.lidar_rule import LidarRule
from agent_client.settings import ActionSettings, Settings, StartSettings
from agent_client.task import Outcome, TaskStep
from meshes.curves import generate_curve
from meshes.swept import circular
from meshes.swept_geometry import SweptGeometry
from protocol.agent import SessionSettings
from protocol.errors import Refusal
from protocol.plant import CommandBatch
from protocol.twin import open_twin

Maker = Callable[..., Any]


class Follower:
    """A policy that looks at the target's direction: any rule that uses the observation."""

    entropies = math.nan

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Straight, right, left, up or down, at the fastest speed."""
        up, right = observations[:, 25], observations[:, 26]
        sideways = np.where(np.abs(right) < 0.1, 0, np.where(right > 0, 1, 2))
        upward = np.where(np.abs(up) < 0.1, 0, np.where(up > 0, 3, 4))
        return 4 * np.where(sideways > 0, sideways, upward) + 3


class Seen:
    """Copies of what `on_step` was shown."""

    def __init__(self) -> None:
        self.index: list[int] = []
        self.arrays: list[dict[str, np.ndarray]] = []

    def __call__(self, step: FlightStep) -> None:
        """Keep a copy."""
        self.index.append(step.index)
        self.arrays.append(
            {
                "command": step.command.copy(), "pose": step.pose.copy(), "actions": step.actions.copy(),
                "observation": step.task.observation.copy(), "reward": step.task.reward.copy(),
                "terms": step.task.reward_terms.copy(), "outcome": step.task.outcome.copy(),
                "lidar": step.task.lidar.copy(), "phases": step.phases.copy(), "step": step.task.step.copy(),
            }
        )  # fmt: skip


def flight(
    geometry: Any, controller: Controller, settings: Settings | None = None, dt: float = 0.1, **options: Any
) -> FlightResult:
    """Fly through the kinematic twin."""
    settings = settings or Settings()
    options = {"seeds": range(geometry.lanes), "clearance_contact": True, **options}
    with open_twin(KinematicPlant(settings), SessionSettings(geometry.lanes, dt, dt)) as session:
        return fly(session, geometry, controller, settings, **options)


@pytest.mark.parametrize("lookahead", [0.5, 1.0, 2.0])
def test_pure_pursuit_flies_a_cylinder(cylinder: Maker, lookahead: float) -> None:
    """20 m in about 20 m / (2 m/s x 0.1 s) steps, close to the axis all the way after the start."""
    tube = cylinder(lanes=8)
    result = flight(tube, PurePursuit(tube, Settings(), lookahead=lookahead))
    assert result.outcome == (Outcome.SUCCESS,) * 8
    assert (result.contacts == 0).all()
    assert result.steps.max() <= 100
    assert (result.quality > 0.97).all()
    np.testing.assert_allclose(result.progress, 0.98, atol=0.01)
    np.testing.assert_allclose(result.sim_time, 0.1 * result.steps)


@pytest.mark.parametrize(("bend_radius", "clearance"), [(3.0, 0.6), (1.7, 0.45)])
def test_pure_pursuit_flies_bends(bend: Maker, bend_radius: float, clearance: float) -> None:
    """A torus as tight as the tightest generated tube, at the fastest speed, well clear of the wall."""
    tube = bend(lanes=8, bend=bend_radius, length=1.5 * np.pi * bend_radius)
    result = flight(tube, PurePursuit(tube, Settings()))
    assert result.outcome == (Outcome.SUCCESS,) * 8
    assert result.min_clearance.min() > clearance


def test_a_policy_flies_by_what_it_observes(cylinder: Maker) -> None:
    """A rule on the target's direction alone gets through a straight tube."""
    settings = Settings()
    result = flight(cylinder(lanes=4), PolicyController(Follower(), settings), settings)
    assert result.outcome == (Outcome.SUCCESS,) * 4


@pytest.mark.parametrize("policy", [True, False])
def test_lanes_do_not_depend_on_the_batch(cylinder: Maker, policy: bool) -> None:
    """Three lanes in one flight give, bit for bit, what three flights of one lane give."""
    settings = Settings()

    def run(seeds: list[int]) -> tuple[FlightResult, Seen]:
        tube, seen = cylinder(lanes=len(seeds)), Seen()
        controller = PolicyController(Follower(), settings) if policy else PurePursuit(tube, settings)
        return flight(tube, controller, settings, seeds=seeds, on_step=seen), seen

    together, seen_together = run([1, 2, 3])
    for lane, seed in enumerate([1, 2, 3]):
        alone, seen = run([seed])
        assert alone.steps[0] == together.steps[lane]
        for one, all_lanes in zip(seen.arrays, seen_together.arrays, strict=False):
            for name in ("command", "pose", "actions", "observation", "reward", "terms", "lidar"):
                np.testing.assert_array_equal(one[name][0], all_lanes[name][lane], err_msg=name)


def test_lanes_in_swept_tubes_do_not_depend_on_the_batch() -> None:
    """The same with compiled geometry and a bend in every tube."""
    settings = Settings()
    tubes = [circular(generate_curve(2, [seed], 8.0)) for seed in range(3)]

    def run(lanes: list[int]) -> tuple[FlightResult, Seen]:
        tube, seen = SweptGeometry([tubes[lane] for lane in lanes], len(lanes)), Seen()
        return flight(tube, PurePursuit(tube, settings), settings, seeds=lanes, on_step=seen), seen

    together, seen_together = run([0, 1, 2])
    assert together.outcome == (Outcome.SUCCESS,) * 3
    for lane in range(3):
        _, seen = run([lane])
        for one, all_lanes in zip(seen.arrays, seen_together.arrays, strict=False):
            for name in ("pose", "observation", "reward", "lidar"):
                np.testing.assert_array_equal(one[name][0], all_lanes[name][lane], err_msg=name)


def test_the_same_seed_gives_the_same_flight(cylinder: Maker) -> None:
    """And another one gives another."""
    runs = []
    for seed in (4, 4, 5):
        tube, seen = cylinder(), Seen()
        flight(tube, PurePursuit(tube, Settings()), seeds=[seed], on_step=seen)
        runs.append(np.concatenate([a["pose"].ravel() for a in seen.arrays]))
    np.testing.assert_array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0][:16], runs[2][:16])


def test_on_step_sees_the_reset_and_every_control_step(cylinder: Maker) -> None:
    """Index 0 is the reset with a zero command; command k stands beside the pose that answered it."""
    tube, seen = cylinder(), Seen()
    result = flight(tube, PurePursuit(tube, Settings()), on_step=seen)
    assert seen.index == list(range(result.control_steps + 1))
    first, second, last = seen.arrays[0], seen.arrays[1], seen.arrays[-1]
    assert (first["command"] == 0.0).all()
    assert (first["phases"] == 0).all()
    assert first["outcome"][0] == Outcome.RUNNING
    assert first["pose"].view(np.int64)[0, 15] == 0
    assert second["pose"].view(np.int64)[0, 15] == 1
    assert second["actions"][0] == CONTINUOUS
    assert (second["command"][0, 4], second["command"][0, 3]) == (0.9, 2.0)
    assert np.linalg.norm(second["command"][0, :3]) == pytest.approx(1.0)
    assert (second["phases"] >= 0).all()
    assert last["outcome"][0] == Outcome.SUCCESS
    assert result.steps[0] == last["step"][0] == result.control_steps
    total = np.sum([a["phases"] for a in seen.arrays], axis=0)
    np.testing.assert_array_equal(result.phases, total)
    assert len(result.phases) == len(PHASES)


def test_on_step_may_end_the_flight(cylinder: Maker) -> None:
    """After the reset, or after any step: the step under way is the last, and the outcome is still RUNNING."""
    tube = cylinder()
    for wanted in (0, 3):
        seen: list[int] = []

        def stop(step: FlightStep, seen: list[int] = seen, wanted: int = wanted) -> bool:
            seen.append(step.index)
            return step.index == wanted

        result = flight(tube, PurePursuit(tube, Settings()), on_step=stop)
        assert result.control_steps == wanted + 1
        assert seen == list(range(wanted + 2))
        assert result.outcome == (Outcome.RUNNING,)


def test_lanes_that_are_over_stand_still_until_the_last_one_ends(cylinder: Maker) -> None:
    """The result of a lane is that of its own last step."""
    settings = Settings(start=StartSettings(offset=0.0, heading_error=0.0))
    tube, seen = cylinder(lanes=2), Seen()
    tube.length[0] = 5.0
    result = flight(tube, PurePursuit(tube, settings), settings, on_step=seen)
    assert result.outcome == (Outcome.SUCCESS,) * 2
    assert result.steps[0] < result.steps[1] == result.control_steps
    after = seen.arrays[result.steps[0] + 1 :]
    assert all(a["command"][0, 3] == 0.0 for a in after)
    assert all(a["reward"][0] == 0.0 for a in after)
    assert all(a["command"][1, 3] == 2.0 for a in after)
    assert result.progress[0] == pytest.approx(0.9, abs=0.05)


def test_lanes_that_are_over_stand_still_whatever_is_on_its_way_to_them(cylinder: Maker) -> None:
    """Neither commands that a delay still holds back nor the air near the wall move them."""
    tube, seen = cylinder(lanes=2), Seen()
    tube.length[0] = 5.0
    drawn = draw_conditions(Conditions(action_delay=(3, 3), near_wall=(0.5, 0.5)), [(1,), (2,)])
    result = flight(tube, PurePursuit(tube, Settings()), drawn=drawn, on_step=seen)
    assert result.outcome == (Outcome.SUCCESS,) * 2
    assert result.steps[0] + 3 < result.steps[1]
    before, after = seen.arrays[result.steps[0]], seen.arrays[result.steps[0] + 1 :]
    assert before["command"][0, 3] > 0.0
    assert all(a["command"][0, 3] == 0.0 for a in after)
    assert all(a["command"][1, 3] > 0.0 for a in after)


def test_a_decision_arrives_when_its_delay_has_passed(cylinder: Maker) -> None:
    """Lanes of delays 0, 1 and 4: the command of step k was decided at k - delay; before it, none to move."""

    class Counting(Controller):
        decided = 0

        def act(self, step: TaskStep, commands: CommandBatch, actions: np.ndarray) -> None:
            self.decided += 1
            commands.direction[:], commands.speed[:] = [1.0, 0.0, 0.0], 0.01 * self.decided

    drawn = draw_conditions(Conditions(), [(1,)] * 3)
    drawn["action_delay"] = [0, 1, 4]
    seen = Seen()
    flight(cylinder(lanes=3), Counting(), drawn=drawn, on_step=seen, step_limit=12)
    speeds = np.array([a["command"][:, 3] for a in seen.arrays[1:]])
    steps = np.arange(1, 13)
    for lane, delay in enumerate([0, 1, 4]):
        np.testing.assert_allclose(speeds[:, lane], 0.01 * np.maximum(steps - delay, 0), atol=1e-15)


def test_every_command_carries_the_compensation_of_its_episode(cylinder: Maker) -> None:
    """As drawn, and that of the settings where nothing was drawn."""
    drawn = draw_conditions(Conditions(compensation=(0.8, 1.05)), [(1,), (2,)])
    tube = cylinder(lanes=2)
    for conditions, expected in ((drawn, drawn["compensation"]), (None, [0.9, 0.9])):
        seen = Seen()
        flight(tube, PurePursuit(tube, Settings()), drawn=conditions, on_step=seen)
        assert all((a["command"][:, 4] == expected).all() for a in seen.arrays[1:])


BLIND = HARD.with_ranges(
    {"lidar_noise": (0.3, 0.3), "lidar_dropout": (0.5, 0.5), "observation_delay": (5, 5)}
)
"""Sensors that are of little use."""


def commands_of(geometry: Any, controller: Controller, conditions: Conditions) -> np.ndarray:
    """What a flight of one lane commanded."""
    seen = Seen()
    flight(geometry, controller, drawn=draw_conditions(conditions, [(3,)]), on_step=seen)
    return np.array([a["command"] for a in seen.arrays])


def test_sensors_do_not_touch_pure_pursuit(cylinder: Maker) -> None:
    """It knows the axis and its place: with and without noise and delay of the sensors it flies the same."""
    tube = cylinder()
    clear = BLIND.with_ranges(
        {"lidar_noise": (0.0, 0.0), "lidar_dropout": (0.0, 0.0), "observation_delay": (0, 0)}
    )
    there = commands_of(tube, PurePursuit(tube, Settings()), BLIND)
    np.testing.assert_array_equal(there, commands_of(tube, PurePursuit(tube, Settings()), clear))
    late = commands_of(tube, PurePursuit(tube, Settings()), clear.with_ranges({"action_delay": (2, 2)}))
    assert not np.array_equal(there[:20], late[:20])


@pytest.mark.parametrize("name", ["lidar_noise", "lidar_dropout", "observation_delay"])
def test_sensors_touch_the_lidar_rule(cylinder: Maker, name: str) -> None:
    """Noise, drop-outs and the observation's delay each change what it commands."""
    settings = Settings()
    still = commands_of(cylinder(), LidarRule(settings), Conditions())
    disturbed = Conditions().with_ranges({name: BLIND.ranges()[name]})
    there = commands_of(cylinder(), LidarRule(settings), disturbed)
    assert not np.array_equal(there[:15], still[:15])


def test_a_policy_sees_what_is_as_old_as_the_delay(cylinder: Maker) -> None:
    """What it is given at step k is the observation of step k - 3, and until there is one, the first."""
    given: list[np.ndarray] = []

    class Straight:
        entropies = math.nan

        def act(self, observations: np.ndarray) -> np.ndarray:
            given.append(observations.copy())
            return np.full(len(observations), 3)

    settings, seen = Settings(), Seen()
    drawn = draw_conditions(Conditions(observation_delay=(3, 3)), [(1,), (2,)])
    flight(
        cylinder(lanes=2),
        PolicyController(Straight(), settings),
        settings,
        drawn=drawn,
        on_step=seen,
        step_limit=10,
    )
    assert len(given) == 10
    for step, observation in enumerate(given):
        np.testing.assert_array_equal(observation, seen.arrays[max(step - 3, 0)]["observation"])


def test_a_flight_into_the_wall_is_a_collision_unless_contacts_may_continue(cylinder: Maker) -> None:
    """With on_contact "continue" the same flight goes on, and leaves the tube."""

    class Aside(Controller):
        def act(self, step: TaskStep, commands: CommandBatch, actions: np.ndarray) -> None:
            commands.direction[:], commands.speed[:] = [0.6, 0.8, 0.0], 1.0

    assert flight(cylinder(), Aside()).outcome == (Outcome.COLLISION,)
    result = flight(cylinder(), Aside(), on_contact="continue")
    assert result.outcome == (Outcome.EXIT,)
    assert result.contacts[0] > 1


def test_time_runs_out_at_the_step_limit(cylinder: Maker) -> None:
    """At the slowest speed two thirds of the limit are needed; a limit of 10 steps is met exactly."""
    tube = cylinder()
    result = flight(tube, PurePursuit(tube, Settings(), speed=0.5), step_limit=10)
    assert (result.outcome, result.steps[0]) == ((Outcome.TIMEOUT,), 10)


def test_a_refused_command_ends_the_flight_with_the_plants_words(cylinder: Maker) -> None:
    """A speed above what the plant takes is refused by the plant, not clipped on the way."""
    fast = Settings(actions=ActionSettings(speeds=(1.0, 5.0)))
    tube = cylinder()
    with (
        open_twin(KinematicPlant(Settings()), SessionSettings(1, 0.1, 0.1)) as session,
        pytest.raises(Refusal, match="speed in lane 0"),
    ):
        fly(session, tube, PurePursuit(tube, fast), fast, seeds=[0], clearance_contact=True)
