"""What can go wrong in a session.

    ProtocolError
    ├── Refusal             the peer is alive, the request was not carried out; the session goes on
    ├── SessionError        our side misused the session, or the rendezvous cannot be used
    ├── HandshakeError      magic, version, size, session, lanes or time step differ; no session came to be
    ├── PeerViolation       the peer broke the protocol: a skipped, repeated, early or torn step
    └── PeerLost            the peer's process exited, was killed, or passed a deadline
"""

from __future__ import annotations


class ProtocolError(Exception):
    """Root of everything that this package raises on purpose."""


class Refusal(ProtocolError):
    """The request was refused and nothing was integrated; the session goes on.

    Names the `field`, what was `expected` and what was `found`; `lane` is -1 where no lane is meant.
    """

    def __init__(self, field: str, expected: str, found: str, lane: int = -1) -> None:
        self.field = field
        self.expected = expected
        self.found = found
        self.lane = lane
        where = "" if lane < 0 else f" in lane {lane}"
        super().__init__(f"{field}{where}: expected {expected}, found {found}")


class SessionError(ProtocolError):
    """Our own side asked for something that the session cannot do in its state, or cannot be opened."""


class HandshakeError(ProtocolError):
    """The two sides do not agree on what they are to exchange; names field, expected and found."""


class PeerViolation(ProtocolError):
    """The other side broke the protocol; the session is over."""


class PeerLost(ProtocolError):
    """The other side's process is gone or passed its deadline; says who, how, at which step and in which phase."""
