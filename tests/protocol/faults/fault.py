"""How faults are written: a function that puts something wrong in place and returns the plant to serve.

Whatever is not named in a fault works as it should: the toy plant behind the ordinary physics side.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from protocol import layout
from protocol.errors import Refusal
from protocol.layout import POSE
from protocol.physics import PhysicsSession
from protocol.plant import Plant, PlantDescription
from protocol.toy import ToyPlant

Make = Callable[[], Plant]

FAULTS: dict[str, Make] = {}
"""Faults by the rule that catches them."""


class Deliberate(Exception):  # noqa: N818  it is meant
    """The fault is that the server ends here."""


def fault(*rules: str) -> Callable[[Make], Make]:
    """Register what makes a broken server, for each of the rules that must catch it."""

    def register(make: Make) -> Make:
        for rule in rules:
            assert rule not in FAULTS, rule
            FAULTS[rule] = make
        return make

    return register


def promising_walls(said: PlantDescription) -> PlantDescription:
    """The description of a plant whose tubes have walls."""
    return dataclasses.replace(said, walls=True)


class Walled(ToyPlant):
    """Says that its tubes have walls, and has none."""

    def describe(self) -> PlantDescription:
        """Promise walls."""
        return promising_walls(super().describe())


Publish = Callable[[PhysicsSession, int, int, int], None]


def around_publish(wrap: Callable[[Publish, PhysicsSession, int, int, int], None]) -> None:
    """Put `wrap(publish, session, status, engine_ns, number)` in place of what publishes replies."""
    publish = PhysicsSession._publish

    def replacement(
        session: PhysicsSession, status: int, engine_ns: int, number: int, *refusal: Refusal
    ) -> None:
        def whole(session: PhysicsSession, status: int, engine_ns: int, number: int) -> None:
            publish(session, status, engine_ns, number, *refusal)

        wrap(whole, session, status, engine_ns, number)

    PhysicsSession._publish = replacement  # type: ignore[method-assign]


def write_reply(session: PhysicsSession, number: int, **words: int) -> None:
    """Publish a reply by hand, each word as it is given, the doorbell last."""
    session._pose[layout.pose_rows(session.offer.settings.lanes)] = session._pose_bytes
    sound = {"begin": number, "status": 0, "step": session.steps, "engine_ns": 0, "end": number}
    for name, value in {**sound, **words, "doorbell": words.get("doorbell", number)}.items():
        layout.write_i64(session._pose, POSE[name], value)
    session.number = number
