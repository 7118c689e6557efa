"""Kills at random moments and at chosen ones: a typed error in time, no process and no segment left."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from protocol.errors import PeerLost
from protocol.memory import create_segment, parse_rendezvous, segment_path
from protocol.physics import serve
from protocol.toy import ToyPlant

ROOT = Path(__file__).parents[2]
BOUND_MS = 100.0

Start = Callable[..., subprocess.Popen[str]]
Soak = Callable[..., dict[str, Any]]

DIE_LEAVING = """
import os, signal, sys
from protocol import agent, handshake

def die_after(function):
    def dying(*arguments):
        function(*arguments)
        os.kill(os.getpid(), signal.SIGKILL)
    return dying

if sys.argv[2] == "goodbye":
    agent.AgentSession._say_goodbye = die_after(agent.AgentSession._say_goodbye)
else:
    handshake.part = die_after(handshake.part)
with agent.AgentSession.open(sys.argv[1], agent.SessionSettings(1, 0.1, 0.1), attach_timeout=20.0) as session:
    if sys.argv[2] == "farewell":
        session._wait = None  # an error of the agent's own in the next exchange
        session.release_tube(0)
"""


def test_every_random_kill_is_noticed_and_leaves_nothing(soak: Soak) -> None:
    """Thirty kills of either side anywhere: typed errors, no hang, no segment, within the bound on a free core."""
    found = soak("kills", "--count", "30")
    assert found["faults"] == []
    assert found["noticed"] == 30
    # Time in which the dying or the surviving process was ready and another had its core is the machine's own.
    assert found["noticed_ms_on_a_core"]["max"] <= BOUND_MS, found


@pytest.mark.parametrize("last", ["goodbye", "farewell"])
def test_an_agent_that_is_killed_while_it_leaves_has_nothing_left(
    rendezvous: str, start: Start, last: str
) -> None:
    """Killed right after its goodbye or its farewell, when nobody watches any more: the names are gone (the fixture
    looks)."""
    server = start("serve", rendezvous)
    agent = subprocess.run(
        [sys.executable, "-c", DIE_LEAVING, rendezvous, last], check=False, cwd=ROOT, timeout=20.0
    )
    assert agent.returncode == -signal.SIGKILL
    assert server.wait(20) == (0 if last == "goodbye" else 3)


@pytest.mark.parametrize("sizes", [{".cmd": 0}, {".cmd": 8192}, {".cmd": 8192, ".pose": 0}])
def test_an_agent_that_is_killed_while_it_creates_has_nothing_left(
    rendezvous: str, sizes: dict[str, int]
) -> None:
    """Segments without a header, or without a size, of an agent that is dead: its physics process removes them."""
    agent = subprocess.Popen([sys.executable, "-c", ""])
    place = parse_rendezvous(rendezvous)
    for suffix, size in sizes.items():
        if size:
            create_segment(place, suffix, size).close()
        else:
            segment_path(place, suffix).touch()
    agent.wait()
    with pytest.raises(PeerLost, match=r"ended before a session was offered"):
        serve(rendezvous, ToyPlant(), attach_timeout=20.0, launcher=agent.pid)
