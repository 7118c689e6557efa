"""Whether another process lives, stands still or is gone, told by its pid and the time it was started.

A pid alone proves nothing, since it is used again; the pair does. A zombie counts as dead. On Linux the kernel's
/proc tells everything; on Windows the process handle; elsewhere only the existence of the pid is known.
"""

from __future__ import annotations

import os
import signal
import sys
from enum import Enum
from pathlib import Path
from typing import Final

UNKNOWN: Final = 0
"""A start time that is not known."""


class Life(Enum):
    """What a process is doing, as far as a peer cares."""

    RUNNING = "running"
    STOPPED = "stopped"
    DEAD = "dead"


def start_time(pid: int) -> int:
    """Return when a process started: Linux, field 22 of /proc/PID/stat (clock ticks since boot); Windows, its
    creation time (100 ns since 1601); 0 where that is not known or there is no such process.
    """
    if sys.platform == "win32":
        from protocol import windows

        return windows.process(pid)[1]
    stat = _proc_stat(pid)
    return int(stat[_START_TIME]) if stat else UNKNOWN


def life(pid: int, started: int) -> Life:
    """Tell whether the process `pid` that started at `started` runs, is stopped, or is dead.

    A pid of 0 or less names no process that could be looked at: it counts as running.
    """
    if pid <= 0:
        return Life.RUNNING
    if sys.platform == "win32":
        from protocol import windows

        alive, created = windows.process(pid)
        same = UNKNOWN in (started, created) or started == created
        return Life.RUNNING if alive and same else Life.DEAD
    if not _HAS_PROC:
        return Life.RUNNING if _exists(pid) else Life.DEAD
    stat = _proc_stat(pid)
    if not stat or stat[0] in "ZXx" or (started != UNKNOWN and int(stat[_START_TIME]) != started):
        return Life.DEAD
    return Life.STOPPED if stat[0] in "Tt" else Life.RUNNING


def how_ended(pid: int) -> str:
    """Say how a dead process ended, as far as it can still be told; the wait status is left for its parent."""
    if sys.platform != "win32":
        try:
            result = os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT)
        except (ChildProcessError, AttributeError):  # not our child; or a system without waitid
            result = None
        if result is not None and result.si_pid == pid:
            killed = result.si_code in (os.CLD_KILLED, os.CLD_DUMPED)
            return describe_exit(-result.si_status if killed else result.si_status)
        stat = _proc_stat(pid)
        if stat and stat[0] == "Z":  # a zombie that is not our child: the kernel shows its wait status
            return describe_exit(os.waitstatus_to_exitcode(int(stat[_EXIT_STATUS])))
    return "its process is gone"


def describe_exit(code: int) -> str:
    """Put an exit code into words; a negative one is the signal that killed the process."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"killed by signal {-code}"


_HAS_PROC: Final = Path("/proc/self/stat").exists()
# Indices into the fields that follow the command's name, which may itself hold spaces and brackets (proc(5)).
_START_TIME: Final = 19
_EXIT_STATUS: Final = 49


def _proc_stat(pid: int) -> list[str]:
    # Plain system calls: this is called fifty times a second while a session waits.
    try:
        descriptor = os.open(f"/proc/{pid}/stat", os.O_RDONLY)
    except FileNotFoundError:
        return []
    try:
        text = os.read(descriptor, 4096).decode(errors="replace")
    except ProcessLookupError:
        return []
    finally:
        os.close(descriptor)
    return text[text.rindex(")") + 2 :].split()


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # it exists and is another user's
        return True
    return True
