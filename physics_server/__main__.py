"""The program `python -m physics_server RENDEZVOUS`: rigid bodies for the agent that offers a session.

Exit status: 0 the agent said goodbye; 2 bad usage, a rendezvous that cannot be used, or the engine is not
there; 3 the agent, the protocol or the engine failed; 128 + n ended by signal n. An error is one line on
stderr; stdout stays empty.
"""

from __future__ import annotations

import argparse
import math
import os
import signal
import sys
from types import FrameType
from typing import NoReturn

from physics_server.errors import EngineError, PhysicsServerError
from protocol.errors import ProtocolError, SessionError
from protocol.physics import serve
from protocol.plant import Plant

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def main() -> int:
    """Serve one session and return the exit status."""
    arguments = _parser().parse_args()
    for number in _SIGNALS:
        signal.signal(number, _leave)
    # Whatever an engine prints from C goes to stderr: stdout stays clean for whoever started this.
    os.dup2(sys.stderr.fileno(), 1)
    try:
        plant = _plant(arguments.engine)
    except EngineError as error:
        return _say(error, 2)
    try:
        serve(arguments.rendezvous, plant, arguments.attach_timeout, arguments.launcher)
    except SessionError as error:
        return _say(error, 2)
    except (ProtocolError, PhysicsServerError) as error:
        return _say(error, 3)
    return 0


def _plant(engine: str) -> Plant:
    """Make the plant of this name; only the engine that is asked for is imported."""
    if engine == "null":
        from physics_server.null import NullPlant

        return NullPlant()
    if engine == "reference":
        from physics_server.reference import ReferencePlant

        return ReferencePlant()
    from physics_server.bullet import BulletPlant

    return BulletPlant()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m physics_server",
        description="Integrate rigid bodies for the agent that offers a session at RENDEZVOUS.",
    )
    parser.add_argument("rendezvous", metavar="RENDEZVOUS", help="shm:NAME or file:/path/stem")
    parser.add_argument(
        "--engine",
        choices=("bullet", "reference", "null"),
        default="bullet",
        help="bullet: PyBullet (default); reference: a fast rigid body without any walls, which refuses tubes; "
        "null: answers at once and moves nothing, for benchmarks",
    )
    parser.add_argument(
        "--attach-timeout",
        metavar="SECONDS",
        type=_seconds,
        default=30.0,
        help="how long to wait for the agent to offer the session (default 30)",
    )
    parser.add_argument(
        "--launcher",
        metavar="PID",
        type=_pid,
        help="end when this process ends before a session is offered",
    )
    return parser


def _seconds(text: str) -> float:
    """Read a time that can pass: NaN and infinity would wait for ever."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not (math.isfinite(seconds) and seconds >= 0):
        raise argparse.ArgumentTypeError(f"expected a finite time in seconds >= 0, found {text!r}")
    return seconds


def _pid(text: str) -> int:
    """Read a process id."""
    try:
        pid = int(text)
    except ValueError:
        pid = 0
    if not 1 <= pid < 2**31:
        raise argparse.ArgumentTypeError(f"expected a process id >= 1, found {text!r}")
    return pid


def _say(error: Exception, status: int) -> int:
    """Write one line that says what was wrong."""
    sys.stderr.write(f"physics_server: {' '.join(str(error).split())}\n")
    return status


def _leave(number: int, frame: FrameType | None) -> NoReturn:
    """End with the status that a shell gives to a signal, by way of every `finally`; a second one changes nothing."""
    for each in _SIGNALS:
        signal.signal(each, signal.SIG_IGN)
    raise SystemExit(128 + number)


if __name__ == "__main__":
    sys.exit(main())
