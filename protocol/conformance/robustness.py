"""Rules for servers about an agent that dies, leaves, stands still or was here before; in every state.

The states come from the table of states, so that none is forgotten: `scenes.FAULT_STATES`.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from protocol.conformance.raw_agent import RawAgent
from protocol.conformance.removals import removals, removed
from protocol.conformance.rig import (
    LEAVING_S,
    PeerProcess,
    Rig,
    await_end,
    await_no_segments,
    segments_left,
)
from protocol.conformance.rule import Failure, Level, Skip, demand, expect, server_rule
from protocol.conformance.scenes import (
    ALLOWANCE_S,
    FAULT_STATES,
    NOTICE_S,
    SETTLE_S,
    UNDER_WAY,
    Scene,
    at_work,
    command_path,
    hand_over,
    in_fault_states,
    ready,
    ring,
    scene,
    stop,
)
from protocol.conformance.sound import resets
from protocol.conformance.stand_in import StandIn, dead_process
from protocol.handshake import owner, write_farewell
from protocol.layout import Farewell
from protocol.states import Event, State

ROBUSTNESS: Final = Level.ROBUSTNESS
PAUSE_S: Final = 0.3
LONG_PAUSE_S: Final = 1.0
_BOUND: Final = NOTICE_S + ALLOWANCE_S
_KINDS: Final = (Farewell.STOPPED, Farewell.FAILED, Farewell.VIOLATION, Farewell.HANDSHAKE)


# --- death ---


@server_rule(
    "agent-killed",
    ROBUSTNESS,
    "10",
    "an agent killed in any state, or gone without a word, is noticed within 100 ms "
    f"(+{ALLOWANCE_S * 1e3:.0f}): names removed, server ends",
    covers=in_fault_states(Event.LOSS),
)
def _agent_killed(rig: Rig) -> str:
    took = {state: _dies(rig, state, StandIn.kill) for state in FAULT_STATES}
    took[State.READY] = max(took[State.READY], _dies(rig, State.READY, StandIn.leave))
    return _slowest(took)


@server_rule(
    "agent-killed-at-work",
    ROBUSTNESS,
    "10",
    "an agent that dies while the engine works is noticed when it is done",
)
def _agent_killed_at_work(rig: Rig) -> str:
    with at_work(rig) as s:
        s.stand_in.kill()
        until = s.go_on() + rig.timeout
        while s.agent.get("doorbell") < s.agent.number and segments_left(s.agent.rendezvous):
            demand(time.monotonic() < until, "the engine", f"done within {rig.timeout:g} s", "still at work")
            time.sleep(0.001)
        since = time.monotonic()
        _await_removal(s, _BOUND)
        await_end(s.server, "after its agent died while the engine worked")
        return f"noticed {(time.monotonic() - since) * 1e3:.0f} ms after the work"


@server_rule("agent-zombie", ROBUSTNESS, "10", "an agent that is a zombie is dead")
def _agent_zombie(rig: Rig) -> str:
    return _slowest({State.READY: _dies(rig, State.READY, lambda stand_in: stand_in.kill(reap=False))})


def _slowest(took: dict[State, float]) -> str:
    state = max((s for s in took if s is not State.OFFERED), key=lambda s: took[s])
    return f"noticed after {took[state] * 1e3:.0f} ms at most ({state.name})"


def _dies(rig: Rig, state: State, how: Callable[[StandIn], None]) -> float:
    """Let the agent die in a state; return how long the names stood after that (s)."""
    with scene(rig, state) as s:
        how(s.stand_in)
        since = s.go_on()
        # A server that is still starting looks at its first session whenever it has started.
        bound = rig.timeout if state is State.OFFERED else _BOUND
        _await_removal(s, bound)
        took = time.monotonic() - since
        if state is not State.OFFERED:  # there it waits on, for a new agent
            await_end(s.server, f"after its agent died {s.where}")
        return took


def _await_removal(s: Scene, bound: float) -> None:
    try:
        await_no_segments(s.agent.rendezvous, bound)
    except Failure as failure:
        raise Failure(f"segments of an agent that died {s.where}", failure.expected, failure.found) from None


@server_rule(
    "agent-pid-reused", ROBUSTNESS, "10", "a process of the agent's pid but another start is not the agent"
)
def _agent_pid_reused(rig: Rig) -> None:
    agent, other = rig.agent(), StandIn()
    try:
        if not other.started:
            raise Skip("the start of a process is not known on this system")
        hand_over(agent).close()  # the lock is free, as that of a dead agent is
        agent.offer(pid=other.pid, start_time=other.started - 1)
        rig.start()
        await_no_segments(rig.rendezvous, rig.timeout)
    finally:
        other.close()


@server_rule(
    "newer-segments-kept",
    ROBUSTNESS,
    "2",
    "a server whose agent died does not remove the segments of a newer session",
)
def _newer_segments_kept(rig: Rig) -> None:
    with scene(rig, State.READY) as s:
        path = command_path(s.agent.rendezvous)
        names = (path, path.with_suffix(".pose"))
        for name in names:
            name.unlink()
            name.write_bytes(b"another session's")
        s.stand_in.kill()
        s.go_on()
        await_end(s.server, "after its agent died")
        for name in names:
            demand(name.exists(), name.suffix, "the newer segment of that name kept", "it was removed")
            name.unlink()


@server_rule(
    "names-under-lock",
    ROBUSTNESS,
    "2",
    "the names of a dead agent's segments stay while another process holds the lock of the command segment",
)
def _names_under_lock(rig: Rig) -> None:
    agent = rig.agent()
    holder = hand_over(agent)
    try:
        pid, started = dead_process()
        agent.offer(pid=pid, start_time=started)
        server = rig.start()
        time.sleep(LONG_PAUSE_S)
        _both_stay(agent, "before a session")
        expect("the end of a server that waits for the lock", server.watch(), None)
    finally:
        holder.close()
    await_no_segments(rig.rendezvous, rig.timeout)  # it has looked again
    with scene(rig, State.READY) as s:
        s.stand_in.kill()
        holder = StandIn(command_path(s.agent.rendezvous))
        try:
            s.go_on()
            await_end(s.server, "after its agent died, though another holds the lock")
            _both_stay(s.agent, s.where)
        finally:
            holder.close()


def _both_stay(agent: RawAgent, where: str) -> None:
    left = segments_left(agent.rendezvous)
    demand(
        len(left) == 2, f"segments of a dead agent {where}, locked by another", "both left to that one", left
    )


@server_rule(
    "pose-removed-first",
    ROBUSTNESS,
    "2",
    "of a dead agent's segments .pose is removed first: one that stands alone tells whose it was",
)
def _pose_removed_first(rig: Rig) -> None:
    with scene(rig, State.READY) as s:
        command = command_path(s.agent.rendezvous)
        with removals(command.parent) as watch:
            s.stand_in.kill()
            s.go_on()
            await_end(s.server, "after its agent died")
            found = [name for name in removed(watch) if Path(name).stem == command.stem]
        expect("names removed, in order", found, [command.with_suffix(".pose").name, command.name])


@server_rule(
    "request-taken-first",
    ROBUSTNESS,
    "10",
    "a request that was published before the agent died or said farewell is answered before the server leaves",
)
def _request_taken_first(rig: Rig) -> None:
    for fault in ("died", "said farewell"):
        with scene(rig, State.RESETTING) as s:
            if fault == "died":
                s.stand_in.kill()
            else:
                write_farewell(s.agent.command, Farewell.STOPPED, "it is a test of farewells")
            s.go_on()
            await_end(s.server, f"after its agent {fault} {s.where}")
            expect(
                f"the last reply to an agent that {fault} {s.where}", s.agent.get("doorbell"), s.agent.number
            )


# --- silence ---


@server_rule(
    "agent-paused",
    ROBUSTNESS,
    "10",
    "an agent that stands still (SIGSTOP), in any state and for a second, is waited for and then answered",
)
def _agent_paused(rig: Rig) -> None:
    agent = rig.agent()
    stand_in = hand_over(agent)
    try:
        agent.offer(pid=stand_in.pid, start_time=stand_in.started)
        stand_in.stop()
        server = rig.start()
        agent.attend(server)
        agent.await_header()
        _still_there(server, agent, LONG_PAUSE_S, State.OFFERED)
        stand_in.resume()
        expect("status of a reset", agent.reset(resets(agent)).status, 0)
        for state, op in UNDER_WAY.items():
            stand_in.stop()
            ring(agent, op)
            agent.await_reply()
            if state is not State.CLOSING:
                _still_there(server, agent, PAUSE_S, state)
            stand_in.resume()
        await_end(server, "after a goodbye")
    finally:
        stand_in.close()


def _still_there(server: PeerProcess, agent: RawAgent, seconds: float, state: State) -> None:
    before = bytes(agent.pose)
    time.sleep(seconds)
    expect(f"the end of a server whose agent stands still after {state.name}", server.watch(), None)
    demand(
        bytes(agent.pose) == before,
        "the pose segment",
        "untouched while no request is under way",
        "it changed",
    )


@server_rule(
    "server-paused",
    ROBUSTNESS,
    "10",
    "a server that was stopped and continued, in any state, answers what was asked meanwhile, exactly once",
)
def _server_paused(rig: Rig) -> None:
    with scene(rig, State.OFFERED) as s:
        time.sleep(PAUSE_S)
        s.go_on()
        s.agent.await_header()
    agent, server, stand_in = ready(rig)
    try:
        for state, op in UNDER_WAY.items():
            stop(server, *owner(agent.pose))
            ring(agent, op)
            time.sleep(PAUSE_S)
            expect(f"replies of a stopped server {state.name}", agent.get("doorbell"), agent.number - 1)
            server.signal(signal.SIGCONT)
            agent.await_reply()
            if state is not State.CLOSING:
                _still_there(server, agent, SETTLE_S, state)
        await_end(server, "after a goodbye")
        expect("the server's last doorbell", agent.get("doorbell"), agent.number)
    finally:
        stand_in.close()


# --- farewells ---


@server_rule(
    "agent-farewell",
    ROBUSTNESS,
    "8",
    f"an agent's farewell, of any kind and in any state, ends the server within 100 ms (+{ALLOWANCE_S * 1e3:.0f}) "
    "and the names stay",
    covers=tuple((state, Event.FAREWELL) for state in FAULT_STATES if state is not State.OFFERED),
)
def _agent_farewell(rig: Rig) -> str:
    took = {}
    for number, state in enumerate((*UNDER_WAY, *(State.READY,) * len(_KINDS))):
        kind = _KINDS[number % len(_KINDS)]
        with scene(rig, state) as s:
            write_farewell(s.agent.command, kind, "it is a test of farewells")
            since = s.go_on()
            _await_leaving(s, since)
            took[state] = time.monotonic() - since
            await_end(s.server, f"after the agent's farewell {kind.value} {s.where}")
            demand(
                len(segments_left(s.agent.rendezvous)) == 2,
                f"segments of a living agent that left {s.where}",
                "both kept: the agent removes them",
                segments_left(s.agent.rendezvous),
            )
            said, _ = s.agent.farewell()
            demand(said in (0, 1), "the server's own farewell", "none, or kind 1", said)
    return f"ended after {max(took.values()) * 1e3:.0f} ms at most"


def _await_leaving(s: Scene, since: float) -> None:
    """Wait until a server has left: by a farewell of its own, or by its end."""
    while not s.agent.farewell()[0] and s.server.watch() is None:
        if s.state is State.CLOSING and s.agent.get("doorbell") == s.agent.number:
            return  # it answers the goodbye and leaves by that
        if time.monotonic() - since > _BOUND + LEAVING_S / 10:
            raise Failure(
                f"a server whose agent said farewell {s.where}",
                f"a farewell of its own or its end within {_BOUND * 1e3:.0f} ms",
                "neither",
            )
        time.sleep(0.001)


# --- told to stop ---


@server_rule(
    "told-to-stop",
    ROBUSTNESS,
    "8",
    "a server that is told to stop (SIGTERM or SIGINT) leaves a farewell 1, promptly, idle and at work",
)
def _told_to_stop(rig: Rig) -> str:
    heeded = [number for number in (signal.SIGTERM, signal.SIGINT) if _heeds(rig, number)]
    names = " and ".join(number.name for number in heeded)
    demand(bool(heeded), "farewell after SIGTERM or SIGINT", "kind 1", "none after either")
    return f"after {names}"


def _heeds(rig: Rig, number: signal.Signals) -> bool:
    """Whether a server leaves a farewell 1 on a signal, in both states; a farewell of another kind is a failure."""
    for state in (State.READY, State.STEPPING):
        with scene(rig, state) as s:
            s.server.signal(number)
            s.go_on()
            kind, text = s.agent.await_farewell(LEAVING_S)
            await_end(s.server, f"after {number.name} {s.where}")
            if not kind:
                return False
            demand(
                kind == Farewell.STOPPED, f"farewell after {number.name} {s.where}", "kind 1", (kind, text)
            )
    return True
