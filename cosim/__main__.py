"""The console script `cosim`, which is `python -m cosim` as well.

Ctrl-C is answered from here on: importing the command takes a few tenths of a second, in which Python's own answer
would be a traceback.
"""

from __future__ import annotations

import os
import signal
from types import FrameType


def main() -> None:
    """Import the command and run it."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave_at_once)  # a hangup does so by itself
    from cosim.cli import main as run  # it has handlers of its own

    run()


def _leave_at_once(number: int, _frame: FrameType | None) -> None:
    """End with the status that a shell gives to a signal; nothing has begun that could be left behind."""
    os._exit(128 + number)


if __name__ == "__main__":
    main()
