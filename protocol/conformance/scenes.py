"""Sessions brought to one state of the protocol with the server held there, so that a fault falls exactly into it.

A server answers too quickly to be caught at work: it is stopped (SIGSTOP) before the doorbell rings, the fault is
made, and it goes on (SIGCONT) to find both. The agent is a stand-in process, so that it can die alone.
"""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from protocol.conformance.raw_agent import RawAgent
from protocol.conformance.rig import PeerProcess, Rig, segments_left
from protocol.conformance.rule import Failure, Skip, expect
from protocol.conformance.sound import commands, resets
from protocol.conformance.stand_in import StandIn
from protocol.handshake import owner
from protocol.layout import FAREWELL, INNER_STEPS_MAX, Op
from protocol.liveness import Life, life
from protocol.states import TRANSITIONS, TURN, Event, Side, State

NOTICE_S: Final = 0.1
"""Within this time a side notices that the other is dead (section 10)."""
ALLOWANCE_S: Final = 0.4
"""What a busy machine may add to it."""
WORK_S: Final = 0.15
"""How long a step lasts in which a server is caught at work."""
CATCHES: Final = 5
"""How often that is tried, each time with a step four times as long."""
SETTLE_S: Final = 0.15
"""How long nothing may happen where nothing should."""

FAULT_STATES: Final = [state for state, moves in TRANSITIONS.items() if Event.LOSS in moves]
"""The states in which a side can be lost."""
UNDER_WAY: Final = {
    state: Op(event)
    for event, state in TRANSITIONS[State.READY].items()
    if TURN[state] is Side.PHYSICS and event.value in {op.value for op in Op}
}
"""The states in which a request is under way, with its op."""


def in_fault_states(event: Event) -> tuple[tuple[State, Event], ...]:
    """What a rule covers that lets an event come in each of the FAULT_STATES."""
    return tuple((state, event) for state in FAULT_STATES)


@dataclass
class Scene:
    """One session in one state."""

    state: State
    agent: RawAgent
    server: PeerProcess
    stand_in: StandIn

    @property
    def where(self) -> str:
        """The state in words, for messages."""
        return f"in state {self.state.name}"

    def go_on(self) -> float:
        """Let the server go on, and return the time at which it did."""
        now = time.monotonic()
        self.server.signal(signal.SIGCONT)
        return now


@contextmanager
def scene(rig: Rig, state: State) -> Iterator[Scene]:
    """Start a server and bring a session with it into `state`, the server stopped; everything is ended behind it."""
    if state is State.OFFERED:
        server = rig.start(rendezvous := rig.new_rendezvous())
        stop(server, server.pid)
        agent = rig.agent(rendezvous=rendezvous)
        stand_in = hand_over(agent)
        agent.offer(pid=stand_in.pid, start_time=stand_in.started)
        agent.attend(server)
    else:
        agent, server, stand_in = ready(rig)
        stop(server, *owner(agent.pose))
        if state is not State.READY:
            ring(agent, UNDER_WAY[state])
    try:
        yield Scene(state, agent, server, stand_in)
    finally:
        _close(agent, server, stand_in)


@contextmanager
def at_work(rig: Rig) -> Iterator[Scene]:
    """Bring a session into STEPPING and stop the server while its engine works; a step lasts about `WORK_S`.

    On a busy machine a step may be done before the kit comes to stop the server: then a longer one is asked for.

    Raises:
        Skip: the engine was done every time.
    """
    inner_steps = 1000
    agent, server, stand_in = ready(rig, inner_steps)
    each = min(_seconds_of_a_step(agent) for _ in range(5)) / inner_steps  # some of them may be held up
    _close(agent, server, stand_in)
    if each * INNER_STEPS_MAX < WORK_S / 4:
        raise Skip("the engine is too quick to be caught at work")
    inner_steps = math.ceil(WORK_S / each)
    for _ in range(CATCHES):
        inner_steps = min(INNER_STEPS_MAX, inner_steps)
        agent, server, stand_in = ready(rig, inner_steps)
        try:
            ring(agent, Op.STEP)
            time.sleep(WORK_S / 16)
            stop(server, *owner(agent.pose))
            if (
                agent.get("begin") < agent.number
            ):  # it has not begun its reply: early requests are still to be seen
                yield Scene(State.STEPPING, agent, server, stand_in)
                return
        finally:
            _close(agent, server, stand_in)
        inner_steps *= 4
    raise Skip(
        f"the engine was done before it could be caught at work, {CATCHES} times in a row: a busy machine"
    )


def _close(agent: RawAgent, server: PeerProcess, stand_in: StandIn) -> None:
    server.end()
    stand_in.close()
    agent.close()


def _seconds_of_a_step(agent: RawAgent) -> float:
    began = time.monotonic()
    agent.step(commands(agent))
    return time.monotonic() - began


def ready(rig: Rig, inner_steps: int = 4) -> tuple[RawAgent, PeerProcess, StandIn]:
    """Open a session whose agent is a stand-in, with its lane reset and a step done."""
    agent = rig.agent(inner_steps=inner_steps, rendezvous=rig.new_rendezvous())
    stand_in = hand_over(agent)
    try:
        agent.offer(pid=stand_in.pid, start_time=stand_in.started)
        server = rig.start(agent.rendezvous)
        agent.attend(server)
        agent.await_header()
        expect("status of a reset", agent.reset(resets(agent)).status, 0)
        expect("status of a step", agent.step(commands(agent)).status, 0)
    except BaseException:
        stand_in.close()
        raise
    return agent, server, stand_in


def ring(agent: RawAgent, op: Op, **words: int) -> None:
    """Publish a sound request of any kind, its payload in place, or one with other `words`."""
    if op is Op.STEP:
        agent.put_commands(commands(agent))
    elif op is Op.RESET:
        agent.put_resets(resets(agent))
    agent.request(op, **words)


def hand_over(agent: RawAgent) -> StandIn:
    """Let a stand-in hold the lock of the command segment in place of the kit."""
    path = command_path(agent.rendezvous)
    os.close(os.open(path, os.O_RDWR))  # POSIX gives up all record locks of a file that a process closes once
    return StandIn(path)


def command_path(rendezvous: str) -> Path:
    """The file of a command segment."""
    (path,) = (Path(name) for name in segments_left(rendezvous) if name.endswith(".cmd"))
    return path


def stop(server: PeerProcess, pid: int, started: int = 0) -> None:
    """Stop a server and wait until it stands still.

    Raises:
        Failure: it does not.
    """
    server.signal(signal.SIGSTOP)
    until = time.monotonic() + 5.0
    while life(pid, started) is not Life.STOPPED:
        if time.monotonic() > until:
            raise Failure("the server", "a process that SIGSTOP stops", life(pid, started).value)
        time.sleep(0.001)


def without_farewell(segment: memoryview) -> bytes:
    """The bytes of a segment, its farewell blanked."""
    content = bytearray(segment)
    for field in FAREWELL:
        content[field.bytes] = bytes(field.size)
    return bytes(content)
