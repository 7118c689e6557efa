"""How a controller does over many episodes, each of which one seed names and can be flown again alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from agent_client.conditions import Conditions, draw_conditions
from agent_client.controllers import Controller
from agent_client.flight import fly
from agent_client.settings import Settings
from agent_client.start import RegisterWalls
from agent_client.task import Outcome
from agent_client.tubes import PAPER_TUBES, Domain, TubeRecipe, draw_tube
from meshes.curves import DOMAINS
from meshes.geometry import Geometry
from meshes.swept import SweptTube
from meshes.swept_geometry import SweptGeometry
from protocol.agent import AgentSession
from protocol.plant import NO_TUBE

MakeController = Callable[[Geometry], Controller]
"""Makes who flies, given the tubes."""


@dataclass(frozen=True)
class Episode:
    """One episode: the seed gives the tube, the start, the conditions and the noise of the sensors."""

    level: int
    seed: int
    recipe: TubeRecipe = PAPER_TUBES
    domain: Domain = "evaluate"

    def tube(self) -> SweptTube:
        """The episode's tube: the same object again as long as few others were asked for, since a tube is drawn in
        milliseconds and flown by many in turn."""
        return _draw(self)


@lru_cache(maxsize=256)
def _draw(episode: Episode) -> SweptTube:
    return draw_tube(episode.level, (episode.seed,), episode.domain, episode.recipe)


@dataclass(frozen=True)
class EpisodeResult:
    """How an episode ended."""

    level: int
    seed: int
    outcome: Outcome
    steps: int
    progress: float
    quality: float
    min_clearance: float
    """Smallest distance of the centre to the wall (m)."""
    contacts: int
    """Control steps with contact."""
    length_ratio: float
    """Steps over length / (v_max dt); below 1 where corners are cut."""
    conditions: dict[str, float]
    """What the episode drew of those conditions that are ranges (`agent_client.conditions`)."""


@dataclass(frozen=True)
class Score:
    """Outcomes of many episodes; the first four fractions sum to one. The paper's exits are exit + collision."""

    episodes: int
    success: float
    exit: float
    collision: float
    timeout: float
    quality: float
    """Mean of Q."""
    mean_steps: float
    """Mean length of an episode (control steps)."""
    length_ratio: float
    """Mean over the successes; NaN without a success."""
    success_ci95: tuple[float, float]
    """Wilson's interval of the success rate."""


def draw_episodes(
    level: int, count: int, seed: int, recipe: TubeRecipe = PAPER_TUBES, domain: Domain = "evaluate"
) -> list[Episode]:
    """The episodes of a level that belong to a seed; the first of many are the same as those of few.

    Args:
        level: 0, 1 or 2.
        count: how many.
        seed: a whole number from 0 on; any is unseen in training, which draws from a domain of its own.
        recipe: of their tubes.
        domain: of the tubes' seeds.
    """
    # The domain enters: tuning must not meet the starts and draws of the evaluation of the same seed.
    words = [seed, level] if domain == "evaluate" else [seed, level, DOMAINS[domain]]
    seeds = np.random.SeedSequence(words).generate_state(count, np.uint32).tolist()
    return [Episode(level, number, recipe, domain) for number in seeds]


def fly_episodes(
    session: AgentSession,
    episodes: Sequence[Episode],
    make_controller: MakeController,
    settings: Settings,
    conditions: Conditions,
    register_walls: RegisterWalls | None = None,
) -> list[EpisodeResult]:
    """Fly episodes, as many side by side as the session has lanes; how they end does not depend on how many.

    Args:
        session: an open session.
        episodes: what to fly.
        make_controller: makes who flies.
        settings: constants of the task.
        conditions: ranges that each episode draws from.
        register_walls: for a plant with walls, which then reports contact; None for one without, where contact
            is judged from the clearance.
    """
    results: list[EpisodeResult] = []
    lanes = session.lanes
    varied = [name for name, (low, high) in conditions.ranges().items() if low < high]
    for start in range(0, len(episodes), lanes):
        group = list(episodes[start : start + lanes])
        flown = group + [group[-1]] * (lanes - len(group))  # lanes too many fly the last one again
        tubes = [episode.tube() for episode in group]
        tubes += [tubes[-1]] * (lanes - len(group))
        walls = [NO_TUBE] * lanes if register_walls is None else list(register_walls(session, tubes))
        geometry = SweptGeometry(tubes, lanes)
        drawn = draw_conditions(conditions, [(episode.seed,) for episode in flown])
        result = fly(
            session,
            geometry,
            make_controller(geometry),
            settings,
            seeds=[episode.seed for episode in flown],
            tube=walls,
            drawn=drawn,
            clearance_contact=register_walls is None,
        )
        fewest = geometry.length / (settings.speed_max * session.dt)
        results += [
            EpisodeResult(
                episode.level,
                episode.seed,
                result.outcome[lane],
                int(result.steps[lane]),
                float(result.progress[lane]),
                float(result.quality[lane]),
                float(result.min_clearance[lane]),
                int(result.contacts[lane]),
                float(result.steps[lane] / fewest[lane]),
                {name: float(drawn[name][lane]) for name in varied},
            )
            for lane, episode in enumerate(group)
        ]
    return results


def summarise(results: Sequence[EpisodeResult]) -> Score:
    """Put episodes, at least one, into one score."""
    outcomes = [result.outcome for result in results]
    shares = {outcome: outcomes.count(outcome) / len(outcomes) for outcome in Outcome}
    ratios = [result.length_ratio for result in results if result.outcome == Outcome.SUCCESS]
    return Score(
        episodes=len(results),
        success=shares[Outcome.SUCCESS],
        exit=shares[Outcome.EXIT],
        collision=shares[Outcome.COLLISION],
        timeout=shares[Outcome.TIMEOUT],
        quality=float(np.mean([result.quality for result in results])),
        mean_steps=float(np.mean([result.steps for result in results])),
        length_ratio=float(np.mean(ratios)) if ratios else math.nan,
        success_ci95=wilson(outcomes.count(Outcome.SUCCESS), len(outcomes)),
    )


Z95: Final = 1.959963984540054
"""The 97.5 % point of the normal distribution."""


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """The 95 % score interval of a proportion (Wilson 1927), of at least one trial."""
    share, square = successes / trials, Z95**2
    centre = (share + square / (2 * trials)) / (1.0 + square / trials)
    half = (
        Z95 * math.sqrt(share * (1.0 - share) / trials + square / (4 * trials**2)) / (1.0 + square / trials)
    )
    # The interval holds the proportion; rounding would let it miss 0 and 1 by a hair.
    return min(max(centre - half, 0.0), share), max(min(centre + half, 1.0), share)
