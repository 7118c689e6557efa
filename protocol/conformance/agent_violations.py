"""Rules for agents about headers and replies that are wrong, and about a rendezvous that is not free.

A wrong header ends in a farewell 4 that names the field, a wrong reply in a farewell 3; either way the agent
removes its segments and ends with another exit status than 0.
"""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from protocol import layout
from protocol.conformance.agent_scenes import POLL_S, asked, entered, turns_down
from protocol.conformance.flight import meeting
from protocol.conformance.raw_physics import RawPhysics, Request, Wrong
from protocol.conformance.rig import Rig, await_end, segments_left
from protocol.conformance.rule import Level, Skip, agent_rule, demand, expect
from protocol.conformance.scenes import UNDER_WAY, hand_over
from protocol.conformance.stand_in import dead_process
from protocol.layout import COMMAND, COMMAND_MAGIC, HEADER, Farewell, Op
from protocol.memory import COMMAND_SUFFIX, parse_rendezvous, segment_path
from protocol.states import Event, State

ROBUSTNESS: Final = Level.ROBUSTNESS
EARLY_S: Final = (0.0, 20e-6, 200e-6, 2e-3, 10e-3)
"""How long after a reply the next one comes, before its request (s)."""
_REFUSED_ANSWER: Final = ((State.OFFERED, Event.FAREWELL),)


# --- headers ---


def _turned_down(rig: Rig, name: str, value: int | float | bytes) -> None:
    """Answer with a header with one wrong field: farewell 4 that names it."""
    with meeting(rig) as physics:
        physics.attach({name: value})
        said = f"a header with {name} = {value!r}"
        text = turns_down(physics, said, Farewell.HANDSHAKE, last=0)
        plain = text.lower().replace("_", " ")
        demand(
            name.replace("_", " ") in plain,
            f"farewell text after {said}",
            f"one that names {name}",
            repr(text),
        )


@agent_rule(
    "answer-magic", ROBUSTNESS, "4", "another magic than TUBE.POS is turned down", covers=_REFUSED_ANSWER
)
def _answer_magic(rig: Rig) -> None:
    """A command segment's magic is not a pose segment's."""
    _turned_down(rig, "magic", COMMAND_MAGIC)


@agent_rule(
    "answer-major-version", ROBUSTNESS, "13", "another major version is turned down", covers=_REFUSED_ANSWER
)
def _answer_major_version(rig: Rig) -> None:
    """Neither an older nor a newer one is understood."""
    for version in (0, 2):
        _turned_down(rig, "version_major", version)


@agent_rule("answer-session", ROBUSTNESS, "4", "a foreign session is turned down", covers=_REFUSED_ANSWER)
def _answer_session(rig: Rig) -> None:
    """The physics side must echo the identity of this session."""
    _turned_down(rig, "session", b"another session.")


@agent_rule(
    "answer-echoes",
    ROBUSTNESS,
    "4",
    "lanes, times, slots and strides that are not the agent's own are turned down",
    covers=_REFUSED_ANSWER,
)
def _answer_echoes(rig: Rig) -> None:
    """Each echoed word by itself."""
    for field in HEADER:
        if field.offset < COMMAND["lanes"].offset:
            continue
        wrong = 0.0625 if field.kind == "f64" else 3
        _turned_down(rig, field.name, wrong)


@agent_rule("answer-size", ROBUSTNESS, "4", "a stated size that does not fit the lanes is turned down")
def _answer_size(rig: Rig) -> None:
    """The size of a thousand lanes more."""
    _turned_down(rig, "segment_bytes", layout.pose_bytes(1000))


@agent_rule("answer-speed-max", ROBUSTNESS, "3", "a speed_max that is not finite and > 0 is turned down")
def _answer_speed_max(rig: Rig) -> None:
    """Nothing could be commanded."""
    for speed in (0.0, math.inf, math.nan):
        _turned_down(rig, "speed_max", speed)


@agent_rule("answer-defaults", ROBUSTNESS, "4", "default parameters that are not finite are turned down")
def _answer_defaults(rig: Rig) -> None:
    """They would be sent back in a reset."""
    _turned_down(rig, "defaults", math.nan)


@agent_rule("answer-walls", ROBUSTNESS, "3", "walls that are neither 0 nor 1 are turned down")
def _answer_walls(rig: Rig) -> None:
    """Contact is promised or it is not."""
    _turned_down(rig, "walls", 2)


@agent_rule(
    "newer-minor-version",
    Level.CORE,
    "13",
    "a header of a newer minor version is accepted",
    covers=((State.OFFERED, Event.ATTACH),),
)
def _newer_minor_version(rig: Rig) -> None:
    """A minor version of 7 is no reason to leave."""
    with meeting(rig) as physics:
        physics.attach({"version_minor": 7})
        physics.await_request()


# --- replies ---


def _answers_wrongly(rig: Rig, op: Op, what: str, wrong: Callable[[RawPhysics, Request], Wrong]) -> None:
    """Answer a request with wrong words: farewell 3 with a text."""
    with asked(rig, op) as (physics, request):
        steps = physics.steps
        physics.steps += op is Op.STEP
        words = wrong(physics, request)
        physics.reply(request.rung, words)
        physics.steps = steps
        turns_down(physics, f"{what} to a {op.name}", Farewell.VIOLATION, last=request.rung)


def _to_every_request(rig: Rig, what: str, wrong: Callable[[RawPhysics, Request], Wrong]) -> str:
    """Answer wrongly in every state that the agent enters, each in a session of its own."""
    states = entered(rig)
    for op in states.values():
        _answers_wrongly(rig, op, what, wrong)
    return ", ".join(state.name for state in states)


_WHILE_ASKED: Final = tuple((state, Event.VIOLATION) for state in UNDER_WAY)


@agent_rule(
    "reply-begin", ROBUSTNESS, "8", "a reply of any kind whose `begin` is not its number ends the session",
    covers=_WHILE_ASKED,
)  # fmt: skip
def _reply_begin(rig: Rig) -> str:
    """A torn reply: its first word is that of another."""
    return _to_every_request(rig, "a torn reply, its begin another's,", lambda p, r: {"begin": r.rung - 1})


@agent_rule(
    "reply-end", ROBUSTNESS, "8", "a reply of any kind whose `end` is not its number ends the session"
)
def _reply_end(rig: Rig) -> str:
    """A half-written reply: its last word is still that of the last one."""
    return _to_every_request(rig, "a half-written reply", lambda p, r: {"end": r.rung - 1})


@agent_rule("reply-number", ROBUSTNESS, "8", "a reply of another number than the request's ends the session")
def _reply_number(rig: Rig) -> None:
    """Skipped and repeated numbers, and a doorbell alone that is ahead."""
    for jump in (1, -2):
        _answers_wrongly(
            rig,
            Op.STEP,
            f"a reply {abs(jump)} {'ahead' if jump > 0 else 'behind'}",
            lambda p, r, jump=jump: dict.fromkeys(("begin", "end", "doorbell"), r.rung + jump),  # type: ignore[misc]
        )
    _answers_wrongly(rig, Op.STEP, "a doorbell ahead of its reply", lambda p, r: {"doorbell": r.rung + 1})


@agent_rule(
    "reply-step", ROBUSTNESS, "8", "a reply with a step count that was skipped or repeated ends the session"
)
def _reply_step(rig: Rig) -> None:
    """One step too many and one too few to a step; one too many to a reset."""
    _answers_wrongly(rig, Op.STEP, "a reply a step ahead", lambda p, r: {"step": r.step + 1})
    _answers_wrongly(rig, Op.STEP, "a reply a step behind", lambda p, r: {"step": r.step - 1})
    _answers_wrongly(rig, Op.RESET, "a reply that has stepped", lambda p, r: {"step": r.step + 1})


@agent_rule(
    "reply-refusal-step", ROBUSTNESS, "5", "a refused step that has advanced the count ends the session"
)
def _reply_refusal_step(rig: Rig) -> None:
    """A refusal leaves the count where it was."""
    _answers_wrongly(rig, Op.STEP, "a refusal that has stepped", lambda p, r: {"status": 1, "step": r.step})


@agent_rule("reply-status", ROBUSTNESS, "8", "a status that the protocol does not know ends the session")
def _reply_status(rig: Rig) -> None:
    """Neither done nor refused."""
    for status in (2, -1):
        _answers_wrongly(rig, Op.STEP, f"a reply of status {status}", lambda p, r, s=status: {"status": s})  # type: ignore[misc]


@agent_rule(
    "reply-early",
    ROBUSTNESS,
    "5",
    "a reply to a request that was not made ends the session",
    covers=((State.READY, Event.VIOLATION),),
)
def _reply_early(rig: Rig) -> str:
    """The reply to the next request is there before that request, and is otherwise as it would be.

    It comes after several delays, since nobody sees from outside when the agent has taken the last reply.
    """
    early = []
    for delay in EARLY_S:
        with asked(rig, Op.STEP) as (physics, request):
            if _answers_early(physics, request, delay):
                what, last = "a reply to a request that was not made", physics.number - 1
                turns_down(physics, what, Farewell.VIOLATION, last=last)
                early.append(f"{delay * 1e3:g} ms")
    if not early:
        raise Skip("the agent asks again too quickly for a reply to come before its request")
    return f"{', '.join(early)} after the last one"


def _answers_early(physics: RawPhysics, request: Request | None, delay: float) -> bool:
    """Answer a step and, while the agent has not begun its next request, that one too; False where it was quicker."""
    while request is not None:
        physics.answer(request)
        answered = time.monotonic()
        while time.monotonic() - answered < delay:
            pass
        if _begun(physics) == request.rung:
            physics.steps += 1
            physics.reply(request.rung + 1)
            return _begun(physics) == request.rung
        request = physics.serve_until(lambda r: r.op == Op.STEP)
    return False


def _begun(physics: RawPhysics) -> int:
    return layout.read_i64(physics.command, COMMAND["begin"])


# --- the rendezvous ---


@agent_rule("stale-rendezvous-replaced", ROBUSTNESS, "2", "the segments of a dead agent are replaced")
def _stale_rendezvous_replaced(rig: Rig) -> None:
    """A new session stands in their place."""
    stale = rig.agent()
    stand_in = hand_over(stale)
    stale.offer(pid=stand_in.pid, start_time=stand_in.started)
    stand_in.close()
    process = rig.start()
    until = time.monotonic() + rig.timeout
    while _session_at(rig.rendezvous) in (b"", stale.session):
        demand(
            time.monotonic() < until, "the stale segments", f"replaced within {rig.timeout:g} s", "they stand"
        )
        expect("the end of the agent at stale segments", process.watch(), None)
        time.sleep(POLL_S)
    with RawPhysics(rig.rendezvous, process, rig.timeout) as physics:
        physics.attach()
        physics.await_request()


def _session_at(rendezvous: str) -> bytes:
    """Identity of the session whose magic stands at a rendezvous, or nothing."""
    try:
        segment = segment_path(parse_rendezvous(rendezvous), COMMAND_SUFFIX).read_bytes()
    except FileNotFoundError:
        return b""
    return segment[COMMAND["session"].bytes] if segment.startswith(COMMAND_MAGIC) else b""


@agent_rule(
    "living-rendezvous-refused", ROBUSTNESS, "2", "a rendezvous whose agent lives is refused and left alone"
)
def _living_rendezvous_refused(rig: Rig) -> None:
    """The agent ends, and not a byte of the other's session has changed; its pid lives, or its lock is held."""
    for proof in ("process", "lock"):
        rendezvous = rig.new_rendezvous()
        other = rig.agent(rendezvous=rendezvous)
        stand_in = hand_over(other)
        try:
            pid, started = (stand_in.pid, stand_in.started) if proof == "process" else dead_process()
            other.offer(pid=pid, start_time=started)
            _refused(rig, rendezvous, f"where the {proof} of another agent says that it lives")
        finally:
            stand_in.close()
            other.close()


@agent_rule(
    "foreign-file-refused", ROBUSTNESS, "2", "what is no segment of this protocol is refused and left alone"
)
def _foreign_file_refused(rig: Rig) -> None:
    """Somebody's own file of the same name."""
    path = segment_path(parse_rendezvous(rig.rendezvous), COMMAND_SUFFIX)
    path.write_bytes(b"somebody's own file" * 200)
    _refused(rig, rig.rendezvous, "where a foreign file has its name")


def _refused(rig: Rig, rendezvous: str, where: str) -> None:
    """Demand that the agent does not come to be at a rendezvous, and touches nothing there."""
    before = _contents(rendezvous)
    code = await_end(rig.start(rendezvous), where, rig.timeout)
    demand(code != 0, f"exit status {where}", "another than 0", code)
    demand(
        _contents(rendezvous) == before, f"the segments {where}", "untouched", "changed, replaced or removed"
    )


def _contents(rendezvous: str) -> list[tuple[str, int, bytes]]:
    paths = map(Path, segments_left(rendezvous))
    return [(path.name, path.stat().st_ino, path.read_bytes()) for path in paths]


# --- told to stop ---


@agent_rule(
    "told-to-stop",
    ROBUSTNESS,
    "8",
    "an agent that is told to stop (SIGTERM or SIGINT) leaves a farewell 1 and no segments, promptly",
)
def _told_to_stop(rig: Rig) -> str:
    """While it waits for the physics side's header, and while it waits for a reply."""
    heeded = [number for number in (signal.SIGTERM, signal.SIGINT) if _heeds(rig, number)]
    demand(
        bool(heeded), "farewell after SIGTERM or SIGINT", "kind 1 and no segments left", "not so after either"
    )
    return f"after {' and '.join(number.name for number in heeded)}"


def _heeds(rig: Rig, number: signal.Signals) -> bool:
    with meeting(rig) as physics:
        if not _leaves_on(physics, number):
            return False
    with asked(rig, Op.STEP) as (physics, _):
        return _leaves_on(physics, number)


def _leaves_on(physics: RawPhysics, number: signal.Signals) -> bool:
    physics.process.signal(number)
    await_end(physics.process, f"after {number.name}")
    return physics.farewell()[0] == Farewell.STOPPED and not segments_left(physics.rendezvous)
