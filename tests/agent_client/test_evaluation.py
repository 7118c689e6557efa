"""Episodes and their scores, and the policy that is shipped."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binomtest

import agent_client
from agent_client.conditions import HARD, Conditions, draw_conditions
from agent_client.contract import require_match, running_contract
from agent_client.controllers import PolicyController, PurePursuit
from agent_client.evaluation import (
    EpisodeResult,
    MakeController,
    Score,
    draw_episodes,
    fly_episodes,
    summarise,
    wilson,
)
from agent_client.kinematic import KinematicPlant
from agent_client.lidar_rule import LidarRule
from agent_client.policy import Policy, load_policy
from agent_client.settings import Settings
from agent_client.task import Outcome
from agent_client.tubes import HARD_TUBES, PAPER_TUBES, VARIED_TUBES, TubeRecipe, draw_tube
from meshes.swept import SweptTube
from physics_server.reference import ReferencePlant
from protocol.agent import AgentSession, SessionSettings
from protocol.plant import (
    PARAMETER_INDEX,
    CommandBatch,
    Plant,
    PoseBatch,
    ResetBatch,
    TubeReference,
)
from protocol.twin import open_twin

SHIPPED = Path(agent_client.__file__).parent / "policies" / "tube_ppo.zip"
SETTINGS = Settings()
SHORT = replace(HARD_TUBES, lengths=(6.0,))
"""Tubes that are flown in thirty control steps."""


def open_world(plant: Plant, lanes: int) -> AgentSession:
    """A session in this process with the usual time steps."""
    physics_dt = 0.1 if isinstance(plant, KinematicPlant) else 1 / 240
    return open_twin(plant, SessionSettings(lanes, 0.1, physics_dt))


def result_of(outcome: Outcome, steps: int, quality: float, length_ratio: float) -> EpisodeResult:
    """A result in which the rest does not matter."""
    return EpisodeResult(0, 1, outcome, steps, 1.0, quality, 0.5, 0, length_ratio, {})


# Scores


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilsons_interval_is_that_of_the_tables(successes: int, trials: int, low: float, high: float) -> None:
    """Table I of Newcombe (1998), method 3."""
    assert wilson(successes, trials) == pytest.approx((low, high), abs=5e-5)


@pytest.mark.parametrize("trials", [1, 3, 200, 1000])
def test_wilsons_interval_holds_the_proportion_and_is_that_of_scipy(trials: int) -> None:
    """From no success to nothing but successes; the ends are met exactly, and the interval has mirror symmetry."""
    for successes in {0, 1, trials // 3, trials - 1, trials}:
        low, high = wilson(successes, trials)
        assert 0.0 <= low <= successes / trials <= high <= 1.0
        other = binomtest(successes, trials).proportion_ci(0.95, method="wilson")
        assert (low, high) == pytest.approx((other.low, other.high), abs=1e-12)
        mirrored = wilson(trials - successes, trials)
        assert (low, high) == pytest.approx((1.0 - mirrored[1], 1.0 - mirrored[0]), abs=1e-12)
    assert wilson(0, trials)[0] == 0.0
    assert wilson(trials, trials)[1] == 1.0


def test_a_score_counts_outcomes_and_compares_lengths_of_successes_alone() -> None:
    """Two successes of 10 and 30 steps where 10 would do at best, one time-out and one collision."""
    results = [
        result_of(Outcome.SUCCESS, 10, 1.0, 1.0),
        result_of(Outcome.TIMEOUT, 100, 0.5, 10.0),
        result_of(Outcome.SUCCESS, 30, 0.9, 3.0),
        result_of(Outcome.COLLISION, 4, 0.6, 0.4),
    ]
    assert summarise(results) == Score(4, 0.5, 0.0, 0.25, 0.25, 0.75, 36.0, 2.0, wilson(2, 4))


def test_a_score_without_a_success_has_no_length_ratio() -> None:
    """It is not a number, and the rest is there."""
    score = summarise([result_of(Outcome.EXIT, 7, 0.3, 0.5)])
    assert math.isnan(score.length_ratio)
    assert (score.episodes, score.success, score.exit, score.mean_steps) == (1, 0.0, 1.0, 7.0)


# Episodes


def test_few_episodes_are_the_first_of_many() -> None:
    """More episodes of the same seed add to those that there are."""
    many = draw_episodes(1, 50, 3)
    assert draw_episodes(1, 7, 3) == many[:7]
    assert len({episode.seed for episode in many}) == 50


def test_levels_and_seeds_have_episodes_of_their_own() -> None:
    """No number of one is among those of another."""
    seeds = [e.seed for level in range(3) for seed in range(3) for e in draw_episodes(level, 30, seed)]
    assert len(set(seeds)) == 270


def test_an_episodes_tube_depends_on_its_domain_and_recipe() -> None:
    """The same number is another tube for tuning than for evaluation; the same episode is the same tube."""
    (evaluate,) = draw_episodes(2, 1, 5)
    tune = replace(evaluate, domain="tune")
    again = draw_tube(2, (evaluate.seed,), "evaluate")
    np.testing.assert_array_equal(evaluate.tube().points, again.points)
    assert not np.array_equal(evaluate.tube().points, tune.tube().points)
    assert evaluate.tube().length == pytest.approx(20.0)
    assert draw_episodes(2, 1, 5, SHORT)[0].tube().length == pytest.approx(6.0)


ROUGH = HARD.with_ranges(
    {
        "action_delay": (0, 2),
        "observation_delay": (0, 2),
        "near_wall": (0.0, 0.3),
        "gust": (0.0, 0.5),
        "mass": (0.5, 2.0),
    }
)
"""Everything at once that an episode draws or delays."""


def pilots() -> dict[str, MakeController]:
    """Everybody who flies."""
    policy = load_policy(SHIPPED)
    return {
        "policy": lambda _: PolicyController(policy, SETTINGS, policy.contract.lags),
        "pure-pursuit": lambda geometry: PurePursuit(geometry, SETTINGS),
        "lidar-rule": lambda _: LidarRule(SETTINGS),
    }


@pytest.mark.parametrize("make_plant", [KinematicPlant, ReferencePlant])
@pytest.mark.parametrize("pilot", ["policy", "pure-pursuit", "lidar-rule"])
def test_an_episode_ends_alone_as_it_ends_among_others(pilot: str, make_plant: Callable[[], Plant]) -> None:
    """Bit for bit, under noise, delays and gusts; five episodes on two lanes leave one lane over."""
    episodes = draw_episodes(2, 5, 8, SHORT)
    make = pilots()[pilot]
    with open_world(make_plant(), 2) as session:
        together = fly_episodes(session, episodes, make, SETTINGS, ROUGH)
    assert [(r.level, r.seed) for r in together] == [(e.level, e.seed) for e in episodes]
    with open_world(make_plant(), 1) as session:
        alone = [fly_episodes(session, [episode], make, SETTINGS, ROUGH)[0] for episode in episodes]
    assert alone == together
    assert len({r.min_clearance for r in together}) == 5


def test_an_episode_is_the_same_in_any_lane_and_order() -> None:
    """The first of three flown as the last of three."""
    episodes = draw_episodes(1, 3, 2, SHORT)
    with open_world(ReferencePlant(), 3) as session:
        there = fly_episodes(session, episodes, pilots()["lidar-rule"], SETTINGS, ROUGH)
        back = fly_episodes(session, episodes[::-1], pilots()["lidar-rule"], SETTINGS, ROUGH)
    assert back[::-1] == there


class Noting(ReferencePlant):
    """Keeps what it was told."""

    def __init__(self) -> None:
        super().__init__()
        self.resets: list[ResetBatch] = []
        self.compensation: list[np.ndarray] = []

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Keep a copy."""
        copy = ResetBatch.zeros(len(resets.raw))
        copy.raw[:] = resets.raw
        self.resets.append(copy)
        super().reset(resets, poses)

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Keep the compensation."""
        self.compensation.append(commands.compensation.copy())
        super().step(commands, poses)


def test_the_conditions_of_each_episode_reach_the_plant_and_its_result() -> None:
    """Gain, mass, gust and body in the reset, compensation in every command; results name the drawn ones alone."""
    episodes = draw_episodes(0, 3, 4, SHORT)
    plant = Noting()
    with open_world(plant, 3) as session:
        results = fly_episodes(session, episodes, pilots()["pure-pursuit"], SETTINGS, ROUGH)
    drawn = draw_conditions(ROUGH, [(episode.seed,) for episode in episodes])
    (resets,) = plant.resets
    for name, parameter in (("gain", "force_gain"), ("mass", "mass"), ("gust", "gust")):
        np.testing.assert_array_equal(resets.parameters[:, PARAMETER_INDEX[parameter]], drawn[name])
        assert [result.conditions[name] for result in results] == drawn[name].tolist()
    assert (resets.parameters[:, PARAMETER_INDEX["body_radius"]] == 0.25).all()
    np.testing.assert_array_equal(
        plant.compensation, np.tile(drawn["compensation"], (len(plant.compensation), 1))
    )
    varied = {
        "gain", "compensation", "action_delay", "observation_delay", "near_wall", "gust", "mass",
    }  # fmt: skip
    assert all(set(result.conditions) == varied for result in results)


def test_conditions_of_no_width_are_drawn_and_not_told() -> None:
    """One value a condition: the plant gets it, and no result repeats it."""
    plant = Noting()
    with open_world(plant, 1) as session:
        (result,) = fly_episodes(
            session,
            draw_episodes(0, 1, 4, SHORT),
            pilots()["pure-pursuit"],
            SETTINGS,
            Conditions(gain=(3.0, 3.0)),
        )
    assert plant.resets[0].parameters[0, PARAMETER_INDEX["force_gain"]] == 3.0
    assert result.conditions == {}


def test_a_thicker_body_touches_what_a_thin_one_passes() -> None:
    """The drawn body's radius decides on contact where it is judged from the clearance."""
    episodes = draw_episodes(2, 6, 1, SHORT)
    make = pilots()["pure-pursuit"]
    with open_world(KinematicPlant(), 6) as session:
        thin = fly_episodes(session, episodes, make, SETTINGS, Conditions(body_radius=(0.05, 0.05)))
        thick = fly_episodes(session, episodes, make, SETTINGS, Conditions(body_radius=(0.9, 0.9)))
    assert all(r.outcome == Outcome.SUCCESS and r.contacts == 0 for r in thin)
    assert all(r.outcome == Outcome.COLLISION and r.min_clearance < 0.9 for r in thick)


def test_a_plant_with_walls_is_reset_into_them_and_judges_contact() -> None:
    """Walls are registered group by group; where physics reports no contact, a touch is none."""
    seen: list[list[SweptTube]] = []
    resets: list[list[int]] = []

    class Walled(KinematicPlant):
        def reset(self, batch: ResetBatch, poses: PoseBatch) -> None:
            resets.append(batch.tube.tolist())
            super().reset(batch, poses)

    def register(session: AgentSession, tubes: Sequence[SweptTube]) -> list[int]:
        first = 2 * len(seen)
        seen.append(list(tubes))
        for index in range(first, first + 2):
            session.register_tube(index, TubeReference("tube.obj", "zup", 1.0, "0" * 64))
        return [first, first + 1]

    episodes = draw_episodes(2, 4, 1, SHORT)
    thick = Conditions(body_radius=(0.9, 0.9))
    with open_world(Walled(), 2) as session:
        results = fly_episodes(session, episodes, pilots()["pure-pursuit"], SETTINGS, thick, register)
    assert resets == [[0, 1], [2, 3]]
    for tube, episode in zip([tube for group in seen for tube in group], episodes, strict=True):
        np.testing.assert_array_equal(tube.points, episode.tube().points)
    assert all(r.outcome == Outcome.SUCCESS and r.contacts == 0 for r in results)


# Who flies well


def score_of(make: MakeController, level: int, episodes: int, recipe: TubeRecipe) -> Score:
    """Fly unseen tubes of a level in the kinematic world."""
    with open_world(KinematicPlant(), episodes) as session:
        return summarise(
            fly_episodes(session, draw_episodes(level, episodes, 9, recipe), make, SETTINGS, Conditions())
        )


def test_pure_pursuit_flies_every_level() -> None:
    """With the exact centreline and a short look-ahead no unseen tube is failed, at nearly the top speed."""
    for level in range(3):
        score = score_of(pilots()["pure-pursuit"], level, 10, PAPER_TUBES)
        assert score.success == 1.0
        assert 0.9 < score.length_ratio < 1.3


@pytest.fixture(scope="module")
def shipped() -> Policy:
    """The policy that is shipped."""
    return load_policy(SHIPPED)


def test_the_shipped_policy_is_small_and_fits_the_default_settings(shipped: Policy) -> None:
    """It is below 1.5 MB, carries its contract, and was trained without knowledge of the tube."""
    assert SHIPPED.stat().st_size < 1.5e6
    assert shipped.notes == ()
    assert require_match(shipped.contract, running_contract(), SHIPPED.name) == ()
    assert set(shipped.contract.masked) == {"progress", "position_f", "position_u", "position_r"}
    assert shipped.contract.training["preset"]


@pytest.mark.parametrize("level", [0, 1, 2])
def test_the_shipped_policy_flies_unseen_tubes(level: int) -> None:
    """In 40 unseen tubes of each level it arrives, in time and near the middle."""
    score = score_of(pilots()["policy"], level, 40, PAPER_TUBES)
    assert score.success == 1.0
    assert score.quality >= 0.9
    assert score.length_ratio <= 1.3


def test_the_shipped_policy_flies_narrow_wide_and_long_tubes() -> None:
    """Radii of 0.8 to 1.2 m that change along the tube, and lengths up to 84 m, are flown too."""
    score = score_of(pilots()["policy"], 2, 20, VARIED_TUBES)
    assert score.success >= 0.95
    assert score.timeout == 0.0


def test_tuning_meets_other_draws_than_evaluation() -> None:
    """Of the same seed no episode seed is shared, so that neither starts nor hidden parameters are known before."""
    evaluated = {episode.seed for episode in draw_episodes(2, 200, 5, domain="evaluate")}
    tuned = {episode.seed for episode in draw_episodes(2, 200, 5, domain="tune")}
    assert not evaluated & tuned
