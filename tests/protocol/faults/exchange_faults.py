"""Faults of the exchange."""

from __future__ import annotations

import threading
import time

import numpy as np
from fault import Deliberate, Publish, around_publish, fault, write_reply

from protocol import layout
from protocol.errors import PeerViolation, Refusal, RefusalCode
from protocol.layout import COMMAND, POSE, Op
from protocol.physics import PhysicsSession
from protocol.plant import Plant
from protocol.toy import ToyPlant


@fault("reply-numbers")
def stale_end() -> Plant:
    """The last word of a reply is the number before."""

    def publish(_: Publish, session: PhysicsSession, status: int, engine_ns: int, number: int) -> None:
        write_reply(session, number, status=status, end=number - 1)

    around_publish(publish)
    return ToyPlant()


@fault("step-count")
def counts_requests() -> Plant:
    """The reply counts requests where it should count steps."""

    def publish(_: Publish, session: PhysicsSession, status: int, engine_ns: int, number: int) -> None:
        write_reply(session, number, status=status, step=number - 1)

    around_publish(publish)
    return ToyPlant()


@fault("refused-step-count")
def counts_refused_steps() -> Plant:
    """A refused step counts."""

    def publish(whole: Publish, session: PhysicsSession, status: int, engine_ns: int, number: int) -> None:
        session.steps += status
        whole(session, status, engine_ns, number)

    around_publish(publish)
    return ToyPlant()


@fault("engine-time")
def picoseconds() -> Plant:
    """The engine's time has another unit."""

    def publish(whole: Publish, session: PhysicsSession, status: int, engine_ns: int, number: int) -> None:
        whole(session, status, 1000 * engine_ns, number)

    around_publish(publish)
    return ToyPlant()


@fault("silent-between-requests")
def restless() -> Plant:
    """The engine goes on by itself between commands."""

    def publish(whole: Publish, session: PhysicsSession, status: int, engine_ns: int, number: int) -> None:
        whole(session, status, engine_ns, number)
        threading.Thread(target=go_on, args=(session,), daemon=True).start()

    def go_on(session: PhysicsSession) -> None:
        time.sleep(0.03)
        session._poses.position[:] += 0.5
        session._pose[layout.pose_rows(1)] = session._pose_bytes

    around_publish(publish)
    return ToyPlant()


@fault("reply-whole-at-doorbell")
def doorbell_first() -> Plant:
    """The doorbell rings before the poses are written."""

    def publish(whole: Publish, session: PhysicsSession, status: int, engine_ns: int, number: int) -> None:
        layout.write_i64(session._pose, POSE["begin"], number)
        layout.write_i64(session._pose, POSE["end"], number)
        layout.write_i64(session._pose, POSE["doorbell"], number)
        time.sleep(0.02)
        whole(session, status, engine_ns, number)

    around_publish(publish)
    return ToyPlant()


@fault("command-segment-untouched")
def clears_the_request() -> Plant:
    """It marks a request as taken, in the agent's segment."""

    def publish(whole: Publish, session: PhysicsSession, status: int, engine_ns: int, number: int) -> None:
        with memoryview(session._command.obj).cast("B") as writable:  # type: ignore[arg-type]
            layout.write_i64(writable, COMMAND["op"], 0)
        whole(session, status, engine_ns, number)

    around_publish(publish)
    return ToyPlant()


def unknown_op(op: Op) -> Plant:
    """Take a request for a violation."""
    rare = PhysicsSession._answer_rare

    def answer(session: PhysicsSession, found: int, step: int, number: int) -> bool:
        if found == op:
            raise PeerViolation(f"asked for op {op}, which is not known")
        return rare(session, found, step, number)

    PhysicsSession._answer_rare = answer  # type: ignore[method-assign]
    return ToyPlant()


@fault("transition-step")
def leaves_after_a_refusal() -> Plant:
    """A refused request ends the session."""

    def publish(whole: Publish, session: PhysicsSession, status: int, engine_ns: int, number: int) -> None:
        whole(session, status, engine_ns, number)
        if status:
            raise Deliberate("it was refused")

    around_publish(publish)
    return ToyPlant()


@fault("transition-reset")
def one_reset() -> Plant:
    """A second reset is a violation."""
    reset = PhysicsSession._reset
    seen: list[int] = []

    def once(session: PhysicsSession) -> None:
        seen.append(session.number)
        if len(seen) > 1:
            raise PeerViolation("reset twice")
        reset(session)

    PhysicsSession._reset = once  # type: ignore[method-assign]
    return ToyPlant()


@fault("transition-register-tube")
def no_registrations() -> Plant:
    """It does not know the request."""
    return unknown_op(Op.REGISTER_TUBE)


@fault("transition-release-tube")
def no_releases() -> Plant:
    """It does not know the request."""
    return unknown_op(Op.RELEASE_TUBE)


@fault("goodbye")
def leaves_without_a_word() -> Plant:
    """It leaves at a goodbye and does not answer it."""

    def leave(session: PhysicsSession) -> None:
        raise Deliberate("goodbye")

    PhysicsSession._say_nothing = leave  # type: ignore[method-assign]
    return ToyPlant()


@fault("payload-words-left")
def reads_too_much() -> Plant:
    """A step looks at the words of a tube."""
    check = PhysicsSession._check_commands

    def check_more(session: PhysicsSession) -> None:
        (scale,) = layout.read_f64(session._command, COMMAND["tube_scale"])
        if np.isnan(scale):
            raise Refusal("tube_scale", "a number", "NaN", code=RefusalCode.OUT_OF_RANGE)
        check(session)

    PhysicsSession._check_commands = check_more  # type: ignore[method-assign]
    return ToyPlant()
