"""Any words in headers, requests and replies: a typed end, no hang, and nothing integrated that was not asked for.

What is expected of each comes from an oracle that was written from the specification alone (`tests/helpers`).
"""

from __future__ import annotations

import math
import os
import struct
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from specified import Oracle, common_is_sound

from protocol import layout
from protocol.agent import AgentSession, SessionSettings
from protocol.errors import HandshakeError, PeerLost, PeerViolation, ProtocolError, Refusal, SessionError
from protocol.handshake import Answer, magic, read_farewell, read_offer, write_answer
from protocol.layout import COMMAND, HEADER, POSE, Field
from protocol.memory import parse_rendezvous
from protocol.opening import create_segments
from protocol.physics import PhysicsSession
from protocol.plant import CommandBatch, Plant, PlantDescription, PoseBatch, ResetBatch, TubeReference
from protocol.toy import DEFAULTS, ToyPlant

LANES, TUBE_SLOTS = 2, 3
SETTINGS = SessionSettings(LANES, 0.1, 0.025, TUBE_SLOTS)
Start = Callable[..., subprocess.Popen[str]]


def examples(count: int) -> Any:
    """So many examples, the same ones in every run, none of them stored."""
    return settings(
        max_examples=count,
        derandomize=True,
        deadline=None,
        database=None,
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    )


integers = st.sampled_from(
    [0, 1, 2, 3, 4, 5, -1, 2**31, 2**32 + 1, 2**62, 2**63 - 1, -(2**63)]
) | st.integers(-(2**63), 2**63 - 1)
tiny, huge = 5e-324, 1.7976931348623157e308
floats = (
    st.sampled_from([0.0, -0.0, 1.0, -1.0, 0.5, 0.1, 0.025, 0.05, tiny, -tiny, huge, -huge, 1e-300])
    | st.sampled_from([math.nan, -math.nan, math.inf, -math.inf])
    | st.sampled_from([0.999998, 0.9999996, 1.0000004, 1.000002, 2.0, 10.0, 10.000001])  # around the limits
    | st.floats()
)
words = (
    st.binary(min_size=8, max_size=8)
    | floats.map(lambda x: struct.pack("<d", x))
    | integers.map(lambda x: x.to_bytes(8, "little", signed=True))
)


def put(view: memoryview, place: Field, word: bytes, at: int = 0) -> None:
    """Write one word of a field, or as much of it as the field has."""
    room = min(len(word), place.size - at)
    view[place.offset + at : place.offset + at + room] = word[:room]


def spoil(view: memoryview, changes: dict[str, bytes], fields: dict[str, Field]) -> None:
    """Write words over fields by name."""
    for name, word in changes.items():
        put(view, fields[name], word)


# ---------------------------------------------------------------------------------------------------------------
# Headers


header_words = st.dictionaries(st.sampled_from([place.name for place in HEADER]), words, max_size=3)


@examples(1500)
@given(header_words, st.sampled_from([0, 8, 4096]))
def test_any_header_of_an_agent_is_taken_or_refused(changes: dict[str, bytes], more: int) -> None:
    """Physics takes exactly the headers that the specification takes; of any other it writes no magic."""
    command = memoryview(bytearray(layout.command_bytes(LANES) + more))
    pose = memoryview(bytearray(layout.pose_bytes(LANES) + more))
    AgentSession(command[: layout.command_bytes(LANES)], pose[: layout.pose_bytes(LANES)], SETTINGS)
    spoil(command, changes, COMMAND)
    lanes = layout.read_i64(command, COMMAND["lanes"])
    sound = common_is_sound(command, b"TUBE.CMD", 6464 + 448 * lanes) and lanes <= LANES
    try:
        PhysicsSession(command.toreadonly(), pose, ToyPlant()).close()
    except HandshakeError:
        assert not sound
        assert magic(pose) == bytes(8)
    else:
        assert sound in (True, None)
        assert magic(pose) == b"TUBE.POS"


@examples(1500)
@given(
    header_words
    | st.dictionaries(
        st.sampled_from(["speed_max", "walls", "defaults", "plant_name", "plant_engine"]), words
    ),
)
def test_any_header_of_a_physics_side_is_taken_or_refused(changes: dict[str, bytes]) -> None:
    """The agent takes exactly a header that echoes its own and has finite words."""
    command = memoryview(bytearray(layout.command_bytes(LANES)))
    pose = memoryview(bytearray(layout.pose_bytes(LANES)))
    session = AgentSession(command, pose, SETTINGS)
    write_answer(pose, read_offer(command), Answer(ToyPlant().describe(), 1, 2))
    before = bytes(pose)
    spoil(pose, changes, POSE)
    free = {"version_minor", "pid", "start_time", "plant_name", "plant_engine"}
    sound = all(
        name in free or bytes(pose[POSE[name].bytes]) == before[POSE[name].bytes]
        for name in changes
        if name not in ("speed_max", "walls", "defaults")
    )
    speed_max, defaults = layout.read_f64(pose, POSE["speed_max"])[0], layout.read_f64(pose, POSE["defaults"])
    sound = sound and 0.0 < speed_max < math.inf and all(map(math.isfinite, defaults))
    sound = sound and layout.read_i64(pose, POSE["walls"]) in (0, 1)
    try:
        session.attached(lambda old, step, phase: old + 1)
    except HandshakeError:
        assert not sound
    else:
        assert sound


# ---------------------------------------------------------------------------------------------------------------
# Requests


class CountingPlant(Plant):
    """Moves nothing, and notes what it was asked for; its poses tell how many steps it made."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def describe(self) -> PlantDescription:
        """Say what the toy says."""
        return ToyPlant().describe()

    def open(self, lanes: int, dt: float, physics_dt: float, inner_steps: int) -> None:
        """Nothing to prepare."""

    def register_tube(self, index: int, tube: TubeReference) -> None:
        """Note it."""
        self.asked.append(f"register {index}")

    def release_tube(self, index: int) -> None:
        """Note it."""
        self.asked.append(f"release {index}")

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Note it; answer with the states that were asked for."""
        chosen = resets.selected == 1
        self.asked.append(f"reset {np.flatnonzero(chosen).tolist()}")
        poses.raw[chosen, :13] = resets.raw[chosen, :13]
        poses.step[chosen] = 0

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Note it and count."""
        self.asked.append("step")
        poses.step[:] += 1

    def close(self) -> None:
        """Nothing to give up."""


payloads = st.dictionaries(
    st.tuples(st.integers(0, LANES - 1), st.integers(0, 15) | st.integers(0, 47)),
    words
    | st.just(bytes(8))
    | st.integers(-1, TUBE_SLOTS).map(lambda x: x.to_bytes(8, "little", signed=True)),
    max_size=3,
)
tube_indices = st.integers(-1, TUBE_SLOTS)
tube_words = st.tuples(
    tube_indices, st.sampled_from([0, 1]), st.sampled_from([1.0, 0.001]), st.none(), st.just(b"/a.obj")
) | st.tuples(
    tube_indices | integers,
    st.sampled_from([0, 1, 2]) | integers,
    st.just(1.0) | floats,
    st.none() | st.sampled_from([0, 4096, 4097]) | integers,
    st.just("/ü.obj".encode()) | st.binary(min_size=1, max_size=12),
)
wrong_words = (
    st.none()
    | st.none()
    | st.dictionaries(
        st.sampled_from(["begin", "op", "step", "end", "doorbell"]), integers | st.integers(-2, 7), max_size=2
    )
)
requests = st.lists(
    st.tuples(st.sampled_from([1, 1, 2, 2, 3, 3, 4]), payloads, tube_words, wrong_words),
    min_size=1,
    max_size=10,
)


def sound_rows(command: memoryview, tube: int) -> None:
    """Write sound commands, and sound resets of all lanes into a tube."""
    commands, resets = CommandBatch.zeros(LANES), ResetBatch.zeros(LANES)
    commands.direction[:, 2], commands.compensation[:] = 1.0, 1.0
    resets.selected[:], resets.parameters[:, : len(DEFAULTS)], resets.tube[:] = 1, DEFAULTS, tube
    resets.quaternion[:, 3] = 1.0
    command[layout.command_rows(LANES)] = commands.raw.tobytes()
    command[layout.reset_rows(LANES)] = resets.raw.tobytes()


def write_request(
    command: memoryview,
    number: int,
    steps: int,
    op: int,
    payload: Any,
    tube: Any,
    wrong: dict[str, int] | None,
) -> int:
    """Write one request of the kind `requests` draws; its op, or 0 where its words are not those that are due."""
    index, axes, scale, size, path = tube
    sound_rows(command, 0 if index == 0 else -1)
    for (lane, word), value in payload.items():
        width, start = (64, 6464) if op == 1 else (384, 6464 + 64 * LANES)
        at = start + width * lane + 8 * (word % (width // 8))
        command[at : at + 8] = value
    struct.pack_into("<2qd", command, 2048, index, axes, scale)
    struct.pack_into("<q4096s", command, 2104, len(path) if size is None else size, path)
    words = {"begin": number, "op": op, "step": steps + (op == 1), "end": number, "doorbell": number}
    words |= wrong or {}
    for name, value in words.items():
        layout.write_i64(command, COMMAND[name], value)
    whole = all(words[name] == number for name in ("begin", "end", "doorbell"))
    known = words["op"] in (1, 2, 3, 4, 5) and words["step"] == steps + (words["op"] == 1)
    return words["op"] if whole and known else 0


TUBE_0 = (0, 0, 1.0, None, b"/a.obj")


@examples(800)
@given(requests)
@example([(3, {}, TUBE_0, None), (2, {}, TUBE_0, None), (1, {}, TUBE_0, None), (4, {}, TUBE_0, None)])
def test_any_sequence_of_requests_is_answered_as_specified(drawn: list[Any]) -> None:
    """Done, refused by code and lane, or a violation, as is specified; refused and wrong ones move nothing."""
    command = memoryview(bytearray(layout.command_bytes(LANES)))
    pose = memoryview(bytearray(layout.pose_bytes(LANES)))
    AgentSession(command, pose, SETTINGS)
    plant, oracle = CountingPlant(), Oracle(LANES, TUBE_SLOTS)
    physics = PhysicsSession(command.toreadonly(), pose, plant)
    for op, payload, tube, wrong in drawn:
        number, asked, rows = physics.number + 1, list(plant.asked), bytes(pose[layout.pose_rows(LANES)])
        published = write_request(command, number, oracle.steps, op, payload, tube, wrong)
        if published == 0:
            with pytest.raises(PeerViolation):
                physics.answer(layout.read_i64(command, COMMAND["doorbell"]))
            assert plant.asked == asked
            assert bytes(pose[layout.pose_rows(LANES)]) == rows
            assert layout.read_i64(pose, POSE["doorbell"]) == number - 1
            return
        code, lane = oracle.answer(published, command)
        assert physics.answer(number) == (published != 5)
        status, step = layout.read_i64(pose, POSE["status"]), layout.read_i64(pose, POSE["step"])
        assert (status, step) == (int(code != 0), oracle.steps)
        assert [layout.read_i64(pose, POSE[name]) for name in ("begin", "end", "doorbell")] == [number] * 3
        if code:
            found = [layout.read_i64(pose, POSE[name]) for name in ("refusal_code", "refusal_lane")]
            assert found == [code, lane]
            assert plant.asked == asked
            assert bytes(pose[layout.pose_rows(LANES)]) == rows
        else:
            assert len(plant.asked) == len(asked) + (published != 5)
        if published == 5:
            return


# ---------------------------------------------------------------------------------------------------------------
# Replies


reply_words = st.dictionaries(
    st.sampled_from(["begin", "status", "step", "engine_ns", "end", "doorbell"]),
    integers | st.integers(0, 4),
    max_size=3,
)
texts = st.dictionaries(
    st.sampled_from(["refusal_code", "refusal_lane", "refusal_field", "refusal_expected", "refusal_found"]),
    st.binary(min_size=8, max_size=40),
)


@examples(1000)
@given(reply_words, texts, st.binary(min_size=64, max_size=256))
def test_any_reply_is_taken_refused_or_a_violation(
    changes: dict[str, int], refusal: dict[str, bytes], row: bytes
) -> None:
    """The agent counts a step only where every word is right; any text of a refusal can be told, any code is one."""
    command = memoryview(bytearray(layout.command_bytes(LANES)))
    pose = memoryview(bytearray(layout.pose_bytes(LANES)))
    session = AgentSession(command, pose, SETTINGS)
    write_answer(pose, read_offer(command), Answer(ToyPlant().describe(), 1, 0))
    published: dict[str, int] = {}

    def reply(old: int, step: int, phase: str) -> int:
        published.update(
            {"begin": 1, "status": 0, "step": 1, "engine_ns": 0, "end": 1, "doorbell": 1} | changes
        )
        for name, value in published.items():
            layout.write_i64(pose, POSE[name], value)
        spoil(pose, refusal, POSE)
        put(pose, Field(layout.pose_rows(LANES).start, "poses", "bytes", 256, ""), row)
        return layout.read_i64(pose, POSE["doorbell"])

    session.attached(reply)
    numbers = all(published_or(changes, name) == 1 for name in ("begin", "end", "doorbell"))
    status, step = changes.get("status", 0), changes.get("step", 1)
    commands = CommandBatch.zeros(LANES)
    try:
        poses = session.step(commands)
    except Refusal:
        assert numbers
        assert (status, step, session.steps) == (1, 0, 0)
    except PeerViolation:
        assert not (numbers and (status, step) in ((0, 1), (1, 0)))
        assert read_farewell(command)[0] == 3
        assert session.steps == 0
        with pytest.raises(SessionError):
            session.step(commands)
    else:
        assert numbers
        assert (status, step, session.steps) == (0, 1, 1)
        assert poses.raw.tobytes() == bytes(pose[layout.pose_rows(LANES)])


def published_or(changes: dict[str, int], name: str) -> int:
    """A reply's word, 1 where it is the right one."""
    return changes.get(name, 1)


# ---------------------------------------------------------------------------------------------------------------
# Names and processes


@examples(300)
@given(
    st.sampled_from(["shm:", "file:", "file:/none/", "file:FOLDER/", ""]), st.text(max_size=90), st.booleans()
)
def test_any_text_for_a_rendezvous_is_taken_or_refused(
    tmp_path: Path, name: str, kind: str, text: str, long: bool
) -> None:
    """Whatever is given as a rendezvous: a session is offered there and taken back, or a typed error says why not."""
    place = (
        kind.replace("FOLDER", str(tmp_path)) + (name if kind == "shm:" else "") + text + "x" * (5000 * long)
    )
    with suppress(SessionError):
        AgentSession.offer(place, SETTINGS).close()


def test_a_segment_whose_length_is_no_whole_number_of_words_is_served(tmp_path: Path, start: Start) -> None:
    """A file that somebody made a little longer is mapped all the same; sizes come from the header."""
    place = f"file:{tmp_path / 'odd'}"
    with AgentSession.offer(place, SETTINGS) as session:
        for segment in tmp_path.glob("odd.*"):
            with segment.open("ab") as file:
                file.write(b"\0\0\0")
        server = start("serve", place)
        session.await_physics(attach_timeout=20.0)
    assert server.wait(20) == 0


@examples(5)
@given(
    st.dictionaries(st.sampled_from([place.name for place in HEADER]), words, min_size=1, max_size=3),
    requests,
)
def test_a_server_process_ends_in_order_whatever_it_is_told(
    tmp_path: Path, name: str, changes: dict[str, bytes], drawn: list[Any]
) -> None:
    """Another process that is given any header and any requests ends by itself, with a typed error and no trace."""
    for spoilt in (changes, {}):
        segments = create_segments(parse_rendezvous(f"shm:{name}"), LANES)
        try:
            said = _serve_by_hand(segments.command.view, segments.pose.view, f"shm:{name}", spoilt, drawn)
        finally:
            segments.unlink()
            segments.close()
        assert "Traceback" not in said
        assert said == "" or said.split(":")[0] in {
            error.__name__ for error in ProtocolError.__subclasses__()
        }


def _serve_by_hand(
    command: memoryview, pose: memoryview, place: str, changes: dict[str, bytes], drawn: list[Any]
) -> str:
    """Offer a header, make requests until one is not answered, leave; what the server says of it all."""
    peers = Path(__file__).with_name("peers.py")
    server = subprocess.Popen(
        [sys.executable, str(peers), "serve", place, os.devnull, "0.3"],
        stderr=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(peers.parents[2])},
    )  # fmt: skip
    try:
        with AgentSession(command, pose, SETTINGS) as session:
            spoil(command, changes, COMMAND)
            try:
                session.await_physics(lambda: None if server.poll() is None else "it ended", 20.0)
            except ProtocolError:
                drawn = []
            for number, (op, payload, tube, wrong) in enumerate(drawn, 1):
                write_request(command, number, layout.read_i64(pose, POSE["step"]), op, payload, tube, wrong)
                rung = layout.read_i64(command, COMMAND["doorbell"])
                try:
                    session._wait(number - 1, 0, "fuzz")
                except (PeerLost, SessionError):
                    break
                if rung != number:
                    break
        return str(server.communicate(timeout=20.0)[1])
    finally:
        server.kill()
        server.communicate()
