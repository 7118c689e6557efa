"""Signals held back while shared memory is made or removed, so that an interrupt cannot fall in between."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Final

_HELD: Final = tuple(
    signal.Signals[name] for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""Those that a user or a closed terminal ends a program with; Windows has no hangup."""


@contextmanager
def held_signals() -> Iterator[None]:
    """Hold SIGINT, SIGTERM and SIGHUP back; those that came are delivered at the end, out of the `with` statement.

    Only signals that a Python handler takes are held: the others end the process, or nothing, at once. Outside of
    the main thread it does nothing, since Python runs handlers in the main thread alone. A mask of the thread
    (`pthread_sigmask`) would not do: the system then gives the signal to another thread, such as one of NumPy's,
    and Python runs the handler in the main thread all the same.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    usual: dict[int, Any] = {n: signal.getsignal(n) for n in _HELD if callable(signal.getsignal(n))}
    came: list[int] = []
    holding = True

    def hold(number: int, frame: FrameType | None) -> None:
        if holding:
            came.append(number)
        else:  # an interrupt among the lines below has left this handler in place
            usual[number](number, frame)

    try:
        for number in usual:
            signal.signal(number, hold)
        yield
    finally:
        holding = False
        for number, handler in usual.items():
            signal.signal(number, handler)
        for number in came[:1]:  # the first one decides how the program ends, as it would have
            signal.raise_signal(number)
