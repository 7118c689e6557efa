"""Core rules of refusals: each code with its lane, what a refusal leaves as it was, and which fault goes first."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from typing import Final

import numpy as np

from protocol.conformance.raw_agent import RawAgent
from protocol.conformance.rig import Rig
from protocol.conformance.rule import Level, Skip, demand, expect, server_rule
from protocol.conformance.sound import (
    commands,
    done,
    fly,
    has_walls,
    put_tube,
    refused,
    register,
    release,
    resets,
    same_bits,
    speed_max,
    take_box,
)
from protocol.errors import RefusalCode
from protocol.layout import Op
from protocol.plant import PARAMETER_INDEX, PARAMETERS, RESET_WORDS, Floats, Parameter

LANE: Final = 1
"""The lane at fault among three."""
_BARELY: Final = 0.9e-6
_TOO_FAR: Final = 1.2e-6
"""How far a squared length is from 1, within and beyond the tolerance of 1e-6."""
_NOT_NUMBERS: Final = (math.nan, math.inf, -math.inf)
# Words of a command row.
_SPEED: Final = 3
_COMPENSATION: Final = 4
_COMMAND_RESERVED: Final = (5, 6, 7)
# Words of a reset row.
_QUATERNION: Final = 3
_TUBE: Final = 13
_SELECTED: Final = 15
_PARAMETERS: Final = 16
_MINUS_ZERO: Final = struct.unpack("<q", struct.pack("<d", -0.0))[0]


def _ready(rig: Rig) -> RawAgent:
    """Open a session of three lanes, all of them reset."""
    agent = rig.open(lanes=3)
    done(agent.reset(resets(agent)), "a reset")
    return agent


Value = float | int | tuple[float, ...]
"""What is written into a row: an f64, an i64, or several f64 from a word on."""


def _refused_step(agent: RawAgent, what: str, code: RefusalCode, word: int, value: Value) -> None:
    """Demand that a step is refused for one word of one command row."""
    batch = commands(agent)
    _spoil(batch.raw, word, value)
    refused(agent.step(batch), f"{what} = {value}", code, LANE)


def _refused_reset(agent: RawAgent, what: str, code: RefusalCode, word: int, value: Value) -> None:
    """Demand that a reset is refused for one word of one reset row."""
    batch = resets(agent)
    _spoil(batch.raw, word, value)
    refused(agent.reset(batch), f"{what} = {value}", code, LANE)


def _spoil(rows: Floats, word: int, value: Value) -> None:
    if isinstance(value, int):
        rows.view(np.int64)[LANE, word] = value
    elif isinstance(value, tuple):
        rows[LANE, word : word + len(value)] = value
    else:
        rows[LANE, word] = value


@server_rule("refusal-not-finite-command", Level.CORE, "7", "code 1: NaN or infinity in a command row")
def refusal_not_finite_command(rig: Rig) -> None:
    """Each of the five numbers of a row, in the second of three lanes."""
    agent = _ready(rig)
    for word, name in enumerate(("direction x", "direction y", "direction z", "speed", "compensation")):
        for value in _NOT_NUMBERS:
            _refused_step(agent, name, RefusalCode.NOT_FINITE, word, value)
    fly(agent, commands(agent), 1)


@server_rule("refusal-not-finite-reset", Level.CORE, "7", "code 1: NaN or infinity in a selected reset row")
def refusal_not_finite_reset(rig: Rig) -> None:
    """Each number of the state and each parameter."""
    agent = _ready(rig)
    for word in (*range(_TUBE), *(_PARAMETERS + index for index in range(len(PARAMETERS)))):
        for value in (math.nan, -math.inf):
            _refused_reset(agent, f"word {word} of a reset row", RefusalCode.NOT_FINITE, word, value)
    done(agent.reset(resets(agent)), "a sound reset after the refusals")


@server_rule(
    "refusal-out-of-range-command", Level.CORE, "7", "code 2: speed beyond 0 to speed_max, c beyond 0 to 2"
)
def refusal_out_of_range_command(rig: Rig) -> None:
    """The ends of both ranges are taken, the next numbers beyond them are not."""
    agent = _ready(rig)
    most = speed_max(agent)
    for speed in (0.0, most):
        fly(agent, commands(agent, speed=speed), 1)
    for compensation in (0.0, 2.0):
        fly(agent, commands(agent, compensation=compensation), 1)
    code = RefusalCode.OUT_OF_RANGE
    for speed in (-1e-300, math.nextafter(most, math.inf)):
        _refused_step(agent, "speed", code, _SPEED, speed)
    for compensation in (-1e-300, math.nextafter(2.0, math.inf)):
        _refused_step(agent, "compensation", code, _COMPENSATION, compensation)


@server_rule("refusal-out-of-range-parameter", Level.CORE, "7", "code 2: a parameter outside of its range")
def refusal_out_of_range_parameter(rig: Rig) -> None:
    """Each bound of each parameter's range; and what stands on a bound that belongs to it is taken."""
    agent = _ready(rig)
    for parameter in PARAMETERS:
        word = _PARAMETERS + PARAMETER_INDEX[parameter.name]
        for value in _beyond(parameter):
            _refused_reset(agent, parameter.name, RefusalCode.OUT_OF_RANGE, word, value)
    bounds = {p.name: p.lowest for p in PARAMETERS if math.isfinite(p.lowest) and not p.above_lowest}
    done(agent.reset(resets(agent, **bounds)), "a reset with parameters at the lower ends of their ranges")


def _beyond(parameter: Parameter) -> Iterator[float]:
    """Numbers just outside of a parameter's range."""
    if parameter.either:
        yield from (0.5, 2.0, -1.0)
    if math.isfinite(parameter.lowest):
        yield parameter.lowest if parameter.above_lowest else -1e-300
    if math.isfinite(parameter.highest):
        yield math.nextafter(parameter.highest, math.inf)


@server_rule("refusal-selected", Level.CORE, "7", "code 2: `selected` is neither 0 nor 1")
def refusal_selected(rig: Rig) -> None:
    """No other word means yes."""
    agent = _ready(rig)
    for value in (2, -1, 2**62):
        _refused_reset(agent, "selected", RefusalCode.OUT_OF_RANGE, _SELECTED, value)


@server_rule(
    "refusal-not-unit-direction", Level.CORE, "7", "code 3: a direction's squared length is not 1 within 1e-6"
)
def refusal_not_unit_direction(rig: Rig) -> None:
    """What is within the tolerance is taken."""
    agent = _ready(rig)
    for beyond in (-_BARELY, _BARELY):
        fly(agent, commands(agent, direction=_long(beyond)), 1)
    for direction in (_long(-_TOO_FAR), _long(_TOO_FAR), (0.0, 0.0, 0.0), (1.0, 1.0, 0.0)):
        _refused_step(agent, "direction", RefusalCode.NOT_UNIT, 0, direction)


def _long(beyond: float) -> tuple[float, float, float]:
    """A vector whose squared length is 1 + `beyond`."""
    factor = math.sqrt(1.0 + beyond)
    return (0.6 * factor, 0.0, -0.8 * factor)


@server_rule(
    "refusal-not-unit-quaternion",
    Level.CORE,
    "7",
    "code 3: a quaternion's squared length is not 1 within 1e-6",
)
def refusal_not_unit_quaternion(rig: Rig) -> None:
    """What is within the tolerance is taken."""
    agent = _ready(rig)
    for beyond in (-_BARELY, _BARELY):
        batch = resets(agent)
        batch.quaternion[:, :3], batch.quaternion[:, 3] = _long(beyond), 0.0
        done(agent.reset(batch), f"a quaternion of squared length 1 {beyond:+g}")
    for quaternion in ((*_long(-_TOO_FAR), 0.0), (*_long(_TOO_FAR), 0.0), (0.0, 0.0, 0.0, 0.0)):
        _refused_reset(agent, "quaternion", RefusalCode.NOT_UNIT, _QUATERNION, quaternion)


@server_rule("refusal-reserved", Level.CORE, "7", "code 4: a reserved word is not zero, compared as bits")
def refusal_reserved(rig: Rig) -> None:
    """Each reserved word of both rows; -0.0 is not zero there."""
    agent = _ready(rig)
    for value in (1, _MINUS_ZERO):
        for word in _COMMAND_RESERVED:
            _refused_step(agent, f"word {word} of a command row", RefusalCode.RESERVED, word, value)
        for word in range(_PARAMETERS + len(PARAMETERS), RESET_WORDS):
            _refused_reset(agent, f"word {word} of a reset row", RefusalCode.RESERVED, word, value)


@server_rule("refusal-not-reset", Level.CORE, "7", "code 5: a step while a lane was never reset")
def refusal_not_reset(rig: Rig) -> None:
    """The first lane that was never reset is named, until all of them were."""
    agent = rig.open(lanes=3)
    refused(agent.step(commands(agent)), "a step before any reset", RefusalCode.NOT_RESET, 0)
    done(agent.reset(resets(agent, [0, 2])), "a reset of lanes 0 and 2")
    refused(agent.step(commands(agent)), "a step with lane 1 never reset", RefusalCode.NOT_RESET, 1)
    done(agent.reset(resets(agent, [1])), "a reset of lane 1")
    fly(agent, commands(agent), 1)


@server_rule("refusal-not-reset-first", Level.CORE, "7", "NOT_RESET is reported before every other fault")
def refusal_not_reset_first(rig: Rig) -> None:
    """An unsound command in an earlier lane does not hide a lane that was never reset."""
    agent = rig.open(lanes=3)
    done(agent.reset(resets(agent, [0, 1])), "a reset of lanes 0 and 1")
    batch = commands(agent)
    batch.speed[0] = math.nan
    refused(agent.step(batch), "a NaN in lane 0, and lane 2 never reset", RefusalCode.NOT_RESET, 2)


@server_rule(
    "refusal-unknown-tube",
    Level.CORE,
    "7",
    "code 6: a reset or a release names a tube that is not registered",
)
def refusal_unknown_tube(rig: Rig) -> None:
    """An index within the slots, one beyond them, and one below -1."""
    agent = _ready(rig)
    for tube in (0, agent.settings.tube_slots, -2):
        _refused_reset(agent, "tube", RefusalCode.UNKNOWN_TUBE, _TUBE, tube)
    refused(release(agent, 0), "release of a free index", RefusalCode.UNKNOWN_TUBE, -1)


@server_rule("refusal-tube-slot-release", Level.CORE, "7", "code 7: release of an index outside of the slots")
def refusal_tube_slot_release(rig: Rig) -> None:
    """Both ends of the slots."""
    agent = _ready(rig)
    for index in (-1, agent.settings.tube_slots):
        refused(release(agent, index), f"release of index {index}", RefusalCode.TUBE_SLOT, -1)


@server_rule(
    "refusal-tube-slot-register",
    Level.CORE,
    "7",
    "code 7: registration outside of the slots or of a taken index",
)
def refusal_tube_slot_register(rig: Rig) -> None:
    """Both ends of the slots, and an index that is taken until it is released."""
    agent = _ready(rig)
    box = take_box(agent, rig.folder)
    for index in (-1, agent.settings.tube_slots, 0):
        refused(register(agent, index, box), f"registration of index {index}", RefusalCode.TUBE_SLOT, -1)
    done(release(agent, 0), "release of index 0")
    done(register(agent, 0, box), "registration of the released index")
    done(register(agent, agent.settings.tube_slots - 1, box), "the same file under the last index")


@server_rule("refusal-tube-in-use", Level.CORE, "7", "code 8: release of a tube that a lane flies in")
def refusal_tube_in_use(rig: Rig) -> None:
    """The first lane in it is named; once all of them have left it may be released."""
    agent = _ready(rig)
    take_box(agent, rig.folder)
    batch = resets(agent, [1, 2])
    batch.tube[:] = 0
    done(agent.reset(batch), "a reset of lanes 1 and 2 into the tube")
    refused(release(agent, 0), "release with lanes 1 and 2 in the tube", RefusalCode.TUBE_IN_USE, 1)
    done(agent.reset(resets(agent, [1])), "a reset of lane 1 out of it")
    refused(release(agent, 0), "release with lane 2 in the tube", RefusalCode.TUBE_IN_USE, 2)
    done(agent.reset(resets(agent, [2])), "a reset of lane 2 out of it")
    done(release(agent, 0), "release of the empty tube")


@server_rule("refusal-malformed", Level.CORE, "7", "code 9: axes or path of a registration cannot be read")
def refusal_malformed(rig: Rig) -> None:
    """Axes that are neither 0 nor 1; a path that is empty, too long, no UTF-8, or has a zero byte."""
    agent = _ready(rig)
    box = take_box(agent, rig.folder)
    for axes in (2, -1):
        refused(register(agent, 1, box, axes), f"axes {axes}", RefusalCode.MALFORMED, -1)
    length = len(str(box).encode())
    for what, words in (
        ("an empty path", {"tube_path_bytes": 0}),
        ("a path of -1 bytes", {"tube_path_bytes": -1}),
        ("a path of 4097 bytes", {"tube_path_bytes": 4097}),
        ("a path that is no UTF-8", {"tube_path": b"/\xff\xfe", "tube_path_bytes": 3}),
        ("a path with a zero byte", {"tube_path_bytes": length + 1, "tube_path": str(box).encode() + b"\0"}),
    ):
        put_tube(agent, 1, box)
        agent.put(**words)
        refused(agent.ask(Op.REGISTER_TUBE), what, RefusalCode.MALFORMED, -1)
    done(register(agent, 1, box), "a sound registration after the refusals")


@server_rule("refusal-tube-scale", Level.CORE, "7", "code 2: a scale that is not a finite number > 0")
def refusal_tube_scale(rig: Rig) -> None:
    """Nothing, less than nothing, and what is no number."""
    agent = _ready(rig)
    box = take_box(agent, rig.folder)
    for scale in (0.0, -1.0, *_NOT_NUMBERS):
        refused(register(agent, 1, box, scale=scale), f"scale {scale}", RefusalCode.OUT_OF_RANGE, -1)


@server_rule("refusal-plant", Level.CORE, "7", "code 10: no such file, another hash, no mesh")
def refusal_plant(rig: Rig) -> None:
    """A plant with walls reads the file that it is named."""
    agent = _ready(rig)
    if not has_walls(agent):
        raise Skip("the plant has no walls, and need not read a tube's file")
    box = take_box(agent, rig.folder)
    missing, empty, folder = rig.folder / "missing.obj", rig.folder / "empty.obj", rig.folder / "folder.obj"
    empty.write_text("# nothing\n", encoding="ascii")
    folder.mkdir()
    for what, path in (("a missing file", missing), ("a file without a face", empty), ("a folder", folder)):
        refused(register(agent, 1, path), what, RefusalCode.PLANT, -1)
    put_tube(agent, 1, box, sha256=bytes(32))
    refused(agent.ask(Op.REGISTER_TUBE), "another hash", RefusalCode.PLANT, -1)
    done(register(agent, 1, box), "a sound registration after the refusals")


@server_rule("refusal-moves-nothing", Level.CORE, "7", "a refused step integrates nothing, in any lane")
def refusal_moves_nothing(rig: Rig) -> None:
    """The pose rows are the last ones, and the flight goes on as if nobody had asked."""
    agent, undisturbed = _ready(rig), rig.open(lanes=3)
    done(undisturbed.reset(resets(undisturbed)), "a reset")
    moving = commands(agent, speed=0.5 * speed_max(agent), compensation=0.5)
    fly(agent, moving, 2)
    before = agent.poses()
    _refused_step(agent, "speed in lane 1", RefusalCode.NOT_FINITE, _SPEED, math.nan)
    same_bits("poses after a refused step", agent.poses(), before)
    same_bits("the step after it", fly(agent, moving, 1)[-1], fly(undisturbed, moving, 3)[-1])


@server_rule(
    "refusal-resets-nothing", Level.CORE, "7", "a refused reset moves no lane, not the sound ones before it"
)
def refusal_resets_nothing(rig: Rig) -> None:
    """Lane 0 is sound and lane 1 is not: lane 0 flies on as it did."""
    agent, undisturbed = _ready(rig), rig.open(lanes=3)
    done(undisturbed.reset(resets(undisturbed)), "a reset")
    moving = commands(agent, speed=0.5 * speed_max(agent), compensation=0.5)
    fly(agent, moving, 2)
    before = agent.poses()

    batch = resets(agent)
    batch.position[:], batch.parameters[:, PARAMETER_INDEX["gravity"]] = 5.0, -3.0
    batch.quaternion[LANE] = 0.0
    refused(agent.reset(batch), "a reset with an unsound lane 1", RefusalCode.NOT_UNIT, LANE)
    same_bits("poses after a refused reset", agent.poses(), before)
    same_bits("the step after it", fly(agent, moving, 1)[-1], fly(undisturbed, moving, 3)[-1])


@server_rule("refusal-recovery", Level.CORE, "7", "after a refusal the session goes on")
def refusal_recovery(rig: Rig) -> None:
    """Ten refusals of every kind of request, each with a step behind it."""
    agent = _ready(rig)
    for number in range(10):
        expect("step of the session", agent.steps, number)
        agent.put(tube_index=agent.settings.tube_slots)
        for op in (Op.REGISTER_TUBE, Op.RELEASE_TUBE):
            demand(agent.ask(op).refused is not None, op.name.lower(), "a refusal", "status 0")
        _refused_step(agent, "compensation", RefusalCode.OUT_OF_RANGE, _COMPENSATION, 3.0)
        fly(agent, commands(agent), 1)
