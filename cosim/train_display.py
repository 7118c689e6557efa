"""How a training looks while it runs: one live line on a terminal, a plain line an iteration elsewhere."""

from __future__ import annotations

import math
import sys
from datetime import timedelta
from types import TracebackType
from typing import TYPE_CHECKING, Self

import click

if TYPE_CHECKING:
    from agent_client.training_log import Progress


class TrainingDisplay:
    """Level, success rate over the last 300 episodes, mean return, steps per second and time left, on stderr.

    Args:
        steps: control steps in all.
    """

    def __init__(self, steps: int) -> None:
        self._bar = None
        if sys.stderr is not None and sys.stderr.isatty():
            # rich draws bars and degrades on dumb terminals; imported only where a line is drawn.
            from rich.console import Console
            from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn

            self._bar = Progress(
                SpinnerColumn(),
                BarColumn(24),
                TextColumn("{task.fields[text]}"),
                console=Console(stderr=True),
                refresh_per_second=2,
            )
            self._task = self._bar.add_task("", total=steps, text="drawing tubes, compiling")

    def update(self, progress: Progress) -> None:
        """Show where the training is."""
        if self._bar is None:
            steps = f"{progress.steps:,} of {progress.total_steps:,} steps"
            click.echo(f"iteration {progress.iteration}  {steps}  {describe(progress)}", err=True)
        else:
            self._bar.update(
                self._task, completed=progress.steps, total=progress.total_steps, text=describe(progress)
            )

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()


def describe(progress: Progress) -> str:
    """What is told of an iteration, in one width; a dash where no episode has ended yet."""
    success = _number(100.0 * progress.success_rate, "5.1f")
    mean_return = _number(progress.mean_return, "7.1f")
    left = timedelta(seconds=round(progress.seconds_left))
    return (
        f"level {progress.level}  success {success} %  return {mean_return}  "
        f"{progress.steps_per_second:6,.0f} steps/s  {left} left"
    )


def _number(value: float, form: str) -> str:
    width = form.split(".")[0]
    return f"{'-':>{width}}" if math.isnan(value) else f"{value:{form}}"
