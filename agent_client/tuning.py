"""The strongest Pure Pursuit for a level: look-ahead and speed found on tubes of their own domain, "tune".

`tune_pure_pursuit(open_session, level, conditions, recipe, settings, episodes, seed)` returns a `Tuning`, whose
`make_controller(settings)` flies what was found. The candidates are halved in rungs (successive halving: Jamieson
and Talwalkar 2016): all fly a few tubes, the better ones more, the best all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from agent_client.conditions import Conditions
from agent_client.controllers import PurePursuit
from agent_client.evaluation import (
    EpisodeResult,
    MakeController,
    Score,
    draw_episodes,
    fly_episodes,
    summarise,
)
from agent_client.settings import Settings
from agent_client.start import RegisterWalls
from agent_client.tubes import PAPER_TUBES, TubeRecipe
from protocol.agent import AgentSession

OpenLanes = Callable[[int], AgentSession]
"""Opens a session of so many lanes with the plant that is tuned for."""

LOOKAHEADS: Final = (0.15, 0.2, 0.3, 0.45, 0.7, 1.0, 1.5, 2.0, 3.0)
"""Look-aheads that are tried (m)."""

TUNING_EPISODES: Final = 100
"""Tubes of a level that the last candidates fly."""

_RUNGS: Final = ((0.2, 0.25), (0.5, 0.4), (1.0, 0.0))
"""Share of the tubes that have been flown after each rung, and share of the candidates that go on."""


@dataclass(frozen=True)
class Trial:
    """How one candidate did, on as many tubes as it got to fly."""

    lookahead: float
    """Arc length ahead (m)."""
    speed: float
    """Commanded speed (m/s)."""
    score: Score


@dataclass(frozen=True)
class Tuning:
    """What was found for a level, and all that was tried."""

    level: int
    lookahead: float
    """The best look-ahead (m)."""
    speed: float
    """The best speed (m/s)."""
    trials: tuple[Trial, ...]
    """Every candidate, the best first; the ones that were dropped early flew fewer tubes."""

    def make_controller(self, settings: Settings) -> MakeController:
        """Who flies as was found."""
        return _pursuit(settings, self.lookahead, self.speed)


def tune_pure_pursuit(
    open_session: OpenLanes,
    level: int,
    conditions: Conditions,
    recipe: TubeRecipe = PAPER_TUBES,
    settings: Settings | None = None,
    episodes: int = TUNING_EPISODES,
    seed: int = 0,
    register_walls: RegisterWalls | None = None,
) -> Tuning:
    """Find the look-ahead and speed level with which Pure Pursuit succeeds most often at a level.

    Candidates are every look-ahead of LOOKAHEADS with every speed level. Of equals in success the one with more
    quality a control step wins, clean and fast at once. The same arguments give the same answer.

    Args:
        open_session: opens the session to fly in; called once, and the session is closed at the end.
        level: 0, 1 or 2.
        conditions: ranges that each episode draws from.
        recipe: of the tubes; they are drawn from the domain "tune", which no evaluation draws from.
        settings: constants of the task, None for the defaults.
        episodes: tubes that the last candidates fly.
        seed: of tubes, starts and conditions.
        register_walls: as for `agent_client.evaluation.fly_episodes`.
    """
    settings = settings or Settings()
    drawn = draw_episodes(level, episodes, seed, recipe, "tune")
    flown: dict[tuple[float, float], list[EpisodeResult]] = {
        (lookahead, speed): [] for lookahead in LOOKAHEADS for speed in settings.actions.speeds
    }
    racing = list(flown)
    with open_session(max(round(_RUNGS[0][0] * episodes), 1)) as session:
        for share, stay in _RUNGS:
            done, until = len(flown[racing[0]]), max(round(share * episodes), 1)
            for lookahead, speed in racing:
                flown[lookahead, speed] += fly_episodes(
                    session,
                    drawn[done:until],
                    _pursuit(settings, lookahead, speed),
                    settings,
                    conditions,
                    register_walls,
                )
            racing.sort(key=lambda key: _rank(summarise(flown[key])), reverse=True)
            racing = racing[: max(round(stay * len(racing)), 1)]
    trials = [Trial(*key, summarise(results)) for key, results in flown.items()]
    trials.sort(key=lambda trial: (trial.score.episodes, _rank(trial.score)), reverse=True)
    return Tuning(level, trials[0].lookahead, trials[0].speed, tuple(trials))


def _pursuit(settings: Settings, lookahead: float, speed: float) -> MakeController:
    """Pure Pursuit of one look-ahead (m) and one speed (m/s)."""
    return lambda geometry: PurePursuit(geometry, settings, lookahead=lookahead, speed=speed)


def _rank(score: Score) -> tuple[float, float]:
    """Greater is better."""
    return score.success, score.quality / score.mean_steps
