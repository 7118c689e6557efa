"""An agent's half of a session by hand: every word of it can be written wrong, early, late or in pieces."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from protocol import handshake, layout
from protocol.conformance.rule import Failure, Silence
from protocol.errors import PeerLost, ProtocolError, Verdict
from protocol.handshake import Offer, SessionSettings, read_farewell
from protocol.layout import COMMAND, COMMAND_MAGIC, POSE, POSE_MAGIC, Field, Op, Status
from protocol.liveness import start_time
from protocol.memory import FENCE, Segments, parse_rendezvous
from protocol.opening import create_segments
from protocol.plant import COMMAND_WORDS, POSE_WORDS, RESET_WORDS, CommandBatch, PoseBatch, ResetBatch
from protocol.waiting import Peer, Waiter

if TYPE_CHECKING:
    from protocol.conformance.rig import PeerProcess

LOOK_S: Final = 0.01
POLL_S: Final = 0.0005
"""How often a header is looked for; a server that is starting needs the core more."""
_NO_MAGIC: Final = bytes(8)
_HEADER: Final = slice(8, 1024)
_REQUEST_AT: Final = COMMAND["begin"].offset
_DOORBELL: Final = COMMAND["doorbell"].word
_REPLY_DOORBELL: Final = POSE["doorbell"].word

Value = int | float | bytes
"""An i64, an f64 or raw bytes, as a field's kind asks for; bytes may be written into any field."""


@dataclass(frozen=True)
class Refused:
    """The words of a refusal."""

    code: int
    lane: int
    field: str
    expected: str
    found: str


@dataclass(frozen=True)
class Reply:
    """One reply as it stood when its doorbell rang."""

    doorbell: int
    begin: int
    status: int
    step: int
    engine_ns: int
    end: int
    poses: PoseBatch
    """A copy of the pose rows."""
    refused: Refused | None
    """The refusal's words, where the status is not 0."""


class RawAgent:
    """The agent's half, driven word by word; `Rig.agent` makes one and closes it.

    Sound requests are one call (`reset`, `step`, ...). For others `request` takes words by name that replace those
    of a sound one, and `put` writes any word of the command segment.
    """

    def __init__(self, rendezvous: str, settings: SessionSettings, timeout: float) -> None:
        self.rendezvous = rendezvous
        self.settings = settings
        self.timeout = timeout
        """How long the server may take to attach, or to answer (s)."""
        self.number = 0
        """Number of the last request."""
        self.steps = 0
        """Control steps that the server has integrated."""
        self.process: PeerProcess | None = None
        """The server, from `attend` on."""
        self._segments: Segments | None = create_segments(parse_rendezvous(rendezvous), settings.lanes)
        self.command, self.pose = self._segments.command.view, self._segments.pose.view
        self.words, self._reply = self.command.cast("q"), self.pose.cast("q")
        self.session = os.urandom(16)
        self._waiter: Waiter | None = None

    # --- handshake ---

    def offer(self, **words: Value) -> None:
        """Write the header, its magic last; `words` replace fields of a sound one."""
        magic = words.pop("magic", COMMAND_MAGIC)
        self.put_header(**words)
        self.publish(magic)

    def put_header(self, **words: Value) -> None:
        """Write the header but for its magic."""
        pid = os.getpid()
        offer = Offer(self.settings, self.session, pid, start_time(pid))
        header = memoryview(bytearray(len(self.command)))
        handshake.write_offer(header, offer)
        self.command[_HEADER] = header[_HEADER]
        self.put(**words)

    def publish(self, magic: Value = COMMAND_MAGIC) -> None:
        """Write the magic, in one store."""
        if FENCE is not None:
            FENCE()
        assert isinstance(magic, bytes)
        self.words[0] = int.from_bytes(magic, "little", signed=True)

    def attend(self, process: PeerProcess) -> None:
        """Name the process whose end also ends every wait."""
        self.process = process
        self._waiter = None

    def await_header(self, timeout: float | None = None) -> None:
        """Wait until the server's magic stands.

        Raises:
            Failure: it left or ended before, or took too long.
        """
        patience = self.timeout if timeout is None else timeout
        began = look_at = time.monotonic()
        while handshake.magic(self.pose) == _NO_MAGIC:
            now = time.monotonic()
            if now >= look_at:
                look_at = now + LOOK_S
                self._demand_life("a header")
            if now - began > patience:
                raise Silence("the server", f"a header within {patience:g} s", "none, though it runs")
            time.sleep(POLL_S)
        if FENCE is not None:
            FENCE()
        if handshake.magic(self.pose) != POSE_MAGIC:
            raise Failure("magic of the pose segment", POSE_MAGIC, handshake.magic(self.pose))

    def _demand_life(self, due: str) -> None:
        reason, text = read_farewell(self.pose)
        if reason:
            raise Failure("the server", due, f"farewell {reason}: {text}")
        ended = self.process.watch() if self.process is not None else None
        if ended is not None and handshake.magic(self.pose) == _NO_MAGIC:
            raise Failure("the server", due, f"its end, {ended}")

    # --- requests ---

    def put(self, **words: Value) -> None:
        """Write fields of the command segment by name: integers, floats, or bytes as they are."""
        for name, value in words.items():
            field = COMMAND[name]
            if isinstance(value, bytes):
                self.command[field.offset : field.offset + len(value)] = value
            elif isinstance(value, float):
                layout.write_f64(self.command, field, value)
            elif name == "doorbell":  # one store
                if FENCE is not None:
                    FENCE()
                self.words[_DOORBELL] = value
            else:
                layout.write_i64(self.command, field, value)

    def put_commands(self, commands: CommandBatch) -> None:
        """Write the command rows."""
        rows = layout.flat_bytes(commands.raw, COMMAND_WORDS, self.settings.lanes, "commands")
        self.command[layout.command_rows(self.settings.lanes)] = rows

    def put_resets(self, resets: ResetBatch) -> None:
        """Write the reset rows."""
        rows = layout.flat_bytes(resets.raw, RESET_WORDS, self.settings.lanes, "resets")
        self.command[layout.reset_rows(self.settings.lanes)] = rows

    def request(self, op: int, **words: int) -> int:
        """Publish a request whose payload stands, and return its number.

        `begin`, `step`, `end` and `doorbell` are those of a sound one unless `words` names others.
        """
        number = self.number + 1
        step = self.steps + 1 if op == Op.STEP else self.steps
        if words:
            sound = {"begin": number, "op": op, "step": step, "end": number, "doorbell": number}
            self.put(**{**sound, **words})
        else:  # what is measured must not be slowed down by names
            layout.REQUEST.pack_into(self.command, _REQUEST_AT, number, op, step, number)
            self.put(doorbell=number)
        self.number = number
        return number

    def await_reply(self, timeout: float | None = None) -> Reply:
        """Wait for the reply to the last request.

        Raises:
            Failure: the server left or ended, took too long, or rang with another number.
        """
        self.await_bell(timeout)
        reply = self.reply()
        number = self.number
        if not reply.doorbell == reply.begin == reply.end == number:
            found = f"doorbell {reply.doorbell}, begin {reply.begin}, end {reply.end}"
            raise Failure(f"reply {number}", f"doorbell, begin and end {number}", found)
        self.steps = reply.step
        return reply

    def await_bell(self, timeout: float | None = None) -> None:
        """Wait until the doorbell rings for the last request, and read nothing: what a measurement waits for.

        Raises:
            Failure: the server left or ended, or took too long.
        """
        if self._waiter is None:
            pid, started = handshake.owner(self.pose)
            watch = self.process.watch if self.process is not None else None
            self._waiter = Waiter(
                self._reply, _REPLY_DOORBELL, Peer("server", pid, started, self.pose, watch)
            )
        self._waiter.deadline = self.timeout if timeout is None else timeout
        try:
            self._waiter(self.number - 1, self.steps, "a reply")
        except ProtocolError as error:
            found = error.how if isinstance(error, PeerLost) else str(error)
            kind = Silence if isinstance(error, PeerLost) and error.verdict is Verdict.TOO_SLOW else Failure
            raise kind("the server", f"a reply to request {self.number}", found) from error

    def reply(self) -> Reply:
        """Read the reply as it stands now."""
        doorbell = self._reply[_REPLY_DOORBELL]
        if FENCE is not None:
            FENCE()
        begin, status, step, engine_ns, end = layout.REPLY.unpack_from(self.pose, POSE["begin"].offset)
        refused = self.refused() if status != Status.DONE else None
        return Reply(doorbell, begin, status, step, engine_ns, end, self.poses(), refused)

    def refused(self) -> Refused:
        """Read the refusal's words."""
        texts = (
            layout.read_text(self.pose, POSE[f"refusal_{name}"]) for name in ("field", "expected", "found")
        )
        return Refused(self.get("refusal_code"), self.get("refusal_lane"), *texts)

    def get(self, name: str) -> int:
        """Read an integer of the pose segment by its field's name."""
        return layout.read_i64(self.pose, POSE[name])

    def get_bytes(self, name: str) -> bytes:
        """Read a field of the pose segment as it stands."""
        field: Field = POSE[name]
        return bytes(self.pose[field.bytes])

    def poses(self) -> PoseBatch:
        """Copy the pose rows."""
        lanes = self.settings.lanes
        rows = np.frombuffer(bytes(self.pose[layout.pose_rows(lanes)]), np.float64)
        return PoseBatch(rows.reshape(lanes, POSE_WORDS).copy())

    # --- sound requests ---

    def ask(self, op: int, **words: int) -> Reply:
        """Publish a request and wait for its reply, done or refused."""
        self.request(op, **words)
        return self.await_reply()

    def reset(self, resets: ResetBatch) -> Reply:
        """Ask for a reset."""
        self.put_resets(resets)
        return self.ask(Op.RESET)

    def step(self, commands: CommandBatch) -> Reply:
        """Ask for a step."""
        self.put_commands(commands)
        return self.ask(Op.STEP)

    def goodbye(self) -> Reply:
        """Say goodbye."""
        return self.ask(Op.GOODBYE)

    def locks_pose(self) -> bool:
        """Whether the lock on the pose segment, which is the server's, can be had; if so it is held from now on."""
        assert self._segments is not None
        return self._segments.pose.lock()

    # --- the end ---

    def farewell(self) -> tuple[int, str]:
        """The server's farewell and its text; (0, "") while it has said none."""
        return read_farewell(self.pose)

    def await_farewell(self, timeout: float | None = None) -> tuple[int, str]:
        """Wait for the server's farewell and return it; (0, "") where its process ended without one.

        Raises:
            Failure: it neither left nor ended in time.
        """
        patience = self.timeout if timeout is None else timeout
        until = time.monotonic() + patience
        while True:
            ended = self.process is not None and self.process.watch() is not None
            said = self.farewell()
            if said[0] or ended:
                return said
            if time.monotonic() > until:
                raise Failure("the server", f"a farewell within {patience:g} s", "none, and it still runs")
            time.sleep(0.001)

    def close(self) -> None:
        """Remove and unmap the segments; idempotent."""
        segments, self._segments = self._segments, None
        if segments is None:
            return
        self.words.release()
        self._reply.release()
        segments.unlink()
        segments.close()
