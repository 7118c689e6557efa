"""Faults of speed."""

from __future__ import annotations

import time
from types import SimpleNamespace

from fault import Publish, around_publish, fault

from protocol import waiting
from protocol.physics import PhysicsSession
from protocol.plant import CommandBatch, Plant, PoseBatch
from protocol.toy import ToyPlant
from protocol.waiting import Waiter


@fault("no-sleep-in-step")
class Sleeps(ToyPlant):
    """A step sleeps a little."""

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Sleep."""
        time.sleep(0.002)
        super().step(commands, poses)


@fault("idle-cpu")
def spins() -> Plant:
    """A wait never sleeps."""
    waiting.time = SimpleNamespace(monotonic=time.monotonic, sleep=lambda seconds: None)  # type: ignore[attr-defined]
    return ToyPlant()


@fault("long-pause")
def gives_up() -> Plant:
    """It gives the agent half a second."""
    usual = Waiter.__init__

    def impatient(self: Waiter, *arguments: object) -> None:
        usual(self, *arguments)  # type: ignore[arg-type]
        self.deadline = 0.5

    Waiter.__init__ = impatient  # type: ignore[method-assign]
    return ToyPlant()


@fault("lanes-cost")
def slow_lanes() -> Plant:
    """Many lanes take their time outside of the engine."""

    def publish(whole: Publish, session: PhysicsSession, status: int, engine_ns: int, number: int) -> None:
        if session.offer.settings.lanes > 1:
            time.sleep(0.01)
        whole(session, status, engine_ns, number)

    around_publish(publish)
    return ToyPlant()
