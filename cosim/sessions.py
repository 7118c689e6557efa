"""Opening a session with a physics process: ours, the user's command, or one that the user starts by hand."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cosim.errors import CosimError
from cosim.supervise import PhysicsProcess
from protocol.agent import AgentSession, SessionSettings
from protocol.errors import ProtocolError


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
