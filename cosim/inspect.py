"""`cosim inspect`: whether a mesh can be flown through, what its tube is like by arc length, and pictures of it."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import click
import numpy as np

from cosim.conduits import check_room
from cosim.errors import OutputError
from cosim.folders import make_folder, remove_empty
from cosim.inspect_report import WIDE_APART, Agreement, describe, describe_opening, lines
from cosim.live import working
from meshes.errors import EndsError, MeshError
from meshes.formats import AxesChoice
from meshes.inspection import Construction, Profile, examine, measure_profile
from meshes.scale import MeanRadius, guess_unit
from meshes.sections import measure_rings
from meshes.sweep import write_centreline_obj
from meshes.swept import unit_tangents
from meshes.tube import Tube, read_tube
from meshes.wall import read_wall
from physics_server.parameters import BodyParameters
from protocol.plant import TubeReference

REPORT: Final = "inspection.json"
PROFILE: Final = "profile.png"
OVERVIEW: Final = "overview.png"

ENGINE_SECTIONS: Final = 200
"""Sections in which the rays of the engine are compared with those of perception."""

Place = tuple[float, float, float] | int


@dataclass(frozen=True)
class InspectOptions:
    """What is inspected, and where the results go."""

    mesh: Path
    centerline: Path | None = None
    entry: Place | None = None
    exit: Place | None = None
    axes: AxesChoice = "auto"
    scale: float | MeanRadius | None = None
    body_radius: float = BodyParameters().body_radius
    out: Path | None = None


def inspect(options: InspectOptions, *, as_json: bool) -> dict[str, Any]:
    """Inspect a mesh and print what was found.

    Args:
        options: what to inspect.
        as_json: one JSON object on stdout and nothing else.

    Raises:
        MeshError: the mesh cannot be read, or cannot be flown through; says why and where.
        OutputError: the folder holds an inspection already, or cannot be written.
        CosimError: pictures are wanted, and matplotlib is not installed.
    """
    made = _check_folder(options.out)
    try:
        return _inspect(options, as_json)
    except BaseException:
        remove_empty(made)
        raise


def _inspect(options: InspectOptions, as_json: bool) -> dict[str, Any]:
    try:
        tube = _read(options)
    except MeshError as error:
        _report_refusal(options, error, as_json)
        raise
    if options.out is not None and tube.found is not None and _centreline_in(options.out, tube).exists():
        raise OutputError(
            f"--out {options.out}: expected a folder without {_centreline_in(options.out, tube).name}, found one"
        )
    refused: MeshError | None = None
    with working("inspecting"):
        profile, construction = measure_profile(tube), examine(tube)
        agreement = compare_engines(tube, profile)
        guess = guess_unit(float(profile.radius.mean()) / tube.scale, tube.wall.stated)
        try:
            check_room(tube, options.body_radius)
        except MeshError as error:
            refused = error
        said = None if refused is None else str(refused)
        report = describe(tube, profile, construction, agreement, guess, options.body_radius, said)
        if options.out is not None:
            files = _write(options.out, tube, profile, construction, options.body_radius)
            _write_report(options.out, report, files)
    if as_json:
        click.echo(json.dumps(report, allow_nan=False))
    else:
        for line in lines(report, tube.wall, options.scale is not None):
            click.echo(line)
    if refused is not None:
        raise refused
    return report


def _read(options: InspectOptions) -> Tube:
    with working("reading the mesh"):
        return read_tube(
            options.mesh,
            options.centerline,
            options.axes,
            options.scale,
            "first",
            options.entry,
            options.exit,
        )


def compare_engines(tube: Tube, profile: Profile) -> Agreement:
    """Cast rings of rays along the axis in the physics engine and in perception, and compare their lengths."""
    from physics_server.bullet import measure_wall

    chosen = np.unique(np.linspace(1, len(profile.points) - 2, ENGINE_SECTIONS).astype(np.int64))
    points, tangents = profile.points[chosen], unit_tangents(profile.points)[chosen]
    rings = measure_rings(tube.wall.scene, points, tangents)
    directions = rings.directions.reshape(-1, 3)
    origins = np.repeat(points, rings.distances.shape[1], axis=0)
    reach = float(np.linalg.norm(np.ptp(tube.wall.vertices, axis=0)))
    reference = TubeReference(str(tube.path.resolve()), tube.axes, tube.scale, tube.sha256)
    engine = measure_wall(reference, origins, directions, reach)
    differences = np.abs(engine - np.minimum(rings.distances.ravel(), reach))
    apart = differences > WIDE_APART * float(profile.radius.mean())
    return Agreement(
        len(differences), float(np.median(differences)), float(differences.max()), float(apart.mean())
    )


def _check_folder(out: Path | None) -> list[Path]:
    """Make the folder, unless it holds an inspection of a mesh that was not refused; which ones were made."""
    if out is None:
        return []
    report = out / REPORT
    if report.exists() and "profile" in _read_report(report):
        raise OutputError(f"--out {out}: expected a folder without {REPORT}, found one; name another folder")
    return make_folder(out)[1]


def _read_report(path: Path) -> dict[str, Any]:
    """An earlier report; one that cannot be read is taken for somebody's work."""
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, ValueError, TypeError):
        return {"profile": None}


def _write(
    folder: Path, tube: Tube, profile: Profile, construction: Construction, body_radius: float
) -> list[Path]:
    """Write pictures, and the centreline where it was found; the paths."""
    from cosim.inspect_plots import draw_overview, draw_profile

    written = [
        draw_profile(folder / PROFILE, tube.path.name, profile, body_radius),
        draw_overview(folder / OVERVIEW, tube.wall, profile, construction.openings, body_radius),
    ]
    if tube.found is not None:
        path = _centreline_in(folder, tube)
        try:
            write_centreline_obj(path, tube.wall.to_file(tube.found.points), digits=17)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error
        written.append(path)
    return written


def _centreline_in(folder: Path, tube: Tube) -> Path:
    """As it is looked for beside the mesh."""
    return folder / f"{tube.path.stem}_centerline.obj"


def _write_report(folder: Path, report: dict[str, Any], files: list[Path]) -> None:
    path = folder / REPORT
    report["files"] = [str(file) for file in (*files, path)]
    try:
        path.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error


def _report_refusal(options: InspectOptions, error: MeshError, as_json: bool) -> None:
    """What can be said of a mesh that cannot be flown: why, its openings, and a picture of its wall."""
    report: dict[str, Any] = {
        "mesh": str(options.mesh),
        "flyable": False,
        "refused": str(error),
        "openings": [],
    }
    scale = None if isinstance(options.scale, MeanRadius) else options.scale
    wall = None
    with suppress(MeshError):  # then that is why it was refused
        wall = read_wall(options.mesh, options.axes, scale)
    if wall is not None:
        openings = error.openings if isinstance(error, EndsError) else ()
        report["openings"] = [describe_opening(wall, opening) for opening in openings]
        if options.out is not None:
            from cosim.inspect_plots import draw_overview

            picture = draw_overview(options.out / OVERVIEW, wall, None, openings, options.body_radius)
            _write_report(options.out, report, [picture])
    if as_json:
        click.echo(json.dumps(report, allow_nan=False))
