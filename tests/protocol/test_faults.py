"""Two real processes, one of which is killed, stopped or interrupted: a typed error, and nothing left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from protocol import layout
from protocol.agent import AgentSession, SessionSettings
from protocol.errors import PeerLost, PeerViolation, SessionError, Verdict
from protocol.handshake import Offer, write_farewell, write_offer
from protocol.layout import Farewell, Op
from protocol.liveness import start_time
from protocol.memory import parse_rendezvous
from protocol.opening import create_segments
from protocol.physics import serve
from protocol.plant import CommandBatch, PoseBatch, ResetBatch
from protocol.toy import ToyPlant
from protocol.twin import open_twin

SETTINGS = SessionSettings(1, 0.1, 0.025)

Start = Callable[..., subprocess.Popen[str]]
Resets = Callable[..., ResetBatch]
Commands = Callable[..., CommandBatch]
Watch = Callable[[subprocess.Popen[str]], Callable[[], str | None]]
Eventually = Callable[[Callable[[], bool]], None]


@pytest.mark.parametrize("watched", [True, False])
@pytest.mark.parametrize("point", ["idle", "in the step", "exit"])
def test_a_server_that_dies_is_reported(
    rendezvous: str, start: Start, resets: Resets, commands: Commands, watch: Watch, peers: ModuleType,
    point: str, watched: bool,
) -> None:  # fmt: skip
    """Who, how it ended, at which step and in which phase; with a launcher's watch or without one."""
    server = start("serve", rendezvous)
    view = watch(server) if watched else None
    with AgentSession.open(rendezvous, SETTINGS, watch=view, attach_timeout=20.0) as session:
        session.reset(resets())
        session.step(commands())
        if point == "idle":
            server.kill()
        speed = {"in the step": peers.DIE, "exit": peers.EXIT}.get(point, 1.0)
        with pytest.raises(PeerLost) as caught:
            session.step(commands(speed=speed))
    how = "exit code 3" if point == "exit" else "killed by SIGKILL"
    assert (caught.value.how, caught.value.verdict) == (how, Verdict.EXITED)
    assert (caught.value.step, caught.value.phase) == (2, "step")
    assert str(server.pid) in caught.value.who


def test_a_server_that_dies_before_it_attaches_is_reported(
    rendezvous: str, start: Start, watch: Watch
) -> None:
    """The launcher's watch ends the wait for a physics side that never came to be."""
    server = start("serve", rendezvous)
    server.kill()
    with pytest.raises(PeerLost, match="phase attach: killed by SIGKILL") as caught:
        AgentSession.open(rendezvous, SETTINGS, watch=watch(server), attach_timeout=20.0)
    assert caught.value.verdict is Verdict.EXITED


def test_a_death_while_idle_is_seen_at_the_goodbye(rendezvous: str, start: Start) -> None:
    """Closing a session whose server is dead is quiet and complete."""
    server = start("serve", rendezvous)
    session = AgentSession.open(rendezvous, SETTINGS, attach_timeout=20.0)
    server.kill()
    server.wait()
    session.close()
    session.close()


@pytest.mark.parametrize("point", ["attached", "stepping", "physics at work"])
def test_a_killed_agent_leaves_nothing(
    rendezvous: str, start: Start, flown: Path, eventually: Eventually, peers: ModuleType, point: str
) -> None:
    """The server notices, removes both segments (the fixture looks) and ends with a typed error."""
    agent = start("fly", rendezvous, peers.LINGER if point == "physics at work" else 1.0)
    server = start("serve", rendezvous)
    awaited = "" if point == "attached" else "step"
    eventually(lambda: flown.exists() and awaited in flown.read_text(encoding="utf-8"))
    agent.kill()
    _, said = server.communicate(timeout=20)
    assert server.returncode == 3
    assert f"PeerLost: lost agent (pid {agent.pid})" in said
    assert "killed by SIGKILL" in said or "its process is gone" in said


@pytest.mark.parametrize("last", ["error of the plant", "farewell", "early request"])
def test_a_dead_agent_leaves_nothing_whatever_ended_the_server(rendezvous: str, last: str) -> None:
    """The server leaves for another reason than the agent's death, and still removes both segments."""
    agent = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    segments = create_segments(parse_rendezvous(rendezvous), 1)
    command = segments.command.view
    write_offer(command, Offer(SETTINGS, bytes(16), agent.pid, start_time(agent.pid)))

    class LastAct(ToyPlant):
        """The toy plant; while it is at work the agent does one last thing and dies."""

        def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
            if last == "farewell":
                write_farewell(command, Farewell.STOPPED, "it was told to stop")
            elif last == "early request":
                layout.write_i64(command, layout.COMMAND["begin"], 2)
            agent.kill()
            agent.wait()
            if last == "error of the plant":
                raise ZeroDivisionError(last)

    for field, value in (("begin", 1), ("op", Op.RESET), ("step", 0), ("end", 1), ("doorbell", 1)):
        layout.write_i64(command, layout.COMMAND[field], value)
    ends = {"farewell": PeerLost, "early request": PeerViolation}
    with pytest.raises(ends.get(last, ZeroDivisionError)):
        serve(rendezvous, LastAct())
    left = [path for segment in (segments.command, segments.pose) if (path := segment.path) and path.exists()]
    segments.unlink()
    segments.close()
    assert left == []


def test_a_stopped_server_is_waited_for(
    rendezvous: str, start: Start, resets: Resets, commands: Commands
) -> None:
    """SIGSTOP for a second in the middle of a run, then SIGCONT: the same poses as without."""

    def fly(session: AgentSession, pause: Callable[[], None]) -> bytes:
        poses = [session.reset(resets()).raw.tobytes()]
        for step in range(10):
            if step == 5:
                pause()
            poses.append(session.step(commands(speed=2.0)).raw.tobytes())
        return b"".join(poses)

    server = start("serve", rendezvous)

    def stop_for_a_second() -> None:
        server.send_signal(signal.SIGSTOP)
        threading.Timer(1.0, server.send_signal, [signal.SIGCONT]).start()

    with AgentSession.open(rendezvous, SETTINGS, attach_timeout=20.0) as session:
        paused = fly(session, stop_for_a_second)
    with open_twin(ToyPlant(), SETTINGS) as twin:
        assert paused == fly(twin, lambda: None)
    assert server.wait(20) == 0


def test_a_stopped_agent_is_waited_for(
    rendezvous: str, start: Start, flown: Path, eventually: Eventually
) -> None:
    """A server whose agent stands still for a second serves on when it continues."""
    server = start("serve", rendezvous)
    agent = start("fly", rendezvous)
    eventually(lambda: flown.exists() and "step" in flown.read_text(encoding="utf-8"))
    agent.send_signal(signal.SIGSTOP)
    time.sleep(1.0)
    stood = flown.stat().st_mtime_ns
    assert server.poll() is None
    agent.send_signal(signal.SIGCONT)
    eventually(lambda: flown.stat().st_mtime_ns > stood)
    agent.terminate()
    server.communicate(timeout=20)


@pytest.mark.parametrize("stopped", [True, False])
def test_a_deadline_tells_stopped_from_slow(
    rendezvous: str, start: Start, resets: Resets, commands: Commands, peers: ModuleType, stopped: bool
) -> None:
    """Only where a deadline was set a peer that lives is given up, and the verdict says what it was doing."""
    server = start("serve", rendezvous)
    with AgentSession.open(rendezvous, SETTINGS, attach_timeout=20.0, reply_timeout=0.1) as session:
        session.reset(resets())
        if stopped:
            server.send_signal(signal.SIGSTOP)
        with pytest.raises(PeerLost, match=r"deadline 0.1 s") as caught:
            session.step(commands(speed=peers.LINGER))
        server.send_signal(signal.SIGCONT)
    assert caught.value.verdict is (Verdict.STOPPED if stopped else Verdict.TOO_SLOW)
    assert server.wait(20) == 3


@pytest.mark.parametrize("how", ["SIGTERM while idle", "SIGINT in the step"])
def test_a_server_that_is_told_to_stop_says_so(
    rendezvous: str, start: Start, resets: Resets, commands: Commands, peers: ModuleType, how: str
) -> None:
    """A signal that the server's program turns into an exception ends the session with a farewell."""
    server = start("serve", rendezvous)
    with AgentSession.open(rendezvous, SETTINGS, attach_timeout=20.0) as session:
        session.reset(resets())
        if how == "SIGTERM while idle":
            server.terminate()
            server.wait(20)
        with pytest.raises(PeerLost, match="it was told to stop") as caught:
            session.step(commands(speed=peers.INTERRUPT))
    assert caught.value.verdict is Verdict.LEFT


def test_an_agent_that_leaves_in_the_middle_says_so(
    rendezvous: str, start: Start, resets: Resets, commands: Commands, peers: ModuleType
) -> None:
    """After Ctrl-C during a step the server finishes its work, finds the farewell and ends; nothing is left."""
    server = start("serve", rendezvous)

    armed = threading.Event()

    def interrupt() -> str | None:
        if armed.is_set():
            raise KeyboardInterrupt
        return None

    with AgentSession.open(rendezvous, SETTINGS, watch=interrupt, attach_timeout=20.0) as session:
        session.reset(resets())
        armed.set()
        with pytest.raises(KeyboardInterrupt):
            session.step(commands(speed=peers.LINGER))
    _, said = server.communicate(timeout=20)
    assert "it was told to stop (KeyboardInterrupt)" in said
    assert server.returncode == 3


def test_a_terminated_agent_closes_its_session(
    rendezvous: str, start: Start, flown: Path, eventually: Eventually
) -> None:
    """SIGTERM as an exception leaves through the context manager; the server ends and nothing is left."""
    server = start("serve", rendezvous)
    agent = start("fly", rendezvous)
    eventually(lambda: flown.exists() and "step" in flown.read_text(encoding="utf-8"))
    agent.terminate()
    assert agent.wait(20) == 128 + signal.SIGTERM
    assert server.wait(20) in (0, 3)


def test_a_violation_is_told_across_processes(rendezvous: str, start: Start, resets: Resets) -> None:
    """An agent that rings twice is told by the server's farewell what it did, and the server says it too."""
    server = start("serve", rendezvous)
    with AgentSession.open(rendezvous, SETTINGS, attach_timeout=20.0) as session:
        session.reset(resets())
        layout.write_i64(session._command, layout.COMMAND["doorbell"], 3)
        with pytest.raises(SessionError, match="it says that we rang the doorbell with 3 where 2 was due"):
            session._wait(1, 1, "step")
    _, said = server.communicate(timeout=20)
    assert "PeerViolation: rang the doorbell with 3 where 2 was due" in said


def test_an_idle_pair_costs_little(
    rendezvous: str, start: Start, resets: Resets, record_property: Callable[[str, object], None]
) -> None:
    """A server that waits sleeps most of the time; the share of a core is recorded, and far from spinning."""
    server = start("serve", rendezvous)
    with AgentSession.open(rendezvous, SETTINGS, attach_timeout=20.0) as session:
        session.reset(resets())
        time.sleep(0.3)
        began, used = time.monotonic(), cpu_seconds(server.pid)
        time.sleep(1.0)
        share = (cpu_seconds(server.pid) - used) / (time.monotonic() - began)
    record_property("idle_share_of_a_core", share)
    assert share < 0.5


def cpu_seconds(pid: int) -> float:
    """Processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")


def test_many_steps_are_neither_lost_nor_doubled(
    rendezvous: str, start: Start, resets: Resets, commands: Commands
) -> None:
    """Every answer of a long run carries the next step, and the last one is the sum of all."""
    start("serve", rendezvous)
    with AgentSession.open(rendezvous, SETTINGS, attach_timeout=20.0) as session:
        session.reset(resets())
        batch = commands()
        counted = [int(session.step(batch).step[0]) for _ in range(2000)]
    assert np.array_equal(counted, np.arange(1, 2001))
