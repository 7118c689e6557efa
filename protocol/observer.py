"""A read-only observer: sees the commands, the poses and the state of a running session, and disturbs nobody.

It maps the segments for reading, takes no lock and writes no byte, so that any number of them may look on. An
observer belongs into a process of its own: in the agent's or the physics process it would cost that process its
lock, and is refused. What it returns are copies, whole by section 12 of the specification; they stay valid after
the session's end, and so does the observer itself.

    with Observer.attach("shm:NAME") as observer:
        while not observer.status().ended:
            snapshot = observer.wait_for_new(timeout=0.1)
            if snapshot is not None:
                draw(snapshot.poses.position)
"""

from __future__ import annotations

import struct
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from protocol import handshake, layout
from protocol.errors import HandshakeError, SessionError
from protocol.handshake import Answer, Offer, SessionSettings
from protocol.layout import COMMAND, COMMAND_STRIDE, POSE, POSE_STRIDE, Farewell, Op, Status
from protocol.leftovers import Found, Standing, survey
from protocol.liveness import Life, how_ended, life
from protocol.memory import COMMAND_SUFFIX, FENCE, POSE_SUFFIX, SHM_FOLDER, Rendezvous, parse_rendezvous
from protocol.plant import COMMAND_WORDS, POSE_WORDS, CommandBatch, PlantDescription, PoseBatch
from protocol.read_only import ReadOnlySegment, open_read_only
from protocol.states import TRANSITIONS, Event, State
from protocol.waiting import LOOK_S, NAP_MAX_S, NAP_MIN_S, give_way

TRIES: Final = 200
"""How often a message is read before it is given up as torn: a few milliseconds, in which any peer that runs
finishes a write."""
_AT_ONCE: Final = 20
"""Tries without giving way to the writer in between."""
_LOOK_AGAIN_S: Final = 0.01
_HEADER_BYTES: Final = 2048

_DOORBELL, _BEGIN, _END = (COMMAND[name].word for name in ("doorbell", "begin", "end"))
_REPLY_DOORBELL, _REPLY_BEGIN, _REPLY_END = (POSE[name].word for name in ("doorbell", "begin", "end"))
# A message is copied from the word behind `begin`; what stands behind these few words are its rows.
_REQUEST_WORDS: Final = struct.Struct("<2q")
_REPLY_WORDS: Final = struct.Struct("<3q")
_REQUEST_AT, _ROWS = COMMAND["op"].offset, COMMAND["commands"].offset
_REPLY_AT, _POSES = POSE["status"].offset, POSE["poses"].offset


@dataclass(frozen=True, eq=False)
class Snapshot:
    """One reply of the physics side, whole."""

    number: int
    """Number of the request that it answers; grows by one with every request."""
    refused: bool
    """Whether that request was refused; the poses are the last ones then."""
    step: int
    """Control steps integrated in this session."""
    engine_seconds: float
    """How long the plant worked on the request (s)."""
    poses: PoseBatch
    """(N, 16) a copy that cannot be written to."""


@dataclass(frozen=True, eq=False)
class Request:
    """One request of the agent, whole; it may not be answered yet."""

    number: int
    op: int
    """What it asks for: an `Op`."""
    step: int
    """Control steps integrated once it is done."""
    commands: CommandBatch
    """(N, 8) the commands of the last step that was asked for; a copy that cannot be written to."""


@dataclass(frozen=True)
class Party:
    """One side of the session."""

    name: str
    """ "agent" or "physics"."""
    pid: int
    """Its process; 0 where it is not known (yet)."""
    life: Life
    farewell: int
    """0, or why it left: a `Farewell`."""
    farewell_text: str

    @property
    def how_it_left(self) -> str:
        """Say how this side left otherwise than by goodbye; empty while it is there."""
        who = f"{self.name} (pid {self.pid})" if self.pid else self.name
        if self.farewell:
            return f"{who} {_LEFT.get(self.farewell, 'left')}: {self.farewell_text}"
        return f"{who} is dead: {how_ended(self.pid)}" if self.life is Life.DEAD else ""


_LEFT: Final = {
    Farewell.STOPPED.value: "left",
    Farewell.FAILED.value: "failed",
    Farewell.VIOLATION.value: "ended the session, for the other side",
    Farewell.HANDSHAKE.value: "does not accept the other side's header",
}


@dataclass(frozen=True)
class SessionStatus:
    """What a session is doing, as far as its segments and processes tell."""

    state: State
    agent: Party
    physics: Party
    why: str
    """How the session ended; empty while it goes on."""

    @property
    def ended(self) -> bool:
        """Whether nothing more will come."""
        return not TRANSITIONS[self.state]


class Observer:
    """Looks on at one session; `attach` makes one. Use it as a context manager, or close it."""

    def __init__(
        self, rendezvous: Rendezvous, offer: Offer, command: ReadOnlySegment, pose: ReadOnlySegment
    ) -> None:
        self.rendezvous = rendezvous
        self.torn = 0
        """Readings that were given up because every try was torn: a writer that is stopped or dead in mid-write."""
        self._offer = offer
        lanes = offer.settings.lanes
        self._answer: Answer | None = None
        self._seen = 0
        self._views = ExitStack()
        self._views.callback(command.close)
        self._views.callback(pose.close)
        keep = self._views.enter_context
        self._command, self._pose = command.view, pose.view
        self._words, self._reply = keep(command.view.cast("q")), keep(pose.view.cast("q"))
        self._request_bytes = keep(command.view[_REQUEST_AT : _ROWS + lanes * COMMAND_STRIDE])
        self._reply_bytes = keep(pose.view[_REPLY_AT : _POSES + lanes * POSE_STRIDE])

    @classmethod
    def attach(cls, where: str, timeout: float = 0.0) -> Observer:
        """Look on at the session at `where`; also at one that waits for its physics side, or has ended and left
        its segments behind.

        Args:
            where: a rendezvous, "shm:NAME" or "file:/absolute/stem"; or the bare name of a session, looked for
                in shared memory and then in the folder for temporary files.
            timeout: how long to wait for a session that goes on (s).

        Raises:
            SessionError: there is none, it may not be read, or it is one of this very process.
            HandshakeError: it is of another version, or no session at all.
        """
        places = _places(where)
        until = time.monotonic() + timeout
        while True:
            for place in places:
                observer = _try_attach(place)
                if observer is None:
                    continue
                if time.monotonic() >= until or not observer.status().ended:
                    return observer
                observer.close()
            if time.monotonic() >= until:
                raise SessionError(_nothing_there(where, timeout))
            time.sleep(_LOOK_AGAIN_S)

    @property
    def settings(self) -> SessionSettings:
        """What the agent asked of the session."""
        return self._offer.settings

    @property
    def description(self) -> PlantDescription | None:
        """What the physics side says of itself; None until it has attached.

        Raises:
            HandshakeError: its header does not fit; the agent refuses it too.
        """
        answer = self._read_answer()
        return None if answer is None else answer.description

    def latest(self) -> Snapshot | None:
        """Return the newest reply; None before the first one, or where every try was torn (`torn` counts those)."""
        message = self._read(self._reply, _REPLY_BEGIN, _REPLY_END, self._reply_bytes)
        if message is None:
            return None
        self._seen, copy = message
        status, step, engine_ns = _REPLY_WORDS.unpack_from(copy)
        poses = np.frombuffer(copy, offset=_POSES - _REPLY_AT).reshape(-1, POSE_WORDS)
        return Snapshot(self._seen, status != Status.DONE, step, engine_ns * 1e-9, PoseBatch(poses))

    def request(self) -> Request | None:
        """Return the newest request; None before the first one, or where every try was torn."""
        message = self._read(self._words, _BEGIN, _END, self._request_bytes)
        if message is None:
            return None
        number, copy = message
        op, step = _REQUEST_WORDS.unpack_from(copy)
        commands = np.frombuffer(copy, offset=_ROWS - _REQUEST_AT).reshape(-1, COMMAND_WORDS)
        return Request(number, op, step, CommandBatch(commands))

    def _read(self, words: memoryview, begin: int, end: int, message: memoryview) -> tuple[int, bytes] | None:
        """Return a message's number and bytes; None where there is none yet or it cannot be had whole."""
        found = _whole(words, begin, end, message)
        self.torn += found is None
        return found if found is not None and found[0] != 0 else None

    def wait_for_new(self, timeout: float) -> Snapshot | None:
        """Wait for a reply that was not returned yet, at most `timeout` seconds, and return the newest one.

        None where nothing came in that time or nothing can come any more; `status` tells which. It polls with
        naps of 1 to 15 ms, so that it costs the session nothing.
        """
        now = time.monotonic()
        until, look_at, nap = now + timeout, now + LOOK_S, NAP_MIN_S
        while True:
            before = self._seen
            if self._reply[_REPLY_DOORBELL] != before:
                snapshot = self.latest()
                if snapshot is not None and snapshot.number != before:
                    return snapshot
            now = time.monotonic()
            if now >= until:
                return None
            if now >= look_at:
                if self.status().ended and self._reply[_REPLY_DOORBELL] == before:
                    return None
                look_at = now + LOOK_S
            time.sleep(min(nap, until - now))
            nap = min(1.2 * nap, NAP_MAX_S)

    def status(self) -> SessionStatus:
        """Look at headers, doorbells, farewells and processes."""
        agent = _party("agent", self._command, self._offer.pid, self._offer.started)
        physics = _party("physics", self._pose, *handshake.owner(self._pose))
        try:
            state = self._state()
        except HandshakeError as error:
            return SessionStatus(State.BROKEN, agent, physics, f"the physics side's header: {error}")
        if state is State.CLOSED:
            return SessionStatus(state, agent, physics, "goodbye")
        left = "; ".join(party.how_it_left for party in (agent, physics) if party.how_it_left)
        if left or state is State.BROKEN:
            why = left or "the doorbells do not fit together"
            return SessionStatus(State.BROKEN, agent, physics, why)
        return SessionStatus(state, agent, physics, "")

    def close(self) -> None:
        """Unmap the segments; idempotent."""
        self._views.close()

    def __enter__(self) -> Observer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _state(self) -> State:
        """Tell the state from the words alone, as if both sides lived."""
        if self._read_answer() is None:
            return State.OFFERED
        words, reply = self._words, self._reply
        for _ in range(TRIES):
            asked: int = words[_DOORBELL]
            _fence()
            op, _ = _REQUEST_WORDS.unpack_from(self._request_bytes)
            answered: int = reply[_REPLY_DOORBELL]
            written = words[_BEGIN], words[_END]
            _fence()
            if words[_DOORBELL] != asked:
                continue  # the next request was published meanwhile
            if answered not in (asked, asked - 1):
                return State.BROKEN
            if asked == 0 or written != (asked, asked):  # the next request is being written
                return State.READY
            if answered == asked:
                return State.CLOSED if op == Op.GOODBYE else State.READY
            return TRANSITIONS[State.READY][Event(op)] if op in tuple(Op) else State.BROKEN
        return State.STEPPING  # too fast to be seen standing

    def _read_answer(self) -> Answer | None:
        if self._answer is None and handshake.magic(self._pose) != bytes(8):
            self._answer = handshake.read_answer(self._pose, self._offer)
        return self._answer


def sessions(folders: Sequence[Path] = ()) -> tuple[Found, ...]:
    """List the sessions whose agent lives: those in shared memory, and those of `file:` rendezvous in `folders`."""
    return tuple(found for found in survey(folders) if found.standing is Standing.LIVE)


def _whole(words: memoryview, begin: int, end: int, message: memoryview) -> tuple[int, bytes] | None:
    """Copy a message, again and again until nothing was overwritten meanwhile: `end` is read first, `begin` last.

    Returns its number and bytes; None where every try was torn.
    """
    for tried in range(TRIES):
        number: int = words[end]
        _fence()
        copy = bytes(message)
        _fence()
        if words[begin] == number:
            return number, copy
        if tried >= _AT_ONCE:
            give_way()
    return None


def _fence() -> None:
    if FENCE is not None:
        FENCE()


def _party(name: str, view: memoryview, pid: int, started: int) -> Party:
    reason, text = handshake.read_farewell(view)
    return Party(name, pid, life(pid, started), reason, text)


def _places(where: str) -> tuple[Rendezvous, ...]:
    """Return the rendezvous that a text may mean."""
    if ":" in where:
        return (parse_rendezvous(where),)
    if not where or Path(where).name != where:
        raise SessionError(f"session: expected a name, shm:NAME or file:/path/stem, found {where!r}")
    file = parse_rendezvous(f"file:{Path(tempfile.gettempdir()) / where}")
    return (parse_rendezvous(f"shm:{where}"), file) if SHM_FOLDER.is_dir() else (file,)


def _try_attach(place: Rendezvous) -> Observer | None:
    """Open both segments if a session stands there now."""
    with ExitStack() as opened:
        command = open_read_only(place, COMMAND_SUFFIX)
        if command is None:
            return None
        opened.callback(command.close)
        if len(command.view) < _HEADER_BYTES:
            raise HandshakeError(
                f"size of {command.name}", f"at least {_HEADER_BYTES} bytes", str(len(command.view))
            )
        if handshake.magic(command.view) == bytes(8):
            return None
        offer = handshake.read_offer(command.view)
        pose = open_read_only(place, POSE_SUFFIX)
        if pose is None:
            return None
        opened.callback(pose.close)
        if (
            not command.stands()
        ):  # a new session took its place meanwhile, and the second segment is of that one
            return None
        handshake.check_size(pose.view, layout.pose_bytes(offer.settings.lanes), "pose segment")
        observer = Observer(place, offer, command, pose)
        opened.pop_all()
        return observer


def _nothing_there(where: str, timeout: float) -> str:
    waited = f" within {timeout:g} s" if timeout else ""
    running = ", ".join(str(found.rendezvous) for found in sessions([Path(tempfile.gettempdir())]))
    return f"session {where!r}: expected a running session, found none{waited}; " + (
        f"running now: {running}" if running else "none is running now"
    )
