"""Ctrl-C and SIGTERM that are not lost: remembered when they come, for where the exception itself is swallowed.

An import of a library, or a callback of the interpreter's, may catch whatever is raised in it.
"""

from __future__ import annotations

_pending: list[type[BaseException]] = []


def remember(error: type[BaseException]) -> None:
    """Note that the command is to end with this error."""
    _pending.append(error)


def check() -> None:
    """Raise what is to end the command, if anything is; cheap enough for every step."""
    if _pending:
        raise _pending[0]
