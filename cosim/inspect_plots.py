"""The pictures of `cosim inspect`: the profile of a tube by arc length, and the tube from three sides."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.errors import CosimError, OutputError
from cosim.requirements import install_command
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
    axes[0].fill_between(
        s, body_radius, profile.clearance, color=_CLEARANCE, alpha=0.12, label="clearance for the drone"
    )
    highest = max(float(profile.greatest.max()), body_radius)
    axes[0].set(ylabel="wall distance (m)", ylim=(0.0, 1.4 * highest), title=name)
    _mark(axes[0], s[profile.narrowest], "narrowest")

    axes[1].plot(s, profile.curvature, color=_BEND, label="curvature")
    highest = max(0.3 / float(profile.radius.mean()), float(profile.curvature.max()))
    axes[1].set(ylabel="curvature (1/m)", ylim=(0.0, 1.4 * highest))
    times_radius = axes[1].twinx()
    times_radius.plot(s, profile.bend, color=_RADIUS, linestyle=":")
    times_radius.set(ylabel="curvature x R", ylim=(0.0, 1.4 * max(0.3, float(profile.bend.max()))))
    axes[1].plot([], [], color=_RADIUS, linestyle=":", label="times the local radius R (right)")
    _mark(axes[1], s[profile.tightest], "tightest bend")

    axes[2].plot(s, profile.torsion, color=_TORSION, label="torsion (none where it is straight)")
    axes[2].axhline(0.0, color="black", linewidth=0.6)
    axes[2].set(ylabel="torsion (1/m)", ylim=_torsion_limits(profile))

    axes[3].plot(s, profile.harmonics[:, 1], color=_RADIUS, label="ellipticity (share of R)")
    axes[3].plot(s, profile.harmonics[:, 2:].max(axis=1), color=_BEND, label="strongest lobes (share of R)")
    axes[3].plot(s, profile.opened, color=_MARK, linestyle=":", label="share of the section without a wall")
    highest = max(float(profile.harmonics[:, 1:].max()), float(profile.opened.max()), 0.1)
    axes[3].set(
        ylabel="shape of the section",
        xlabel="arc length (m)",
        xlim=(0.0, float(s[-1])),
        ylim=(0.0, 1.3 * highest),
    )
    for panel in axes:
        panel.grid(alpha=0.25)
        panel.legend(loc="upper right", framealpha=0.9, fontsize=8, ncols=3)
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
        _draw_openings(panel, openings, i, j)
        panel.set(title=title, xlabel=across, ylabel=up)
        panel.set_aspect("equal", adjustable="datalim")
        panel.locator_params(nbins=5)
        panel.grid(alpha=0.2)
    if profile is not None:
        figure.colorbar(
            line, ax=panels, label=f"clearance beside a drone of {body_radius:g} m (m)", shrink=0.8
        )
    handles, labels = panels[0].get_legend_handles_labels()
    if labels:
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    figure.suptitle(wall.path.name)
    return _save(figure, path)


def _figure(width: float, height: float) -> Any:
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise CosimError(
            f"pictures need {error.name}; install it with: {install_command('view')}, or leave --out away"
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
    narrowest, tightest = profile.narrowest, profile.tightest
    marks = (
        (0, "^", "black", "start"),
        (-1, "s", "black", "end"),
        (narrowest, "x", _MARK, f"narrowest ({profile.arc_length[narrowest]:.4g} m along)"),
        (tightest, "D", _TORSION, f"tightest bend ({profile.arc_length[tightest]:.4g} m along)"),
    )
    for place, marker, colour, label in marks:
        panel.plot(
            *points[place],
            marker,
            color=colour,
            markersize=7,
            fillstyle="none",
            markeredgewidth=1.6,
            label=label,
        )
    return line


def _draw_openings(panel: Any, openings: Sequence[Opening], i: int, j: int) -> None:
    """Dots with their numbers; those that lie behind one another share a label."""
    numbers: dict[tuple[float, float], list[str]] = {}
    for number, opening in enumerate(openings, start=1):
        at = (float(opening.centre[i]), float(opening.centre[j]))
        near = next((o for o in numbers if np.hypot(o[0] - at[0], o[1] - at[1]) < opening.radius), at)
        numbers.setdefault(near, []).append(str(number))
        panel.plot(*at, "o", color=_OPENING, markersize=4, label="openings" if number == 1 else None)
    for at, shared in numbers.items():
        panel.annotate(
            ", ".join(shared), at, xytext=(6, 6), textcoords="offset points", color=_OPENING, weight="bold"
        )
