"""Starting the physics process, keeping what it prints, noticing how it ended, and ending it."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Final, Self

import protocol
from cosim import interrupts
from cosim.errors import OutputError, PeerCommandError
from protocol.liveness import describe_exit

GOODBYE_SECONDS: Final = 5.0
"""How long a server may take to leave after the session's goodbye, before it is terminated."""
TERMINATE_SECONDS: Final = 2.0
"""How long it may take to end when it is terminated, before it is killed."""
LOOK_SECONDS: Final = 0.1
"""Between two looks at whether somebody became impatient."""

LOGS: Final = ("physics.stdout.log", "physics.stderr.log")

_SERVER: Final = (
    f"import sys; sys.path.append({str(Path(protocol.__file__).resolve().parents[1])!r}); "
    "from physics_server.__main__ import main; sys.exit(main())"
)
"""`python -m physics_server`, but from any folder: found where we are found, and behind everything else."""


def physics_command(server: str | None) -> list[str]:
    """The command that starts the physics process: ours, or the user's with the rendezvous appended.

    Raises:
        PeerCommandError: the user's command cannot be read or run.
    """
    if server is None:
        # -P: a file of the user's folder must not be imported in place of a module.
        return [sys.executable, "-P", "-c", _SERVER, "--launcher", str(os.getpid())]
    try:
        words = shlex.split(server)
    except ValueError as error:
        raise PeerCommandError(f"--server: expected a command, found {server!r} ({error})") from error
    if not words:
        raise PeerCommandError("--server: expected a command, found an empty string")
    if shutil.which(words[0]) is None:
        raise PeerCommandError(
            f"--server: expected a program that can be run, found {words[0]!r}, which cannot"
        )
    return words


class PhysicsProcess:
    """The physics process as a child of ours, in a process group of its own so that Ctrl-C reaches us alone.

    Its stdout and stderr are kept in `log_dir` as LOGS.

    Raises:
        OutputError: the logs cannot be written.
        PeerCommandError: the command cannot be started.
    """

    def __init__(self, command: Sequence[str], rendezvous: str, log_dir: Path) -> None:
        self.serving = False
        """Whether a session was opened with it: only then does it deserve patience when it ends."""
        self._stderr_path = log_dir / LOGS[1]
        try:
            with (log_dir / LOGS[0]).open("wb") as stdout, self._stderr_path.open("wb") as stderr:
                self._process = _start([*command, rendezvous], stdout, stderr)
        except OSError as error:
            raise OutputError(f"{log_dir}: the logs cannot be written: {error.strerror}") from error

    @property
    def pid(self) -> int:
        """Process id of the child."""
        return self._process.pid

    def watch(self) -> str | None:
        """None while the process lives, else how it ended."""
        code = self._process.poll()
        return None if code is None else describe_exit(code)

    def last_words(self, lines: int = 5) -> str:
        """The last lines that the process wrote to its stderr."""
        text = self._stderr_path.read_text(errors="replace").strip()
        return "\n".join(text.splitlines()[-lines:])

    def stop(self, patience: float) -> None:
        """Wait for the process to leave; terminate it, then kill its whole group, when it does not."""
        try:
            if not self._leaves(patience):
                self._signal(signal.SIGTERM)
                self._leaves(TERMINATE_SECONDS)
        finally:
            self._signal(signal.SIGKILL)  # with whatever it started itself
            self._process.wait()

    def _leaves(self, patience: float) -> bool:
        """Whether the process ends within a time (s); nobody waits for it once Ctrl-C was pressed again."""
        until = time.monotonic() + patience
        while not interrupts.hurried() and (left := until - time.monotonic()) > 0.0:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(min(left, LOOK_SECONDS))
                return True
        return self._process.poll() is not None

    def _signal(self, number: signal.Signals) -> None:
        """Send a signal to the process and all that it started."""
        with suppress(ProcessLookupError):  # all of them are gone already
            os.killpg(self._process.pid, number)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        patience = GOODBYE_SECONDS if error is None else TERMINATE_SECONDS
        self.stop(patience if self.serving else 0.0)


def _start(command: list[str], stdout: IO[bytes], stderr: IO[bytes]) -> subprocess.Popen[bytes]:
    try:
        return subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=stdout, stderr=stderr, start_new_session=True
        )
    except OSError as error:
        raise PeerCommandError(
            f"the physics command {shlex.join(command)!r} cannot be started: {error.strerror}; "
            "give --server a program that exists"
        ) from error
