"""Rules for agents about a physics side that dies, leaves, stands still, refuses or breaks the protocol.

The faults fall into every state that the agent enters by itself; the states come from the table of states.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from typing import Final

from protocol.conformance.agent_scenes import POLL_S, asked, ends, entered, has_left
from protocol.conformance.agents import number_faults
from protocol.conformance.flight import meeting
from protocol.conformance.raw_physics import RawPhysics, Request
from protocol.conformance.rig import Rig
from protocol.conformance.rule import Failure, Level, Skip, agent_rule, demand
from protocol.conformance.scenes import ALLOWANCE_S, UNDER_WAY, in_fault_states
from protocol.conformance.stand_in import StandIn
from protocol.errors import Refusal
from protocol.layout import Farewell, Op
from protocol.states import Event, State

ROBUSTNESS: Final = Level.ROBUSTNESS
PAUSE_S: Final = 0.3
LONG_PAUSE_S: Final = 1.0
UNKNOWN_CODE: Final = 77
"""A code of refusal that only a later version could know."""
_WITHIN: Final = f"within 100 ms (+{ALLOWANCE_S * 1e3:.0f})"


# --- death and farewell ---


def _slowest(took: dict[State, float]) -> str:
    state = max(took, key=lambda s: took[s])
    return f"noticed after {took[state] * 1e3:.0f} ms at most ({state.name}), in {', '.join(s.name for s in took)}"


def _in_every_state(rig: Rig, fault: Callable[[RawPhysics], None], what: str) -> str:
    """Let a fault happen in every state that the agent enters, and demand that it ends each time."""
    took: dict[State, float] = {}
    for state, op in entered(rig).items():
        with asked(rig, op) as (physics, _):
            fault(physics)
            took[state] = ends(physics, time.monotonic(), f"{what} in {state.name}")
    with asked(rig, Op.STEP) as (physics, request):
        physics.answer(request)
        fault(physics)
        _await_turn(physics)
        took[State.READY] = ends(physics, time.monotonic(), f"{what} in READY")
    return _slowest(took)


def _await_turn(physics: RawPhysics) -> None:
    """Wait until the agent has come round to its next request, or has left: before, nobody waits for anything."""
    until = time.monotonic() + physics.timeout
    while physics.rung() == physics.number and not has_left(physics) and time.monotonic() < until:
        time.sleep(POLL_S)


def _kill(physics: RawPhysics) -> None:
    assert physics.stand_in is not None
    physics.stand_in.kill()


def _kill_unreaped(physics: RawPhysics) -> None:
    assert physics.stand_in is not None
    physics.stand_in.kill(reap=False)


@agent_rule(
    "physics-killed",
    ROBUSTNESS,
    "10",
    f"a physics side killed in any state ends the agent {_WITHIN}, with both segments removed",
    covers=in_fault_states(Event.LOSS)[1:],
)
def _physics_killed(rig: Rig) -> str:
    """Each state is a session of its own; the exit status is not 0, but for a goodbye that finds nobody."""
    return _in_every_state(rig, _kill, "the death of the physics side")


@agent_rule("physics-zombie", ROBUSTNESS, "10", "a physics side that is a zombie is dead")
def _physics_zombie(rig: Rig) -> str:
    """The stand-in's parent has not asked how it ended."""
    with asked(rig, Op.STEP) as (physics, _):
        _kill_unreaped(physics)
        took = ends(physics, time.monotonic(), "the death of the physics side, now a zombie")
    return f"noticed after {took * 1e3:.0f} ms"


@agent_rule(
    "physics-pid-reused", ROBUSTNESS, "10", "a process of the physics side's pid but another start is not it"
)
def _physics_pid_reused(rig: Rig) -> None:
    """The header names a living process with an earlier start; the agent sees it while it waits for a reply."""
    with meeting(rig) as physics:
        physics.begin_header()
        assert physics.stand_in is not None
        if not physics.stand_in.started:
            raise Skip("the start of a process is not known on this system")
        physics.attach({"start_time": physics.stand_in.started - 1})
        _await_turn(physics)
        ends(physics, time.monotonic(), "a header of a process that is gone")


@agent_rule(
    "physics-farewell",
    ROBUSTNESS,
    "8",
    f"a farewell of the physics side, of any kind and in any state, ends the agent {_WITHIN}",
    covers=in_fault_states(Event.FAREWELL),
)
def _physics_farewell(rig: Rig) -> str:
    """Also one without a header, while the session is only on offer."""
    kinds = (Farewell.FAILED, Farewell.STOPPED, Farewell.VIOLATION, Farewell.HANDSHAKE)
    count = iter(range(1000))

    def leave(physics: RawPhysics) -> None:
        physics.say_farewell(kinds[next(count) % len(kinds)], "it is a test of farewells")

    with meeting(rig) as physics:
        physics.begin_header()
        physics.say_farewell(Farewell.FAILED, "its engine did not start")
        ends(physics, time.monotonic(), "a farewell in OFFERED")
    return _in_every_state(rig, leave, "a farewell of the physics side")


@agent_rule(
    "physics-replaced", ROBUSTNESS, "2", "a physics side that died before its magic is replaced by another"
)
def _physics_replaced(rig: Rig) -> None:
    """The agent waits on, and asks the second one."""
    with meeting(rig) as physics:
        physics.begin_header()
        _kill(physics)
        time.sleep(PAUSE_S)
        demand(
            not has_left(physics),
            "the agent, when a physics side died before its magic",
            "to wait on",
            "it left",
        )
        physics.begin_header()
        physics.attach()
        physics.await_request()


# --- silence ---


@agent_rule(
    "physics-paused",
    ROBUSTNESS,
    "10",
    "a physics side that stands still (SIGSTOP), in any state and for a second, is waited for",
)
def _physics_paused(rig: Rig) -> str:
    """Header and first reply of each kind come late; the session goes on to its goodbye."""
    with meeting(rig) as physics:
        physics.begin_header()
        assert physics.stand_in is not None
        paused = [State.OFFERED]
        _pause(physics.stand_in, LONG_PAUSE_S)
        physics.attach()
        seen: set[int] = set()
        while Op.GOODBYE not in seen:
            request = physics.await_request()
            if request.op not in seen:
                _pause(physics.stand_in, LONG_PAUSE_S if request.op == Op.STEP else PAUSE_S)
                paused += [state for state, op in UNDER_WAY.items() if op == request.op]
            seen.add(request.op)
            demand(
                physics.farewell()[0] == 0,
                f"the agent while {request.name} waits",
                "to wait on",
                "a farewell",
            )
            physics.answer(request)
    return ", ".join(state.name for state in paused)


def _pause(stand_in: StandIn, seconds: float) -> None:
    stand_in.stop()
    time.sleep(seconds)
    stand_in.resume()


@agent_rule(
    "agent-paused",
    ROBUSTNESS,
    "10",
    "an agent that was stopped and continued, in any state, takes the reply that came meanwhile and goes on",
)
def _agent_paused(rig: Rig) -> None:
    """The first request of each kind is answered while the agent stands still."""
    requests: list[Request] = []
    with meeting(rig) as physics:
        physics.attach()
        seen: set[int] = set()
        while Op.GOODBYE not in seen:
            request = physics.await_request()
            requests.append(request)
            if request.op not in seen:
                physics.process.signal(signal.SIGSTOP)
                time.sleep(PAUSE_S / 2)
            physics.answer(request)
            if request.op not in seen:
                time.sleep(PAUSE_S / 2)
                physics.process.signal(signal.SIGCONT)
            seen.add(request.op)
    for fault in number_faults(requests):
        raise Failure("requests of an agent that was stopped and continued", "none lost or doubled", fault)


# --- refusals ---


@agent_rule(
    "refusals-taken",
    ROBUSTNESS,
    "7",
    "a refusal of any request is no end of the session: the next request has the next number, and the count stood",
    covers=tuple((state, Event.REFUSED) for state in UNDER_WAY if state is not State.CLOSING),
)
def _refusals_taken(rig: Rig) -> str:
    """The agent may ask again or say goodbye, but not leave without a word; codes that it does not know are PLANT."""
    refusal = Refusal("engine", "a plant that can", "a test of how refusals are taken")
    taken = []
    for state, op in entered(rig).items():
        if op is Op.GOODBYE:
            continue
        with asked(rig, op) as (physics, request):
            physics.refuse(request.rung, refusal, code=UNKNOWN_CODE)
            following = physics.await_request()  # a goodbye at least
            due = request.rung + 1
            step = physics.steps + (1 if following.op == Op.STEP else 0)
            found = (following.rung, following.begin, following.end, following.step)
            what = f"doorbell, begin, end and step of the request after a refusal in {state.name}"
            demand(found == (due, due, due, step), what, (due, due, due, step), found)
            taken.append(f"{state.name}, then {Op(following.op).name.lower()}")
            physics.answer(following)
    return "; ".join(taken)
