"""The vector environment of training."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="the extra 'train' is not installed")

from agent_client.curriculum import Curriculum
from agent_client.environment import REWARD_SCALE, TubeVecEnv
from agent_client.history import PRESENT
from agent_client.kinematic import KinematicPlant
from agent_client.privileged import WIDTH
from agent_client.settings import RewardSettings, Settings
from agent_client.tubes import TubeRecipe, draw_pool, draw_tube
from agent_client.world import TubeWorld, WorldOptions
from protocol.agent import SessionSettings
from protocol.twin import open_twin

LANES = 5
SHORT = TubeRecipe(lengths=(4.0,))


def make_pools(count: int = 4) -> list:
    """A small pool of short tubes for each level."""
    return [draw_pool(level, 0, count, (SHORT,)) for level in range(3)]


@pytest.fixture
def make_env() -> Iterator[Callable[..., TubeVecEnv]]:
    """Makes environments of five kinematic lanes in short tubes, seed 3."""
    with ExitStack() as sessions:

        def make(options: WorldOptions | None = None) -> TubeVecEnv:
            settings = SessionSettings(lanes=LANES, dt=0.1, physics_dt=0.1)
            session = sessions.enter_context(open_twin(KinematicPlant(), settings))
            return TubeVecEnv(TubeWorld(session, make_pools(), Curriculum(), options or WorldOptions(), 3))

        yield make


@pytest.fixture
def env(make_env: Callable[..., TubeVecEnv]) -> TubeVecEnv:
    """The environment of the default options."""
    return make_env()


def roll(env: TubeVecEnv, steps: int, seed: int = 0) -> list:
    """Random actions; everything that the environment returned, copied."""
    rng = np.random.default_rng(seed)
    seen = [env.reset().copy()]
    for _ in range(steps):
        seen.append(env.step(rng.integers(36, size=LANES)))
    return seen


def test_spaces_and_shapes(env: TubeVecEnv) -> None:
    """37 observations in [-1, 1] as float32, 36 actions, and one row a lane of everything."""
    assert env.observation_space.shape == (37,)
    assert env.action_space.n == 36
    for observation, reward, done, infos in roll(env, 60)[1:]:
        assert observation.dtype == np.float32
        assert observation.shape == (LANES, 37)
        assert np.abs(observation).max() <= 1.0
        assert reward.shape == done.shape == (LANES,)
        assert len(infos) == LANES


def test_returned_observations_are_not_overwritten(env: TubeVecEnv) -> None:
    """A learner may keep what a step returned: the next step leaves it as it is."""
    env.reset()
    first = env.step(np.zeros(LANES, dtype=np.int64))[0]
    kept = first.copy()
    env.step(np.zeros(LANES, dtype=np.int64))
    np.testing.assert_array_equal(first, kept)


def test_a_lane_that_is_done_begins_anew(env: TubeVecEnv) -> None:
    """Its info carries the last observation and the episode; the observation returned is a new start's."""
    ended = 0
    for observation, _, done, infos in roll(env, 150)[1:]:
        for lane in range(LANES):
            if not done[lane]:
                assert infos[lane] == {}
                continue
            ended += 1
            episode = infos[lane]["episode"]
            assert episode["outcome"] in ("success", "exit", "collision", "timeout")
            assert infos[lane]["TimeLimit.truncated"] == (episode["outcome"] == "timeout")
            assert episode["level"] == 0
            # The episode clock starts again, and a start has no memory of another episode.
            assert observation[lane, 36] == pytest.approx(-1.0)
            assert infos[lane]["terminal_observation"][36] > -1.0
    assert ended > LANES


def test_the_return_is_the_sum_of_unscaled_rewards(env: TubeVecEnv) -> None:
    """Rewards are scaled for the learner, the episode's return is not, and its steps are counted."""
    total, steps = np.zeros(LANES), np.zeros(LANES, dtype=int)
    ended = 0
    for _, reward, done, infos in roll(env, 150)[1:]:
        total += reward.astype(np.float64) / REWARD_SCALE
        steps += 1
        for lane in np.flatnonzero(done):
            assert infos[lane]["episode"]["r"] == pytest.approx(total[lane], abs=1e-3)
            assert infos[lane]["episode"]["l"] == steps[lane]
            total[lane], steps[lane] = 0.0, 0
            ended += 1
    assert ended > 0


def test_centring_pays_for_flying_in_the_middle(make_env: Callable[..., TubeVecEnv]) -> None:
    """With a weight, the learner's reward is the task's plus weight x S_center x way flown over v_max dt."""
    plain = make_env()
    shaped = make_env(WorldOptions(Settings(reward=RewardSettings(centring=2.0))))
    np.testing.assert_array_equal(plain.reset(), shaped.reset())
    before = plain.world.state.axis.arc_length.copy()
    for _ in range(4):
        rewards = [env.step(np.full(LANES, 3))[1] for env in (plain, shaped)]
        state = plain.world.state
        share = np.minimum((state.axis.arc_length - before) / 0.2, 1.0)
        added = REWARD_SCALE * 2.0 * state.centring * share
        np.testing.assert_allclose(rewards[1], rewards[0] + added, atol=1e-6)
        before = state.axis.arc_length.copy()


def test_spaces_tell_what_the_world_shows(make_env: Callable[..., TubeVecEnv]) -> None:
    """Stacked observations are as many times wider, in the same bounds; what is privileged has none."""
    stacked = make_env(WorldOptions(lags=(0, 1, 5))).observation_space
    assert stacked.shape == (3 * 37,)
    assert stacked.high.max() == 1.0
    hidden = make_env(WorldOptions(lags=PRESENT, privileged=True))
    assert hidden.observation_space.shape == (37 + WIDTH,)
    assert np.isinf(hidden.observation_space.high).all()
    assert hidden.reset().shape == (LANES, 37 + WIDTH)


def test_the_same_seed_gives_the_same_episodes(env: TubeVecEnv) -> None:
    """After the same seed, the same actions give the same observations and rewards to the last bit."""
    env.seed(11)
    first = roll(env, 80)
    env.seed(11)
    second = roll(env, 80)
    env.seed(12)
    other = roll(env, 80)
    assert first[0].tobytes() == second[0].tobytes() != other[0].tobytes()
    for a, b in zip(first[1:], second[1:], strict=True):
        assert a[0].tobytes() == b[0].tobytes()
        assert a[1].tobytes() == b[1].tobytes()


def test_training_and_evaluation_draw_different_tubes() -> None:
    """The same level and seed in two domains are two tubes; in one domain the same one."""
    one, again = (draw_tube(1, (5,), "train") for _ in range(2))
    other = draw_tube(1, (5,), "evaluate")
    np.testing.assert_array_equal(one.points, again.points)
    assert np.abs(one.points - other.points).max() > 0.1


def test_a_recipe_keeps_its_ranges() -> None:
    """Radii stay within the mean's range times one plus or minus the swing; lengths are over the mean radius."""
    recipe = TubeRecipe((10.0, 20.0), (0.8, 1.2), (0.0, 0.15))
    tubes = [draw_tube(2, (1, i), "train", recipe) for i in range(40)]
    radii = np.concatenate([tube.radius for tube in tubes])
    assert radii.min() >= 0.8 * 0.85
    assert radii.max() <= 1.2 * 1.15
    assert any(np.ptp(tube.radius) > 0.05 for tube in tubes)
    assert min(t.length for t in tubes) >= 0.8 * 10.0 - 1e-9
    assert max(t.length for t in tubes) <= 1.2 * 20.0 + 1e-9
    assert {round(t.length / t.step) for t in tubes} == {50, 100}


def test_the_curriculum_moves_on_at_its_threshold_only_when_its_window_is_full() -> None:
    """299 successes are not enough, 300 are; the next level counts from nothing."""
    curriculum = Curriculum()
    moved = [curriculum.record(0, True) for _ in range(300)]
    assert moved == [False] * 299 + [True]
    assert curriculum.level == 1
    assert np.isnan(curriculum.success_rate)


def test_the_curriculum_takes_the_rate_over_the_last_window() -> None:
    """Early failures drop out of the window; at 85 % of the last 300 the level is passed, not before."""
    curriculum = Curriculum()
    for _ in range(300):
        curriculum.record(0, False)
    successes = 0
    while curriculum.level == 0:
        curriculum.record(0, True)
        successes += 1
    assert successes == 255


def test_episodes_of_other_levels_do_not_count() -> None:
    """An episode that began before the level changed is ignored, and the last level can be passed."""
    curriculum = Curriculum(window=2)
    for level in (0, 0, 0, 1, 1, 0, 2):
        curriculum.record(level, True)
    assert (curriculum.level, curriculum.passed) == (2, False)
    curriculum.record(2, True)
    assert (curriculum.level, curriculum.passed) == (2, True)


def test_replay_draws_earlier_levels_with_its_share() -> None:
    """Without replay only the current level is drawn; with it the earlier ones share it evenly."""
    rng = np.random.default_rng(0)
    assert {Curriculum(level=2).draw(rng) for _ in range(100)} == {2}
    drawn = np.bincount([Curriculum(level=2, replay=0.4).draw(rng) for _ in range(5000)], minlength=3) / 5000
    np.testing.assert_allclose(drawn, [0.2, 0.2, 0.6], atol=0.03)
