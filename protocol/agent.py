"""The agent's side: offer a session, then step the physics in strict lockstep."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Final

from protocol import compiled_choice, handshake, layout, requests
from protocol.errors import PeerLost, PeerViolation, ProtocolError
from protocol.handshake import Offer, SessionSettings
from protocol.layout import COMMAND, POSE, Farewell, Status
from protocol.liveness import start_time
from protocol.memory import FENCE, parse_rendezvous
from protocol.opening import create_segments
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
from protocol.requests import Request
from protocol.signals import held_signals
from protocol.states import TRANSITIONS, Event, State, follow
from protocol.waiting import Peer, Waiter, Watch, await_header

if TYPE_CHECKING:
    from protocol.compiled import Desk

__all__ = ["AgentSession", "SessionSettings"]

_log = logging.getLogger("protocol")

Wait = Callable[[int, int, str], int]
"""(old doorbell, step, phase) -> the doorbell's next value; step and phase are for messages."""

GOODBYE_S: Final = 2.0
"""How long the orderly goodbye waits for its answer."""

_READY: Final = State.READY
_BEGIN: Final = COMMAND["begin"].word
_REQUEST_REST_AT: Final = COMMAND["op"].offset
_DOORBELL: Final = COMMAND["doorbell"].word
_REPLY_AT: Final = POSE["begin"].offset
_REPLY_DOORBELL: Final = POSE["doorbell"].word
_DONE: Final = Status.DONE.value
_REFUSED: Final = Status.REFUSED.value
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
        self._waiter: Waiter
        self._desk: Desk | None = None
        self.exchange = "in memory"
        """By what steps are exchanged: "compiled" or "stdlib", and why; see `protocol.compiled_choice`."""
        self._offer = Offer(settings, os.urandom(16), pid, start_time(pid))
        self._poses = PoseBatch.zeros(lanes)
        self._pose_bytes = layout.flat_bytes(self._poses.raw, POSE_WORDS, lanes, "poses")
        self._commands: CommandBatch | None = None
        self._command_bytes = _NOTHING

        self._views = ExitStack()
        keep = self._views.enter_context
        self._command, self._pose = command, keep(pose.toreadonly())  # its every byte is the physics side's
        self._words, self._reply = keep(command.cast("q")), keep(self._pose.cast("q"))
        self._wire = requests.cut_wire(command, self._pose, lanes, keep)
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
            choice = compiled_choice.choose("agent", may_compile=True)  # while the physics process starts
            await_header(self._pose, self._rendezvous, watch, attach_timeout)
            answer = handshake.read_answer(self._pose, self._offer)
            peer = Peer("physics", answer.pid, answer.started, self._pose, watch)
            self._waiter = Waiter(self._reply, _REPLY_DOORBELL, peer, reply_timeout)
            self.attached(self._waiter)
            self.exchange, speed_max = str(choice), self.description.speed_max
            if choice.kernels is not None:
                batches = CommandBatch.zeros(self.lanes), self._poses
                self._desk = choice.kernels.desk(self._command, self._pose, *batches, speed_max)
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
    def lanes(self) -> int:
        """Number of drones N."""
        return self._offer.settings.lanes

    @property
    def dt(self) -> float:
        """Control step (s)."""
        return self._offer.settings.dt

    @property
    def physics_dt(self) -> float:
        """Inner step of the physics (s)."""
        return self._offer.settings.physics_dt

    @property
    def inner_steps(self) -> int:
        """Inner steps of one control step."""
        return self._offer.settings.inner_steps

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
            if self._desk is not None:
                self._desk.use_commands(commands)
        self._exchange(requests.STEP, self.steps + 1, self._wire.commands, self._command_bytes, meanwhile)
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
        self._exchange(requests.RESET, self.steps, self._wire.resets, payload)
        return self._poses

    def register_tube(self, index: int, tube: TubeReference) -> None:
        """Name a tube to the physics side, so that lanes can be reset into it by `index`.

        Raises:
            Refusal: the slot is taken, or the physics side cannot read the tube.
            SessionError: the reference cannot be written down, or the session is over.
            PeerLost, PeerViolation: the session is over.
        """
        self._exchange(requests.REGISTER_TUBE, self.steps, self._wire.tube, requests.pack_tube(index, tube))

    def release_tube(self, index: int) -> None:
        """Let the physics side forget a tube.

        Raises:
            Refusal: no such tube, or a lane still flies in it.
            PeerLost, PeerViolation, SessionError: the session is over.
        """
        payload = index.to_bytes(8, "little", signed=True)
        self._exchange(requests.RELEASE_TUBE, self.steps, self._wire.tube_index, payload)

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
            self._exchange(requests.GOODBYE, self.steps, self._wire.tube_index, bytes(8))
        except ProtocolError as error:
            _log.warning("no orderly goodbye: %s", error)

    def _exchange(
        self,
        request: Request,
        due: int,
        wire: memoryview,
        payload: memoryview | bytes,
        meanwhile: Callable[[], None] | None = None,
    ) -> None:
        """Publish a request with its payload and take in the reply, after which `due` steps are integrated."""
        if self._state is not _READY:
            follow(self._state, request.event)  # raises what says so
        before, desk = self._number, self._desk
        number = before + 1
        self._state = request.asking
        try:
            if self._reply[_REPLY_DOORBELL] != before:
                raise PeerViolation(f"physics answered request {number} before it was made")
            engine_ns = -1
            if desk is None or request is not requests.STEP:
                self._publish(request.op, due, number, wire, payload)
            else:
                polls = self._waiter.polls * desk.polls_per_poll if meanwhile is None else 0
                engine_ns = desk.exchange(desk.address, number, due, polls)
            if meanwhile is not None:
                meanwhile()
            if engine_ns >= 0:
                self._engine_ns, status = engine_ns, _DONE
            else:
                status = self._take_reply(number, due, self._wait(before, due, request.phase))
        except BaseException as error:
            self._break(error)
            raise
        self._number = number
        if status == _DONE:
            self.steps, self._state = due, request.done
        else:
            self._state = follow(request.asking, Event.REFUSED)
            raise requests.read_refusal(self._pose)

    def _publish(self, op: int, due: int, number: int, wire: memoryview, payload: memoryview | bytes) -> None:
        """Write a request and ring the doorbell."""
        words = self._words
        words[_BEGIN] = number
        wire[:] = payload
        layout.REQUEST_REST.pack_into(self._command, _REQUEST_REST_AT, op, due, number)
        if FENCE is not None:
            FENCE()
        words[_DOORBELL] = number

    def _take_reply(self, number: int, due: int, rung: int) -> int:
        """Copy the poses and return the status, which is done or refused.

        Raises:
            PeerViolation: the reply is not one to request `number`.
        """
        if FENCE is not None:
            FENCE()
        self._pose_bytes[:] = self._wire.poses
        begin, status, step, self._engine_ns, end = layout.REPLY.unpack_from(self._pose, _REPLY_AT)
        if not (rung == begin == end == number):
            raise PeerViolation(requests.fault_of_reply(number, rung, begin, end))
        if status == _DONE and step == due:
            return _DONE
        if status == _REFUSED and step == self.steps:
            return _REFUSED
        raise PeerViolation(
            f"physics answered request {number} with status {status} at step {step} where {due} was due"
        )

    def _break(self, error: BaseException) -> None:
        """End the session because of `error`, and tell the other side where it may still listen."""
        self._remove()
        handshake.part(self._command, error, self._pose)
        events = {PeerViolation: Event.VIOLATION, PeerLost: Event.LOSS}
        self._state = follow(self._state, events.get(type(error), Event.FAREWELL))


def _remove_nothing() -> None:
    """A session in memory has no names to remove."""
