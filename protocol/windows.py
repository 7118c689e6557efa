"""What Windows does otherwise: whether a process lives, how a file is claimed, and when it can be removed.

Imported there alone. Written by the documentation of the system's calls and tested against stand-ins for them.
"""

from __future__ import annotations

import ctypes
import msvcrt
import os
import sys
import time
from pathlib import Path
from typing import Final

assert sys.platform == "win32"  # mypy reads on for that platform alone

REMOVAL_S: Final = 1.0
"""How long a file that is to be removed is given to lose its other users."""
_RETRY_S: Final = 0.01

_QUERY_LIMITED_INFORMATION: Final = 0x1000
_SYNCHRONIZE: Final = 0x100000
_WAIT_TIMEOUT: Final = 0x102
_ACCESS_DENIED: Final = 5
_LARGEST_PID: Final = 2**32 - 1

_kernel = ctypes.WinDLL("kernel32", use_last_error=True)
_kernel.OpenProcess.argtypes = (ctypes.c_uint32, ctypes.c_int, ctypes.c_uint32)
_kernel.OpenProcess.restype = ctypes.c_void_p
_kernel.WaitForSingleObject.argtypes = (ctypes.c_void_p, ctypes.c_uint32)
_kernel.WaitForSingleObject.restype = ctypes.c_uint32
_kernel.GetProcessTimes.argtypes = (ctypes.c_void_p, *(ctypes.POINTER(ctypes.c_uint64),) * 4)
_kernel.CloseHandle.argtypes = (ctypes.c_void_p,)


def process(pid: int) -> tuple[bool, int]:
    """Whether a process lives, and when it was created (100 ns since 1601; 0 where that is not known).

    (`os.kill(pid, 0)` would send it Ctrl-C.)
    """
    if not 0 < pid <= _LARGEST_PID:
        return False, 0
    handle = _kernel.OpenProcess(_QUERY_LIMITED_INFORMATION | _SYNCHRONIZE, False, pid)
    if not handle:
        return ctypes.get_last_error() == _ACCESS_DENIED, 0  # another user's lives as well
    try:
        # A process that has ended keeps its number for as long as somebody has a handle to it.
        alive = _kernel.WaitForSingleObject(handle, 0) == _WAIT_TIMEOUT
        created, *others = (ctypes.c_uint64() for _ in range(4))
        known = _kernel.GetProcessTimes(
            handle, ctypes.byref(created), *(ctypes.byref(other) for other in others)
        )
        return alive, created.value if known else 0
    finally:
        _kernel.CloseHandle(handle)


def lock_file(descriptor: int) -> bool:
    """Claim byte 0 of a file until it is closed; False where another process has it."""
    os.lseek(descriptor, 0, os.SEEK_SET)
    try:
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
    except OSError:
        return False
    return True


def remove_file(path: Path) -> bool:
    """Remove a file that is closed here, once nobody else maps it; False where somebody still does."""
    patience = time.monotonic() + REMOVAL_S
    while True:
        try:
            path.unlink(missing_ok=True)
        except PermissionError:
            if time.monotonic() > patience:
                return False
            time.sleep(_RETRY_S)
        else:
            return True
