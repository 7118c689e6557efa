"""Success over gain and gravity compensation as a picture, to show where no controller succeeds."""

from __future__ import annotations

import textwrap
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.errors import CosimError, OutputError
from cosim.pilots import TUNED_PURSUIT
from cosim.requirements import install_command

TITLE_SIZE: Final = 10
"""Of the figure's title (points)."""
CHARACTERS_PER_INCH: Final = 12
"""Of a title of this size, so that none is cut off at the sides."""


def require_matplotlib() -> None:
    """Refuse before anything is flown.

    Raises:
        CosimError: matplotlib is not installed.
    """
    if find_spec("matplotlib") is None:
        raise CosimError(f"--map needs matplotlib; install it with: {install_command('view')}")


def draw_map(path: Path, report: dict[str, Any]) -> None:
    """Draw one panel for each pilot and level, pilots side by side and levels below each other.

    Args:
        path: the .png to write.
        report: of an evaluation whose rows carry `gain` and `compensation`.

    Raises:
        OutputError: the file cannot be written.
    """
    from matplotlib.figure import Figure  # without pyplot: no display, and nothing global

    rows = report["rows"]
    names = list(dict.fromkeys(row["policy"] for row in rows))
    levels = sorted({row["level"] for row in rows})
    gains = sorted({row["gain"] for row in rows})
    compensations = sorted({row["compensation"] for row in rows})
    share = {(r["policy"], r["level"], r["gain"], r["compensation"]): 100.0 * r["success"] for r in rows}
    width, height = 1.5 + 0.62 * len(gains), 1.1 + 0.45 * len(compensations)
    figure = Figure(figsize=(width * len(names) + 1.0, height * len(levels) + 0.7), layout="constrained")
    panels = figure.subplots(len(levels), len(names), squeeze=False, sharex=True, sharey=True)
    for (i, j), panel in np.ndenumerate(panels):
        cells = np.array([[share[names[j], levels[i], g, c] for g in gains] for c in compensations])
        image = panel.imshow(cells, origin="lower", aspect="auto", cmap="viridis", vmin=0.0, vmax=100.0)
        for (y, x), value in np.ndenumerate(cells):
            shade = "black" if value > 55.0 else "white"
            panel.text(x, y, f"{value:.0f}", ha="center", va="center", color=shade, fontsize=9)
        panel.set_xticks(range(len(gains)), [f"{gain:g}" for gain in gains])
        panel.set_yticks(range(len(compensations)), [f"{c:g}" for c in compensations])
        name = "tuned Pure Pursuit" if names[j] == TUNED_PURSUIT else names[j]
        panel.set_title(f"{name}, level {levels[i]}", fontsize=10)
        if i == len(levels) - 1:
            panel.set_xlabel("gain k_v (1/s)")
        if j == 0:
            panel.set_ylabel("compensation c\n(weight)")
    figure.colorbar(image, ax=panels, label="success (%)", shrink=0.9)
    hard = ", hard conditions otherwise" if report["hard"] else ""
    title = (
        f"Success of {report['episodes']} flights a cell, engine {report['engine']}, seed {report['seed']}{hard}; "
        "Pure Pursuit tuned anew for every cell"
    )
    line = int(figure.get_figwidth() * CHARACTERS_PER_INCH)
    figure.suptitle(textwrap.fill(title, line), fontsize=TITLE_SIZE)
    try:
        figure.savefig(path, dpi=120)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror}") from error
