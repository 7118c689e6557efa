"""The physics half of a session by hand, on the table of bytes: sound by default, able to write anything wrong.

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

from protocol.conformance.stand_in import StandIn
from protocol.layout import (
    COMMAND,
    COMMAND_MAGIC,
    POSE,
    POSE_MAGIC,
    Farewell,
    Field,
    Op,
    Status,
    command_rows,
    pose_bytes,
    pose_rows,
    read_f64,
    read_i64,
    read_text,
    reset_rows,
    write_f64,
    write_i64,
    write_text,
)
from protocol.memory import FENCE, Segment, open_segment, parse_rendezvous
from protocol.plant import COMMAND_WORDS, PARAMETER_SLOTS, RESET_WORDS, CommandBatch, PoseBatch, ResetBatch
from protocol.toy import DEFAULTS, SPEED_MAX, ToyPlant

POLL_S: Final = 0.0002
"""Sleep between two looks at a doorbell; the kit judges order and content here, not speed."""
HEADER_BYTES: Final = 2048

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
    """The physics side of one session; `close` gives its views up and ends its stand-in."""

    def __init__(self, command: Segment, pose: Segment) -> None:
        self.command, self.pose = command, pose
        self.view, self.agent = pose.view, command.view.toreadonly()
        self.lanes = read_i64(self.agent, COMMAND["lanes"])
        self.steps = 0
        """Control steps integrated in this session."""
        self.number = 0
        """Number of the last request that was answered."""
        self.stand_in: StandIn | None = None
        self._plant = ToyPlant()
        self._poses = PoseBatch.zeros(self.lanes)

    @classmethod
    def meet(cls, rendezvous: str, patience: float, ended: Callable[[], bool]) -> RawPhysics | None:
        """Open the segments that an agent offers; None where there are none in time or the agent has ended."""
        place, until = parse_rendezvous(rendezvous), time.monotonic() + patience
        while time.monotonic() < until:
            command, pose = open_segment(place, ".cmd"), open_segment(place, ".pose")
            if command is not None and pose is not None and len(command.view) >= HEADER_BYTES:
                if bytes(command.view[COMMAND["magic"].bytes]) == COMMAND_MAGIC:
                    return cls(command, pose)
            for segment in (command, pose):
                if segment is not None:
                    segment.close()
            if ended():
                return None
            time.sleep(POLL_S)
        return None

    def __enter__(self) -> RawPhysics:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give up the views and the stand-in; idempotent."""
        if self.stand_in is not None:
            self.stand_in.close()
        self.agent.release()
        self.command.close()
        self.pose.close()

    def begin_header(self) -> None:
        """Take the lock, by a stand-in, and write whose header this will be."""
        self.stand_in = StandIn(self.pose.path)
        write_i64(self.view, POSE["pid"], self.stand_in.pid)
        write_i64(self.view, POSE["start_time"], self.stand_in.started)

    def attach(self, wrong: Wrong | None = None) -> None:
        """Publish a header; `wrong` fields carry other values than the sound ones."""
        if self.stand_in is None:
            self.begin_header()
        view = self.view
        numbers: dict[str, int | float | bytes] = {
            "version_major": 1,
            "version_minor": read_i64(self.agent, COMMAND["version_minor"]),
            "segment_bytes": pose_bytes(self.lanes),
            "session": bytes(self.agent[COMMAND["session"].bytes]),
            **{name: bytes(self.agent[COMMAND[name].bytes]) for name in _ECHOED},
            "speed_max": SPEED_MAX,
            "walls": 0,
            "defaults": struct.pack(f"<{PARAMETER_SLOTS}d", *DEFAULTS, *(0.0,) * (32 - len(DEFAULTS))),
        }
        for name, value in {**numbers, **(wrong or {})}.items():
            if name != "magic":
                write_field(view, POSE[name], value)
        write_text(view, POSE["plant_name"], "protocol.conformance")
        write_text(view, POSE["plant_version"], "1")
        write_text(view, POSE["plant_engine"], "toy plant, by hand")
        (dt,), (physics_dt,) = (
            read_f64(self.agent, COMMAND["dt"]),
            read_f64(self.agent, COMMAND["physics_dt"]),
        )
        self._plant.open(self.lanes, dt, physics_dt, read_i64(self.agent, COMMAND["inner_steps"]))
        magic = (wrong or {}).get("magic", POSE_MAGIC)
        assert isinstance(magic, bytes)
        self.store("magic", int.from_bytes(magic, "little", signed=True))

    def store(self, name: str, value: int) -> None:
        """Write one word of the pose segment in one store, with everything before it visible."""
        if FENCE is not None:
            FENCE()
        with self.view.cast("q") as words:
            words[POSE[name].word] = value

    def rung(self) -> int:
        """The agent's doorbell."""
        with self.agent.cast("q") as words:
            value: int = words[COMMAND["doorbell"].word]
        return value

    def await_request(self, patience: float, ended: Callable[[], bool]) -> Request | None:
        """Wait until the agent's doorbell is not the last answered number; None where it stays silent."""
        until = time.monotonic() + patience
        while (rung := self.rung()) == self.number:
            over = time.monotonic() >= until or ended() or self.agents_farewell()[0] != 0
            if over and self.rung() == self.number:
                return None
            time.sleep(POLL_S)
        if FENCE is not None:
            FENCE()
        segment = bytes(self.agent)
        begin, op, step, end = (
            int.from_bytes(segment[COMMAND[name].bytes], "little", signed=True)
            for name in ("begin", "op", "step", "end")
        )
        return Request(rung, begin, op, step, end, segment, self.lanes)

    def agents_farewell(self) -> tuple[int, str]:
        """Kind and text of the agent's farewell; (0, "") while there is none."""
        kind = read_i64(self.agent, COMMAND["farewell"])
        return kind, read_text(self.agent, COMMAND["farewell_text"]) if kind else ""

    def answer(self, request: Request) -> None:
        """Carry a request out and publish a sound reply."""
        if request.op == Op.RESET:
            self._plant.reset(request.resets, self._poses)
        elif request.op == Op.STEP:
            self._plant.step(request.commands, self._poses)
            self.steps += 1
        self.reply(request.rung)

    def refuse(self, request: Request, code: int = 10) -> None:
        """Refuse a request for the physics side's own reasons."""
        write_i64(self.view, POSE["refusal_code"], code)
        write_i64(self.view, POSE["refusal_lane"], -1)
        write_text(self.view, POSE["refusal_field"], "engine")
        write_text(self.view, POSE["refusal_expected"], "an engine that can")
        write_text(self.view, POSE["refusal_found"], "a test of how refusals are taken")
        self.reply(request.rung, {"status": Status.REFUSED})

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
        self.view[pose_rows(self.lanes)] = self._poses.raw.data.cast("B")
        for name in ("status", "step", "engine_ns", "end", "doorbell"):
            self.store(name, int(words[name]))
        self.number = number

    def say_farewell(self, kind: Farewell | int, text: str) -> None:
        """Leave a farewell."""
        write_text(self.view, POSE["farewell_text"], text)
        self.store("farewell", int(kind))
