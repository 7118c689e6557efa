"""Wrong headers: each is refused by a typed error that names field, expected and found."""

from __future__ import annotations

import math

import pytest

from protocol import layout
from protocol.agent import AgentSession, SessionSettings
from protocol.errors import HandshakeError
from protocol.handshake import Answer, part, read_answer, read_farewell, read_offer, write_answer
from protocol.layout import COMMAND, POSE, Farewell
from protocol.physics import PhysicsSession
from protocol.plant import PlantDescription
from protocol.toy import ToyPlant

SETTINGS = SessionSettings(2, 0.1, 0.025)


class Pair:
    """Two segments with the agent's header, and if wanted the physics side's."""

    def __init__(self, answered: bool = False) -> None:
        self.command = memoryview(bytearray(layout.command_bytes(2)))
        self.pose = memoryview(bytearray(layout.pose_bytes(2)))
        self.session = AgentSession(self.command, self.pose, SETTINGS)
        if answered:
            write_answer(self.pose, read_offer(self.command), Answer(ToyPlant().describe(), 1, 2))


def spoil(view: memoryview, name: str, value: int | float | bytes) -> None:
    """Overwrite a header field."""
    field = COMMAND[name] if name in COMMAND else POSE[name]
    if isinstance(value, bytes):
        view[field.bytes] = value
    elif isinstance(value, float):
        layout.write_f64(view, field, value)
    else:
        layout.write_i64(view, field, value)


WRONG_OFFERS: list[tuple[str, int | float | bytes]] = [
    ("magic", b"TUBE.POS"),
    ("magic", b"OTHER!!!"),
    ("version_major", 2),
    ("version_major", 0),
    ("segment_bytes", 6464 + 447 * 2),
    ("lanes", 0),
    ("lanes", -1),
    ("lanes", 65_537),
    ("dt", math.nan),
    ("dt", 0.11),
    ("dt", -0.1),
    ("physics_dt", 0.0),
    ("physics_dt", math.inf),
    ("inner_steps", 0),
    ("inner_steps", 5),
    ("tube_slots", 0),
    ("command_stride", 56),
    ("pose_stride", 136),
    ("reset_stride", 0),
]


@pytest.mark.parametrize(("name", "value"), WRONG_OFFERS)
def test_physics_refuses_a_wrong_header_of_the_agent(name: str, value: int | float | bytes) -> None:
    """Physics names the field, and leaves the pose segment's magic unwritten."""
    pair = Pair()
    spoil(pair.command, name, value)
    with pytest.raises(HandshakeError, match=r"expected .*, found ") as caught:
        PhysicsSession(pair.command, pair.pose, ToyPlant())
    named = {"dt": ("dt", "inner_steps"), "lanes": ("lanes", "size")}.get(name, (name,))
    assert caught.value.field.startswith(named)
    assert not any(pair.pose[:8])


def test_physics_refuses_an_absurd_number_of_inner_steps() -> None:
    """A whole number of inner steps that nobody could wait for is refused, though it fits the two times."""
    pair = Pair()
    spoil(pair.command, "dt", 2_000_000 * 0.025)
    spoil(pair.command, "inner_steps", 2_000_000)
    with pytest.raises(HandshakeError, match="a whole number up to 1000000"):
        PhysicsSession(pair.command, pair.pose, ToyPlant())


def test_physics_refuses_more_lanes_than_the_segment_holds() -> None:
    """A lane count that the stated size does not fit is refused by size."""
    pair = Pair()
    spoil(pair.command, "lanes", 3)
    with pytest.raises(HandshakeError, match=r"segment_bytes of the command segment: expected '?7808"):
        PhysicsSession(pair.command, pair.pose, ToyPlant())


def test_physics_refuses_segments_that_are_cut_short() -> None:
    """A mapping shorter than its lanes need is refused, whichever of the two it is."""
    pair = Pair()
    with pytest.raises(HandshakeError, match="size of the command segment"):
        PhysicsSession(pair.command[:-8], pair.pose, ToyPlant())
    with pytest.raises(HandshakeError, match="size of the pose segment"):
        PhysicsSession(pair.command, pair.pose[:-8], ToyPlant())


WRONG_ANSWERS: list[tuple[str, int | float | bytes]] = [
    ("magic", b"TUBE.CMD"),
    ("version_major", 9),
    ("segment_bytes", 1),
    ("session", b"another session."),
    ("lanes", 3),
    ("dt", 0.2),
    ("physics_dt", 0.05),
    ("inner_steps", 2),
    ("tube_slots", 1),
    ("command_stride", 1),
    ("pose_stride", 1),
    ("reset_stride", 1),
    ("speed_max", 0.0),
    ("speed_max", math.nan),
    ("walls", 2),
]


@pytest.mark.parametrize(("name", "value"), WRONG_ANSWERS)
def test_the_agent_refuses_a_wrong_header_of_physics(name: str, value: int | float | bytes) -> None:
    """The agent names the field in which physics does not echo what was offered."""
    pair = Pair(answered=True)
    spoil(pair.pose, name, value)
    with pytest.raises(HandshakeError, match=r"expected .*, found ") as caught:
        pair.session.attached(lambda old, step, phase: old + 1)
    assert caught.value.field.startswith(name)


def test_a_newer_minor_version_is_welcome() -> None:
    """Another minor version on either side is accepted."""
    pair = Pair()
    spoil(pair.command, "version_minor", 7)
    PhysicsSession(pair.command, pair.pose, ToyPlant())
    spoil(pair.pose, "version_minor", 9)
    pair.session.attached(lambda old, step, phase: old + 1)
    assert pair.session.description == ToyPlant().describe()


def test_a_longer_mapping_is_welcome() -> None:
    """A mapping may be rounded up to pages; sizes come from the header."""
    pair = Pair()
    PhysicsSession(
        memoryview(bytearray(pair.command) + bytes(512)), memoryview(bytearray(8192)), ToyPlant()
    ).close()


def test_a_refused_handshake_is_told_to_the_other_side() -> None:
    """The error that ended the handshake stands as a farewell in our own segment."""
    pair = Pair()
    part(pair.pose, HandshakeError("lanes", "2", "3"))
    assert read_farewell(pair.pose) == (Farewell.HANDSHAKE, "lanes: expected 2, found 3")


def test_a_description_survives_the_header() -> None:
    """Names with any characters arrive as they were, cut only where they do not fit."""
    said = PlantDescription("ünity", "2022.3 β", "x" * 200, 2.5, tuple(float(i) for i in range(18)), True)
    pair = Pair()
    offer = read_offer(pair.command)
    write_answer(pair.pose, offer, Answer(said, 11, 12))
    found = read_answer(pair.pose, offer)
    assert (found.pid, found.started) == (11, 12)
    assert found.description == PlantDescription("ünity", "2022.3 β", "x" * 128, 2.5, said.defaults, True)
