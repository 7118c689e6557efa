"""Waiting for the other side: a little polling, then yielding, then sleeping, with an eye on its process.

Polling answers fastest while the peer runs on another core; yielding lets it run where both share one; sleeping
makes a long wait (a policy update, a breakpoint) cost almost nothing. A wait ends with a new doorbell, or with one
typed verdict: the peer exited, left, failed, or passed a deadline that was set. A stopped peer is waited for.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from protocol.errors import HandshakeError, PeerLost, ProtocolError, SessionError, Verdict
from protocol.handshake import magic, read_farewell
from protocol.layout import Farewell
from protocol.liveness import Life, how_ended, life

POLLS: Final = 200
"""Polls of the doorbell before the first yield, about 8 us."""
IN_VAIN: Final = 3
"""Waits in a row whose polling was in vain, after which waits yield at once."""
TRIAL: Final = 256
"""Every so many waits that yield at once, one polls all the same: the peer may have got a core of its own."""
YIELDING_S: Final = 0.05
"""How long a wait without progress yields before it begins to sleep."""
LOOK_S: Final = 0.03
"""Time between two looks at the peer's process."""
NAP_MIN_S: Final = 0.001
NAP_MAX_S: Final = 0.015
EXIT_NEWS_S: Final = 0.05
"""How long a launcher is given to learn how its dead child ended."""

Watch = Callable[[], str | None]
"""A launcher's own view of the peer's process: None while it lives, else how it ended."""


def spin(words: memoryview, index: int, old: int, polls: int) -> int:
    """Poll a word a few times; return its new value, or `old` if it did not change."""
    value: int = old
    for _ in range(polls):
        value = words[index]
        if value != old:
            break
    return value


def give_way() -> None:
    """Let another process run on this core."""
    if hasattr(os, "sched_yield"):
        os.sched_yield()
    else:
        time.sleep(0)


@dataclass(frozen=True)
class Peer:
    """The other side, as a wait looks at it."""

    who: str
    """Its name in messages: "physics" or "agent"."""
    pid: int
    started: int
    view: memoryview
    """Its segment, where it writes its farewell."""
    watch: Watch | None = None

    def check(self, step: int, phase: str) -> Life:
        """Look at the peer's farewell and process; return whether it runs or is stopped.

        Raises:
            PeerLost, SessionError, HandshakeError: it left, or is dead.
        """
        reason, text = read_farewell(self.view)
        if reason != Farewell.NONE:
            raise farewell_error(self.name, reason, text, step, phase)
        state = life(self.pid, self.started)
        ended = self.watch() if self.watch is not None else None
        if state is Life.DEAD or ended is not None:
            raise PeerLost(self.name, ended or self._how_ended(), Verdict.EXITED, step, phase)
        return state

    @property
    def name(self) -> str:
        """The peer with its pid, as messages name it."""
        return f"{self.who} (pid {self.pid})" if self.pid else self.who

    def _how_ended(self) -> str:
        """Say how the dead process ended; its launcher may need a moment to know."""
        how = how_ended(self.pid)
        patience = time.monotonic() + EXIT_NEWS_S
        while self.watch is not None and time.monotonic() < patience:
            ended = self.watch()
            if ended is not None:
                return ended
            time.sleep(NAP_MIN_S)
        return how


def farewell_error(who: str, reason: int, text: str, step: int, phase: str) -> ProtocolError:
    """Turn the other side's farewell into our error."""
    if reason == Farewell.VIOLATION:
        return SessionError(f"{who} ended the session at step {step}, phase {phase}: it says that we {text}")
    if reason == Farewell.HANDSHAKE:
        return HandshakeError(f"{who}'s view of our header", "agreement", text)
    verdict = Verdict.FAILED if reason == Farewell.FAILED else Verdict.LEFT
    return PeerLost(who, text, verdict, step, phase)


class Waiter:
    """Waits for the peer's next doorbell; one for each side of a session.

    It learns whether polling is of use: where it was in vain a few times in a row, the peer shares this core and was
    only kept from running, or it takes longer than that. Then waits yield at once, but for a trial now and then.
    """

    def __init__(self, words: memoryview, doorbell: int, peer: Peer, deadline: float | None = None) -> None:
        self.peer = peer
        self.deadline = deadline
        """Longest wait (s), or None: as long as the peer lives."""
        self._words = words
        self._doorbell = doorbell
        self.polls = POLLS
        """Polls of the next wait before its first yield."""
        self._in_vain = 0
        self._last_in_vain = -1

    def __call__(self, old: int, step: int, phase: str) -> int:
        """Return the doorbell's value as soon as it is not `old` any more; `step`, `phase` are for messages.

        Raises:
            PeerLost, SessionError, HandshakeError: the peer died, left, or passed the deadline.
        """
        value = spin(self._words, self._doorbell, old, self.polls)
        if value != old:
            return value
        self._in_vain = self._in_vain + 1 if old == self._last_in_vain + 1 else 1
        self._last_in_vain = old
        self.polls = POLLS if self._in_vain < IN_VAIN or self._in_vain % TRIAL == 0 else 1
        give_way()
        value = self._words[self._doorbell]
        return value if value != old else self._wait_long(old, step, phase)

    def _wait_long(self, old: int, step: int, phase: str) -> int:
        words, doorbell = self._words, self._doorbell
        began = now = time.monotonic()
        look_at = began + LOOK_S
        nap = NAP_MIN_S
        while True:
            value: int = words[doorbell]
            if value != old:
                return value
            if now - began < YIELDING_S:
                give_way()
            else:
                time.sleep(nap)
                nap = min(1.2 * nap, NAP_MAX_S)
            now = time.monotonic()
            if now >= look_at:
                self._look(old, now - began, step, phase)
                look_at = now + LOOK_S

    def _look(self, old: int, waited: float, step: int, phase: str) -> None:
        try:
            state = self.peer.check(step, phase)
        except ProtocolError:
            if self._words[self._doorbell] != old:  # it rang before it ended
                return
            raise
        if self.deadline is not None and waited > self.deadline:
            stopped = state is Life.STOPPED
            raise PeerLost(
                self.peer.name,
                f"no answer in {waited:.1f} s (deadline {self.deadline} s); its process is {state.value}"
                + ("; continue it (kill -CONT) or remove the debugger" if stopped else ""),
                Verdict.STOPPED if stopped else Verdict.TOO_SLOW,
                step,
                phase,
            )


def await_header(pose: memoryview, rendezvous: str, watch: Watch | None, timeout: float) -> None:
    """Wait until the physics side's magic stands.

    Raises:
        PeerLost, SessionError, HandshakeError: it left, died, or did not attach within `timeout` seconds.
    """
    peer = Peer("physics", 0, 0, pose, watch)
    began = look_at = time.monotonic()
    while magic(pose) == bytes(8):
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
        time.sleep(NAP_MIN_S)
