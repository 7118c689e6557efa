"""Whether a session's steps go by machine code (`compiled.py`) or by the standard library; both do the same.

The environment variable PROTOCOL_EXCHANGE says which, on each side for itself:

    auto       machine code where it costs no start-up: there are two cores, and the process has loaded numba anyway
    compiled   machine code; numba is loaded for it, which takes some tenths of a second, and once a second or two
    stdlib     the standard library

Loading numba takes as long as machine code saves in some 100,000 steps, so that it is never loaded unasked; nor
does a physics process compile unasked, for an agent waits for it. Which way was taken, and why, is logged and
stands in `exchange` of either session.
"""

from __future__ import annotations

import logging
import os
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Final

from protocol.errors import SessionError

if TYPE_CHECKING:
    from protocol.compiled import Kernels

ENVIRONMENT: Final = "PROTOCOL_EXCHANGE"
AUTO: Final = "auto"
COMPILED: Final = "compiled"
STDLIB: Final = "stdlib"

_log = logging.getLogger("protocol")


@dataclass(frozen=True)
class Choice:
    """The machine code of a session, or None, and why."""

    kernels: Kernels | None
    why: str

    def __str__(self) -> str:
        return f"{COMPILED if self.kernels else STDLIB} ({self.why})"


def choose(who: str, *, may_compile: bool) -> Choice:
    """Choose for a session of `who` ("agent" or "physics"), load what that takes, and log it.

    Args:
        who: for the log.
        may_compile: whether time may be taken to compile, where no earlier process has kept machine code.

    Raises:
        SessionError: the environment variable has another value, or demands machine code that cannot be had.
    """
    wish = os.environ.get(ENVIRONMENT, AUTO)
    if wish not in (AUTO, COMPILED, STDLIB):
        raise SessionError(f"{ENVIRONMENT}: expected {AUTO}, {COMPILED} or {STDLIB}, found {wish!r}")
    obstacle = _obstacle(wish)
    choice = Choice(None, obstacle) if obstacle else _load(may_compile or wish == COMPILED)
    if wish == COMPILED and choice.kernels is None:
        raise SessionError(f"{ENVIRONMENT}: {COMPILED} cannot be had, {choice.why}; or unset it")
    _log.info("%s exchanges steps by %s", who, choice)
    return choice


def _obstacle(wish: str) -> str:
    """Why machine code is not even tried, or nothing."""
    if wish == STDLIB:
        return f"{ENVIRONMENT} says so"
    if find_spec("numba") is None:
        return "numba is not installed: pip install numba"
    if wish == COMPILED:
        return ""
    if _cores() < 2:
        return "this process has one core"
    if "numba" not in sys.modules:
        return f"this process has no other use for numba; {ENVIRONMENT}={COMPILED} loads it all the same"
    return ""


def _load(may_compile: bool) -> Choice:
    try:
        from protocol.compiled import VERSION, load_kernels

        return Choice(load_kernels(may_compile), f"numba {VERSION}")
    except Exception as error:  # noqa: BLE001  whatever is wrong with numba, sessions work without it
        return Choice(None, f"numba cannot be used: {type(error).__name__}: {error}")


def _cores() -> int:
    """Cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
