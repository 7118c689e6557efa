"""`cosim inspect`: whether a mesh can be flown through, what its tube is like by arc length, and pictures of it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import click
import numpy as np

from cosim.errors import OutputError
from cosim.folders import make_folder
from cosim.live import working
from meshes.errors import EndsError, MeshError
from meshes.formats import AxesChoice
from meshes.geometry import Floats
from meshes.inspection import Construction, Profile, UnitGuess, examine, guess_unit, measure_profile
from meshes.openings import Opening
from meshes.scale import MeanRadius
from meshes.sections import measure_rings
from meshes.sweep import write_centreline_obj
from meshes.swept import unit_tangents
from meshes.tube import Tube, read_tube
from meshes.wall import Wall, read_wall
from physics_server.parameters import BodyParameters
from protocol.plant import TubeReference

REPORT: Final = "inspection.json"
PROFILE: Final = "profile.png"
OVERVIEW: Final = "overview.png"

ROWS: Final = 12
"""Rows of the table by arc length."""
ENGINE_SECTIONS: Final = 200
"""Sections in which the rays of the engine are compared with those of perception."""
WIDE_APART: Final = 0.03
"""Rays that differ by more than so many radii are counted: grazing ones, or a wall that one of them misses."""

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


@dataclass(frozen=True)
class Agreement:
    """How far the engine's rays differ from those of perception (m)."""

    rays: int
    median: float
    largest: float
    apart: float
    """Share of the rays that differ by more than `WIDE_APART` radii."""


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
    folder = _new_folder(options.out)
    try:
        with working("reading the mesh"):
            tube = read_tube(
                options.mesh,
                options.centerline,
                options.axes,
                options.scale,
                "first",
                options.entry,
                options.exit,
            )
    except MeshError as error:
        _report_refusal(options, folder, error, as_json)
        raise
    with working("inspecting"):
        profile, construction = measure_profile(tube), examine(tube)
        agreement = compare_engines(tube, profile)
        guess = guess_unit(float(profile.radius.mean()) / tube.scale, tube.wall.stated)
        report = describe(tube, profile, construction, agreement, guess, options.body_radius)
        if folder is not None:
            report["files"] = [
                str(path) for path in _write(folder, tube, profile, construction, options.body_radius)
            ]
            _write_report(folder, report)
    if as_json:
        click.echo(json.dumps(report, allow_nan=False))
    else:
        for line in lines(report):
            click.echo(line)
    return report


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


def describe(
    tube: Tube,
    profile: Profile,
    construction: Construction,
    agreement: Agreement,
    guess: UnitGuess,
    body_radius: float,
) -> dict[str, Any]:
    """All that was found, as JSON: lengths in metres, places in the world frame and in the file's coordinates."""
    wall, found = tube.wall, tube.found
    room = float(profile.clearance[profile.narrowest]) - body_radius
    return {
        "mesh": str(tube.path),
        "sha256": tube.sha256,
        "flyable": room > 0.0,
        "axes": tube.axes,
        "scale": tube.scale,
        "stated": wall.stated.where,
        "unit": {"metres": guess.metres, "reason": guess.reason},
        "walls": {
            "vertices": construction.vertices,
            "faces": construction.faces,
            "duplicate_faces": construction.duplicate_faces,
            "double": construction.thickness is not None,
            "thickness_m": construction.thickness,
            "normals": construction.normals,
            "flipped_share": construction.flipped,
            "holes": construction.holes,
        },
        "centreline": {
            "found": found is not None,
            "path": None if tube.centreline_path is None else str(tube.centreline_path),
            "sha256": tube.centreline_sha256,
            "length_m": tube.length,
            "start": _place(wall, tube.axis[0]),
            "end": _place(wall, tube.axis[-1]),
            "openings": [None, None] if found is None else list(found.used),
            "capped": list(construction.capped),
            "notes": [] if found is None else list(found.notes),
        },
        "openings": [_opening(wall, opening) for opening in construction.openings],
        "radius": {
            "mean_m": float(profile.radius.mean()),
            "least_m": float(profile.least.min()),
            "greatest_m": float(profile.greatest.max()),
        },
        "section": {
            "shape": profile.shape,
            "harmonics": [float(a) for a in np.median(profile.harmonics, axis=0)],
        },
        "narrowest": {
            "arc_length_m": float(profile.arc_length[profile.narrowest]),
            "place": _place(wall, profile.points[profile.narrowest]),
            "clearance_m": float(profile.clearance[profile.narrowest]),
            "body_radius_m": body_radius,
            "room_m": room,
        },
        "tightest": {
            "arc_length_m": float(profile.arc_length[profile.tightest]),
            "place": _place(wall, profile.points[profile.tightest]),
            "curvature_per_m": float(profile.curvature[profile.tightest]),
            "curvature_times_radius": float(profile.bend[profile.tightest]),
        },
        "engine_agreement": {
            "rays": agreement.rays,
            "median_m": agreement.median,
            "largest_m": agreement.largest,
            "share_apart": agreement.apart,
        },
        "profile": {
            "arc_length_m": _numbers(profile.arc_length),
            "radius_m": _numbers(profile.radius),
            "least_m": _numbers(profile.least),
            "greatest_m": _numbers(profile.greatest),
            "clearance_m": _numbers(profile.clearance - body_radius),
            "curvature_per_m": _numbers(profile.curvature),
            "torsion_per_m": _numbers(profile.torsion),
            "ellipticity": _numbers(profile.harmonics[:, 1]),
            "lobes": _numbers(profile.harmonics[:, 2:].max(axis=1)),
            "open_share": _numbers(profile.opened),
        },
    }


def lines(report: dict[str, Any]) -> Iterator[str]:
    """The report for people."""
    walls, centreline, radius = report["walls"], report["centreline"], report["radius"]
    narrow, tight, engine = report["narrowest"], report["tightest"], report["engine_agreement"]
    yield report["mesh"]
    double = f"double wall, {walls['thickness_m']:.3g} m thick" if walls["double"] else "single wall"
    duplicates = (
        f"{walls['duplicate_faces']:,} duplicates dropped" if walls["duplicate_faces"] else "no duplicates"
    )
    normals = f"normals {walls['normals']}"
    if walls["flipped_share"] > 0.0:
        normals += f", {100 * walls['flipped_share']:.2g} % the other way"
    yield _row(
        "mesh", f"{walls['vertices']:,} vertices, {walls['faces']:,} faces, {duplicates}; {double}; {normals}"
    )
    up = "Y" if report["axes"] == "yup" else "Z"
    yield _row("unit", f"read with {report['scale']:.6g} m a unit and {up} up; {report['stated']}")
    yield _row("", report["unit"]["reason"])
    for i, opening in enumerate(report["openings"], start=1):
        yield _row(
            "" if i > 1 else "openings",
            f"{i} at {_in_file(opening['place'])}, radius {opening['radius_m']:.3g} m",
        )
    if not report["openings"]:
        yield _row("openings", "none")
    ends = [
        f"opening {number}" if number is not None else "a cap" if capped else "a place inside"
        for number, capped in zip(centreline["openings"], centreline["capped"], strict=True)
    ]
    source = "found" if centreline["found"] else f"from {centreline['path']}"
    yield _row("centreline", f"{source}, {centreline['length_m']:.4g} m")
    if centreline["found"]:
        yield _row("", f"from {ends[0]} at {_in_file(centreline['start'])}")
        yield _row("", f"to {ends[1]} at {_in_file(centreline['end'])}")
    for note in centreline["notes"]:
        yield _row("", note)
    yield _row(
        "radius",
        f"mean {radius['mean_m']:.4g} m, from {radius['least_m']:.4g} to {radius['greatest_m']:.4g} m; "
        f"length over radius {centreline['length_m'] / radius['mean_m']:.1f}",
    )
    amplitudes = report["section"]["harmonics"]
    yield _row(
        "section",
        f"{report['section']['shape']}; ellipticity {amplitudes[1]:.2g}, lobes {max(amplitudes[2:]):.2g} R",
    )
    yield _row(
        "narrowest",
        f"{narrow['clearance_m']:.4g} m to the wall at {narrow['arc_length_m']:.4g} m, {_in_file(narrow['place'])}",
    )
    yield _row("", _room(narrow))
    bend_radius = 1.0 / tight["curvature_per_m"] if tight["curvature_per_m"] > 0.0 else np.inf
    yield _row(
        "tightest bend",
        f"radius {bend_radius:.4g} m, curvature x R {tight['curvature_times_radius']:.2f}, at "
        f"{tight['arc_length_m']:.4g} m, {_in_file(tight['place'])}",
    )
    yield _row(
        "engine",
        f"its rays differ from perception's by {engine['median_m']:.2g} m in the median, {engine['largest_m']:.2g} m "
        f"at most; {100 * engine['share_apart']:.2g} % of {engine['rays']:,} by more than {WIDE_APART:g} R",
    )
    yield ""
    yield from _table(report["profile"])
    yield from report.get("files", ())


def _room(narrow: dict[str, Any]) -> str:
    body, room = narrow["body_radius_m"], narrow["room_m"]
    if room > 0.0:
        return f"{room:.3g} m are free beside a drone of radius {body:g} m"
    return f"a drone of radius {body:g} m does not fit: {-room:.3g} m are missing; make it wider (--scale radius=1)"


def _table(profile: dict[str, list[float | None]]) -> Iterator[str]:
    """Some rows of the profile, at even arc lengths."""
    columns = (
        ("s (m)", "arc_length_m"), ("R (m)", "radius_m"), ("least", "least_m"), ("greatest", "greatest_m"),
        ("clearance", "clearance_m"), ("curvature", "curvature_per_m"), ("torsion", "torsion_per_m"),
        ("ellipticity", "ellipticity"), ("lobes", "lobes"), ("open", "open_share"),
    )  # fmt: skip
    yield "".join(f"{name:>12}" for name, _ in columns)
    count = len(profile["arc_length_m"])
    for i in np.unique(np.linspace(0, count - 1, ROWS).astype(int)):
        values = [profile[key][i] for _, key in columns]
        yield "".join(f"{'-' if value is None else f'{value:.4g}':>12}" for value in values)


def _row(name: str, text: str) -> str:
    return f"{name:<15}{text}"


def _place(wall: Wall, point: Floats) -> dict[str, list[float]]:
    """A place (3,) in the world frame and in the coordinates of the file."""
    return {"world_m": _plain(point), "file": _plain(wall.to_file(point[None])[0])}


def _in_file(where: dict[str, list[float]]) -> str:
    return "({:.4g}, {:.4g}, {:.4g})".format(*where["file"])


def _opening(wall: Wall, opening: Opening) -> dict[str, Any]:
    return {
        "place": _place(wall, opening.centre),
        "outward": _plain(opening.outward),
        "radius_m": opening.radius,
    }


def _plain(values: Floats) -> list[float]:
    return [float(value) for value in values]


def _numbers(values: Floats) -> list[float | None]:
    """Numbers as JSON has them: what is none is null."""
    return [float(value) if np.isfinite(value) else None for value in values]


def _new_folder(out: Path | None) -> Path | None:
    if out is None:
        return None
    if (out / REPORT).exists():
        raise OutputError(f"--out {out}: expected a folder without {REPORT}, found one; name another folder")
    return make_folder(out)[0]


def _write(
    folder: Path, tube: Tube, profile: Profile, construction: Construction, body_radius: float
) -> Iterator[Path]:
    """Write pictures, and the centreline where it was found; yields the paths."""
    from cosim.inspect_plots import draw_overview, draw_profile

    yield draw_profile(folder / PROFILE, tube.path.name, profile, body_radius)
    yield draw_overview(folder / OVERVIEW, tube.wall, profile, construction.openings, body_radius)
    if tube.found is not None:
        path = folder / f"{tube.path.stem}_centerline.obj"
        try:
            write_centreline_obj(path, tube.wall.to_file(tube.found.points), digits=17)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error
        yield path


def _write_report(folder: Path, report: dict[str, Any]) -> None:
    path = folder / REPORT
    report["files"].append(str(path))
    try:
        path.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error


def _report_refusal(options: InspectOptions, folder: Path | None, error: MeshError, as_json: bool) -> None:
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
    openings = error.openings if isinstance(error, EndsError) else ()
    if wall is not None:
        report["openings"] = [_opening(wall, opening) for opening in openings]
        if folder is not None:
            from cosim.inspect_plots import draw_overview

            report["files"] = [
                str(draw_overview(folder / OVERVIEW, wall, None, openings, options.body_radius))
            ]
            _write_report(folder, report)
    if as_json:
        click.echo(json.dumps(report, allow_nan=False))
