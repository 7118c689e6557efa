"""Ctrl-C, SIGTERM and a terminal that was closed: each ends the command in order, and none of them is lost.

What a signal raises may be swallowed, by a library's import or by a callback of compiled code. So it is remembered,
and raised again: by `check`, by the next signal, and by a timer where we know that it was swallowed. While the
command is being ended, another signal raises nothing, which would cut the cleaning up short: it hurries it instead.
"""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from dataclasses import dataclass
from types import FrameType
from typing import Final

from cosim.errors import HungUp, Terminated

SIGNALS: Final = {signal.SIGINT: KeyboardInterrupt, signal.SIGTERM: Terminated, signal.SIGHUP: HungUp}
"""What each of them raises."""
AGAIN_SECONDS: Final = 0.05
"""From an exception that was swallowed or held back to the next attempt."""
_CALLBACKS: Final = "llvmlite/binding/executionengine.py"


@dataclass
class _Came:
    """The first signal that came, if any did, and whether there was another while the command was being ended."""

    number: signal.Signals | None = None
    again: bool = False
    terminals: tuple[int, ...] = ()
    """Those of stdout and stderr that were a terminal at the beginning."""


_came = _Came()


def listen() -> None:
    """Let the signals end the command from here on; a hangup that is ignored, as under `nohup`, stays so."""
    for number in SIGNALS:
        if number is not signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _take)
    signal.signal(signal.SIGALRM, _raise_again)
    _came.terminals = tuple(stream for stream in (1, 2) if os.isatty(stream))
    sys.unraisablehook = _notice_swallowed


def ignore() -> None:
    """Ignore the signals from here on: the command has ended, and only the interpreter has not."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    # Where Ctrl-C broke off code that was given as a string, as dataclasses make theirs at an import, `python -m`
    # would kill itself by SIGINT at its exit, whatever the status. The next such code that ends makes it forget.
    exec("")


def pending() -> signal.Signals | None:
    """The signal that the command is to end with, if one came."""
    return _came.number


def hurried() -> bool:
    """Whether somebody asked a second time, so that nothing is to be waited for with patience."""
    return _came.again


def check() -> None:
    """Raise what is to end the command, if anything is; cheap enough for every step."""
    if _came.number is not None:
        raise SIGNALS[_came.number]


def _take(number: int, frame: FrameType | None) -> None:
    if _called_by_compiler(frame):
        _came.number = _came.number or signal.Signals(number)
        signal.setitimer(signal.ITIMER_REAL, AGAIN_SECONDS)
        return
    if _is_ending():
        _came.again = True
        with suppress(OSError):  # print() could come into its own way here
            os.write(2, b"cosim: ending, a moment\n")
        return
    if _came.number is None:
        _came.number = signal.Signals(number)
    if number == signal.SIGHUP:
        _leave_terminal()
    check()


def _leave_terminal() -> None:
    """Write to nowhere what went to a terminal that is gone: its errors would come between us and the cleaning."""
    for stream in _came.terminals:
        if not os.isatty(stream):
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, stream)
            os.close(null)


def _is_ending() -> bool:
    """Whether what a signal raised is being handled where this one came."""
    error = sys.exception()
    while error is not None:
        if isinstance(error, tuple(SIGNALS.values())):
            return True
        error = error.__context__
    return False


def _called_by_compiler(frame: FrameType | None) -> bool:
    """Whether a callback of LLVM's is at work, which swallows an exception, or crashes of it."""
    while frame is not None:
        if frame.f_code.co_filename.endswith(_CALLBACKS):
            return True
        frame = frame.f_back
    return False


def _notice_swallowed(unraisable: sys.UnraisableHookArgs) -> None:
    """Of our own exceptions say nothing, but raise them again; of others, what Python always says."""
    if isinstance(unraisable.exc_value, tuple(SIGNALS.values())):
        signal.setitimer(signal.ITIMER_REAL, AGAIN_SECONDS)
    else:
        sys.__unraisablehook__(unraisable)


def _raise_again(_number: int, _frame: FrameType | None) -> None:
    if _came.number is not None and not _is_ending():
        signal.raise_signal(_came.number)  # which waits where signals are held back
