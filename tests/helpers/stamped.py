"""A session in which every word tells its step, so that a torn reading shows: `python stamped.py PART RENDEZVOUS LANES`.

`serve` answers each step with rows of which every word is the step; `fly` commands a direction, a speed and a
compensation that follow from the step, as fast as it can, until it is killed or `STEPS` are flown.
"""

from __future__ import annotations

import math
import sys

import numpy as np

from protocol.agent import AgentSession, SessionSettings
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


def main() -> None:
    """Play the part that the command line names."""
    part, rendezvous, lanes, *rest = sys.argv[1:]
    if part == "serve":
        serve(rendezvous, StampPlant())
    else:
        fly(rendezvous, int(lanes), int(rest[0]) if rest else sys.maxsize)


if __name__ == "__main__":
    main()
