"""One flight, disturbed in every way that only takes time: the bytes of all commands and poses must be the same.

The commands follow from the poses, so that a single other bit would end in another flight. Either side is frozen or
slowed at random moments, put on other cores, made to wait otherwise, or reached by another transport.
"""

from __future__ import annotations

import hashlib
import os
import random
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from pair import SIDES, Pair, Roles, exchanges, meeting

from protocol import waiting
from protocol.agent import AgentSession, SessionSettings
from protocol.compiled_choice import COMPILED, STDLIB
from protocol.plant import CommandBatch, PoseBatch, ResetBatch
from protocol.toy import DEFAULTS, ToyPlant
from protocol.twin import open_twin

LANES: Final = 2
STEPS: Final = 250
SETTINGS: Final = SessionSettings(LANES, 0.1, 0.1 / 12)
RESET_EVERY: Final = 60
FREEZE_S: Final = (0.001, 0.08)
"""Shortest and longest freeze: a wait polls, then yields, and after 50 ms it sleeps."""
THAW_S: Final = (0.0005, 0.02)
SLOW_S: Final = 0.004
SLOW_EVERY: Final = 4


def wait_spinning() -> None:
    """Poll, and never give the core away."""
    waiting.POLLS = 10**9


def wait_yielding() -> None:
    """Yield between any two polls, and never sleep."""
    waiting.POLLS, waiting.YIELDING_S = 1, 1e9


def wait_sleeping() -> None:
    """Sleep between any two polls."""
    waiting.POLLS, waiting.YIELDING_S = 1, 0.0


@dataclass(frozen=True)
class Variant:
    """One way to fly the same."""

    transport: str = "shm"
    freeze: tuple[str, ...] = ()
    """The sides that are stopped and continued again and again."""
    slow: str = ""
    """The side that sleeps in some of its steps."""
    one_core: bool = False
    wait: Callable[[], None] | None = None
    """Changes how both sides wait; None leaves the usual way."""
    compiled: tuple[str, ...] = ()
    """The sides that exchange steps by machine code."""


VARIANTS: Final = {
    "shared memory": Variant(),
    "a mapped file": Variant("file"),
    "one core": Variant(one_core=True),
    "one core, a mapped file, both frozen": Variant("file", SIDES, one_core=True),
    "agent frozen": Variant(freeze=("agent",)),
    "physics frozen": Variant("file", freeze=("physics",)),
    "agent slow": Variant("file", slow="agent"),
    "physics slow": Variant(slow="physics"),
    "spinning": Variant(wait=wait_spinning),
    "yielding": Variant(wait=wait_yielding),
    "yielding on one core, both frozen": Variant(freeze=SIDES, one_core=True, wait=wait_yielding),
    "sleeping": Variant(wait=wait_sleeping),
    "sleeping on one core, agent frozen": Variant(freeze=("agent",), one_core=True, wait=wait_sleeping),
    "machine code": Variant(compiled=SIDES),
    "machine code of the agent's, physics frozen": Variant("file", ("physics",), compiled=("agent",)),
    "machine code of physics, one core": Variant(one_core=True, compiled=("physics",)),
    "machine code, both frozen": Variant(freeze=SIDES, compiled=SIDES),
}


class _SlowPlant(ToyPlant):
    """The toy, which takes its time now and then."""

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Step, late."""
        _dawdle(int(poses.step[0]))
        super().step(commands, poses)


def _dawdle(step: int) -> None:
    if step % SLOW_EVERY == 0:
        time.sleep(random.uniform(0.0, SLOW_S))  # another time in every flight


def fly(session: AgentSession, slow: bool = False) -> str:
    """Fly by commands that follow from the poses; the hash of all commands and poses as they crossed."""
    resets, commands = ResetBatch.zeros(LANES), CommandBatch.zeros(LANES)
    resets.parameters[:, : len(DEFAULTS)], resets.quaternion[:, 3] = DEFAULTS, 1.0
    resets.position[:, 0] = np.arange(LANES)
    resets.selected[:] = 1
    poses, bytes_of_all = session.reset(resets), hashlib.sha256()
    for step in range(STEPS):
        if slow:
            _dawdle(step)
        if step % RESET_EVERY == RESET_EVERY - 1:
            resets.selected[:] = np.arange(LANES) == step % LANES
            resets.position[:] = poses.position[::-1]
            bytes_of_all.update(session.reset(resets).raw.tobytes())
        steer(poses, commands)
        poses = session.step(commands)
        bytes_of_all.update(commands.raw.tobytes() + poses.raw.tobytes())
    return bytes_of_all.hexdigest()


def steer(poses: PoseBatch, commands: CommandBatch) -> None:
    """Commands from poses by arithmetic that enlarges a difference of the last bit within some steps."""
    x = 1000.0 * (poses.position + poses.linear_velocity + poses.angular_velocity + poses.quaternion[:, :3])
    wish = np.sin(x) + np.array([0.1, 0.2, 0.3])
    commands.direction[:] = wish / np.sqrt((wish * wish).sum(1, keepdims=True))
    commands.speed[:] = 5.0 + 4.0 * np.cos(x[:, 1])
    commands.compensation[:] = 1.0 + 0.5 * np.sin(x[:, 2])


def undisturbed() -> str:
    """The hash of the flight with both sides in this process."""
    with open_twin(ToyPlant(), SETTINGS) as session:
        return fly(session)


def run_variant(variant: Variant, chance: random.Random) -> dict[str, Any]:
    """Fly one way; the hash and how often a side was frozen.

    Raises:
        AssertionError: a side failed.
    """
    core = min(os.sched_getaffinity(0))

    def prepare(side: str) -> None:
        if variant.one_core:
            os.sched_setaffinity(0, {core})
        if variant.wait is not None:
            variant.wait()

    plant = _SlowPlant if variant.slow == "physics" else ToyPlant
    roles = Roles(
        SETTINGS,
        plant,
        lambda session: fly(session, variant.slow == "agent"),
        {side: COMPILED if side in variant.compiled else STDLIB for side in SIDES},
        prepare,
    )
    freezes = 0
    with meeting(variant.transport) as rendezvous:
        pair = Pair(rendezvous, roles)
        while variant.freeze and not pair.ended("agent"):
            side = chance.choice(variant.freeze)
            time.sleep(chance.uniform(*THAW_S))
            pair.signal(side, signal.SIGSTOP)
            time.sleep(chance.uniform(*FREEZE_S))
            freezes += not pair.ended(side)
            pair.signal(side, signal.SIGCONT)
        ends = pair.finish()
    agent, physics = (ends[side] for side in SIDES)
    if agent is None or physics is None or agent.error or physics.error:
        raise AssertionError(f"agent {agent}, physics {physics}")
    return {"hash": agent.value, "freezes": freezes}


def run_pauses(seed: int) -> dict[str, Any]:
    """Fly in every way, one after another; the first is undisturbed and without a second process."""
    chance, ways = random.Random(seed), exchanges()
    flights: dict[str, Any] = {"twin": {"hash": undisturbed(), "freezes": 0}}
    for name, variant in VARIANTS.items():
        if COMPILED in ways or not variant.compiled:
            flights[name] = run_variant(variant, chance)
    return flights
