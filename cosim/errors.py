"""What can go wrong around a run, and the exit status of the command for each.

    CosimError                      2
    ├── OutputError                 2   the run folder cannot be written, or already holds a run
    ├── RunError                    2   a run folder that cannot be read
    ├── PeerCommandError            2   the physics command cannot be started
    ├── ViewError                   2   nothing can be drawn here
    │   └── NoDisplayError          2   a window without a display
    └── WorkerError                     a worker process failed; 3, or the status of what it failed of
    protocol.errors.ProtocolError   3   the other process or the protocol failed
    ├── protocol.errors.SessionError    2   our own side asked for what cannot be had (no room, name in use)
    meshes.errors.MeshError         2   the tube cannot be read
    agent_client.errors.AgentError  2   policy, contract or settings do not fit
    OSError                         2   of a disk that is full or cannot be written

`protocol` and `meshes` import nothing of ours, so each package has one root; this table joins them.
"""

from __future__ import annotations

import errno
from typing import Final

USAGE: Final = 2
PEER: Final = 3
INTERNAL: Final = 70
"""A fault of our own: 1 means "no success" and nothing else."""
SIGNALLED: Final = 128
"""Of a signal, beside its number: what a shell makes of it."""
HUNG_UP: Final = SIGNALLED + 1
INTERRUPTED: Final = SIGNALLED + 2
BROKEN_PIPE: Final = SIGNALLED + 13
TERMINATED: Final = SIGNALLED + 15

_DISK: Final = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO)
"""Of the operating system's errors, those that no check beforehand finds."""


class CosimError(Exception):
    """Root of what this package raises on purpose."""


class OutputError(CosimError):
    """A run folder that cannot be made or written; says which and why."""


class RunError(CosimError):
    """A run folder that cannot be read; says what is missing or differs."""


class PeerCommandError(CosimError):
    """A physics command that cannot be started."""


class ViewError(CosimError):
    """A picture or window that cannot be made here; says what is missing and what to do."""


class NoDisplayError(ViewError):
    """A window without a display."""


class WorkerError(CosimError):
    """A worker process failed or was killed; carries the exit status of what it failed of."""

    def __init__(self, text: str, status: int = PEER) -> None:
        super().__init__(text, status)  # both are its `args`, so that it travels between processes
        self.status = status

    def __str__(self) -> str:
        return str(self.args[0])


class Terminated(BaseException):
    """SIGTERM arrived; handled like Ctrl-C, so that both processes end and the recording is saved."""


class HungUp(Terminated):
    """SIGHUP arrived: the terminal was closed."""


def exit_status(error: BaseException) -> int | None:
    """Exit status for an error, or None for one that nobody raised on purpose."""
    from agent_client.errors import AgentError
    from meshes.errors import MeshError
    from protocol.errors import ProtocolError, SessionError

    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED
    if isinstance(error, BrokenPipeError):
        return BROKEN_PIPE
    if isinstance(error, HungUp):
        return HUNG_UP
    if isinstance(error, Terminated):
        return TERMINATED
    if isinstance(error, WorkerError):
        return error.status
    if isinstance(error, (CosimError, MeshError, AgentError, SessionError)):
        return USAGE
    if isinstance(error, ProtocolError):
        return PEER
    if isinstance(error, OSError) and error.errno in _DISK:
        return USAGE
    return None
