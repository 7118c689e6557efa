"""How a controller does over many tubes, one lane a tube."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from agent_client.controllers import Controller
from agent_client.flight import FlightResult, fly
from agent_client.settings import Settings
from agent_client.task import Outcome
from meshes.geometry import Floats, Geometry
from meshes.swept import SweptTube
from meshes.swept_geometry import SweptGeometry
from protocol.agent import AgentSession


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
    """Mean over the successes of steps over length / (v_max dt), the fewest possible; NaN without a success."""


def evaluate(
    session: AgentSession,
    tubes: Sequence[SweptTube],
    make_controller: Callable[[Geometry], Controller],
    settings: Settings,
    *,
    seed: int,
    clearance_contact: bool,
) -> Score:
    """Fly every tube once from a random start.

    Args:
        session: an open session with one lane a tube.
        tubes: from `agent_client.tubes.draw_tube`, of the domain "evaluate".
        make_controller: makes who flies, given the tubes.
        settings: constants of the task.
        seed: of the starts; lane i has a seed of its own made of it.
        clearance_contact: whether contact is known from the clearance rather than from physics.
    """
    geometry = SweptGeometry(tubes, len(tubes))
    seeds = np.random.SeedSequence(seed).generate_state(len(tubes), np.uint32).tolist()
    result = fly(
        session,
        geometry,
        make_controller(geometry),
        settings,
        seeds=seeds,
        clearance_contact=clearance_contact,
    )
    return summarise(result, geometry.length, settings.speed_max * session.dt)


def summarise(result: FlightResult, length: Floats, top_step: float) -> Score:
    """Put the lanes of a flight into one score.

    Args:
        result: a flight that went on until every episode was over.
        length: (N,) lengths of the lanes' tubes (m).
        top_step: way in one control step at the fastest speed level (m).
    """
    outcome = np.array(result.outcome)
    success = outcome == Outcome.SUCCESS
    ratios = (result.steps * top_step / length)[success]
    return Score(
        episodes=len(outcome),
        success=float(success.mean()),
        exit=float((outcome == Outcome.EXIT).mean()),
        collision=float((outcome == Outcome.COLLISION).mean()),
        timeout=float((outcome == Outcome.TIMEOUT).mean()),
        quality=float(result.quality.mean()),
        mean_steps=float(result.steps.mean()),
        length_ratio=float(ratios.mean()) if success.any() else float("nan"),
    )
