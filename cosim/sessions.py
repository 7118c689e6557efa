"""Opening a session with a physics process: ours, the user's command, or one that the user starts by hand."""

from __future__ import annotations

import itertools
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, Literal

from cosim.errors import CosimError
from cosim.supervise import PhysicsProcess, physics_command
from protocol.agent import AgentSession, SessionSettings
from protocol.errors import ProtocolError

Engine = Literal["bullet", "reference"]

ATTACH_TIMEOUT: Final = 60.0
"""Patience for our own server's attach (s): it may compile first, on a machine that is busy."""

_sessions = itertools.count()


def rendezvous_of(connect: str | None, name: str | None, transport: str) -> str:
    """The rendezvous string of a session: as given to --connect, or made from name and transport.

    Raises:
        CosimError: a name that no transport can carry.
    """
    if connect is not None:
        if ":" in connect:
            return connect
        name = connect
    if name is None:
        name = f"cosim-{os.getpid()}-{time.time_ns() % 1_000_000_000:09d}"
    if Path(name).name != name:
        raise CosimError(f"--session or --connect: expected a name without a folder, found {name!r}")
    return f"shm:{name}" if transport == "shm" else f"file:{Path(tempfile.gettempdir()) / name}"


@contextmanager
def physics_session(
    rendezvous: str,
    settings: SessionSettings,
    *,
    process: PhysicsProcess | None,
    attach_timeout: float,
) -> Iterator[AgentSession]:
    """An open session with a physics process.

    Args:
        rendezvous: where the two sides meet.
        settings: lanes and time steps.
        process: ours to watch; None for a peer that somebody else starts.
        attach_timeout: patience for the peer's attach (s).

    Raises:
        ProtocolError: the session could not be opened, or failed while it was used; the last lines that the
            process wrote to its stderr are added as a note.
    """
    watch = None if process is None else process.watch
    try:
        with AgentSession.open(rendezvous, settings, watch=watch, attach_timeout=attach_timeout) as session:
            if process is not None:
                process.serving = True
            yield session
    except ProtocolError as error:
        if process is not None and (words := process.last_words()):
            error.add_note(f"the physics process said: {words}")
        raise


@contextmanager
def server_session(settings: SessionSettings, engine: Engine = "bullet") -> Iterator[AgentSession]:
    """An open session with a physics server of ours, which is started for it and ends with it.

    Args:
        settings: lanes, time steps, and slots for tubes.
        engine: of the server; "reference" has no walls.

    Raises:
        ProtocolError: as `physics_session`.
    """
    rendezvous = rendezvous_of(None, f"cosim-{os.getpid()}-{next(_sessions)}-{time.time_ns() % 10**9}", "shm")
    command = [*physics_command(None), "--engine", engine]
    with (
        tempfile.TemporaryDirectory(prefix="cosim-physics-") as logs,
        PhysicsProcess(command, rendezvous, Path(logs)) as process,
        physics_session(rendezvous, settings, process=process, attach_timeout=ATTACH_TIMEOUT) as session,
    ):
        yield session
