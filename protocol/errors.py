"""What can go wrong in a session.

ProtocolError
├── Refusal             the peer is alive, the request was not carried out; the session goes on
├── SessionError        our side misused the session, or the rendezvous cannot be used
├── HandshakeError      magic, version, size, session, lanes or time step differ; no session came to be
├── PeerViolation       the peer broke the protocol: a skipped, repeated, early or torn step
└── PeerLost            the peer's process exited, was killed, left, failed, or passed a deadline
"""

from __future__ import annotations

from enum import Enum, IntEnum


class RefusalCode(IntEnum):
    """Why a request was refused, as the number on the wire."""

    NOT_FINITE = 1
    """A number is NaN or infinite."""
    OUT_OF_RANGE = 2
    """A number is outside of its range."""
    NOT_UNIT = 3
    """A direction or a quaternion has not length 1."""
    RESERVED = 4
    """A reserved word is not zero."""
    NOT_RESET = 5
    """A step was asked of a lane that was never reset."""
    UNKNOWN_TUBE = 6
    """No tube is registered under this index."""
    TUBE_SLOT = 7
    """The index is outside of the slots, or taken."""
    TUBE_IN_USE = 8
    """A lane still flies in the tube that was to be released."""
    MALFORMED = 9
    """A text or a code of a tube registration cannot be read."""
    PLANT = 10
    """The plant cannot do it, for a reason of its own."""


class Verdict(Enum):
    """How a wait for the other side ended without an answer."""

    EXITED = "exited"
    """The process is gone: it exited or was killed."""
    LEFT = "left"
    """It said farewell before the session's end, because it was told to stop."""
    FAILED = "failed"
    """It said farewell because of an error of its own."""
    STOPPED = "stopped"
    """It stands still (SIGSTOP, a debugger), and passed the deadline that was set."""
    TOO_SLOW = "too slow"
    """It runs, and passed the deadline that was set."""


class ProtocolError(Exception):
    """Root of everything that this package raises on purpose."""


class Refusal(ProtocolError):  # noqa: N818  the protocol's own word
    """The request was refused and nothing was integrated; the session goes on.

    Names the `field`, what was `expected` and what was `found`; `lane` is -1 where no lane is meant.
    """

    def __init__(
        self, field: str, expected: str, found: str, lane: int = -1, code: RefusalCode = RefusalCode.PLANT
    ) -> None:
        self.field = field
        self.expected = expected
        self.found = found
        self.lane = lane
        self.code = code
        where = "" if lane < 0 else f" in lane {lane}"
        super().__init__(f"{field}{where}: expected {expected}, found {found}")


class SessionError(ProtocolError):
    """Our own side asked for something that the session cannot do in its state, or cannot be opened."""


class HandshakeError(ProtocolError):
    """The two sides do not agree on what they are to exchange; names field, expected and found."""

    def __init__(self, field: str, expected: str, found: str) -> None:
        self.field = field
        self.expected = expected
        self.found = found
        super().__init__(f"{field}: expected {expected}, found {found}")


class PeerViolation(ProtocolError):  # noqa: N818  the protocol's own word
    """The other side broke the protocol; the session is over."""


class PeerLost(ProtocolError):  # noqa: N818  the protocol's own word
    """The other side is gone or passed its deadline; the session is over.

    Says `who` it is, `how` it ended, the `verdict` in one word, at which `step` of the session and in which
    `phase` (attach, idle, step, reset, register_tube, release_tube, goodbye).
    """

    def __init__(self, who: str, how: str, verdict: Verdict, step: int, phase: str) -> None:
        self.who = who
        self.how = how
        self.verdict = verdict
        self.step = step
        self.phase = phase
        super().__init__(f"lost {who} at step {step}, phase {phase}: {how}")
