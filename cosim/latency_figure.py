"""The histogram of round trips as a PNG."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cosim.errors import CosimError, OutputError
from cosim.requirements import install_command
from cosim.round_trip import Samples

BINS = 120


def check_figure() -> None:
    """Make sure that a figure can be drawn.

    Raises:
        CosimError: matplotlib is not installed.
    """
    _matplotlib()


def draw_histogram(samples: Mapping[str, Samples], path: Path) -> None:
    """Draw how the round trips of each way are spread, one strip a way, the fastest on top.

    Args:
        samples: round trips of each way (us).
        path: of the PNG.

    Raises:
        CosimError: matplotlib is not installed.
        OutputError: the file cannot be written.
    """
    canvas, figure_class = _matplotlib()
    names = sorted(samples, key=lambda name: float(np.median(samples[name])))
    everything = np.concatenate([samples[name] for name in names])
    edges = np.geomspace(everything.min(), max(np.quantile(everything, 0.999), everything.min() * 10), BINS)
    figure = figure_class(figsize=(9.0, 0.6 + 0.42 * len(names)), layout="constrained")
    canvas(figure)
    axes = figure.add_subplot()
    for height, name in enumerate(reversed(names)):
        counts, _ = np.histogram(samples[name], edges)
        top = height + 0.9 * counts / max(1, counts.max())
        colour = "#1f6fb2" if name.startswith("session") else "#9a9a9a"
        axes.fill_between(edges[:-1], height, top, step="post", color=colour, linewidth=0.0)
        median = float(np.median(samples[name]))
        axes.plot([median, median], [height, height + 0.9], color="black", linewidth=1.0)
        axes.text(edges[-1], height + 0.2, f" {median:.3g} us", fontsize=8)
    axes.set_xscale("log")
    axes.set_yticks(np.arange(len(names)) + 0.4, list(reversed(names)), fontsize=8)
    axes.set_xlabel("round trip of one command and one pose (us); line: median")
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(left=False)
    try:
        figure.savefig(path, dpi=150)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error


def _matplotlib() -> tuple[Any, Any]:
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise CosimError(f"--png needs {error.name}; install it with: {install_command('bench')}") from error
    return FigureCanvasAgg, Figure
