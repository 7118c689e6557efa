"""Core rules of the exchange: numbers and counts, whose turn it is, every transition of a request, the end."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from protocol import layout
from protocol.conformance.raw_agent import RawAgent, Reply
from protocol.conformance.rig import Rig, await_end, segments_left
from protocol.conformance.rule import Failure, Level, Skip, demand, expect, server_rule
from protocol.conformance.sound import (
    commands,
    done,
    fly,
    refused,
    register,
    release,
    resets,
    speed_max,
    words,
    write_box,
)
from protocol.errors import RefusalCode
from protocol.layout import COMMAND, Farewell, Op, Status
from protocol.states import TRANSITIONS, Event, State

_MOMENT_S: Final = 0.05
_SILENCE_S: Final = 0.15


@server_rule(
    "reply-numbers", Level.CORE, "5", "a reply carries its request's number in begin, end and doorbell"
)
def reply_numbers(rig: Rig) -> None:
    """From 1 on, whatever is asked, done or refused."""
    agent = rig.open()
    agent.put_commands(commands(agent))
    replies = [
        agent.ask(Op.STEP),
        agent.reset(resets(agent)),
        *(agent.step(commands(agent)) for _ in range(3)),
    ]
    replies += [release(agent, 0), agent.goodbye()]
    for number, reply in enumerate(replies, start=1):
        expect(
            f"numbers of reply {number}", (reply.doorbell, reply.begin, reply.end), (number, number, number)
        )


@server_rule("step-count", Level.CORE, "5", "the reply's step counts the control steps of the session")
def step_count(rig: Rig) -> None:
    """Steps add one; resets and refusals leave it, over all episodes."""
    agent = rig.open()
    for before in (0, 3):
        expect("step of the reply to a reset", agent.reset(resets(agent)).step, before)
        for step in (1, 2, 3):
            expect(
                f"step of the reply to step {before + step}", agent.step(commands(agent)).step, before + step
            )
        expect("step of the reply to a refused request", release(agent, 0).step, before + 3)


@server_rule(
    "refused-step-count", Level.CORE, "5", "a refused step leaves the count; the next one carries it again"
)
def refused_step_count(rig: Rig) -> None:
    """The request after a refused step has the same step and is carried out."""
    agent = rig.open()
    done(agent.reset(resets(agent)), "a reset")
    fly(agent, commands(agent), 1)
    reply = agent.step(commands(agent, speed=2 * speed_max(agent)))
    refused(reply, "a speed of twice speed_max", RefusalCode.OUT_OF_RANGE, 0)
    expect("step of the reply to a refused step", reply.step, 1)
    done(agent.step(commands(agent)), "the same step again, with a sound command")
    expect("step of the reply", agent.steps, 2)


@server_rule(
    "engine-time", Level.CORE, "5", "engine_ns is no more than the exchange took, and 0 for a refusal"
)
def engine_time(rig: Rig) -> None:
    """The plant's time lies within the agent's."""
    agent = rig.open()
    done(agent.reset(resets(agent)), "a reset")
    for _ in range(5):
        agent.put_commands(commands(agent))
        began = time.perf_counter_ns()
        reply = agent.ask(Op.STEP)
        whole = time.perf_counter_ns() - began
        demand(0 <= reply.engine_ns <= whole, "engine_ns of a step", f"0 to {whole}", reply.engine_ns)
    expect("engine_ns of a refused request", release(agent, 0).engine_ns, 0)


@server_rule("silent-between-requests", Level.CORE, "5", "between requests the server writes nothing")
def silent_between_requests(rig: Rig) -> None:
    """Nothing integrates without a command: the pose segment stays as it is, byte for byte."""
    agent = rig.open()
    done(agent.reset(resets(agent, gravity=9.81)), "a reset")
    fly(agent, commands(agent, compensation=0.0), 2)
    before = bytes(agent.pose)
    time.sleep(_SILENCE_S)
    _same_bytes("the pose segment while no request is under way", bytes(agent.pose), before)


@server_rule("reply-whole-at-doorbell", Level.CORE, "11", "a reply is whole when its doorbell rings")
def reply_whole_at_doorbell(rig: Rig) -> None:
    """What stands when the doorbell shows stays as it is, for a reset, a step and a refusal."""
    agent = rig.open()
    agent.put_resets(resets(agent, gravity=9.81))
    for op, compensation in ((Op.RESET, 0.0), (Op.STEP, 0.0), (Op.STEP, 3.0)):  # the last is refused
        agent.put_commands(commands(agent, compensation=compensation))
        agent.request(op)
        agent.await_bell()
        seen = bytes(agent.pose)
        time.sleep(_MOMENT_S)
        _same_bytes(f"the pose segment after the doorbell rang for a {op.name}", bytes(agent.pose), seen)
        agent.await_reply()


@server_rule("command-segment-untouched", Level.CORE, "2", "the server never writes into the agent's segment")
def command_segment_untouched(rig: Rig) -> None:
    """Every byte of .cmd is as the agent left it, at the end of a session."""
    agent = rig.open()
    agent.reset(resets(agent))
    fly(agent, commands(agent), 2)
    register(agent, 0, write_box(rig.folder / "box.obj"))
    agent.request(Op.GOODBYE)
    written = bytes(agent.command)
    agent.await_reply()
    _same_bytes("the command segment", bytes(agent.command), written)


def _same_bytes(what: str, found: bytes, expected: bytes) -> None:
    for at, (one, other) in enumerate(zip(found, expected, strict=True)):
        if one != other:
            raise Failure(f"{what}, byte {at}", f"{other:#04x}", f"{one:#04x}")


# --- transitions ---


def _step(agent: RawAgent, folder: Path) -> Reply:
    return agent.step(commands(agent))


def _reset(agent: RawAgent, folder: Path) -> Reply:
    return agent.reset(resets(agent))


def _register(agent: RawAgent, folder: Path) -> Reply:
    return register(agent, 0, write_box(folder / "box.obj"))


def _release(agent: RawAgent, folder: Path) -> Reply:
    return release(agent, 0)


def _walk(
    event: Event, ask: Callable[[RawAgent, Path], Reply], *before: Callable[[RawAgent, Path], Reply]
) -> None:
    """Register the rule that a request is done, that its unsound form is refused, and that both lead to READY."""
    busy = TRANSITIONS[State.READY][event]
    name = event.name.lower()

    @server_rule(
        f"transition-{name.replace('_', '-')}",
        Level.CORE,
        "9",
        f"READY, {event.name}: {busy.name}; DONE or REFUSED: READY again",
        covers=((State.READY, event), (busy, Event.DONE), (busy, Event.REFUSED)),
    )
    def transition(rig: Rig) -> None:
        agent = rig.open()
        for earlier in before:
            _carried_out(earlier(agent, rig.folder), "a request before it")
        _carried_out(ask(agent, rig.folder), name)
        _SPOIL[event](agent)
        reply = agent.ask(int(event))
        demand(reply.refused is not None, f"an unsound {name}", "a refusal", "status 0")
        _carried_out(agent.reset(resets(agent)), "a reset after it")

    transition.__doc__ = (
        f"The server carries out {name}, refuses an unsound one, and takes requests after both."
    )


def _carried_out(reply: Reply, what: str) -> None:
    if reply.refused is not None and reply.refused.code == RefusalCode.PLANT and "reset" not in what:
        raise Skip(f"the plant refuses this ({words(reply.refused)})")
    done(reply, what)


def _spoil_commands(agent: RawAgent) -> None:
    agent.put_commands(commands(agent, compensation=3.0))


def _spoil_resets(agent: RawAgent) -> None:
    agent.put_resets(resets(agent, mass=-1.0))


def _spoil_index(agent: RawAgent) -> None:
    agent.put(tube_index=-1)


_SPOIL: Final[dict[Event, Callable[[RawAgent], None]]] = {
    Event.STEP: _spoil_commands,
    Event.RESET: _spoil_resets,
    Event.REGISTER_TUBE: _spoil_index,
    Event.RELEASE_TUBE: _spoil_index,
}

_walk(Event.STEP, _step, _reset)
_walk(Event.RESET, _reset)
_walk(Event.REGISTER_TUBE, _register)
_walk(Event.RELEASE_TUBE, _release, _register)


@server_rule(
    "goodbye",
    Level.CORE,
    "6",
    "a goodbye is answered with status 0, and the server leaves",
    covers=((State.READY, Event.GOODBYE), (State.CLOSING, Event.DONE)),
)
def goodbye(rig: Rig) -> None:
    """The answer comes first; the process ends within 5 s; the segments stay for the agent to remove."""
    agent = rig.open()
    fly_a_little(agent)
    expect("status of the reply to goodbye", agent.goodbye().status, Status.DONE.value)
    assert agent.process is not None
    await_end(agent.process, "after the goodbye")
    expect("farewell after a goodbye", agent.farewell()[0], int(Farewell.NONE))
    expect("segments after a goodbye", len(segments_left(agent.rendezvous)), 2)


def fly_a_little(agent: RawAgent) -> None:
    """A reset and two steps."""
    done(agent.reset(resets(agent)), "a reset")
    fly(agent, commands(agent), 2)


@server_rule("payload-words-left", Level.CORE, "6", "words that a request does not use are not looked at")
def payload_words_left(rig: Rig) -> None:
    """A step between nonsense in the reset rows and the tube's words is a step."""
    agent = rig.open()
    done(agent.reset(resets(agent)), "a reset")
    rows = layout.reset_rows(1)
    agent.command[rows] = b"\xff" * (rows.stop - rows.start)
    start, end = COMMAND["tube_index"].offset, COMMAND["tube_path"].offset
    agent.command[start:end] = b"\xff" * (end - start)
    fly(agent, commands(agent), 1)
