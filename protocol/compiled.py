"""A step's exchange in machine code: publish, wait and take in by one call on either side. Optional.

The only importer of numba in this package; `compiled_choice` says whether a session has it. It knows the ordinary
course alone: a sound step request, and a reply that says done. Whatever else stands in the segments is left to the
two sessions, which look at the same words again and say what is wrong.

Doorbells are read with acquire and written with release ordering, and fences stand where an observer needs them
(`README.md`, sections 11 and 12), so that this is right on processors that reorder, too. The interpreter's lock is
kept: a call polls for a few microseconds, and whoever gives the lock away may wait 5 ms to get it back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np
from llvmlite import ir
from numba import __version__, njit, types
from numba.core.cgutils import raw_memcpy
from numba.core.event import Event, Listener, install_listener
from numba.extending import intrinsic

from protocol.layout import COMMAND, POSE, WORD, Op, Status, command_rows, pose_rows
from protocol.plant import CommandBatch, PoseBatch
from protocol.validation import COMPENSATION_MAX, UNIT_TOLERANCE

VERSION: Final[str] = __version__
"""Of numba."""
POLLS_PER_POLL: Final = 250
"""Polls of a compiled loop in the time of one poll in Python."""

_STEP: Final = Op.STEP.value
_DONE: Final = Status.DONE.value

# Words of a desk: addresses and sizes that the machine code works with. They are data, not code, because numba
# knows no better than this file's date whether machine code that it kept still fits.
_REQUEST_BELL: Final = 0
_REQUEST: Final = 1  # begin, op, step, end follow each other
_WIRE_COMMANDS: Final = 2
_OWN_COMMANDS: Final = 3
_COMMAND_WORDS: Final = 4
_REPLY_BELL: Final = 5
_REPLY: Final = 6  # begin, status, step, engine_ns, end follow each other
_WIRE_POSES: Final = 7
_OWN_POSES: Final = 8
_POSE_WORDS: Final = 9
_SPEED_MAX: Final = 10
_COMPENSATION_MAX: Final = 11
_UNIT_TOLERANCE: Final = 12
_DESK_WORDS: Final = 13

_FOUR_INTEGERS: Final = "int64(int64, int64, int64, int64)"
_COMMAND_ROW: Final = 8
"""Words of a command row: direction of 3, speed, compensation, 3 reserved."""


class NotCompiledYetError(Exception):
    """There is no machine code from an earlier run, and none may be made now."""


@dataclass(frozen=True)
class Kernels:
    """The machine code; arguments and results are integers, the first one a desk's address."""

    exchange: Callable[[int, int, int, int], int]
    """Agent: (desk, number, due, polls) -> publish step request `number`; engine_ns, 0 or more, if the reply is in
    and says done, else -1."""
    take: Callable[[int, int, int, int], int]
    """Physics: (desk, number, due, polls) -> 1 if step request `number` is there, copied and sound, else 0."""
    publish: Callable[[int, int, int, int], int]
    """Physics: (desk, number, step, engine_ns) -> 1 and the reply is published, or 0 if the request has changed."""

    def desk(
        self,
        command: memoryview,
        pose: memoryview,
        commands: CommandBatch,
        poses: PoseBatch,
        speed_max: float,
    ) -> Desk:
        """A desk for one side of a session: its segments, its own batches, and the plant's limit."""
        return Desk(self, command, pose, commands, poses, speed_max)


class Desk:
    """One side's machine code, and where it finds the two segments and the private copies of what is in them.

    The segments must stay mapped for as long as it is used.
    """

    def __init__(
        self,
        kernels: Kernels,
        command: memoryview,
        pose: memoryview,
        commands: CommandBatch,
        poses: PoseBatch,
        speed_max: float,
    ) -> None:
        self.exchange, self.take, self.publish = kernels.exchange, kernels.take, kernels.publish
        self.polls_per_poll = POLLS_PER_POLL
        words = np.zeros(_DESK_WORDS, dtype=np.int64)
        lanes = len(poses.raw)
        request, reply = _address_of(command), _address_of(pose)
        words[_REQUEST_BELL] = request + COMMAND["doorbell"].offset
        words[_REQUEST] = request + COMMAND["begin"].offset
        words[_WIRE_COMMANDS] = request + command_rows(lanes).start
        words[_COMMAND_WORDS] = commands.raw.size
        words[_REPLY_BELL] = reply + POSE["doorbell"].offset
        words[_REPLY] = reply + POSE["begin"].offset
        words[_WIRE_POSES] = reply + pose_rows(lanes).start
        words[_OWN_POSES] = poses.raw.ctypes.data
        words[_POSE_WORDS] = poses.raw.size
        words[_SPEED_MAX:].view(np.float64)[:] = speed_max, COMPENSATION_MAX, UNIT_TOLERANCE
        self.address = int(words.ctypes.data)
        self._words, self._poses = words, poses
        self.use_commands(commands)

    def use_commands(self, commands: CommandBatch) -> None:
        """Send, or take, commands from now on by this batch."""
        self._commands = commands
        self._words[_OWN_COMMANDS] = commands.raw.ctypes.data


@cache
def load_kernels(may_compile: bool) -> Kernels:
    """Load the machine code that an earlier process left, or compile it, which takes a second or two.

    Raises:
        NotCompiledYetError: there is none, and `may_compile` is False.
        RuntimeError: numba finds no folder in which machine code can be kept.
    """
    with install_listener("numba:compile", _Compiling(may_compile)):
        # What `compile` returns takes integers alone and skips numba's look at the types of its arguments,
        # which takes as long as all the rest of a call.
        return Kernels(
            *(njit(cache=True)(function).compile(_FOUR_INTEGERS) for function in (_exchange, _take, _publish))
        )


class _Compiling(Listener):  # type: ignore[misc]  # numba carries no types
    """Stops numba where it would begin to compile and may not."""

    def __init__(self, may: bool) -> None:
        self._may = may

    def on_start(self, event: Event) -> None:
        if not self._may:
            raise NotCompiledYetError("no machine code was kept by an earlier run")

    def on_end(self, event: Event) -> None:
        """Nothing to note."""


def _address_of(view: memoryview) -> int:
    return int(np.frombuffer(view, np.uint8).ctypes.data)


def _word_pointer(builder: Any, address: Any) -> Any:
    return builder.inttoptr(address, ir.IntType(64).as_pointer())


@intrinsic
def _load(_typing: Any, address: Any) -> Any:
    """The integer at an address."""

    def code(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.load(_word_pointer(builder, arguments[0]))

    return types.int64(types.int64), code


@intrinsic
def _load_float(_typing: Any, address: Any) -> Any:
    """The number at an address."""

    def code(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.load(builder.inttoptr(arguments[0], ir.DoubleType().as_pointer()))

    return types.float64(types.int64), code


@intrinsic
def _store(_typing: Any, address: Any, value: Any) -> Any:
    """Write an integer to an address."""

    def code(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        builder.store(arguments[1], _word_pointer(builder, arguments[0]))
        return context.get_dummy_value()

    return types.void(types.int64, types.int64), code


@intrinsic
def _load_acquire(_typing: Any, address: Any) -> Any:
    """The doorbell at an address: what is read behind it is at least as new."""

    def code(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.load_atomic(_word_pointer(builder, arguments[0]), "acquire", WORD)

    return types.int64(types.int64), code


@intrinsic
def _store_release(_typing: Any, address: Any, value: Any) -> Any:
    """Ring the doorbell at an address: what was written before is seen before."""

    def code(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        builder.store_atomic(arguments[1], _word_pointer(builder, arguments[0]), "release", WORD)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64), code


@intrinsic
def _release_fence(_typing: Any) -> Any:
    """Let no later write be seen before an earlier one; no instruction at all on x86."""

    def code(context: Any, builder: Any, _signature: Any, _arguments: Any) -> Any:
        builder.fence("release")
        return context.get_dummy_value()

    return types.void(), code


@intrinsic
def _copy(_typing: Any, to: Any, source: Any, words: Any) -> Any:
    """Copy words between addresses as the C library does: a loop over words takes three times as long."""

    def code(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        octet = ir.IntType(8).as_pointer()
        places = [builder.inttoptr(address, octet) for address in arguments[:2]]
        raw_memcpy(builder, *places, arguments[2], WORD)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64), code


@njit(inline="always")
def _at(desk: int, word: int) -> int:
    """A word of the desk."""
    return _load(desk + WORD * word)  # type: ignore[no-any-return]


@njit(inline="always")
def _rings(bell: int, number: int, polls: int) -> bool:
    """Whether a doorbell shows `number` within so many polls; any other change ends the polling too."""
    before = number - 1
    value = before
    for _ in range(polls):
        value = _load_acquire(bell)
        if value != before:
            break
    return value == number


def _exchange(desk: int, number: int, due: int, polls: int) -> int:
    request = _at(desk, _REQUEST)
    _store(request, number)
    _release_fence()
    _copy(_at(desk, _WIRE_COMMANDS), _at(desk, _OWN_COMMANDS), _at(desk, _COMMAND_WORDS))
    _store(request + WORD, _STEP)
    _store(request + 2 * WORD, due)
    _release_fence()
    _store(request + 3 * WORD, number)
    _store_release(_at(desk, _REQUEST_BELL), number)
    if not _rings(_at(desk, _REPLY_BELL), number, polls):
        return -1
    _copy(_at(desk, _OWN_POSES), _at(desk, _WIRE_POSES), _at(desk, _POSE_WORDS))
    reply = _at(desk, _REPLY)
    if (
        _load(reply) != number
        or _load(reply + WORD) != _DONE
        or _load(reply + 2 * WORD) != due
        or _load(reply + 4 * WORD) != number
    ):
        return -1
    return _load(reply + 3 * WORD)  # type: ignore[no-any-return]


def _take(desk: int, number: int, due: int, polls: int) -> int:
    if not _rings(_at(desk, _REQUEST_BELL), number, polls):
        return 0
    own, words, request = _at(desk, _OWN_COMMANDS), _at(desk, _COMMAND_WORDS), _at(desk, _REQUEST)
    _copy(own, _at(desk, _WIRE_COMMANDS), words)
    if (
        _load(request) != number
        or _load(request + WORD) != _STEP
        or _load(request + 2 * WORD) != due
        or _load(request + 3 * WORD) != number
    ):
        return 0
    return int(_all_are_sound(desk, own, own + WORD * words))


def _publish(desk: int, number: int, step: int, engine_ns: int) -> int:
    if _load_acquire(_at(desk, _REQUEST_BELL)) != number or _load(_at(desk, _REQUEST)) != number:
        return 0
    reply = _at(desk, _REPLY)
    _store(reply, number)
    _release_fence()
    _copy(_at(desk, _WIRE_POSES), _at(desk, _OWN_POSES), _at(desk, _POSE_WORDS))
    _store(reply + WORD, _DONE)
    _store(reply + 2 * WORD, step)
    _store(reply + 3 * WORD, engine_ns)
    _release_fence()
    _store(reply + 4 * WORD, number)
    _store_release(_at(desk, _REPLY_BELL), number)
    return 1


@njit(inline="always")
def _all_are_sound(desk: int, rows: int, end: int) -> bool:
    """`validation.commands_are_sound`; NaN fails every comparison."""
    speed_max = _load_float(desk + WORD * _SPEED_MAX)
    compensation_max = _load_float(desk + WORD * _COMPENSATION_MAX)
    tolerance = _load_float(desk + WORD * _UNIT_TOLERANCE)
    for row in range(rows, end, WORD * _COMMAND_ROW):
        x, y, z = _load_float(row), _load_float(row + WORD), _load_float(row + 2 * WORD)
        speed, compensation = _load_float(row + 3 * WORD), _load_float(row + 4 * WORD)
        reserved = _load(row + 5 * WORD) | _load(row + 6 * WORD) | _load(row + 7 * WORD)
        if not (
            -tolerance <= x * x + y * y + z * z - 1.0 <= tolerance
            and 0.0 <= speed <= speed_max
            and 0.0 <= compensation <= compensation_max
            and reserved == 0
        ):
            return False
    return True
