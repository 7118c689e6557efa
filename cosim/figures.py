"""The paper's two figures of a training: success rate and mean return by iteration, level changes marked."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from agent_client.curriculum import THRESHOLDS
from agent_client.training_log import Progress, read_log
from cosim.errors import CosimError, OutputError
from cosim.requirements import install_command

SUCCESS: Final = "success.png"
RETURN: Final = "return.png"

_INK: Final = {"success": "#1f6fb2", "return": "#2e8b57"}


def draw_figures(log: Path, folder: Path) -> tuple[Path, Path]:
    """Draw both figures from the log of a training, which may still run.

    Args:
        log: from `agent_client.training`.
        folder: where to put them.

    Returns:
        The paths of the figure of the success rate and of the one of the return.

    Raises:
        TrainingError: there is no log.
        CosimError: it has no iteration yet, or matplotlib is not installed.
        OutputError: a figure cannot be written.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise CosimError(f"figures need {error.name}; install it with: {install_command('train')}") from error
    rows = read_log(log)
    if not rows:
        raise CosimError(f"{log}: expected at least one iteration to draw, found none")
    paths = folder / SUCCESS, folder / RETURN
    for path, kind in zip(paths, ("success", "return"), strict=True):
        figure = Figure(figsize=(8.0, 4.5), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        _draw(axes, rows, kind)
        try:
            figure.savefig(path, dpi=150)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error
    return paths


def _draw(axes: Any, rows: Sequence[Progress], kind: str) -> None:
    """Draw one figure: what each iteration gave, and the levels."""
    iteration = np.array([row.iteration for row in rows])
    scale = 100.0 if kind == "success" else 1.0
    value = scale * np.array([getattr(row, f"batch_{kind}") for row in rows])
    axes.plot(iteration, value, color=_INK[kind], linewidth=1.6, label="episodes that ended in the iteration")
    if kind == "success":
        axes.set(ylabel="success rate (%)", ylim=(-2.0, 120.0), title="Success rate in training")
        axes.set_yticks(range(0, 101, 20))
        _draw_thresholds(axes, rows)
    else:
        axes.set(ylabel="mean return of an episode", title="Mean return in training")
        axes.margins(y=0.2)
    axes.set(xlabel=f"iteration ({rows[0].steps:,} control steps each)", xlim=_limits(iteration))
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.grid(alpha=0.25)
    _mark_levels(axes, rows)
    axes.legend(loc="lower right", framealpha=0.9)


def _limits(iteration: np.ndarray[Any, np.dtype[np.int64]]) -> tuple[float, float]:
    first, last = int(iteration[0]), int(iteration[-1])
    return first - 0.5, last + 0.5


def _spans(rows: Sequence[Progress]) -> list[tuple[int, float, float]]:
    """(level, first iteration, last iteration) of each stay at a level, widened by half an iteration."""
    spans: list[tuple[int, float, float]] = []
    for row in rows:
        if spans and spans[-1][0] == row.level:
            spans[-1] = (row.level, spans[-1][1], row.iteration + 0.5)
        else:
            spans.append((row.level, row.iteration - 0.5, row.iteration + 0.5))
    return spans


def _mark_levels(axes: Any, rows: Sequence[Progress]) -> None:
    """A line at every change of level, and the level's name at the top of its stay."""
    for level, begin, end in _spans(rows):
        if begin > rows[0].iteration:
            axes.axvline(begin, color="black", linestyle="--", linewidth=1.0)
        axes.axvspan(begin, end, color="black", alpha=0.03 * level, linewidth=0.0)
        axes.annotate(
            f"level {level}",
            (begin, 1.0),
            xycoords=axes.get_xaxis_transform(),
            xytext=(4, -4 - 11 * level),  # one below the other: a stay may be shorter than its name
            textcoords="offset points",
            va="top",
            fontsize=9,
        )


def _draw_thresholds(axes: Any, rows: Sequence[Progress]) -> None:
    for level, begin, end in _spans(rows):
        axes.plot(
            (begin, end),
            [100.0 * THRESHOLDS[level]] * 2,
            color="#c0392b",
            linestyle=":",
            linewidth=1.5,
            label="threshold of the level" if level == rows[0].level else None,
        )
