"""Faults of refusals."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from fault import Publish, Walled, around_publish, fault

from protocol import layout, validation
from protocol.errors import PeerViolation, Refusal, RefusalCode
from protocol.layout import COMMAND
from protocol.physics import PhysicsSession
from protocol.plant import NO_TUBE, Floats, Plant
from protocol.toy import ToyPlant

Judge = Callable[[Refusal], Refusal | None]
"""What a broken server makes of a refusal that is due."""


def commands_judged(judge: Judge) -> Plant:
    """Pass refusals of commands through `judge`."""
    usual = validation.command_refusal

    def refusal(*arguments: object) -> Refusal | None:
        due = usual(*arguments)  # type: ignore[arg-type]
        return due and judge(due)

    validation.command_refusal = refusal
    return ToyPlant()


def resets_judged(judge: Judge) -> Plant:
    """Pass refusals of resets through `judge`."""
    usual = validation.reset_refusal

    def refusal(*arguments: object) -> Refusal | None:
        due = usual(*arguments)  # type: ignore[arg-type]
        return due and judge(due)

    validation.reset_refusal = refusal
    return ToyPlant()


def recoded(name: str, code: RefusalCode) -> Plant:
    """Publish another code wherever a method of the session refuses."""
    usual = getattr(PhysicsSession, name)

    def refusing(session: PhysicsSession) -> object:
        try:
            return usual(session)
        except Refusal as due:
            due.code = code
            raise

    setattr(PhysicsSession, name, refusing)
    return ToyPlant()


def as_code(code: RefusalCode) -> Judge:
    """Refuse with another code."""

    def judge(due: Refusal) -> Refusal:
        return Refusal(due.field, due.expected, due.found, due.lane, code)

    return judge


def but(code: RefusalCode) -> Judge:
    """Take what is to be refused with this code."""
    return lambda due: None if due.code is code else due


def without_lane(due: Refusal) -> Refusal:
    """Refuse without a lane."""
    return Refusal(due.field, due.expected, due.found, -1, due.code)


@fault("refusal-not-finite-command")
def nan_is_out_of_range() -> Plant:
    """NaN is reported as a number out of range."""
    return commands_judged(as_code(RefusalCode.OUT_OF_RANGE))


@fault("refusal-not-finite-reset")
def resets_without_lane() -> Plant:
    """A refused reset names no lane."""
    return resets_judged(without_lane)


@fault("refusal-out-of-range-command")
def takes_any_speed() -> Plant:
    """Speeds and compensations have no range."""
    return commands_judged(but(RefusalCode.OUT_OF_RANGE))


@fault("refusal-out-of-range-parameter")
def takes_any_parameter() -> Plant:
    """Parameters have no range."""
    return resets_judged(but(RefusalCode.OUT_OF_RANGE))


@fault("refusal-selected")
def any_number_selects() -> Plant:
    """Whatever is not zero selects a lane."""
    return resets_judged(lambda due: None if due.field == "selected" else due)


@fault("refusal-not-unit-direction")
def any_direction() -> Plant:
    """Directions have any length."""
    return commands_judged(but(RefusalCode.NOT_UNIT))


@fault("refusal-not-unit-quaternion")
def pedantic_about_quaternions() -> Plant:
    """A quaternion's length is 1 to the last digit."""
    validation.UNIT_TOLERANCE = 1e-12
    usual = validation.reset_refusal

    def refusal(resets: object, tubes: object) -> Refusal | None:
        for lane, quaternion in enumerate(resets.quaternion):  # type: ignore[attr-defined]
            if abs(quaternion @ quaternion - 1.0) > 1e-12:
                return Refusal("quaternion", "length 1", str(quaternion), lane, RefusalCode.NOT_UNIT)
        return usual(resets, tubes)  # type: ignore[arg-type]

    validation.reset_refusal = refusal  # type: ignore[assignment]
    return ToyPlant()


@fault("refusal-reserved")
def minus_zero_is_zero() -> Plant:
    """Reserved words are compared as floats."""
    return commands_judged(lambda due: None if str(-(2**63)) in due.found else due)


@fault("refusal-not-reset")
def any_lane_not_reset() -> Plant:
    """NOT_RESET always names lane 0."""
    usual = PhysicsSession._check_commands

    def check(session: PhysicsSession) -> None:
        try:
            usual(session)
        except Refusal as due:
            due.lane = 0
            raise

    PhysicsSession._check_commands = check  # type: ignore[method-assign]
    return ToyPlant()


@fault("refusal-not-reset-first")
def commands_first() -> Plant:
    """Commands are looked at before lanes that were never reset."""
    usual = PhysicsSession._check_commands

    def check(session: PhysicsSession) -> None:
        refusal = validation.command_refusal(session._commands, 10.0)
        if refusal is not None:
            raise refusal
        usual(session)

    PhysicsSession._check_commands = check  # type: ignore[method-assign]
    return ToyPlant()


@fault("refusal-unknown-tube")
def unknown_is_slot() -> Plant:
    """An unknown tube is a matter of slots."""
    return resets_judged(as_code(RefusalCode.TUBE_SLOT))


@fault("refusal-tube-slot-release")
def slot_is_unknown() -> Plant:
    """An index outside of the slots is an unknown tube."""
    return recoded("_release_tube", RefusalCode.UNKNOWN_TUBE)


@fault("refusal-tube-slot-register")
def replaces_tubes() -> Plant:
    """A tube that is taken is replaced."""
    usual = PhysicsSession._register_tube

    def register(session: PhysicsSession) -> None:
        session._tubes.discard(layout.read_i64(session._command, COMMAND["tube_index"]))
        usual(session)

    PhysicsSession._register_tube = register  # type: ignore[method-assign]
    return ToyPlant()


@fault("refusal-tube-in-use")
def releases_any_tube() -> Plant:
    """Nobody looks who flies in a tube."""
    usual = PhysicsSession._release_tube

    def release(session: PhysicsSession) -> None:
        session._lane_tubes[:] = NO_TUBE
        usual(session)

    PhysicsSession._release_tube = release  # type: ignore[method-assign]
    return ToyPlant()


@fault("refusal-malformed")
def malformed_is_the_plants() -> Plant:
    """What cannot be read is the plant's affair."""
    return recoded("_tube_reference", RefusalCode.PLANT)


@fault("refusal-tube-scale")
def scale_is_malformed() -> Plant:
    """A scale out of range is malformed."""
    return recoded("_tube_reference", RefusalCode.MALFORMED)


@fault("refusal-plant")
def reads_no_file() -> Plant:
    """It promises walls and never reads a tube's file."""
    return Walled()


def after_refusals(move: Callable[[Floats], None]) -> Plant:
    """Let a refusal move bodies behind the agent's back."""

    def publish(whole: Publish, session: PhysicsSession, status: int, engine_ns: int, number: int) -> None:
        whole(session, status, engine_ns, number)
        if status:
            move(session._poses.raw)

    around_publish(publish)
    return ToyPlant()


@fault("refusal-moves-nothing")
def refused_steps_move() -> Plant:
    """The bodies drift on while a step is refused."""

    def drift(poses: Floats) -> None:
        poses[:, :3] += 0.01

    return after_refusals(drift)


@fault("refusal-resets-nothing")
def sound_lanes_are_reset() -> Plant:
    """The sound lanes of a refused reset are reset."""

    def reset(poses: Floats) -> None:
        poses[0, :3] = 5.0

    return after_refusals(reset)


@fault("refusal-recovery")
def patience_for_three() -> Plant:
    """The third refusal is a violation."""
    refused: list[int] = []

    def publish(whole: Publish, session: PhysicsSession, status: int, engine_ns: int, number: int) -> None:
        refused.extend([number] * status)
        if len(refused) == 3:
            raise PeerViolation("asked for nonsense again")
        whole(session, status, engine_ns, number)

    around_publish(publish)
    return ToyPlant()


@fault("refusal-names-first-lane")
def last_lane_first() -> Plant:
    """Lanes are looked at from the last to the first."""

    def refusal(commands: object, speed_max: float) -> Refusal | None:
        raw = commands.raw  # type: ignore[attr-defined]
        for lane in reversed(range(len(raw))):
            if not np.isfinite(raw[lane]).all() or raw[lane, 4] > 2.0:
                return Refusal("command", "sound", "unsound", lane, RefusalCode.OUT_OF_RANGE)
        return None

    validation.command_refusal = refusal  # type: ignore[assignment]
    return ToyPlant()
