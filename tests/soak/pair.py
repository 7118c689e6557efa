"""Two peers forked from this process over one rendezvous: how each of them ended, and when.

Forked and not started: everything is imported already, so that a pair takes milliseconds and a kill can fall
into any moment of a session's start.
"""

from __future__ import annotations

import json
import os
import secrets
import select
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from protocol.agent import AgentSession, SessionSettings
from protocol.compiled_choice import COMPILED, ENVIRONMENT, STDLIB
from protocol.errors import ProtocolError
from protocol.liveness import Life, life, start_time
from protocol.physics import serve
from protocol.plant import Plant
from protocol.waiting import Watch

SIDES: Final = ("agent", "physics")
DEADLINE_S: Final = 30.0
"""After which a peer that has not ended is taken to hang."""


def _as_it_is(side: str) -> None:
    """Prepare nothing."""


def exchanges() -> tuple[str, ...]:
    """The ways to exchange steps that there are here, loaded before anything is forked."""
    if find_spec("numba") is None:
        return (STDLIB,)
    from protocol.compiled import load_kernels

    load_kernels(True)
    return (STDLIB, COMPILED)


@dataclass(frozen=True)
class Roles:
    """What the two peers do."""

    settings: SessionSettings
    plant: Callable[[], Plant]
    """Makes the plant; its `report()`, where it has one, goes into the physics side's report."""
    fly: Callable[[AgentSession], Any]
    """Flies an open session; what it returns goes into the agent's report."""
    exchange: dict[str, str] = field(default_factory=lambda: dict.fromkeys(SIDES, STDLIB))
    """How either side exchanges steps: by the standard library, or by machine code."""
    prepare: Callable[[str], None] = _as_it_is
    """Called in either child with its side before it begins: pins cores, sets how it waits."""


@dataclass(frozen=True)
class Report:
    """How a peer ended, as it saw that itself."""

    error: str
    """Name of the error's class, empty for an orderly end."""
    typed: bool
    """Whether the error is one of the package's."""
    text: str
    at: float
    """Moment of the end (s of the monotonic clock, which all processes share)."""
    queued: float
    """How long the process had waited for a core by then (s)."""
    value: Any


class Pair:
    """Two peers at work; `finish` waits for both."""

    def __init__(self, rendezvous: str, roles: Roles) -> None:
        self.rendezvous = rendezvous
        told, tell = os.pipe()  # the agent is forked first, and told the pid of the other afterwards

        def agent() -> Any:
            os.close(tell)
            os.environ[ENVIRONMENT] = roles.exchange["agent"]
            physics = int.from_bytes(os.read(told, 8), "little")
            roles.prepare("agent")
            with AgentSession.open(rendezvous, roles.settings, watch=watch_of(physics)) as session:
                return roles.fly(session)

        def physics() -> Any:
            os.environ[ENVIRONMENT] = roles.exchange["physics"]
            roles.prepare("physics")
            plant = roles.plant()
            serve(rendezvous, plant, launcher=self.pids["agent"])
            return plant.report() if hasattr(plant, "report") else None

        self.pids: dict[str, int] = {}
        self._pipes: dict[str, int] = {}
        for side, body in (("agent", agent), ("physics", physics)):
            self._fork(side, body)
        os.close(told)
        os.write(tell, self.pids["physics"].to_bytes(8, "little"))
        os.close(tell)

    def _fork(self, side: str, body: Callable[[], Any]) -> None:
        read, write = os.pipe()
        pid = os.fork()
        if pid == 0:
            os.close(read)
            os.write(write, _report_of(body))
            os._exit(0)
        os.close(write)
        self.pids[side], self._pipes[side] = pid, read

    def ended(self, side: str) -> bool:
        """Whether a peer is dead by now, collected or not."""
        return life(self.pids[side], 0) is Life.DEAD

    def signal(self, side: str, number: signal.Signals) -> None:
        """Send a signal to a peer, which may be dead: it stays a zombie until `finish`."""
        os.kill(self.pids[side], number)

    def finish(self) -> dict[str, Report | None]:
        """Wait for both ends; None stands for a peer that was killed.

        Raises:
            TimeoutError: a peer hangs. It is killed.
        """
        deadline = time.monotonic() + DEADLINE_S
        try:
            return {side: self._collect(side, deadline) for side in SIDES}
        finally:
            for side, pid in self.pids.items():
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
                os.close(self._pipes[side])

    def _collect(self, side: str, deadline: float) -> Report | None:
        ready, _, _ = select.select([self._pipes[side]], [], [], max(0.0, deadline - time.monotonic()))
        if not ready:
            raise TimeoutError(f"{side} has not ended within {DEADLINE_S} s")
        with os.fdopen(os.dup(self._pipes[side]), "rb") as pipe:
            text = pipe.read()
        return Report(**json.loads(text)) if text else None


def _report_of(body: Callable[[], Any]) -> bytes:
    error: BaseException | None = None
    value = None
    try:
        value = body()
    except BaseException as raised:  # noqa: BLE001  whatever it is, it is reported and judged by the parent
        error = raised
    at, queued = time.monotonic(), queued_seconds(os.getpid())
    name, text = ("", "") if error is None else (type(error).__name__, str(error))
    report = Report(name, isinstance(error, ProtocolError), text, at, queued, value)
    return json.dumps(report.__dict__).encode()


def watch_of(pid: int) -> Watch:
    """A launcher's view of a process that is no child of ours."""
    started = start_time(pid)
    return lambda: "its process is gone" if life(pid, started) is Life.DEAD else None


def queued_seconds(pid: int) -> float:
    """How long a process has been ready and waited for a core; 0 where the system does not tell."""
    try:
        return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) * 1e-9
    except (OSError, IndexError):
        return 0.0


@contextmanager
def meeting(transport: str) -> Iterator[str]:
    """A rendezvous that nobody else has, whose segments are gone at the end.

    Raises:
        AssertionError: something was left there.
    """
    name = f"cosim-soak-{os.getpid()}-{secrets.token_hex(4)}"
    with tempfile.TemporaryDirectory(prefix="cosim-soak-") as made:
        folder = Path("/dev/shm") if transport == "shm" else Path(made)
        yield f"shm:{name}" if transport == "shm" else f"file:{folder / name}"
        left = sorted(folder.glob(f"{name}*"))
        for path in left:
            path.unlink()
        if left:
            raise AssertionError(f"left behind: {[path.name for path in left]}")
