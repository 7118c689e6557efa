"""The agent's side: offer a session, then step the physics in strict lockstep."""

from __future__ import annotations

import logging
import os
import struct
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Final

from protocol import handshake, layout
from protocol.errors import (
    PeerLost,
    PeerViolation,
    ProtocolError,
    Refusal,
    RefusalCode,
    SessionError,
    Verdict,
)
from protocol.handshake import Offer, SessionSettings
from protocol.layout import COMMAND, POSE, Axes, Farewell, Status, read_i64, read_text
from protocol.liveness import start_time
from protocol.memory import FENCE, parse_rendezvous
from protocol.opening import LOOK_AGAIN_S, create_segments
from protocol.plant import (
    COMMAND_WORDS,
    POSE_WORDS,
    RESET_WORDS,
    CommandBatch,
    PlantDescription,
    PoseBatch,
    ResetBatch,
    TubeReference,
)
from protocol.signals import held_signals
from protocol.states import TRANSITIONS, Event, State, follow
from protocol.waiting import LOOK_S, Peer, Waiter, Watch

__all__ = ["AgentSession", "SessionSettings"]

_log = logging.getLogger("protocol")

Wait = Callable[[int, int, str], int]
"""(old doorbell, step, phase) -> the doorbell's next value; step and phase are for messages."""

GOODBYE_S: Final = 2.0
"""How long the orderly goodbye waits for its answer."""

_TUBE: Final = struct.Struct("<qqd32sq4096s")
_READY: Final = State.READY
_BEGIN: Final = COMMAND["begin"].word
_REQUEST_REST_AT: Final = COMMAND["op"].offset
_DOORBELL: Final = COMMAND["doorbell"].word
_REPLY_AT: Final = POSE["begin"].offset
_REPLY_DOORBELL: Final = POSE["doorbell"].word
_NOTHING: Final = memoryview(b"")


class AgentSession:
    """The agent's half of a session; `open` makes one with a physics process, `protocol.twin` one in memory.

    The session itself does no I/O: it writes requests into one segment and reads replies from the other, and
    is given what waits. Use it as a context manager, or close it.
    """

    def __init__(
        self,
        command: memoryview,
        pose: memoryview,
        settings: SessionSettings,
        on_close: Callable[[], None] | None = None,
    ) -> None:
        lanes = settings.lanes
        pid = os.getpid()
        self.lanes = lanes
        self.dt = settings.dt
        self.physics_dt = settings.physics_dt
        self.inner_steps = settings.inner_steps
        self.steps = 0
        """Control steps integrated in this session."""
        self.description: PlantDescription
        """What the physics side says of itself."""
        self.peer_pid: int
        """Process id of the physics side."""
        self._number = 0
        self._engine_ns = 0
        self._on_close = on_close
        self._rendezvous = ""
        self._remove: Callable[[], None] = _remove_nothing
        self._wait: Wait
        self._offer = Offer(settings, os.urandom(16), pid, start_time(pid))
        self._poses = PoseBatch.zeros(lanes)
        self._pose_bytes = layout.flat_bytes(self._poses.raw, POSE_WORDS, lanes, "poses")
        self._commands: CommandBatch | None = None
        self._command_bytes = _NOTHING

        self._views = ExitStack()
        keep = self._views.enter_context
        self._command, self._pose = command, keep(pose.toreadonly())  # its every byte is the physics side's
        self._words, self._reply = keep(command.cast("q")), keep(self._pose.cast("q"))
        self._wire_commands = keep(command[layout.command_rows(lanes)])
        self._wire_resets = keep(command[layout.reset_rows(lanes)])
        self._wire_tube = keep(command[COMMAND["tube_index"].offset :][: _TUBE.size])
        self._wire_tube_index = keep(self._wire_tube[:8])
        self._wire_poses = keep(self._pose[layout.pose_rows(lanes)])
        handshake.write_offer(command, self._offer)
        self._state = follow(State.ABSENT, Event.OFFER)

    @classmethod
    def open(
        cls,
        rendezvous: str,
        settings: SessionSettings,
        watch: Watch | None = None,
        attach_timeout: float = 30.0,
        reply_timeout: float | None = None,
    ) -> AgentSession:
        """Create the segments at `rendezvous` and wait for a physics process to attach.

        Args:
            rendezvous: "shm:NAME" or "file:/absolute/stem".
            settings: Lanes and time steps.
            watch: The launcher's own view of the peer's process: None while it lives, else how it ended.
            attach_timeout: Longest wait for the physics side's header (s).
            reply_timeout: Longest wait for a reply (s); None waits for as long as the peer's process lives,
                stopped or not.

        Raises:
            SessionError: the rendezvous is taken or cannot be used, or there is no room.
            HandshakeError: the two sides do not agree.
            PeerLost: no physics process attached in time, or it ended.
        """
        session: AgentSession | None = None
        try:
            with (
                held_signals()
            ):  # an interrupt comes before the segments are there, or when they will be removed
                session = cls.offer(rendezvous, settings)
            session.await_physics(watch, attach_timeout, reply_timeout)
        except BaseException:
            if session is not None:
                session.close()
            raise
        return session

    @classmethod
    def offer(cls, rendezvous: str, settings: SessionSettings) -> AgentSession:
        """Take the rendezvous and offer the session there, so that the physics process can be started for it.

        `await_physics` goes on. Closing removes the segments.

        Raises:
            SessionError: the rendezvous is taken or cannot be used, or there is no room.
        """
        with held_signals():
            segments = create_segments(parse_rendezvous(rendezvous), settings.lanes)
            try:
                session = cls(segments.command.view, segments.pose.view, settings, segments.close)
            except BaseException:
                segments.unlink()
                raise
            session._rendezvous, session._remove = rendezvous, segments.unlink
        return session

    def await_physics(
        self, watch: Watch | None = None, attach_timeout: float = 30.0, reply_timeout: float | None = None
    ) -> None:
        """Wait for a physics process to attach to the session on offer; arguments and errors are those of `open`."""
        try:
            _await_header(self._pose, self._rendezvous, watch, attach_timeout)
            answer = handshake.read_answer(self._pose, self._offer)
            peer = Peer("physics", answer.pid, answer.started, self._pose, watch)
            self.attached(Waiter(self._reply, _REPLY_DOORBELL, peer, reply_timeout))
        except BaseException as error:
            with held_signals():
                self._break(error)
            raise

    def attached(self, wait: Wait) -> None:
        """Take note of the physics side, whose header stands; `wait` waits for its replies.

        Raises:
            HandshakeError: its header is not what this version expects, or does not echo ours.
        """
        answer = handshake.read_answer(self._pose, self._offer)
        self.description, self.peer_pid = answer.description, answer.pid
        self._wait = wait
        self._state = follow(self._state, Event.ATTACH)

    @property
    def engine_seconds(self) -> float:
        """How long the physics side's plant worked in the last exchange (s)."""
        return self._engine_ns * 1e-9

    def step(self, commands: CommandBatch, meanwhile: Callable[[], None] | None = None) -> PoseBatch:
        """Integrate one control step in every lane.

        Args:
            commands: (N, 8), all lanes reset before. Reusing one batch is fastest.
            meanwhile: called when the physics side has the commands and works: the place for what need not be
                finished before, such as recording the step before. The poses of that step still stand. An
                exception in it ends the session.

        Returns:
            Poses of all lanes: the same batch every time, valid until the next call.

        Raises:
            Refusal: a command is out of range, or a lane was never reset; nothing was integrated.
            PeerLost, PeerViolation, SessionError: the session is over.
        """
        if commands is not self._commands:
            self._command_bytes = layout.flat_bytes(commands.raw, COMMAND_WORDS, self.lanes, "commands")
            self._commands = commands
        self._exchange(Event.STEP, self.steps + 1, self._wire_commands, self._command_bytes, meanwhile)
        return self._poses

    def reset(self, resets: ResetBatch) -> PoseBatch:
        """Put the selected lanes into their initial states; the others do not notice.

        Args:
            resets: (N, 48); only rows whose `selected` is 1 count.

        Returns:
            Poses of all lanes, as `step` does; rows of lanes that were never reset are zero.

        Raises:
            Refusal: a value is out of range or a tube unknown; no lane was reset.
            PeerLost, PeerViolation, SessionError: the session is over.
        """
        payload = layout.flat_bytes(resets.raw, RESET_WORDS, self.lanes, "resets")
        self._exchange(Event.RESET, self.steps, self._wire_resets, payload)
        return self._poses

    def register_tube(self, index: int, tube: TubeReference) -> None:
        """Name a tube to the physics side, so that lanes can be reset into it by `index`.

        Raises:
            Refusal: the slot is taken, or the physics side cannot read the tube.
            SessionError: the reference cannot be written down, or the session is over.
            PeerLost, PeerViolation: the session is over.
        """
        self._exchange(Event.REGISTER_TUBE, self.steps, self._wire_tube, _pack_tube(index, tube))

    def release_tube(self, index: int) -> None:
        """Let the physics side forget a tube.

        Raises:
            Refusal: no such tube, or a lane still flies in it.
            PeerLost, PeerViolation, SessionError: the session is over.
        """
        self._exchange(
            Event.RELEASE_TUBE, self.steps, self._wire_tube_index, index.to_bytes(8, "little", signed=True)
        )

    def close(self) -> None:
        """Say goodbye and remove the segments; a peer that is lost by now is logged. Idempotent.

        SIGINT and SIGTERM wait until it is done, at most `GOODBYE_S` and the engine's own end.
        """
        with held_signals():
            try:
                self._remove()  # while the other side still watches: should we be killed now, it removes the rest
                if self._state is _READY:
                    self._say_goodbye()
                elif Event.FAREWELL in TRANSITIONS[self._state]:
                    handshake.write_farewell(self._command, Farewell.STOPPED, "it closed the session")
                    self._state = follow(self._state, Event.FAREWELL)
            finally:
                self._views.close()
                on_close, self._on_close = self._on_close, None
                if on_close is not None:
                    on_close()

    def __enter__(self) -> AgentSession:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _say_goodbye(self) -> None:
        if isinstance(self._wait, Waiter):
            self._wait.deadline = GOODBYE_S
        try:
            self._exchange(Event.GOODBYE, self.steps, self._wire_tube_index, bytes(8))
        except ProtocolError as error:
            _log.warning("no orderly goodbye: %s", error)

    def _exchange(
        self,
        event: Event,
        due: int,
        wire: memoryview,
        payload: memoryview | bytes,
        meanwhile: Callable[[], None] | None = None,
    ) -> None:
        """Publish a request with its payload and take in the reply, after which `due` steps are integrated."""
        try:
            asking = TRANSITIONS[self._state][event]
        except KeyError:
            asking = follow(self._state, event)  # raises what says so
        words, before = self._words, self._number
        number = before + 1
        self._state = asking
        try:
            if self._reply[_REPLY_DOORBELL] != before:
                raise PeerViolation(f"physics answered request {number} before it was made")
            words[_BEGIN] = number
            wire[:] = payload
            layout.REQUEST_REST.pack_into(self._command, _REQUEST_REST_AT, event, due, number)
            if FENCE is not None:
                FENCE()
            words[_DOORBELL] = number
            if meanwhile is not None:
                meanwhile()
            rung = self._wait(before, due, _PHASES[event])
            if FENCE is not None:
                FENCE()
            self._pose_bytes[:] = self._wire_poses
            begin, status, step, self._engine_ns, end = layout.REPLY.unpack_from(self._pose, _REPLY_AT)
            if not (rung == begin == end == number):
                raise PeerViolation(_bad_reply(number, rung, begin, end))
            if status == _DONE and step == due:
                self.steps = due
            elif status != _REFUSED or step != self.steps:
                raise PeerViolation(
                    f"physics answered request {number} with status {status} at step {step} where {due} was due"
                )
        except BaseException as error:
            self._break(error)
            raise
        self._number = number
        if status == _DONE:
            self._state = TRANSITIONS[asking][_DONE_EVENT]
        else:
            self._state = follow(asking, Event.REFUSED)
            raise self._read_refusal()

    def _read_refusal(self) -> Refusal:
        view = self._pose
        code = read_i64(view, POSE["refusal_code"])
        return Refusal(
            read_text(view, POSE["refusal_field"]),
            read_text(view, POSE["refusal_expected"]),
            read_text(view, POSE["refusal_found"]),
            read_i64(view, POSE["refusal_lane"]),
            RefusalCode(code) if code in tuple(RefusalCode) else RefusalCode.PLANT,
        )

    def _break(self, error: BaseException) -> None:
        """End the session because of `error`, and tell the other side where it may still listen."""
        self._remove()
        handshake.part(self._command, error, self._pose)
        events = {PeerViolation: Event.VIOLATION, PeerLost: Event.LOSS}
        self._state = follow(self._state, events.get(type(error), Event.FAREWELL))


_PHASES: Final = {event: event.name.lower() for event in Event}
_DONE: Final = Status.DONE.value
_REFUSED: Final = Status.REFUSED.value
_DONE_EVENT: Final = Event.DONE


def _remove_nothing() -> None:
    """A session in memory has no names to remove."""


def _bad_reply(number: int, rung: int, begin: int, end: int) -> str:
    if rung != number:
        return f"physics rang its doorbell with {rung} where {number} was due"
    return f"physics published a torn reply: begin {begin}, end {end} where {number} was due"


def _pack_tube(index: int, tube: TubeReference) -> bytes:
    """Write a tube registration as it stands on the wire."""
    path, most = tube.path.encode(), COMMAND["tube_path"].count
    if tube.axes not in Axes.__members__:
        raise SessionError(f"axes of tube {index}: expected zup or yup, found {tube.axes!r}")
    if not 1 <= len(path) <= most:
        raise SessionError(f"path of tube {index}: expected 1 to {most} bytes, found {len(path)}")
    try:
        digest = bytes.fromhex(tube.sha256)
    except ValueError:
        digest = b""
    if len(digest) != COMMAND["tube_sha256"].count:
        raise SessionError(f"sha256 of tube {index}: expected 64 hexadecimal digits, found {tube.sha256!r}")
    return _TUBE.pack(index, Axes[tube.axes], tube.scale, digest, len(path), path)


def _await_header(pose: memoryview, rendezvous: str, watch: Watch | None, timeout: float) -> None:
    """Wait until the physics side's magic stands."""
    peer = Peer("physics", 0, 0, pose, watch)
    began = look_at = time.monotonic()
    while handshake.magic(pose) == bytes(8):
        now = time.monotonic()
        if now >= look_at:
            peer.check(0, "attach")
            look_at = now + LOOK_S
        if now - began > timeout:
            raise PeerLost(
                "physics",
                f"nobody attached to {rendezvous} within {timeout} s; is the physics process started with this name?",
                Verdict.TOO_SLOW,
                0,
                "attach",
            )
        time.sleep(LOOK_AGAIN_S / 5)
