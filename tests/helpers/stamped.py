"""A session in which every word tells its step, so that a torn reading shows.

python stamped.py serve RENDEZVOUS                 answers each step with rows of which every word is the step
python stamped.py fly RENDEZVOUS LANES [STEPS]     commands what follows from the step, as fast as it can, then
                                                   says goodbye
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from protocol.agent import AgentSession, SessionSettings
from protocol.layout import COMMAND_MAGIC
from protocol.physics import serve
from protocol.plant import CommandBatch, PlantDescription, PoseBatch, ResetBatch
from protocol.toy import DEFAULTS, SPEED_MAX, ToyPlant

PERIOD = 997
"""Steps after which the commands repeat."""


class StampPlant(ToyPlant):
    """Answers step k with rows of 13 words k, `sim_time` k, `contact_steps` k and `step` k."""

    def describe(self) -> PlantDescription:
        """Say what this plant is."""
        return PlantDescription("stamp", "1", "none", SPEED_MAX, DEFAULTS)

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """All words zero."""
        poses.raw[:] = 0.0

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Stamp every word."""
        step = int(poses.step[0]) + 1
        poses.raw[:] = step
        poses.contact_steps[:] = poses.step[:] = step


def stamp(commands: CommandBatch, step: int) -> None:
    """Write the commands of a step."""
    k = step % PERIOD
    angle = 2.0 * math.pi * k / PERIOD
    commands.direction[:] = math.cos(angle), math.sin(angle), 0.0
    commands.speed[:], commands.compensation[:] = 10.0 * k / PERIOD, 2.0 * k / PERIOD


def fly(rendezvous: str, lanes: int, steps: int) -> None:
    """Reset all lanes, then step them."""
    with AgentSession.open(rendezvous, SessionSettings(lanes, 0.1, 0.1)) as session:
        resets, commands = ResetBatch.zeros(lanes), CommandBatch.zeros(lanes)
        resets.selected[:], resets.parameters[:, : len(DEFAULTS)] = 1, DEFAULTS
        session.reset(resets)
        for step in range(1, steps + 1):
            stamp(commands, step)
            poses = session.step(commands)
            assert np.all(poses.step == step)


def offered(rendezvous: object) -> bool:
    """Whether the agent's header stands whole; a kill before leaves a header that is unfinished and not dead."""
    kind, _, stem = str(rendezvous).partition(":")
    path = Path(f"/dev/shm/{stem}.cmd" if kind == "shm" else f"{stem}.cmd")
    return path.exists() and path.read_bytes()[:8] == COMMAND_MAGIC


@contextmanager
def part(*arguments: object) -> Iterator[subprocess.Popen[bytes]]:
    """Play a part in a process of its own, which is killed at the end."""
    command = [sys.executable, __file__, *map(str, arguments)]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    process = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def main() -> None:
    """Play the part that the command line names."""
    role, rendezvous, *rest = sys.argv[1:]
    if role == "serve":
        serve(rendezvous, StampPlant())
    else:
        fly(rendezvous, int(rest[0]), int(rest[1]) if rest[1:] else sys.maxsize)


if __name__ == "__main__":
    main()
