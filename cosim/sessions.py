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
from protocol.signals import held_signals

Engine = Literal["bullet", "reference"]

TUBE: Final = 0
"""Index under which a flight's one tube is registered."""
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
def offered_session(rendezvous: str, settings: SessionSettings) -> Iterator[AgentSession]:
    """A session on offer, for which a physics process can be started: its name is nobody else's from now on.

    Raises:
        SessionError: the rendezvous is taken or cannot be used, or there is no room.
    """
    session: AgentSession | None = None
    try:
        with held_signals():  # Ctrl-C comes before the segments are there, or when they will be removed
            session = AgentSession.offer(rendezvous, settings)
        yield session
    finally:
        if session is not None:
            session.close()


@contextmanager
def attached_session(
    offer: AgentSession, *, process: PhysicsProcess | None, attach_timeout: float
) -> Iterator[AgentSession]:
    """A session with the physics process that takes up the offer; it is closed before that process is.

    Args:
        offer: the session on offer.
        process: ours to watch; None for a peer that somebody else starts.
        attach_timeout: patience for the peer's attach (s).

    Raises:
        ProtocolError: nobody attached, or the session failed while it was used; the last lines that the process
            wrote to its stderr are added as a note.
    """
    try:
        with offer as session:
            session.await_physics(None if process is None else process.watch, attach_timeout)
            if process is not None:
                process.serving = True
            yield session
    except ProtocolError as error:
        if process is not None and (words := process.last_words()):
            error.add_note(f"the physics process said: {words}")
        raise


@contextmanager
def physics_session(
    rendezvous: str,
    settings: SessionSettings,
    *,
    process: PhysicsProcess | None,
    attach_timeout: float,
) -> Iterator[AgentSession]:
    """An open session with a physics process that is there already, at a rendezvous that nobody else knows.

    Raises:
        ProtocolError: as `offered_session` and `attached_session`.
    """
    with (
        offered_session(rendezvous, settings) as offer,
        attached_session(offer, process=process, attach_timeout=attach_timeout) as session,
    ):
        yield session


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
