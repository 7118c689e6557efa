"""The pictures of `cosim inspect`: the profile of a tube by arc length, and the tube from three sides."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.errors import CosimError, OutputError
from meshes.inspection import Profile
from meshes.openings import Opening
from meshes.wall import Wall

_RADIUS: Final = "#1f6fb2"
_BAND: Final = "#a9cce8"
_CLEARANCE: Final = "#2e8b57"
_BODY: Final = "#444444"
_BEND: Final = "#b2561f"
_TORSION: Final = "#7a4fa3"
_WALL: Final = "#6f7f8f"
_OPENING: Final = "#c2185b"
_MARK: Final = "#c0392b"

MOST_FACES: Final = 30_000
"""Faces that a picture draws: of more, every so many."""
LEAST_WIDTH: Final = 0.4
"""Width of a panel, over that of the widest."""
LEAST_SPAN: Final = 0.05
"""Span of the colours at least, over the mean radius: rounding is no narrow place."""
_VIEWS: Final = (
    ("from above", 0, 1, "x (m)", "y (m)"),
    ("from the front", 0, 2, "x (m)", "z (m)"),
    ("from the side", 1, 2, "y (m)", "z (m)"),
)


def draw_profile(path: Path, name: str, profile: Profile, body_radius: float) -> Path:
    """Draw radius, room, curvature, torsion and shape of the sections by arc length.

    Raises:
        CosimError: matplotlib is not installed.
        OutputError: the picture cannot be written.
    """
    figure = _figure(10.0, 11.0)
    axes = figure.subplots(4, 1, sharex=True)
    s = profile.arc_length

    axes[0].fill_between(s, profile.least, profile.greatest, color=_BAND, label="least to greatest")
    axes[0].plot(s, profile.radius, color=_RADIUS, label="mean")
    axes[0].plot(s, profile.clearance, color=_CLEARANCE, linestyle="--", label="nearest wall")
    axes[0].axhline(body_radius, color=_BODY, linestyle=":", label=f"drone ({body_radius:g} m)")
    axes[0].set(ylabel="wall distance (m)", ylim=(0.0, 1.35 * float(profile.greatest.max())), title=name)
    _mark(axes[0], s[profile.narrowest], "narrowest")

    axes[1].plot(s, profile.bend, color=_BEND, label="curvature x R")
    axes[1].set(ylabel="curvature x R", ylim=(0.0, max(0.5, 1.2 * float(profile.bend.max()))))
    _mark(axes[1], s[profile.tightest], "tightest")

    axes[2].plot(s, profile.torsion, color=_TORSION, label="torsion (none where it is straight)")
    axes[2].axhline(0.0, color="black", linewidth=0.6)
    axes[2].set(ylabel="torsion (1/m)", ylim=_torsion_limits(profile))

    axes[3].plot(s, profile.harmonics[:, 1], color=_RADIUS, label="ellipticity (R)")
    axes[3].plot(s, profile.harmonics[:, 2:].max(axis=1), color=_BEND, label="strongest lobes (R)")
    axes[3].plot(s, profile.opened, color=_MARK, linestyle=":", label="share of the section without a wall")
    highest = max(float(profile.harmonics[:, 1:].max()), float(profile.opened.max()), 0.1)
    axes[3].set(
        ylabel="section", xlabel="arc length (m)", xlim=(0.0, float(s[-1])), ylim=(0.0, 1.3 * highest)
    )
    for panel in axes:
        panel.grid(alpha=0.25)
        panel.legend(loc="upper right", framealpha=0.9, fontsize=8, ncols=4)
    return _save(figure, path)


def draw_overview(
    path: Path, wall: Wall, profile: Profile | None, openings: Sequence[Opening], body_radius: float
) -> Path:
    """Draw the wall from three sides, with the centreline by the room on it, and the openings by their numbers.

    Raises:
        CosimError: matplotlib is not installed.
        OutputError: the picture cannot be written.
    """
    extent = np.ptp(wall.vertices, axis=0)
    # As wide as what they show, so that a long tube does not leave two panels empty; a slender one stays legible.
    widths = [max(float(extent[i]), LEAST_WIDTH * float(extent.max())) for _, i, *_ in _VIEWS]
    figure = _figure(15.0, 6.0)
    panels = figure.subplots(1, 3, width_ratios=widths)
    for panel, (title, i, j, across, up) in zip(panels, _VIEWS, strict=True):
        _draw_wall(panel, wall, i, j)
        if profile is not None:
            line = _draw_line(panel, profile, i, j, body_radius)
        for number, opening in enumerate(openings, start=1):
            at = (float(opening.centre[i]), float(opening.centre[j]))
            panel.plot(*at, "o", color=_OPENING, markersize=4)
            panel.annotate(
                str(number), at, xytext=(6, 6), textcoords="offset points", color=_OPENING, weight="bold"
            )
        panel.set(title=title, xlabel=across, ylabel=up)
        panel.set_aspect("equal", adjustable="datalim")
        panel.locator_params(nbins=5)
        panel.grid(alpha=0.2)
    if profile is not None:
        figure.colorbar(line, ax=panels, label=f"room beside a drone of {body_radius:g} m (m)", shrink=0.8)
    figure.suptitle(wall.path.name)
    return _save(figure, path)


def _figure(width: float, height: float) -> Any:
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise CosimError(
            f"pictures need {error.name}; install the extra with: pip install 'tube-cosim[view]', or leave --out away"
        ) from error
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Any, path: Path) -> Path:
    try:
        figure.savefig(path, dpi=130)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path


def _mark(panel: Any, at: float, what: str) -> None:
    """A line across a panel where something is at its most."""
    panel.axvline(at, color=_MARK, linewidth=0.9, linestyle="-.", label=f"{what} ({at:.4g} m)")


def _torsion_limits(profile: Profile) -> tuple[float, float]:
    """Limits that hold nearly all of the torsion: where the axis is nearly straight it jumps."""
    known = np.abs(profile.torsion[np.isfinite(profile.torsion)])
    most = 1.2 * float(np.quantile(known, 0.95)) if len(known) else 0.0
    most = max(most, 0.1 / float(profile.radius.mean()))
    return -most, most


def _draw_wall(panel: Any, wall: Wall, i: int, j: int) -> None:
    from matplotlib.collections import PolyCollection

    faces = wall.faces[:: -(-len(wall.faces) // MOST_FACES)]
    corners = wall.vertices[faces][:, :, [i, j]]
    opacity = min(0.25, max(0.02, 60.0 / len(faces) ** 0.75))
    panel.add_collection(
        PolyCollection(list(corners), facecolors=_WALL, edgecolors=_WALL, linewidths=0.15, alpha=opacity)
    )
    panel.update_datalim(wall.vertices[:, [i, j]])
    panel.autoscale_view()


def _draw_line(panel: Any, profile: Profile, i: int, j: int, body_radius: float) -> Any:
    from matplotlib.collections import LineCollection

    points = profile.points[:, [i, j]]
    room = profile.clearance - body_radius
    line = LineCollection(list(np.stack([points[:-1], points[1:]], axis=1)), cmap="viridis", linewidths=2.0)
    line.set_array(room[:-1])
    low, high = float(room.min()), float(room.max())
    line.set_clim(min(low, high - LEAST_SPAN * float(profile.radius.mean())), high)
    panel.add_collection(line)
    panel.plot(*points[0], marker="^", color="black", markersize=6)
    panel.plot(*points[-1], marker="s", color="black", markersize=5)
    panel.plot(*points[profile.narrowest], marker="x", color=_MARK, markersize=7)
    return line
