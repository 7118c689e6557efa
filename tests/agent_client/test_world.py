"""The lanes of a session as episodes that begin anew: draws, bookkeeping, what is seen, and walls."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest

from agent_client.conditions import NAMES, Conditions
from agent_client.curriculum import Curriculum
from agent_client.episodes import SENSED
from agent_client.kinematic import KinematicPlant
from agent_client.privileged import WIDTH
from agent_client.task import Outcome
from agent_client.tubes import TubeRecipe, draw_pool
from agent_client.world import TubeWorld, WorldOptions, WorldStep
from meshes.swept import SweptTube
from protocol.agent import AgentSession, SessionSettings
from protocol.plant import CommandBatch, PoseBatch, ResetBatch, TubeReference
from protocol.twin import open_twin

LANES = 6
POOLS = [draw_pool(level, 0, 5, (TubeRecipe(lengths=(4.0,)),)) for level in range(3)]
VARIED = Conditions(
    body_radius=(0.1, 0.2), field_of_view=(0.5, 1.0), lidar_noise=(0.0, 0.05), camera_dropout=(0.0, 0.3),
    action_delay=(0, 3), observation_delay=(0, 2), gain=(1.5, 6.0), near_wall=(0.0, 0.3),
)  # fmt: skip


class Recording(KinematicPlant):
    """The kinematic world, and what it was asked."""

    def __init__(self) -> None:
        super().__init__()
        self.resets: list[np.ndarray] = []
        self.commands: list[np.ndarray] = []

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Keep the rows."""
        self.resets.append(resets.raw.copy())
        super().reset(resets, poses)

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Keep the rows."""
        self.commands.append(commands.raw.copy())
        super().step(commands, poses)


@pytest.fixture
def make_world() -> Iterator[Callable[..., TubeWorld]]:
    """Makes worlds of six lanes in tubes of 4 m, over a plant of the test's or the kinematic one."""
    with ExitStack() as sessions:

        def make(
            options: WorldOptions | None = None,
            *,
            seed: int = 5,
            level: int = 0,
            lanes: int = LANES,
            plant: KinematicPlant | None = None,
            **more: Any,
        ) -> TubeWorld:
            settings = SessionSettings(lanes=lanes, dt=0.1, physics_dt=0.1)
            session = sessions.enter_context(open_twin(plant or KinematicPlant(), settings))
            return TubeWorld(session, POOLS, Curriculum(level=level), options or WorldOptions(), seed, **more)

        yield make


def fly(world: TubeWorld, steps: int) -> list[WorldStep]:
    """Fly straight ahead at changing speeds, for so many steps from new starts."""
    world.restart()
    actions = np.random.default_rng(1).integers(4, size=(steps, world.session.lanes))
    return [world.step(row) for row in actions]


def test_the_same_seed_flies_the_same_episodes(make_world: Callable[..., TubeWorld]) -> None:
    """Tubes, starts, conditions and noise come again with the seed, in a new world or in the same one."""
    world = make_world(WorldOptions(conditions=VARIED))
    first = fly(world, 80)
    world.seed(5)
    again, other = fly(world, 80), fly(make_world(WorldOptions(conditions=VARIED)), 80)
    for a, b, c in zip(first, again, other, strict=True):
        assert a.observation.tobytes() == b.observation.tobytes() == c.observation.tobytes()
        np.testing.assert_array_equal(a.reward, b.reward)
        np.testing.assert_array_equal(a.episodes, b.episodes)
    assert sum(len(step.ended) for step in first) > 2 * LANES
    world.seed(6)
    assert fly(world, 1)[0].observation.tobytes() != first[0].observation.tobytes()


def test_every_episode_draws_its_own_conditions(make_world: Callable[..., TubeWorld]) -> None:
    """Bodies, cameras and noise differ between lanes and from episode to episode, within their ranges."""
    world = make_world(WorldOptions(conditions=VARIED))
    steps = fly(world, 120)
    episodes = np.concatenate([step.episodes for step in steps])
    for name in ("body_radius", "field_of_view", "lidar_noise", "camera_dropout"):
        low, high = getattr(VARIED, name)
        assert low <= episodes[name].min() < episodes[name].max() <= high
        assert len(set(episodes[name].tolist())) == len(episodes)
    assert len(set(episodes["noise_seed"].tolist())) == len(episodes)


def test_the_plant_is_told_what_an_episode_drew(make_world: Callable[..., TubeWorld]) -> None:
    """Each selected row carries the body and the seed of the record that the task judges by, and some gain."""
    plant = Recording()
    world = make_world(WorldOptions(conditions=VARIED), plant=plant)
    world.restart()
    rows = ResetBatch(plant.resets[0])
    records = world.state.episodes
    np.testing.assert_array_equal(rows.selected, 1)
    np.testing.assert_array_equal(rows.tube, -1)
    np.testing.assert_array_equal(rows.seed.astype(np.uint64), records["noise_seed"])
    np.testing.assert_array_equal(rows.parameters[:, 4], records["body_radius"])
    assert ((rows.parameters[:, 5] >= 1.5) & (rows.parameters[:, 5] <= 6.0)).all()
    assert len(set(rows.parameters[:, 5].tolist())) == LANES


def test_a_step_tells_how_episodes_ended_and_shows_the_new_ones(make_world: Callable[..., TubeWorld]) -> None:
    """Lanes, levels, returns and last records are those of the episodes that ended; their lanes show a new start."""
    world = make_world(level=1)
    total, steps, ended = np.zeros(LANES), np.zeros(LANES, dtype=int), 0
    for step in fly(world, 120):
        total += step.reward
        steps += 1
        np.testing.assert_array_equal(step.ended, np.flatnonzero(step.outcome))
        np.testing.assert_array_equal(step.outcome[step.ended], step.episodes["outcome"])
        np.testing.assert_array_equal(step.levels, 1)
        np.testing.assert_allclose(step.returns, total[step.ended])
        np.testing.assert_array_equal(step.episodes["step"], steps[step.ended])
        np.testing.assert_allclose(step.observation[step.ended, 36], -1.0)
        assert (step.final[:, 36] > -1.0).all()
        total[step.ended], steps[step.ended] = 0.0, 0
        ended += len(step.ended)
    assert ended > 2 * LANES


def test_the_curriculum_is_told_every_end_once(make_world: Callable[..., TubeWorld]) -> None:
    """What it counts at a level is the successes and failures of the steps' outcomes."""
    world = make_world()
    outcomes = np.concatenate([step.episodes["outcome"] for step in fly(world, 120)])
    told = world.curriculum.success_rate
    assert told == pytest.approx((outcomes == int(Outcome.SUCCESS)).mean())
    assert 0.0 < told <= 1.0


def test_advancing_begins_nothing_anew(make_world: Callable[..., TubeWorld]) -> None:
    """It takes the same step as `step` does until an episode ends; that one then stays as it ended."""
    stepped, advanced = make_world(), make_world()
    np.testing.assert_array_equal(stepped.restart(), advanced.restart())
    actions = np.full(LANES, 3)
    for _ in range(100):
        observation, step = advanced.advance(actions), stepped.step(actions)
        np.testing.assert_array_equal(advanced.state.outcome, step.outcome)
        if len(step.ended):
            np.testing.assert_array_equal(observation[step.ended], step.final)
            break
        np.testing.assert_array_equal(observation, step.observation)
    over = advanced.state.outcome != 0
    assert over.any()
    kept = advanced.state.episodes[over].copy()
    for name in ("position", "step", "outcome", "quality"):
        advanced.advance(actions)
        np.testing.assert_array_equal(advanced.state.episodes[over][name], kept[name])
    np.testing.assert_array_equal(advanced.state.reward[over], 0.0)


def test_what_a_step_returned_is_the_callers(make_world: Callable[..., TubeWorld]) -> None:
    """Later steps change none of it."""
    world = make_world()
    world.restart()
    steps, copies = [], []
    for row in np.random.default_rng(1).integers(4, size=(60, LANES)):
        steps.append(world.step(row))
        copies.append([array.copy() for array in vars(steps[-1]).values()])
    for step, kept in zip(steps, copies, strict=True):
        for array, copy in zip(vars(step).values(), kept, strict=True):
            np.testing.assert_array_equal(array, copy)


def test_the_critic_sees_more_and_the_policy_the_same(make_world: Callable[..., TubeWorld]) -> None:
    """What is privileged comes behind the observation, which is that of a world without it."""
    plain = fly(make_world(WorldOptions(conditions=VARIED, lags=(0, 2))), 60)
    privileged = fly(make_world(WorldOptions(conditions=VARIED, lags=(0, 2), privileged=True)), 60)
    for a, b in zip(plain, privileged, strict=True):
        assert b.observation.shape == (LANES, 2 * 37 + WIDTH)
        np.testing.assert_array_equal(a.observation, b.observation[:, : 2 * 37])
        np.testing.assert_array_equal(a.final, b.final[:, : 2 * 37])


def test_lags_and_delays_show_older_rows(make_world: Callable[..., TubeWorld]) -> None:
    """With an observation delay of 2 and lags 0 and 3, blocks are the plain world's rows of 2 and 5 steps ago."""
    plain = make_world(lanes=1)
    delayed = make_world(WorldOptions(conditions=Conditions(observation_delay=(2, 2)), lags=(0, 3)), lanes=1)
    rows, late = [plain.restart()[0]], [delayed.restart()[0]]
    for _ in range(12):
        rows.append(plain.advance(np.array([3]))[0])
        late.append(delayed.advance(np.array([3]))[0])
    for now, seen in enumerate(late):
        expected = [rows[max(now - age, 0)] for age in (2, 5)]
        np.testing.assert_array_equal(seen, np.concatenate(expected))


def test_commands_reach_the_plant_after_the_delay(make_world: Callable[..., TubeWorld]) -> None:
    """With an action delay of 3 the plant is told to stand still for three steps, and then what was decided first."""
    plant = Recording()
    world = make_world(WorldOptions(conditions=Conditions(action_delay=(3, 3))), lanes=1, plant=plant)
    world.restart()
    for action in (3, 2, 1, 0, 0, 0):
        world.advance(np.array([action]))
    np.testing.assert_array_equal([row[0, 3] for row in plant.commands], [0.0, 0.0, 0.0, 2.0, 1.5, 1.0])
    np.testing.assert_array_equal([row[0, 4] for row in plant.commands], 0.9)


def test_a_plant_with_walls_is_reset_into_the_tubes_and_trusted_with_contact(
    make_world: Callable[..., TubeWorld],
) -> None:
    """All lanes' walls are asked for before a reset, whose rows carry the indices; the clearance ends nothing."""
    plant = Recording()
    asked: list[list[SweptTube]] = []
    everything = [tube for pool in POOLS for tube in pool]

    def register(session: AgentSession, tubes: Sequence[SweptTube]) -> list[int]:
        if not asked:
            for index in range(len(everything)):
                session.register_tube(index, TubeReference("tube.obj", "zup", 1.0, "0" * 64))
        asked.append(list(tubes))
        return [everything.index(tube) for tube in tubes]

    world = make_world(plant=plant, level=2, register_walls=register)
    outcomes = np.concatenate([step.episodes["outcome"] for step in fly(world, 120)])
    assert len(asked) == len(plant.resets) > 1
    for tubes, raw in zip(asked, plant.resets, strict=True):
        assert len(tubes) == LANES
        np.testing.assert_array_equal(ResetBatch(raw).tube, [everything.index(tube) for tube in tubes])
        assert all(10 <= everything.index(tube) < 15 for tube in tubes)
    # This plant has no contact to report: drones leave through the wall.
    assert set(outcomes.tolist()) <= {int(Outcome.SUCCESS), int(Outcome.EXIT)}
    assert int(Outcome.EXIT) in outcomes
    assert (world.state.clearance != 0.0).all()


def test_conditions_are_named_as_the_task_knows_them() -> None:
    """What perception works under is a subset of the table's names."""
    assert set(SENSED) < set(NAMES)


def test_episodes_take_conditions_in_turn(make_world: Callable[..., TubeWorld]) -> None:
    """With one further set of conditions every other episode draws from it, and the others from the first."""
    soft = Conditions(gain=(1.0, 2.0))
    world = make_world(WorldOptions(conditions=Conditions(gain=(5.0, 6.0)), rotation=(soft,)))
    world.restart()
    gains = world.drawn["gain"]
    assert ((gains[0::2] >= 5.0) & (gains[0::2] <= 6.0)).all()
    assert ((gains[1::2] >= 1.0) & (gains[1::2] <= 2.0)).all()
