"""The task as Gymnasium environments, in the kinematic world of this process."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="the extra 'train' is not installed")

import gymnasium
from gymnasium.error import ClosedEnvironmentError, InvalidAction, ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from agent_client.conditions import Conditions
from agent_client.errors import SettingsError
from agent_client.gym_env import TubeEnv, TubeEnvOptions, TubeVectorEnv
from agent_client.kinematic import KinematicPlant
from agent_client.reward import TERMS
from agent_client.settings import Settings, TaskSettings
from agent_client.tubes import TubeRecipe, draw_tube
from protocol.agent import AgentSession, SessionSettings
from protocol.twin import open_twin

SHORT = TubeRecipe(lengths=(4.0,))
STRAIGHT_FAST = 3
LANES = 5


class Opener:
    """Opens kinematic sessions, and counts how many are open."""

    def __init__(self) -> None:
        self.opened = self.closed = 0

    @contextmanager
    def __call__(self, settings: SessionSettings) -> Iterator[AgentSession]:
        """Open one."""
        with open_twin(KinematicPlant(), settings) as session:
            self.opened += 1
            yield session
        self.closed += 1


@pytest.fixture
def opener() -> Iterator[Opener]:
    """An opener whose sessions must all be closed in the end."""
    opener = Opener()
    yield opener
    gc.collect()
    assert opener.closed == opener.opened > 0


@pytest.fixture
def make_env(opener: Opener) -> Iterator[Callable[..., TubeEnv]]:
    """Makes environments of one drone in tubes of 4 m."""
    made: list[TubeEnv] = []

    def make(**options: Any) -> TubeEnv:
        made.append(TubeEnv(opener, TubeEnvOptions(**{"recipe": SHORT, "pool": 6} | options)))
        return made[-1]

    yield make
    for env in made:
        env.close()


@pytest.fixture
def make_vector(opener: Opener) -> Iterator[Callable[..., TubeVectorEnv]]:
    """Makes environments of five drones in tubes of 4 m."""
    made: list[TubeVectorEnv] = []

    def make(**options: Any) -> TubeVectorEnv:
        made.append(TubeVectorEnv(opener, LANES, TubeEnvOptions(**{"recipe": SHORT, "pool": 6} | options)))
        return made[-1]

    yield make
    for env in made:
        env.close()


def fly(env: TubeEnv, action: int = STRAIGHT_FAST) -> list[tuple]:
    """Everything that `step` returned until the episode was over."""
    steps = []
    while not steps or not (steps[-1][2] or steps[-1][3]):
        steps.append(env.step(np.int64(action)))
    return steps


def test_the_spaces_are_the_observation_and_the_actions(make_env: Callable[..., TubeEnv]) -> None:
    """37 numbers in [-1, 1] as float32, as many times that as there are lags, and 36 actions."""
    env = make_env()
    assert env.observation_space == gymnasium.spaces.Box(-1.0, 1.0, (37,), np.float32)
    assert env.action_space == gymnasium.spaces.Discrete(36)
    stacked = make_env(lags=(0, 2, 4))
    assert stacked.observation_space.shape == (111,)
    assert stacked.reset(seed=0)[0].shape == (111,)


def test_an_episode_ends_and_stays_ended_until_reset(make_env: Callable[..., TubeEnv]) -> None:
    """Straight ahead in a short easy tube is a success: it terminates, and wants a reset."""
    env = make_env()
    with pytest.raises(ResetNeeded, match="reset"):
        env.step(np.int64(0))
    _, info = env.reset(seed=0)
    assert info["outcome"] == "running"
    steps = fly(env)
    assert steps[-1][2:4] == (True, False)
    assert steps[-1][4]["outcome"] == "success"
    assert all(step[2:4] == (False, False) for step in steps[:-1])
    with pytest.raises(ResetNeeded):
        env.step(np.int64(0))
    env.reset()
    env.step(np.int64(0))


def test_a_time_out_truncates_and_other_ends_terminate(make_env: Callable[..., TubeEnv]) -> None:
    """A step limit of 4 m at 0.5 m/s times one tenth is 8 steps; flying into the wall is a collision."""
    env = make_env(settings=Settings(task=TaskSettings(time_factor=0.1)))
    env.reset(seed=0)
    steps = fly(env, action=0)
    assert len(steps) == 8
    assert steps[-1][2:4] == (False, True)
    assert steps[-1][4]["outcome"] == "timeout"
    env = make_env()
    env.reset(seed=0)
    last = fly(env, action=4 + STRAIGHT_FAST)[-1]  # to the right
    assert last[2:4] == (True, False)
    assert last[4]["outcome"] == "collision"


def test_infos_say_what_came_of_the_step(make_env: Callable[..., TubeEnv]) -> None:
    """Level and tube, outcome, quality, progress, clearance, regime; terms that sum to the unscaled reward."""
    env = make_env(level=1)
    _, info = env.reset(seed=4)
    tube = draw_tube(1, (info["tube_seed"],), "train", SHORT)
    assert info["level"] == 1
    assert 0 <= info["tube_seed"] < 6
    steps = fly(env)
    for _, reward, _, _, info in steps:
        assert set(info) == {
            "outcome", "level", "tube_seed", "quality", "progress", "clearance", "regime", "reward_terms",
        }  # fmt: skip
        assert tuple(info["reward_terms"]) == TERMS
        assert sum(info["reward_terms"].values()) == pytest.approx(reward)
        assert info["regime"] in ("visible", "memory", "blind")
        assert 0.0 < info["clearance"] < 1.1 * tube.radius.max()
    assert all(a[4]["progress"] < b[4]["progress"] for a, b in pairwise(steps))
    assert steps[-1][4]["reward_terms"]["terminal"] == {"success": 10.0}.get(info["outcome"], -10.0)


def test_the_same_seed_flies_the_same_episodes(make_env: Callable[..., TubeEnv]) -> None:
    """Seeded alike, two environments or one twice have the same episodes; unseeded resets go on from there."""
    conditions = Conditions(lidar_noise=(0.0, 0.05), body_radius=(0.1, 0.2), action_delay=(0, 3))
    one, other = make_env(conditions=conditions), make_env(conditions=conditions)

    def runs(env: TubeEnv, seed: int) -> list[bytes]:
        seen = [env.reset(seed=seed)[0].tobytes()]
        for _ in range(3):
            seen += [step[0].tobytes() for step in fly(env)]
            seen.append(env.reset()[0].tobytes())
        return seen

    assert runs(one, 1) == runs(other, 1) == runs(one, 1)
    assert runs(one, 2) != runs(one, 1)
    firsts = {env.reset()[1]["tube_seed"] for env in (one,) for _ in range(60)}
    assert firsts == set(range(6))


def test_a_reset_may_name_the_tube(make_env: Callable[..., TubeEnv]) -> None:
    """The level and the tube's seed as told, of the environment's domain, in the pool or not; the next is drawn."""
    env = make_env(domain="evaluate", recipe=TubeRecipe())
    _, info = env.reset(seed=7, options={"level": 2, "tube_seed": 1234})
    assert (info["level"], info["tube_seed"]) == (2, 1234)
    tube = draw_tube(2, (1234,), "evaluate")
    observation = env.step(np.int64(0))[0]
    assert info["progress"] == pytest.approx(0.6 / tube.length, abs=0.002)
    again = make_env(domain="evaluate", recipe=TubeRecipe(), level=2)
    again.reset(seed=7, options={"tube_seed": 1234})
    np.testing.assert_array_equal(again.step(np.int64(0))[0], observation)
    _, info = env.reset()
    assert info["level"] == 0
    assert info["tube_seed"] < 6


def test_options_that_do_not_exist_are_refused(make_env: Callable[..., TubeEnv], opener: Opener) -> None:
    """An unknown option, level or tube says what was expected; so does an environment of such a level."""
    env = make_env()
    for options, message in (
        ({"levle": 1}, "levle"),
        ({"level": 3}, "0 to 2"),
        ({"tube_seed": -1}, "tube_seed"),
        ({"tube_seed": "a"}, "tube_seed"),
    ):
        with pytest.raises(SettingsError, match=message):
            env.reset(options=options)
    for wrong in ({"level": 3}, {"pool": 0}):
        with pytest.raises(SettingsError, match=next(iter(wrong))):
            TubeEnvOptions(**wrong)


@pytest.mark.parametrize("action", [-1, 36, 0.5, [1, 2]])
def test_an_action_outside_of_the_space_is_refused(make_env: Callable[..., TubeEnv], action: object) -> None:
    """Nothing is flown; the episode goes on with an action of the space."""
    env = make_env()
    env.reset(seed=0)
    with pytest.raises(InvalidAction, match="0 to 35"):
        env.step(action)
    env.step(np.int64(35))


def test_a_closed_environment_says_so(make_env: Callable[..., TubeEnv], opener: Opener) -> None:
    """It may be closed twice; after that it neither resets nor steps."""
    env = make_env()
    env.reset(seed=0)
    env.close()
    env.close()
    assert opener.closed == 1
    for call in (env.reset, lambda: env.step(np.int64(0))):
        with pytest.raises(ClosedEnvironmentError, match="new one"):
            call()


def test_a_forgotten_environment_closes_its_session(opener: Opener) -> None:
    """Garbage collection is enough, for one drone and for many."""
    env: Any = TubeEnv(opener, TubeEnvOptions(recipe=SHORT))
    env.reset(seed=0)
    del env
    gc.collect()
    assert opener.closed == 1
    env = TubeVectorEnv(opener, 2, TubeEnvOptions(recipe=SHORT, pool=2))
    env.reset(seed=0)
    del env
    gc.collect()
    assert opener.closed == 2


def test_vectors_have_batched_spaces_and_say_how_they_begin_anew(
    make_vector: Callable[..., TubeVectorEnv],
) -> None:
    """Five observations, five actions, and the mode in which episodes begin anew."""
    env = make_vector()
    assert env.num_envs == LANES
    assert env.single_observation_space.shape == (37,)
    assert env.observation_space.shape == (LANES, 37)
    assert env.action_space == gymnasium.spaces.MultiDiscrete([36] * LANES)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP


def test_a_vector_begins_anew_in_the_step_that_ends_an_episode(
    make_vector: Callable[..., TubeVectorEnv],
) -> None:
    """The observation and infos are the new episode's; the old one's last are in final_obs and final_info."""
    env = make_vector(level=2)
    observation, infos = env.reset(seed=3)
    assert observation in env.observation_space
    clock, ended = np.zeros(LANES, dtype=int), 0
    rng = np.random.default_rng(0)
    for _ in range(150):
        before = infos
        observation, reward, terminated, truncated, infos = env.step(rng.integers(36, size=LANES))
        assert observation in env.observation_space
        assert reward.shape == terminated.shape == truncated.shape == (LANES,)
        clock += 1
        done = terminated | truncated
        assert ("final_obs" in infos) == ("final_info" in infos) == done.any()
        for lane in np.flatnonzero(done):
            last = {
                name: values[lane] for name, values in infos["final_info"].items() if name != "reward_terms"
            }
            terms = {name: infos["final_info"]["reward_terms"][name][lane] for name in TERMS}
            assert (last["outcome"] == "timeout") == truncated[lane]
            assert last["outcome"] != "running"
            assert last["tube_seed"] == before["tube_seed"][lane]
            assert sum(terms.values()) == pytest.approx(reward[lane])
            assert infos["final_obs"][lane] in env.single_observation_space
            assert infos["final_obs"][lane][36] > observation[lane, 36] == -1.0
            assert infos["outcome"][lane] == "running"
            assert infos["quality"][lane] == 0.0
            clock[lane], ended = 0, ended + 1
        if done.any():
            np.testing.assert_array_equal(infos["_final_obs"], done)
            np.testing.assert_array_equal(infos["_final_info"], done)
            np.testing.assert_array_equal(infos["final_info"]["_quality"], done)
            assert all(infos["final_obs"][lane] is None for lane in np.flatnonzero(~done))
        terms = np.sum([infos["reward_terms"][name] for name in TERMS], axis=0)
        np.testing.assert_allclose(terms[~done], reward[~done], atol=1e-12)
    assert ended > LANES


def described(infos: Any) -> Any:
    """The keys of infos with the types of their values, all the way down."""
    if isinstance(infos, dict):
        return {name: described(values) for name, values in infos.items()}
    return infos.dtype, infos.shape


def test_infos_are_laid_out_as_in_gymnasiums_own_vectors(
    make_env: Callable[..., TubeEnv], make_vector: Callable[..., TubeVectorEnv]
) -> None:
    """Same keys, masks, types and shapes as Gymnasium makes of as many single environments, ends included."""
    ours = make_vector()
    theirs = SyncVectorEnv([make_env] * LANES, autoreset_mode=AutoresetMode.SAME_STEP)
    assert described(ours.reset(seed=0)[1]) == described(theirs.reset(seed=0)[1])
    layouts = []
    for env in (ours, theirs):
        plain = final = None
        for _ in range(60):
            infos = env.step(np.full(LANES, STRAIGHT_FAST))[4]
            plain, final = (plain, infos) if "final_obs" in infos else (infos, final)
        layouts.append((described(plain), described(final)))
    assert layouts[0] == layouts[1]
    theirs.close()


def test_the_same_seed_flies_the_same_vector(make_vector: Callable[..., TubeVectorEnv]) -> None:
    """Observations and rewards come again bit for bit, in another environment or the same one."""
    conditions = Conditions(lidar_noise=(0.0, 0.05), near_wall=(0.0, 0.5))
    one, other = make_vector(conditions=conditions), make_vector(conditions=conditions)

    def run(env: TubeVectorEnv, seed: int) -> list[bytes]:
        rng = np.random.default_rng(0)
        seen = [env.reset(seed=seed)[0].tobytes()]
        for _ in range(60):
            observation, reward, *_ = env.step(rng.integers(36, size=LANES))
            seen += [observation.tobytes(), reward.tobytes()]
        return seen

    assert run(one, 1) == run(other, 1) == run(one, 1)
    assert run(one, 2) != run(one, 1)


def test_a_vector_refuses_what_it_cannot_do(make_vector: Callable[..., TubeVectorEnv]) -> None:
    """A step before the first reset, options, an action too few or out of the space, anything once it is closed."""
    env = make_vector()
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(LANES, dtype=np.int64))
    with pytest.raises(SettingsError, match="level"):
        env.reset(options={"level": 1})
    env.reset(seed=0, options={})
    for actions in (np.zeros(LANES - 1, dtype=np.int64), np.full(LANES, 36), np.full(LANES, 0.0)):
        with pytest.raises(InvalidAction, match="5 whole numbers"):
            env.step(actions)
    env.close()
    env.close()
    with pytest.raises(ClosedEnvironmentError):
        env.reset()


def test_a_level_is_never_left(make_vector: Callable[..., TubeVectorEnv]) -> None:
    """Hundreds of successes at level 0 do not move it on, as the curriculum of training would."""
    env = make_vector()
    env.reset(seed=0)
    successes = 0
    for _ in range(2000):
        infos = env.step(np.full(LANES, STRAIGHT_FAST))[4]
        if "final_info" in infos:
            successes += int((infos["final_info"]["outcome"] == "success").sum())
        assert (infos["level"] == 0).all()
    assert successes > 300
