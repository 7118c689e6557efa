"""What a pair that waits costs: the share of a core that each side takes while nothing happens."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path
from typing import Final

from cosim import round_trip as trips

SETTLING_S: Final = 0.2
"""A wait yields its core at first and begins to sleep after 50 ms: what comes then is measured."""


def idle_percent(seconds: float, skipped: dict[str, str]) -> dict[str, float]:
    """Percent of a core that either side takes while it waits for the other; nothing where the system does not tell.

    Args:
        seconds: how long to look at each.
        skipped: gets a note where nothing can be measured.
    """
    if not Path("/proc/self/schedstat").is_file():
        skipped["idle_percent"] = "this system has no /proc/PID/schedstat: Linux has"
        return {}
    cores = trips.two_cores()
    with trips.pinned(cores), trips.open_session(cores, 1) as (agent, server):
        agent.reset(trips.sound_resets(agent))
        physics = _percent(server.pid, seconds)  # it waits for the next request
        os.kill(server.pid, signal.SIGSTOP)
        waking = threading.Timer(
            2 * SETTLING_S + seconds, os.kill, (server.pid, signal.SIGCONT)
        )  # the agent waits for a reply until then
        waking.start()
        found: list[float] = []
        looking = threading.Thread(target=lambda: found.append(_percent(os.getpid(), seconds)))
        looking.start()
        try:
            agent.step(trips.sound_commands(1))
        finally:
            looking.join()
            waking.join()
    return {"physics": round(physics, 2), "agent": round(found[0], 2)}


def _percent(pid: int, seconds: float) -> float:
    """Share of a core that a process's first thread took over the next seconds, once it has settled (%)."""
    time.sleep(SETTLING_S)
    began, used = time.monotonic(), _nanoseconds(pid)
    time.sleep(seconds)
    return 100e-9 * (_nanoseconds(pid) - used) / (time.monotonic() - began)


def _nanoseconds(pid: int) -> int:
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0])
