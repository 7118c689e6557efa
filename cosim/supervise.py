"""Starting the physics process, keeping what it prints, noticing how it ended, and ending it."""

from __future__ import annotations

import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from cosim.errors import PeerCommandError

GOODBYE_SECONDS = 5.0
"""How long a server may take to leave after the session's goodbye, before it is terminated."""
TERMINATE_SECONDS = 2.0


def physics_command(server: str | None) -> list[str]:
    """The command that starts the physics process: ours, or the user's with the rendezvous appended."""
    if server is None:
        return [sys.executable, "-m", "physics_server"]
    words = shlex.split(server)
    if not words:
        raise PeerCommandError("--server: expected a command, found an empty string")
    if shutil.which(words[0]) is None:
        raise PeerCommandError(
            f"--server: expected a program that can be run, found {words[0]!r}, which cannot"
        )
    return words


class PhysicsProcess:
    """The physics process as a child of ours, in a session of its own so that Ctrl-C reaches us alone.

    Its stdout and stderr are kept as `physics.stdout.log` and `physics.stderr.log` in `log_dir`.
    """

    def __init__(self, command: Sequence[str], rendezvous: str, log_dir: Path) -> None:
        self.command = [*command, rendezvous]
        self.stderr_path = log_dir / "physics.stderr.log"
        self.killed_by_us = False
        with (
            (log_dir / "physics.stdout.log").open("wb") as stdout,
            self.stderr_path.open("wb") as stderr,
        ):
            try:
                self._process = subprocess.Popen(
                    self.command,
                    stdin=subprocess.DEVNULL,
                    stdout=stdout,
                    stderr=stderr,
                    start_new_session=True,
                )
            except OSError as error:
                raise PeerCommandError(
                    f"the physics command {shlex.join(command)!r} cannot be started: {error.strerror}; "
                    "give --server a program that exists"
                ) from error

    @property
    def pid(self) -> int:
        """Process id of the child."""
        return self._process.pid

    def watch(self) -> str | None:
        """None while the process lives, else how it ended."""
        code = self._process.poll()
        if code is None:
            return None
        if code < 0:
            return f"killed by {signal.Signals(-code).name}"
        return f"exited with code {code}"

    def last_words(self, lines: int = 5) -> str:
        """The last lines that the process wrote to its stderr."""
        text = self.stderr_path.read_text(errors="replace").strip()
        return "\n".join(text.splitlines()[-lines:])

    def stop(self, patience: float = GOODBYE_SECONDS) -> None:
        """Wait for the process to leave; terminate it, then kill it, when it does not."""
        for wait_seconds, act in (
            (patience, self._process.terminate),
            (TERMINATE_SECONDS, self._process.kill),
            (TERMINATE_SECONDS, None),
        ):
            try:
                self._process.wait(wait_seconds)
                return
            except subprocess.TimeoutExpired:
                if act is not None:
                    self.killed_by_us = True
                    act()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop(GOODBYE_SECONDS if error is None else TERMINATE_SECONDS)
