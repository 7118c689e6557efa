"""A process of its own that stands for one side of a session, so that a side can die while the kit lives.

The kit writes a side's words itself, and puts the stand-in's pid and start time into the header. The stand-in
holds the side's lock and does nothing else; to the peer it is the side, and it can be killed, stopped or left.
"""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path
from typing import Final

from protocol.liveness import start_time

_PROGRAM: Final = """
import sys
if len(sys.argv) > 1:
    import fcntl
    segment = open(sys.argv[1], "r+b", 0)
    fcntl.lockf(segment, fcntl.LOCK_EX, 1)
print("here", flush=True)
sys.stdin.read()
"""
"""Ends with its input, so that it never outlives the kit."""

PATIENCE_S: Final = 20.0


class StandIn:
    """A living process that holds the lock of `segment`, if one is given, until it ends."""

    def __init__(self, segment: Path | None = None) -> None:
        command = [sys.executable, "-I", "-S", "-c", _PROGRAM, *([] if segment is None else [str(segment)])]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert self._process.stdout is not None
        self._process.stdout.readline()  # until it holds the lock
        self.pid = self._process.pid
        self.started = start_time(self.pid)

    def kill(self, *, reap: bool = True) -> None:
        """End it by SIGKILL; without `reap` a zombie stays behind."""
        self._process.kill()
        if reap:
            self._process.wait(PATIENCE_S)

    def leave(self) -> None:
        """Let it exit by itself, with status 0."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(PATIENCE_S)

    def stop(self) -> None:
        """Let it stand still (SIGSTOP)."""
        self._process.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        """Let it go on (SIGCONT)."""
        self._process.send_signal(signal.SIGCONT)

    def close(self) -> None:
        """End it if it still lives, and forget it; idempotent."""
        self._process.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        self._process.wait(PATIENCE_S)


def dead_process() -> tuple[int, int]:
    """Pid and start time of a process that is no more."""
    stand_in = StandIn()
    stand_in.close()
    return stand_in.pid, stand_in.started
