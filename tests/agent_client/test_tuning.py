"""Pure Pursuit tuned on tubes of its own."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import pytest

from agent_client.conditions import HARD, Conditions
from agent_client.controllers import PurePursuit
from agent_client.evaluation import draw_episodes, fly_episodes, summarise
from agent_client.kinematic import KinematicPlant
from agent_client.settings import Settings
from agent_client.tubes import HARD_TUBES, PAPER_TUBES
from agent_client.tuning import LOOKAHEADS, Tuning, tune_pure_pursuit
from meshes.swept_geometry import SweptGeometry
from physics_server.reference import ReferencePlant
from protocol.agent import AgentSession, SessionSettings
from protocol.errors import SessionError
from protocol.plant import CommandBatch
from protocol.twin import open_twin

SETTINGS = Settings()
SHORT = replace(HARD_TUBES, lengths=(8.0,))
EPISODES = 10


class Opener:
    """Opens sessions with the rigid body, and remembers them."""

    def __init__(self) -> None:
        self.sessions: list[AgentSession] = []

    def __call__(self, lanes: int) -> AgentSession:
        """Open one."""
        self.sessions.append(open_twin(ReferencePlant(), SessionSettings(lanes, 0.1, 1 / 240)))
        return self.sessions[-1]


def tune(opener: Opener, seed: int = 3) -> Tuning:
    """Tune at level 2 under hard conditions."""
    return tune_pure_pursuit(opener, 2, HARD, SHORT, SETTINGS, EPISODES, seed)


@pytest.fixture(scope="module")
def opener() -> Opener:
    """Who opened the session of `found`."""
    return Opener()


@pytest.fixture(scope="module")
def found(opener: Opener) -> Tuning:
    """A tuning at level 2."""
    return tune(opener)


def test_every_look_ahead_is_tried_at_every_speed(found: Tuning) -> None:
    """Each once; some on all tubes, the most on a few, and the best of the former is what was found."""
    tried = [(trial.lookahead, trial.speed) for trial in found.trials]
    assert sorted(tried) == sorted(product(LOOKAHEADS, SETTINGS.actions.speeds))
    counts = [trial.score.episodes for trial in found.trials]
    assert counts == sorted(counts, reverse=True)
    assert (counts[0], counts[-1]) == (EPISODES, EPISODES // 5)
    assert (found.level, found.lookahead, found.speed) == (2, *tried[0])


def test_nobody_who_flew_all_tubes_was_better(found: Tuning) -> None:
    """By success, then by quality over steps."""
    finalists = [t.score for t in found.trials if t.score.episodes == EPISODES]
    assert len(finalists) > 1
    rank = [(score.success, score.quality / score.mean_steps) for score in finalists]
    assert rank == sorted(rank, reverse=True)


def test_the_scores_are_those_of_tubes_drawn_for_tuning(found: Tuning) -> None:
    """Flown again by hand on the domain "tune" under the same conditions, the best gets the same score."""
    episodes = draw_episodes(2, EPISODES, 3, SHORT, "tune")
    with Opener()(EPISODES) as session:
        results = fly_episodes(session, episodes, found.make_controller(SETTINGS), SETTINGS, HARD)
    assert summarise(results) == found.trials[0].score


def test_tuning_twice_finds_the_same(found: Tuning) -> None:
    """Record by record; another seed is other tubes."""
    assert tune(Opener()) == found
    assert tune(Opener(), seed=4).trials != found.trials


def test_the_session_is_opened_once_and_closed(found: Tuning, opener: Opener) -> None:
    """Its lanes are the tubes of the first rung."""
    (session,) = opener.sessions
    assert session.lanes == EPISODES // 5
    with pytest.raises(SessionError):
        session.step(CommandBatch.zeros(session.lanes))


def test_a_long_look_ahead_loses_in_tight_bends() -> None:
    """In the kinematic world what is found succeeds everywhere, while three metres ahead cut corners."""
    tuning = tune_pure_pursuit(
        lambda lanes: open_twin(KinematicPlant(), SessionSettings(lanes, 0.1, 0.1)),
        2,
        Conditions(),
        replace(PAPER_TUBES, lengths=(10.0,)),
        episodes=EPISODES,
    )
    assert tuning.trials[0].score.success == 1.0
    assert tuning.lookahead < 2.0
    longest = [trial.score.success for trial in tuning.trials if trial.lookahead == max(LOOKAHEADS)]
    assert sum(longest) / len(longest) < 0.8


def test_what_was_found_can_be_flown() -> None:
    """The controller has the look-ahead and the speed of the tuning."""
    geometry = SweptGeometry([draw_episodes(0, 1, 1)[0].tube()], 1)
    pilot = Tuning(0, 0.7, 1.5, ()).make_controller(SETTINGS)(geometry)
    assert isinstance(pilot, PurePursuit)
    assert (pilot.lookahead, pilot.speed) == (0.7, 1.5)
