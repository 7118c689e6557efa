"""The one way in which functions of this package are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

from numba import njit

P = ParamSpec("P")
T = TypeVar("T")


def compiled(function: Callable[P, T]) -> Callable[P, T]:
    """Compiles at the first call and keeps the machine code beside the source for later processes.

    No fast mathematics and no threads, so that results are the same twice; a division by zero gives infinity,
    as in numpy. The decorated function keeps its types, which numba's own decorator loses.
    """
    machine: Callable[P, T] = njit(cache=True, error_model="numpy")(function)
    return machine
