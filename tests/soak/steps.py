"""A long run in which every word of every step is checked on both sides: none lost, doubled or torn.

Commands are a function of the number of the step and poses one of the number and the command, so that each side
can tell by itself whether what it got is whole and due. Now and then a command is refused in between.
"""

from __future__ import annotations

import time
from typing import Any, Final

import numpy as np
from pair import SIDES, Pair, Roles, meeting

from protocol.agent import AgentSession, SessionSettings
from protocol.errors import Refusal
from protocol.plant import CommandBatch, Plant, PlantDescription, PoseBatch, ResetBatch, TubeReference
from protocol.toy import DEFAULTS, SPEED_MAX, ToyPlant

LANES: Final = 4
REFUSED_EVERY: Final = 997
_WORDS: Final = 13
_SPREAD: Final = np.uint64(0x9E3779B97F4A7C15)
_PLACES: Final = (np.arange(1, LANES * _WORDS + 1, dtype=np.uint64) * np.uint64(0xBF58476D1CE4E5B9)).reshape(
    LANES, _WORDS
)
_LANES: Final = np.arange(LANES) / LANES


def due_command(step: int, commands: CommandBatch) -> None:
    """Write the commands of a step: other directions, speeds and compensations in every step and lane."""
    angle = step * 1e-3 + _LANES
    np.cos(angle, out=commands.direction[:, 0])
    np.sin(angle, out=commands.direction[:, 1])
    np.mod(angle, SPEED_MAX, out=commands.speed)
    np.mod(angle, 2.0, out=commands.compensation)


def due_pose(step: int, commands: CommandBatch) -> np.ndarray:
    """The (LANES, 13) words of a step's poses, as unsigned integers: all of them differ from step to step."""
    words = commands.raw.view(np.uint64)
    mixed = (np.uint64(step) + words[:, 0] + words[:, 3]) * _SPREAD
    return np.asarray(mixed[:, None] + _PLACES)


class CheckingPlant(Plant):
    """Checks every command against the one that is due, and answers with words that can be checked."""

    def __init__(self) -> None:
        self._step = 0
        self._due = CommandBatch.zeros(LANES)

    def report(self) -> int:
        """How many steps were integrated."""
        return self._step

    def describe(self) -> PlantDescription:
        """Say what the toy says."""
        return ToyPlant().describe()

    def open(self, lanes: int, dt: float, physics_dt: float, inner_steps: int) -> None:
        """Nothing to prepare."""

    def register_tube(self, index: int, tube: TubeReference) -> None:
        """Accept any tube."""

    def release_tube(self, index: int) -> None:
        """Accept any index."""

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Answer with the state that is asked for."""
        poses.raw[:, :_WORDS] = resets.raw[:, :_WORDS]

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Check, count and answer."""
        self._step += 1
        due_command(self._step, self._due)
        if commands.raw.tobytes() != self._due.raw.tobytes():
            raise AssertionError(f"step {self._step}: a command that is not due: {commands.raw.tolist()}")
        poses.raw.view(np.uint64)[:, :_WORDS] = due_pose(self._step, commands)
        poses.step[:] = self._step

    def close(self) -> None:
        """Nothing to give up."""


def _fly(session: AgentSession, count: int) -> dict[str, Any]:
    resets, commands = ResetBatch.zeros(LANES), CommandBatch.zeros(LANES)
    resets.selected[:], resets.parameters[:, : len(DEFAULTS)], resets.quaternion[:, 3] = 1, DEFAULTS, 1.0
    session.reset(resets)
    refused = 0
    began = time.monotonic()
    for step in range(1, count + 1):
        due_command(step, commands)
        if step % REFUSED_EVERY == 0:
            refused += _is_refused(session, commands)
        poses = session.step(commands)
        if not np.array_equal(poses.raw.view(np.uint64)[:, :_WORDS], due_pose(step, commands)):
            raise AssertionError(f"step {step}: a pose that is not due, or torn: {poses.raw.tolist()}")
        if not (poses.step == step).all() or session.steps != step:
            raise AssertionError(f"step {step}: lost or doubled, poses of {poses.step.tolist()}")
    seconds = round(time.monotonic() - began, 1)
    return {"exchange": session.exchange, "steps": session.steps, "refused": refused, "seconds": seconds}


def _is_refused(session: AgentSession, commands: CommandBatch) -> bool:
    """Ask for a step that must be refused: nothing may be counted anywhere."""
    speed = commands.speed[-1]
    commands.speed[-1] = np.nan
    try:
        session.step(commands)
    except Refusal:
        return True
    finally:
        commands.speed[-1] = speed
    raise AssertionError("a command that is no number was not refused")


def run_steps(count: int, transport: str, exchange: str) -> dict[str, Any]:
    """Fly `count` checked steps over a transport, exchanged in one way by both sides; both sides' counts.

    Raises:
        AssertionError: a side found something that was not due, or the counts differ.
    """
    roles = Roles(
        SessionSettings(LANES, 0.1, 0.025),
        CheckingPlant,
        lambda session: _fly(session, count),
        exchange=dict.fromkeys(SIDES, exchange),
    )
    with meeting(transport) as rendezvous:
        ends = Pair(rendezvous, roles).finish()
    agent, physics = ends["agent"], ends["physics"]
    if agent is None or physics is None or agent.error or physics.error:
        raise AssertionError(f"{transport}: agent {agent}, physics {physics}")
    if (agent.value["steps"], physics.value) != (count, count):
        raise AssertionError(
            f"{transport}: {agent.value['steps']} asked, {physics.value} integrated of {count}"
        )
    return {"integrated": physics.value, **agent.value}
