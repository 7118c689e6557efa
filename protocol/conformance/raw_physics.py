"""A physics side's half of a session by hand: every word of it can be written wrong, early, late or in pieces.

It shares no code with `protocol.physics`, so that the kit does not judge an agent by our own other half. Poses
come from the toy plant, whose free bodies fly as annex A says and know no walls.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from protocol.conformance.rig import PeerProcess
from protocol.conformance.rule import Failure, Silence
from protocol.conformance.stand_in import StandIn
from protocol.errors import Refusal, RefusalCode
from protocol.handshake import magic, read_farewell, write_farewell
from protocol.layout import (
    COMMAND,
    COMMAND_MAGIC,
    LANES_MAX,
    POSE,
    POSE_MAGIC,
    REQUEST,
    Farewell,
    Field,
    Op,
    Status,
    command_bytes,
    command_rows,
    pose_bytes,
    pose_rows,
    read_f64,
    read_i64,
    reset_rows,
    write_f64,
    write_i64,
    write_text,
)
from protocol.memory import COMMAND_SUFFIX, FENCE, POSE_SUFFIX, Segment, open_segment, parse_rendezvous
from protocol.plant import (
    COMMAND_WORDS,
    PARAMETER_INDEX,
    PARAMETER_SLOTS,
    RESET_WORDS,
    CommandBatch,
    PoseBatch,
    ResetBatch,
)
from protocol.toy import DEFAULTS, SPEED_MAX, ToyPlant
from protocol.validation import command_refusal, reset_refusal

POLL_S: Final = 0.0002
"""Sleep between two looks at a doorbell: the kit judges order and content here, not speed."""
LOOK_S: Final = 0.01
"""Time between two looks at the agent's process."""

_ECHOED: Final = (
    *("lanes", "dt", "physics_dt", "inner_steps", "tube_slots"),
    *("command_stride", "pose_stride", "reset_stride"),
)

Wrong = Mapping[str, int | float | bytes]
"""Fields by name, with what is written instead of the sound value."""


@dataclass(frozen=True)
class Request:
    """What stood in the command segment when a doorbell rang."""

    rung: int
    begin: int
    op: int
    step: int
    end: int
    segment: bytes
    """The whole command segment."""
    lanes: int

    @property
    def name(self) -> str:
        """The request in words."""
        op = Op(self.op).name.lower() if self.op in tuple(Op) else f"op {self.op}"
        return f"request {self.rung} ({op}, step {self.step})"

    @property
    def commands(self) -> CommandBatch:
        """The command rows."""
        block = np.frombuffer(self.segment[command_rows(self.lanes)], dtype=np.float64)
        return CommandBatch(block.reshape(self.lanes, COMMAND_WORDS).copy())

    @property
    def resets(self) -> ResetBatch:
        """The reset rows."""
        block = np.frombuffer(self.segment[reset_rows(self.lanes)], dtype=np.float64)
        return ResetBatch(block.reshape(self.lanes, RESET_WORDS).copy())


def write_field(view: memoryview, field: Field, value: int | float | bytes) -> None:
    """Write one value into a field of a segment: bytes as they are, a float into every word of an f64 field."""
    if isinstance(value, bytes):
        view[field.offset : field.offset + len(value)] = value
    elif field.kind == "f64":
        write_f64(view, field, *(float(value),) * field.count)
    else:
        write_i64(view, field, int(value))


class RawPhysics:
    """The physics side of one session, driven word by word; `close` gives its views up and ends its stand-in.

    Its process, to the agent, is the stand-in. Opened while the agent offers the session.

    Raises:
        Failure: the agent ended or offered no session in time.
    """

    def __init__(self, rendezvous: str, process: PeerProcess, timeout: float) -> None:
        self.rendezvous = rendezvous
        self.process = process
        """The agent."""
        self.timeout = timeout
        """How long the agent may take for its header and between two requests (s)."""
        self.number = 0
        """Number of the last request that was answered."""
        self.steps = 0
        """Control steps integrated in this session."""
        self.stand_in: StandIn | None = None
        self._command, self._pose = _await_offer(rendezvous, process, timeout)
        self.pose, self.command = self._pose.view, self._command.view.toreadonly()
        self.lanes = read_i64(self.command, COMMAND["lanes"])
        self._check_sizes()
        self._plant = ToyPlant()
        self._poses = PoseBatch.zeros(self.lanes)
        self._reset_lanes: set[int] = set()
        self._tubes: set[int] = set()

    def __enter__(self) -> RawPhysics:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give up the views and the stand-in; idempotent."""
        if self.stand_in is not None:
            self.stand_in.close()
        self.command.release()
        self._command.close()
        self._pose.close()

    # --- handshake ---

    def _check_sizes(self) -> None:
        """Raise a Failure where the header's lanes do not fit into the segments."""
        sizes = len(self.command), len(self.pose)
        if not (
            1 <= self.lanes <= LANES_MAX and sizes >= (command_bytes(self.lanes), pose_bytes(self.lanes))
        ):
            self.close()
            expected = f"1 to {LANES_MAX}, for which both segments are large enough"
            raise Failure(
                "lanes of the agent's header", expected, f"{self.lanes}, in segments of {sizes} bytes"
            )

    def begin_header(self) -> None:
        """Take the lock, by a new stand-in, and write whose header this will be."""
        if self.stand_in is not None:
            self.stand_in.close()
        self.stand_in = StandIn(self._pose.path)
        write_i64(self.pose, POSE["pid"], self.stand_in.pid)
        write_i64(self.pose, POSE["start_time"], self.stand_in.started)

    def attach(self, wrong: Wrong | None = None) -> None:
        """Publish a header; `wrong` fields carry other values than the sound ones."""
        if self.stand_in is None:
            self.begin_header()
        numbers: dict[str, int | float | bytes] = {
            "version_major": 1,
            "version_minor": read_i64(self.command, COMMAND["version_minor"]),
            "segment_bytes": pose_bytes(self.lanes),
            "session": bytes(self.command[COMMAND["session"].bytes]),
            **{name: bytes(self.command[COMMAND[name].bytes]) for name in _ECHOED},
            "speed_max": SPEED_MAX,
            "walls": 0,
            "defaults": struct.pack(f"<{PARAMETER_SLOTS}d", *DEFAULTS, *(0.0,) * (32 - len(DEFAULTS))),
        }
        for name, value in {**numbers, **(wrong or {})}.items():
            if name != "magic":
                write_field(self.pose, POSE[name], value)
        write_text(self.pose, POSE["plant_name"], "protocol.conformance")
        write_text(self.pose, POSE["plant_version"], "1")
        write_text(self.pose, POSE["plant_engine"], "toy plant, by hand")
        (dt,), (physics_dt,) = (
            read_f64(self.command, COMMAND["dt"]),
            read_f64(self.command, COMMAND["physics_dt"]),
        )
        self._plant.open(self.lanes, dt, physics_dt, read_i64(self.command, COMMAND["inner_steps"]))
        word = (wrong or {}).get("magic", POSE_MAGIC)
        assert isinstance(word, bytes)
        self.store("magic", int.from_bytes(word, "little", signed=True))

    def store(self, name: str, value: int) -> None:
        """Write one word of the pose segment in one store, with everything before it visible."""
        if FENCE is not None:
            FENCE()
        with self.pose.cast("q") as words:
            words[POSE[name].word] = value

    # --- requests ---

    def rung(self) -> int:
        """The agent's doorbell."""
        with self.command.cast("q") as words:
            value: int = words[COMMAND["doorbell"].word]
        return value

    def await_request(self) -> Request:
        """Wait for the agent's next request.

        Raises:
            Failure: the agent left or ended, or asked for nothing in time.
        """
        began = look_at = time.monotonic()
        while (rung := self.rung()) == self.number:
            now = time.monotonic()
            if now >= look_at:
                look_at = now + LOOK_S
                self._look(now - began)
            time.sleep(POLL_S)
        if FENCE is not None:
            FENCE()
        segment = bytes(self.command)
        begin, op, step, end = REQUEST.unpack_from(segment, COMMAND["begin"].offset)
        return Request(rung, begin, op, step, end, segment, self.lanes)

    def _look(self, waited: float) -> None:
        """Raise a Failure where no request can be expected any more."""
        farewell, ended = self.farewell(), self.process.watch()
        if self.rung() != self.number:  # it rang before it left
            return
        what = f"the agent after request {self.number}"
        if farewell[0]:
            raise Failure(what, "a request", f"farewell {farewell[0]}: {farewell[1]}")
        if ended is not None:
            raise Failure(what, "a request", f"its end without a goodbye, {ended}")
        if waited > self.timeout:
            raise Silence(what, f"a request within {self.timeout:g} s", "none, though it runs")

    def serve_until(self, wanted: Callable[[Request], bool]) -> Request | None:
        """Answer soundly until a request is wanted, which is returned unanswered; None where a goodbye came first.

        Raises:
            Failure: the agent left or ended otherwise, or asked for nothing in time.
        """
        while True:
            request = self.await_request()
            if wanted(request):
                return request
            self.answer(request)
            if request.op == Op.GOODBYE:
                return None

    def answer(self, request: Request) -> Refusal | None:
        """Carry a request out, or refuse it where it is not sound; publish the reply and return the refusal."""
        refusal = self._refusal(request)
        if refusal is not None:
            self.refuse(request.rung, refusal)
            return refusal
        index = int.from_bytes(request.segment[COMMAND["tube_index"].bytes], "little", signed=True)
        if request.op == Op.RESET:
            self._plant.reset(request.resets, self._poses)
            self._reset_lanes.update(np.flatnonzero(request.resets.selected).tolist())
        elif request.op == Op.STEP:
            try:
                self._plant.step(request.commands, self._poses)
            except FloatingPointError as error:
                self.say_farewell(Farewell.FAILED, str(error))
                raise Failure(f"the flight at {request.name}", "states that stay finite", error) from error
            self.steps += 1
        elif request.op == Op.REGISTER_TUBE:
            self._tubes.add(index)
        elif request.op == Op.RELEASE_TUBE:
            self._tubes.discard(index)
        self.reply(request.rung)
        return None

    def _refusal(self, request: Request) -> Refusal | None:
        """What a sound physics side without gusts refuses of a request's rows."""
        if request.op == Op.RESET:
            resets = request.resets
            if resets.raw[resets.selected == 1, 16 + PARAMETER_INDEX["gust"]].any():
                return Refusal("gust", "0, since this plant has no gusts", "another number")
            return reset_refusal(resets, self._tubes)
        if request.op == Op.STEP:
            if len(self._reset_lanes) < self.lanes:
                return Refusal("step", "lanes that were reset", "one never reset", code=RefusalCode.NOT_RESET)
            return command_refusal(request.commands, SPEED_MAX)
        return None

    def refuse(self, number: int, refusal: Refusal, code: int | None = None) -> None:
        """Refuse request `number`, with another code than the refusal's own where one is given."""
        write_i64(self.pose, POSE["refusal_code"], refusal.code if code is None else code)
        write_i64(self.pose, POSE["refusal_lane"], refusal.lane)
        write_text(self.pose, POSE["refusal_field"], refusal.field)
        write_text(self.pose, POSE["refusal_expected"], refusal.expected)
        write_text(self.pose, POSE["refusal_found"], refusal.found)
        self.reply(number, {"status": Status.REFUSED})

    def reply(self, number: int, wrong: Wrong | None = None) -> None:
        """Publish a reply to request `number`; `wrong` words carry other values than the sound ones."""
        words = {
            "begin": number,
            "status": Status.DONE,
            "step": self.steps,
            "engine_ns": 1000,
            "end": number,
            "doorbell": number,
            **(wrong or {}),
        }
        self.store("begin", int(words["begin"]))
        self.pose[pose_rows(self.lanes)] = self._poses.raw.data.cast("B")
        for name in ("status", "step", "engine_ns", "end", "doorbell"):
            self.store(name, int(words[name]))
        self.number = number

    # --- the end ---

    def farewell(self) -> tuple[int, str]:
        """Kind and text of the agent's farewell; (0, "") while there is none."""
        return read_farewell(self.command)

    def say_farewell(self, kind: Farewell, text: str) -> None:
        """Leave a farewell."""
        write_farewell(self.pose, kind, text)


def _await_offer(rendezvous: str, process: PeerProcess, timeout: float) -> tuple[Segment, Segment]:
    """Open both segments as soon as the agent's magic stands."""
    place, until = parse_rendezvous(rendezvous), time.monotonic() + timeout
    while True:
        ended = process.watch()
        command, pose = open_segment(place, COMMAND_SUFFIX), open_segment(place, POSE_SUFFIX)
        if command is not None and pose is not None and magic_stands(command.view):
            return command, pose
        for segment in (command, pose):
            if segment is not None:
                segment.close()
        if ended is not None:
            raise Failure("the agent", f"a session offered at {rendezvous}", f"its end, {ended}")
        if time.monotonic() > until:
            raise Silence("the agent", f"a session offered at {rendezvous} within {timeout:g} s", "none")
        time.sleep(5 * POLL_S)


def magic_stands(command: memoryview) -> bool:
    """Whether a command segment has its magic."""
    return len(command) > COMMAND["farewell"].offset and magic(command) == COMMAND_MAGIC
