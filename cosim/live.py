"""On a terminal, and silent where stderr is none: the live line of a flight, a bar, a sign of work."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Final, Self

REFRESH_SECONDS: Final = 0.1


class LiveLine:
    """Progress along the tube, step rate and clearance, redrawn at most ten times a second."""

    def __init__(self, enabled: bool = True) -> None:
        self._progress = None
        self._due = 0.0
        self._seen = (time.monotonic(), 0)
        if enabled and sys.stderr is not None and sys.stderr.isatty():
            # rich draws bars and degrades on dumb terminals; imported only where a line is drawn.
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn

            self._progress = Progress(
                TextColumn("flying"),
                BarColumn(30),
                TextColumn("{task.percentage:5.1f} %  {task.fields[rate]}  {task.fields[clearance]}"),
                console=Console(stderr=True),
                auto_refresh=False,
                transient=True,
            )
            self._task = self._progress.add_task("", total=1.0, rate="", clearance="")

    def update(self, step: int, progress: float, clearance: float) -> None:
        """Say where the flight is; cheap when nothing is due."""
        if self._progress is None or (now := time.monotonic()) < self._due:
            return
        then, before = self._seen
        rate = (step - before) / (now - then) if now > then else 0.0
        self._progress.update(
            self._task,
            completed=progress,
            rate=f"{rate:6.0f} steps/s",
            clearance=f"clearance {clearance:5.2f} m",
        )
        self._progress.refresh()
        self._seen, self._due = (now, step), now + REFRESH_SECONDS

    def __enter__(self) -> Self:
        if self._progress is not None:
            self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._progress is not None:
            self._progress.stop()


@contextmanager
def counting(what: str, total: int) -> Iterator[Callable[[float], None]]:
    """A bar on a terminal that fills as it is told how much more was done; silent where stderr is none.

    Args:
        what: is done.
        total: of what will be done.
    """
    if sys.stderr is None or not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn(what), BarColumn(30), TextColumn("{task.percentage:3.0f} %"))
    with Progress(
        *columns, TimeElapsedColumn(), TimeRemainingColumn(), console=Console(stderr=True), transient=True
    ) as bar:
        task = bar.add_task("", total=total)
        yield lambda done: bar.advance(task, done)


@contextmanager
def working(what: str) -> Iterator[None]:
    """A sign on a terminal that something of unknown length is being done; silent where stderr is none."""
    if sys.stderr is None or not sys.stderr.isatty():
        yield
        return
    from rich.console import Console

    with Console(stderr=True).status(what):
        yield
