"""The physics side: attach to the session that an agent offers, then answer its requests over a Plant."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Final

import numpy as np

from protocol import compiled_choice, handshake, layout, validation
from protocol.errors import PeerViolation, Refusal, RefusalCode
from protocol.handshake import Answer
from protocol.layout import COMMAND, POSE, Axes, Op, Status, read_i64
from protocol.liveness import start_time
from protocol.memory import FENCE, parse_rendezvous
from protocol.opening import attach_segments, remove_if_dead
from protocol.plant import (
    COMMAND_WORDS,
    NO_TUBE,
    POSE_WORDS,
    RESET_WORDS,
    CommandBatch,
    Plant,
    PoseBatch,
    ResetBatch,
    TubeReference,
)
from protocol.states import Event, State, follow
from protocol.waiting import Peer, Waiter

if TYPE_CHECKING:
    from protocol.compiled import Desk, Kernels

_STEP: Final = Op.STEP.value
_DONE: Final = Status.DONE.value
_READY: Final = State.READY
_BEGIN: Final = COMMAND["begin"].word
_DOORBELL: Final = COMMAND["doorbell"].word
_REQUEST_AT: Final = COMMAND["begin"].offset
_REPLY_BEGIN: Final = POSE["begin"].word
_REPLY_REST_AT: Final = POSE["status"].offset
_REPLY_DOORBELL: Final = POSE["doorbell"].word
_EARLY: Final = "wrote an early request before request {} was answered"


def serve(rendezvous: str, plant: Plant, attach_timeout: float = 30.0, launcher: int | None = None) -> None:
    """Wait for the session that an agent offers at `rendezvous`, then answer its requests until it says goodbye.

    May be called before the agent has created the session. Closes the plant. Leaves a farewell for the agent
    whenever it ends otherwise than by the agent's goodbye, and removes the segments if the agent is dead by then.
    `launcher` is the process that started this one: should it end before a session is offered, nobody waits for it.

    Raises:
        SessionError: the rendezvous cannot be used, or another physics process serves the session.
        HandshakeError: the agent's header is not what this version expects.
        PeerViolation: the agent broke the protocol.
        PeerLost: the agent died or left, or no session appeared within `attach_timeout` seconds or before
            the launcher ended.
        Exception: whatever the plant raised; the agent is told.
    """
    try:
        segments = attach_segments(parse_rendezvous(rendezvous), attach_timeout, launcher)
        try:
            _serve_attached(segments.command.view, segments.pose.view, plant)
        finally:
            remove_if_dead(segments)
            segments.close()
    finally:
        plant.close()


def _serve_attached(command: memoryview, pose: memoryview, plant: Plant) -> None:
    with ExitStack() as views:
        command = views.enter_context(command.toreadonly())  # its every byte is the agent's
        try:
            choice = compiled_choice.choose("physics", may_compile=False)
            session = views.enter_context(PhysicsSession(command, pose, plant, choice.kernels))
            offer = session.offer
            words = views.enter_context(command.cast("q"))
            wait = Waiter(words, _DOORBELL, Peer("agent", offer.pid, offer.started, command))
            while session.answer_at_once(wait.polls) or session.answer(
                wait(session.number, session.steps, "idle")
            ):
                pass
        except BaseException as error:
            handshake.part(pose, error, command)
            raise


class PhysicsSession:
    """The physics side's half of a session: it answers requests and does no I/O; `serve` and the twin drive it.

    Checks the agent's header, opens the plant and publishes its own header when it is made.

    Raises:
        HandshakeError: a field of the agent's header, or a segment's size, is not as expected.
    """

    def __init__(
        self, command: memoryview, pose: memoryview, plant: Plant, kernels: Kernels | None = None
    ) -> None:
        self.offer = handshake.read_offer(command)
        """What the agent asks of the session."""
        settings = self.offer.settings
        lanes = settings.lanes
        handshake.check_size(pose, layout.pose_bytes(lanes), "pose segment")
        self.number = 0
        """Number of the last request that was answered."""
        self.steps = 0
        """Control steps integrated in this session."""
        self._plant = plant
        self._tubes: set[int] = set()
        self._lane_tubes = np.full(lanes, NO_TUBE)
        self._was_reset = np.zeros(lanes, dtype=bool)
        self._all_reset = False

        # Private copies of what is on the wire: a plant never sees words that may change under it.
        self._commands, self._poses = CommandBatch.zeros(lanes), PoseBatch.zeros(lanes)
        self._resets = ResetBatch.zeros(lanes)
        self._command_bytes = layout.flat_bytes(self._commands.raw, COMMAND_WORDS, lanes, "commands")
        self._pose_bytes = layout.flat_bytes(self._poses.raw, POSE_WORDS, lanes, "poses")
        self._reset_bytes = layout.flat_bytes(self._resets.raw, RESET_WORDS, lanes, "resets")

        description = plant.describe()
        plant.open(lanes, settings.dt, settings.physics_dt, settings.inner_steps)
        self._speed_max = description.speed_max
        self._commands_are_sound = validation.command_check(self._commands, self._speed_max)
        pid = os.getpid()
        handshake.write_answer(pose, self.offer, Answer(description, pid, start_time(pid)))
        self._state = follow(State.OFFERED, Event.ATTACH)

        self._views = ExitStack()
        keep = self._views.enter_context
        self._command, self._pose = command, pose
        self._words, self._reply = keep(command.cast("q")), keep(pose.cast("q"))
        self._wire_commands = keep(command[layout.command_rows(lanes)])
        self._wire_resets = keep(command[layout.reset_rows(lanes)])
        self._wire_poses = keep(pose[layout.pose_rows(lanes)])
        self._desk: Desk | None = None
        if kernels is not None:
            self._desk = kernels.desk(command, pose, self._commands, self._poses, self._speed_max)

    def __enter__(self) -> PhysicsSession:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give up every view of the segments; idempotent."""
        self._desk = None
        self._views.close()

    def answer_at_once(self, polls: int) -> bool:
        """Answer the next request by machine code, if there is some, and if it is a sound step that comes at once.

        Returns False, and has done nothing, where there is something else to do or to say: `answer` does it.

        Args:
            polls: how long to wait for the doorbell, in polls of a Waiter.

        Raises:
            PeerViolation: the agent broke the protocol.
            Exception: whatever the plant raised.
        """
        desk = self._desk
        if desk is None or not self._all_reset or self._state is not _READY:
            return False
        number, step = self.number + 1, self.steps + 1
        if not desk.take(desk.address, number, step, polls * desk.polls_per_poll):
            return False
        try:
            engine_ns = self._integrate()
        except Refusal as refusal:
            self._publish_refusal(refusal, number)
            return True
        if not desk.publish(desk.address, number, step, engine_ns):
            raise PeerViolation(_EARLY.format(number))
        self.number, self.steps = number, step
        return True

    def answer(self, rung: int) -> bool:
        """Carry out the request whose doorbell shows `rung`, publish the reply, and return whether more may come.

        Raises:
            PeerViolation: the agent broke the protocol.
            Exception: whatever the plant raised.
        """
        if self.answer_at_once(1):
            return True
        if FENCE is not None:
            FENCE()
        number = self.number + 1
        if rung != number or self._state is not _READY:
            raise PeerViolation(f"rang the doorbell with {rung} where {number} was due")
        self._command_bytes[:] = self._wire_commands
        begin, op, step, end = layout.REQUEST.unpack_from(self._command, _REQUEST_AT)
        if begin != number or end != number:
            raise PeerViolation(f"published a torn request: begin {begin}, end {end} where {number} was due")
        if op != _STEP:
            return self._answer_rare(op, step, number)
        if step != self.steps + 1:
            how = "repeated" if step <= self.steps else "skipped"
            raise PeerViolation(f"{how} a step: asked for step {step} where {self.steps + 1} was due")
        try:
            self._check_commands()
            engine_ns = self._integrate()
        except Refusal as refusal:
            self._publish_refusal(refusal, number)
        else:
            self.steps = step
            self._publish(_DONE, engine_ns, number)
        return True

    def _integrate(self) -> int:
        """Take one control step and return how long that took (ns)."""
        began = time.perf_counter_ns()
        self._plant.step(self._commands, self._poses)
        return time.perf_counter_ns() - began

    def _check_commands(self) -> None:
        """Raise the Refusal of the first lane that may not be stepped."""
        if not self._all_reset:
            lane = int(np.argmin(self._was_reset))
            raise Refusal("step", "a lane that was reset", "a lane never reset", lane, RefusalCode.NOT_RESET)
        if not self._commands_are_sound():
            refusal = validation.command_refusal(self._commands, self._speed_max)
            if refusal is not None:
                raise refusal

    def _publish(self, status: int, engine_ns: int, number: int, refusal: Refusal | None = None) -> None:
        """Publish the reply to request `number`, the private poses with it, or a refusal."""
        words, reply = self._words, self._reply
        if words[_DOORBELL] != number or words[_BEGIN] != number:
            raise PeerViolation(_EARLY.format(number))
        reply[_REPLY_BEGIN] = number
        if refusal is None:
            self._wire_poses[:] = self._pose_bytes
        else:
            self._write_refusal(refusal)
        layout.REPLY_REST.pack_into(self._pose, _REPLY_REST_AT, status, self.steps, engine_ns, number)
        if FENCE is not None:
            FENCE()
        reply[_REPLY_DOORBELL] = number
        self.number = number

    def _publish_refusal(self, refusal: Refusal, number: int) -> None:
        self._pose_bytes[:] = self._wire_poses  # a plant that refuses half-way may have written some of them
        self._publish(Status.REFUSED, 0, number, refusal)

    def _write_refusal(self, refusal: Refusal) -> None:
        layout.write_i64(self._pose, POSE["refusal_code"], refusal.code)
        layout.write_i64(self._pose, POSE["refusal_lane"], refusal.lane)
        layout.write_text(self._pose, POSE["refusal_field"], refusal.field)
        layout.write_text(self._pose, POSE["refusal_expected"], refusal.expected)
        layout.write_text(self._pose, POSE["refusal_found"], refusal.found)

    def _answer_rare(self, op: int, step: int, number: int) -> bool:
        """Answer every request but a step."""
        actions: dict[int, Callable[[], None]] = {
            Op.RESET: self._reset,
            Op.REGISTER_TUBE: self._register_tube,
            Op.RELEASE_TUBE: self._release_tube,
            Op.GOODBYE: self._say_nothing,
        }
        if op not in actions:
            raise PeerViolation(f"asked for op {op}, which version {layout.VERSION_MAJOR} does not know")
        if step != self.steps:
            raise PeerViolation(f"asked for {Op(op).name} at step {step} where {self.steps} was due")
        self._state = follow(self._state, Event(op))
        began = time.perf_counter_ns()
        try:
            actions[op]()
        except Refusal as refusal:
            self._publish_refusal(refusal, number)
            self._state = follow(self._state, Event.REFUSED)
        else:
            self._publish(_DONE, time.perf_counter_ns() - began, number)
            self._state = follow(self._state, Event.DONE)
        return self._state is _READY

    def _say_nothing(self) -> None:
        """A goodbye asks for nothing but its reply."""

    def _reset(self) -> None:
        self._reset_bytes[:] = self._wire_resets
        refusal = validation.reset_refusal(self._resets, self._tubes)
        if refusal is not None:
            raise refusal
        self._plant.reset(self._resets, self._poses)
        selected = self._resets.selected == 1
        self._lane_tubes[selected] = self._resets.tube[selected]
        self._was_reset |= selected
        self._all_reset = bool(self._was_reset.all())

    def _register_tube(self) -> None:
        index, tube = self._tube_index(), self._tube_reference()
        if index in self._tubes:
            raise Refusal("tube_index", "a free slot", f"{index}, taken", code=RefusalCode.TUBE_SLOT)
        self._plant.register_tube(index, tube)
        self._tubes.add(index)

    def _release_tube(self) -> None:
        index = self._tube_index()
        if index not in self._tubes:
            raise Refusal("tube_index", "a registered tube", str(index), code=RefusalCode.UNKNOWN_TUBE)
        flying = np.flatnonzero(self._lane_tubes == index)
        if flying.size:
            raise Refusal(
                "tube_index",
                "a tube that no lane flies in",
                str(index),
                int(flying[0]),
                RefusalCode.TUBE_IN_USE,
            )
        self._plant.release_tube(index)
        self._tubes.discard(index)

    def _tube_index(self) -> int:
        index, slots = read_i64(self._command, COMMAND["tube_index"]), self.offer.settings.tube_slots
        if not 0 <= index < slots:
            raise Refusal("tube_index", f"0 to {slots - 1}", str(index), code=RefusalCode.TUBE_SLOT)
        return index

    def _tube_reference(self) -> TubeReference:
        view, malformed = self._command, RefusalCode.MALFORMED
        axes = read_i64(view, COMMAND["tube_axes"])
        (scale,) = layout.read_f64(view, COMMAND["tube_scale"])
        size, place = read_i64(view, COMMAND["tube_path_bytes"]), COMMAND["tube_path"]
        if axes not in tuple(Axes):
            raise Refusal("tube_axes", "0 (Z up) or 1 (Y up)", str(axes), code=malformed)
        if not (np.isfinite(scale) and scale > 0):
            raise Refusal("tube_scale", "a factor > 0", repr(scale), code=RefusalCode.OUT_OF_RANGE)
        if not 1 <= size <= place.count:
            raise Refusal("tube_path_bytes", f"1 to {place.count}", str(size), code=malformed)
        encoded = bytes(view[place.offset : place.offset + size])
        try:
            path = encoded.decode()
        except UnicodeDecodeError:
            raise Refusal("tube_path", "UTF-8", repr(encoded), code=malformed) from None
        if "\0" in path:
            raise Refusal("tube_path", "a path without zero bytes", repr(path), code=malformed)
        sha256 = bytes(view[COMMAND["tube_sha256"].bytes]).hex()
        return TubeReference(path, Axes(axes).name, scale, sha256)
