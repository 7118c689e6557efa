"""Starts the peer under test for one rule, and leaves nothing of it: no process, no segment, no file.

Every rule gets a rig of its own, since a session is served once.
"""

from __future__ import annotations

import os
import secrets
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from protocol.conformance.raw_agent import RawAgent
from protocol.conformance.rule import Failure
from protocol.errors import SessionError
from protocol.handshake import SessionSettings
from protocol.liveness import describe_exit
from protocol.memory import COMMAND_SUFFIX, POSE_SUFFIX, open_segment, parse_rendezvous
from protocol.signals import held_signals

TRANSPORTS: Final = ("shm", "file")
LEAVING_S: Final = 5.0
"""How long a peer may take to leave (section 2 of the specification)."""
_LAST_LINES: Final = 12
_LAST_BYTES: Final = 8192
_LAST_WORDS_S: Final = 0.3
_LOOK_S: Final = 0.002


class PeerProcess:
    """A started `COMMAND RENDEZVOUS` in a process group of its own; what it prints goes to a file.

    Where the command has `{}`, the rendezvous stands there and not at its end.

    Raises:
        Failure: the command cannot be run.
    """

    def __init__(self, command: str, rendezvous: str, output: Path) -> None:
        self._output = output
        environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
        with output.open("ab") as printed:
            try:
                self._process = subprocess.Popen(
                    with_rendezvous(shlex.split(command), rendezvous),
                    env=environment,
                    stdin=subprocess.DEVNULL,
                    stdout=printed,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                )
            except (OSError, ValueError) as error:
                raise Failure("the command", "a program that can be run", f"{command!r}: {error}") from error

    @property
    def pid(self) -> int:
        """Process id of what was started, which is its group's too; a script may have the peer as its child."""
        return self._process.pid

    def watch(self) -> str | None:
        """None while it lives, else how it ended."""
        code = self._process.poll()
        return None if code is None else describe_exit(code)

    def wait(self, seconds: float) -> int | None:
        """Wait until it ends, and return its exit code (negative: the signal); None if it has not ended by then."""
        with suppress(subprocess.TimeoutExpired):
            return self._process.wait(seconds)
        return None

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to the process and all that it started."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, number)

    def end(self) -> None:
        """Kill it and all that it started."""
        self.signal(signal.SIGKILL)
        self._process.wait()

    def last_words(self) -> str:
        """The last lines that it printed."""
        with self._output.open("rb") as printed:
            printed.seek(max(0, self._output.stat().st_size - _LAST_BYTES))
            text = printed.read().decode(errors="replace")
        return "\n".join(text.strip().splitlines()[-_LAST_LINES:])


def with_rendezvous(words: list[str], rendezvous: str) -> list[str]:
    """Put the rendezvous where a command has `{}`, or behind its last word."""
    if not any("{}" in word for word in words):
        return [*words, rendezvous]
    return [word.replace("{}", rendezvous) for word in words]


class Rig:
    """What a rule works with: it starts peers and makes rendezvous, and clears everything away at its end."""

    def __init__(self, command: str, transport: str = "shm", timeout: float = 10.0) -> None:
        if sys.platform == "win32":
            raise SessionError(
                "the conformance kit ends programs by POSIX process groups: run it on Linux or macOS"
            )
        if transport not in TRANSPORTS:
            raise SessionError(f"transport: expected one of {', '.join(TRANSPORTS)}, found {transport!r}")
        self.command = command
        self.transport = transport
        self.timeout = timeout
        """How long the peer may take to start, or to answer (s)."""
        self.folder: Path
        """A scratch folder, for meshes and the like."""
        self.rendezvous: str
        """Where the first session takes place; `new_rendezvous` makes others."""
        self._processes: list[PeerProcess] = []
        self._agents: list[RawAgent] = []
        self._rendezvous: list[str] = []

    def __enter__(self) -> Self:
        with held_signals():
            self.folder = Path(tempfile.mkdtemp(prefix="conformance-"))
        self.rendezvous = self.new_rendezvous()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with held_signals():
            for process in self._processes:
                process.end()
            for agent in self._agents:
                agent.close()
            for rendezvous in self._rendezvous:
                _remove(rendezvous)
            shutil.rmtree(self.folder, ignore_errors=True)

    def new_rendezvous(self) -> str:
        """Make the name of a session that nobody else has."""
        name = f"conformance-{os.getpid()}-{secrets.token_hex(4)}"
        self._rendezvous.append(f"shm:{name}" if self.transport == "shm" else f"file:{self.folder / name}")
        return self._rendezvous[-1]

    def start(self, rendezvous: str | None = None) -> PeerProcess:
        """Start the peer at a rendezvous, the first one if none is named.

        Raises:
            Failure: the command cannot be run.
        """
        output = self.folder / f"peer-{len(self._processes)}.log"
        with held_signals():
            self._processes.append(PeerProcess(self.command, rendezvous or self.rendezvous, output))
        return self._processes[-1]

    def agent(
        self,
        lanes: int = 1,
        dt: float = 0.1,
        inner_steps: int = 4,
        tube_slots: int = 4,
        rendezvous: str | None = None,
    ) -> RawAgent:
        """Create the segments of a session, without a header yet, for an agent that is driven by hand."""
        settings = SessionSettings(lanes, dt, dt / inner_steps, tube_slots)
        with held_signals():
            self._agents.append(RawAgent(rendezvous or self.rendezvous, settings, self.timeout))
        return self._agents[-1]

    def open(self, lanes: int = 1, dt: float = 0.1, inner_steps: int = 4, tube_slots: int = 4) -> RawAgent:
        """Start a server and open a session with it, at a rendezvous of its own if the first is in use.

        Raises:
            Failure: the server ended, refused the header, or did not attach in time.
        """
        rendezvous = self.rendezvous if not self._agents else self.new_rendezvous()
        agent = self.agent(lanes, dt, inner_steps, tube_slots, rendezvous)
        agent.offer()
        agent.attend(self.start(rendezvous))
        agent.await_header()
        return agent

    def last_words(self) -> str:
        """What the peers printed, the end of it; one that is about to end has a moment to finish."""
        for process in self._processes:
            process.wait(_LAST_WORDS_S)
        return "\n".join(filter(None, (process.last_words() for process in self._processes)))


def await_end(process: PeerProcess, why: str, seconds: float = LEAVING_S) -> int:
    """Wait until a peer that has to leave has ended, and return its exit code.

    Raises:
        Failure: it has not within `seconds`.
    """
    code = process.wait(seconds)
    if code is None:
        raise Failure("the process", f"to end within {seconds:g} s {why}", "it still runs")
    return code


def segments_left(rendezvous: str) -> list[str]:
    """Names of the segments that exist at a rendezvous."""
    place, left = parse_rendezvous(rendezvous), []
    for suffix in (COMMAND_SUFFIX, POSE_SUFFIX):
        path = Path(place.stem + suffix) if place.kind == "file" else Path("/dev/shm", place.stem + suffix)
        if path.exists():
            left.append(str(path))
    return left


def await_no_segments(rendezvous: str, seconds: float = LEAVING_S) -> None:
    """Wait until both segments of a rendezvous are gone.

    Raises:
        Failure: one is left after `seconds`.
    """
    patience = time.monotonic() + seconds
    while segments_left(rendezvous):
        if time.monotonic() > patience:
            raise Failure("segments", f"none left within {seconds:g} s", segments_left(rendezvous))
        time.sleep(_LOOK_S)


def _remove(rendezvous: str) -> None:
    """Remove whatever stands at a rendezvous."""
    place = parse_rendezvous(rendezvous)
    for suffix in (COMMAND_SUFFIX, POSE_SUFFIX):
        segment = open_segment(place, suffix)
        if segment is not None:
            segment.unlink()
            segment.close()
