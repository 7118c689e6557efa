"""Rules for servers about an agent that breaks the protocol: each violation ends the session, in every state.

After a violation the server leaves a farewell 3 with a text and ends; the pose segment is otherwise untouched.
"""

from __future__ import annotations

import time
from typing import Final

from protocol.conformance.rig import LEAVING_S, Rig, await_end, segments_left
from protocol.conformance.rule import Level, demand, expect, server_rule
from protocol.conformance.scenes import (
    SETTLE_S,
    UNDER_WAY,
    Scene,
    at_work,
    ring,
    scene,
    without_farewell,
)
from protocol.conformance.sound import commands, resets
from protocol.layout import COMMAND_STRIDE, Farewell, Op, command_rows
from protocol.states import Event, State

ROBUSTNESS: Final = Level.ROBUSTNESS
_UNKNOWN_OPS: Final = (0, 6, -1)
_OTHERS: Final = {state: op for state, op in UNDER_WAY.items() if op is not Op.STEP}


def _covers(*states: State) -> tuple[tuple[State, Event], ...]:
    return tuple((state, Event.VIOLATION) for state in states)


def _ends(s: Scene, what: str) -> None:
    """Let the server find what the agent has done, and demand that it ends the session as specified."""
    before, answered = without_farewell(s.agent.pose), s.agent.get("doorbell")
    s.go_on()
    kind, text = _await_farewell(s, answered, f"{what} {s.where}")
    demand(kind == Farewell.VIOLATION, f"farewell after {what} {s.where}", "kind 3", f"{kind} {text!r}")
    demand(bool(text), f"text of the farewell after {what} {s.where}", "what was seen", "an empty text")
    await_end(s.server, f"after {what} {s.where}")
    if s.state is not State.OFFERED:  # there its header came in between
        unchanged = without_farewell(s.agent.pose) == before
        demand(
            unchanged,
            f"the pose segment after {what} {s.where}",
            "untouched but for the farewell",
            "written to",
        )
    expect(
        f"segments after {what} {s.where}, which the agent removes", len(segments_left(s.agent.rendezvous)), 2
    )


def _await_farewell(s: Scene, answered: int, after: str) -> tuple[int, str]:
    """Wait for the server's farewell or its end; a reply behind number `answered` is a failure at once."""
    until = time.monotonic() + (s.agent.timeout if s.state is State.OFFERED else LEAVING_S)
    while not s.agent.farewell()[0] and s.server.watch() is None:
        demand(s.agent.get("doorbell") == answered, f"the server after {after}", "a farewell 3", "a reply")
        demand(
            time.monotonic() < until, f"the server after {after}", "a farewell 3", "none, and it still runs"
        )
        time.sleep(0.001)
    return s.agent.farewell()


def _asks(rig: Rig, what: str, op: int, **words: int) -> None:
    """From READY, publish a request that breaks the protocol by some `words`."""
    with scene(rig, State.READY) as s:
        number = s.agent.number + 1
        offset = {
            name: value + number for name, value in words.items() if name in ("begin", "end", "doorbell")
        }
        due = s.agent.steps + (1 if op == Op.STEP else 0)
        if "step" in words:
            offset["step"] = due + words["step"]
        if op in tuple(Op):
            ring(s.agent, Op(op), **offset)
        else:
            s.agent.request(op, **offset)
        _ends(s, what)


@server_rule(
    "doorbell-jump",
    ROBUSTNESS,
    "8",
    "a doorbell that is not the number that is due ends the session: skipped, repeated, negative",
    covers=_covers(State.READY),
)
def _doorbell_jump(rig: Rig) -> None:
    _asks(rig, "a skipped number", Op.STEP, begin=1, end=1, doorbell=1)
    _asks(rig, "a repeated number", Op.STEP, begin=-2, end=-2, doorbell=-2)
    _asks(rig, "a doorbell ahead of its request", Op.STEP, doorbell=1)
    _asks(rig, "a negative doorbell", Op.STEP, doorbell=-100)


@server_rule(
    "torn-begin", ROBUSTNESS, "8", "a request of any kind whose `begin` is not its number ends the session"
)
def _torn_begin(rig: Rig) -> None:
    for op in UNDER_WAY.values():
        _asks(rig, f"a {op.name} with another begin", op, begin=-1)


@server_rule(
    "torn-end", ROBUSTNESS, "8", "a request of any kind whose `end` is not its number ends the session"
)
def _torn_end(rig: Rig) -> None:
    for op in UNDER_WAY.values():
        _asks(rig, f"a half-written {op.name}, its end that of the last request", op, end=-1)


@server_rule("step-skipped", ROBUSTNESS, "8", "a step request that skips a step ends the session")
def _step_skipped(rig: Rig) -> None:
    _asks(rig, "a step request one step ahead", Op.STEP, step=1)


@server_rule("step-repeated", ROBUSTNESS, "8", "a step request that repeats a step ends the session")
def _step_repeated(rig: Rig) -> None:
    _asks(rig, "a step request of the step before", Op.STEP, step=-1)


@server_rule(
    "step-count-of-others",
    ROBUSTNESS,
    "5",
    "every other request with another step count than the session's ends it",
)
def _step_count_of_others(rig: Rig) -> None:
    for op in _OTHERS.values():
        _asks(rig, f"a {op.name} with the step count of a step request", op, step=1)


@server_rule("unknown-op", ROBUSTNESS, "8", "an op that the protocol does not know ends the session")
def _unknown_op(rig: Rig) -> None:
    for op in _UNKNOWN_OPS:
        _asks(rig, f"op {op}", op)


@server_rule(
    "early-begin",
    ROBUSTNESS,
    "8",
    "a next request that is begun before the last one is answered ends the session, in every state",
    covers=_covers(*UNDER_WAY),
)
def _early_begin(rig: Rig) -> None:
    for state in UNDER_WAY:
        with scene(rig, state) as s:
            s.agent.put(begin=s.agent.number + 1)
            _ends(s, "an early begin")


@server_rule(
    "early-doorbell",
    ROBUSTNESS,
    "8",
    "a next request that is published before the last one is answered ends the session, in every state",
)
def _early_doorbell(rig: Rig) -> None:
    for state in UNDER_WAY:
        with scene(rig, state) as s:
            ring(s.agent, Op.STEP, step=s.agent.steps + 1)
            _ends(s, "an early request")


@server_rule(
    "early-at-work",
    ROBUSTNESS,
    "5",
    "a next request begun or published while the engine works ends the session; the work is not published",
)
def _early_at_work(rig: Rig) -> None:
    for word in ("begin", "doorbell"):
        with at_work(rig) as s:
            s.agent.put(**{word: s.agent.number + 1})
            _ends(s, f"an early {word} at work")


@server_rule(
    "request-before-session",
    ROBUSTNESS,
    "9",
    "a doorbell that has gone on before the session was ready ends it",
    covers=_covers(State.OFFERED),
)
def _request_before_session(rig: Rig) -> None:
    with scene(rig, State.OFFERED) as s:
        s.agent.put(begin=2, end=2, op=int(Op.RESET), doorbell=2)
        _ends(s, "two requests that nobody answered")


@server_rule(
    "slow-request-awaited",
    ROBUSTNESS,
    "5",
    "a request that is being written is not looked at before its doorbell",
)
def _slow_request_awaited(rig: Rig) -> None:
    agent = rig.open()
    expect("status of a reset", agent.reset(resets(agent)).status, 0)
    before = bytes(agent.pose)
    agent.put(begin=agent.number + 1, op=int(Op.STEP))
    agent.command[command_rows(1)] = b"\xff" * COMMAND_STRIDE
    time.sleep(SETTLE_S)
    demand(
        bytes(agent.pose) == before, "the pose segment while a request is written", "untouched", "written to"
    )
    expect("status of the step, finished at last", agent.step(commands(agent)).status, 0)
