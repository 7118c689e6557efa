"""What `cosim inspect` found, as JSON and as lines for people."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from meshes.geometry import Floats
from meshes.inspection import Construction, Profile
from meshes.openings import Opening
from meshes.scale import UnitGuess
from meshes.tube import Tube
from meshes.wall import Wall, place_in_file

ROWS: Final = 12
"""Rows of the table by arc length."""
WIDE_APART: Final = 0.03
"""Rays that differ by more than so many radii are counted: grazing ones, or a wall that one of them misses."""
AT_OPENING: Final = 1.5
"""An opening within so many radii of the end of a centreline is where it ends."""
METHOD: Final = (
    "own code on scipy's graphs and Embree's rays: the shortest way through balls of free space, centred by rays in "
    "every section; skeletor and vmtk follow the vertices, which double walls and long triangles mislead"
)
"""How a centreline is found, and why so."""


@dataclass(frozen=True)
class Agreement:
    """How far the engine's rays differ from those of perception (m)."""

    rays: int
    median: float
    largest: float
    apart: float
    """Share of the rays that differ by more than `WIDE_APART` radii."""


def describe(
    tube: Tube,
    profile: Profile,
    construction: Construction,
    agreement: Agreement,
    guess: UnitGuess,
    body_radius: float,
    refused: str | None,
) -> dict[str, Any]:
    """All that was found, as JSON.

    Names end in their unit (`_m` metres, `_per_m` 1/m). A place is given in the world frame (`world_m`: metres, Z up)
    and in the coordinates of the mesh's file (`file`); `clearance_m` is what is free beside the drone. Numbers of
    openings count from 1. `profile` holds one value for each section, null where there is none.
    """
    wall = tube.wall
    return {
        "mesh": str(tube.path),
        "sha256": tube.sha256,
        "companions": dict(wall.companions),
        "flyable": refused is None,
        "refused": refused,
        "axes": tube.axes,
        "scale": tube.scale,
        "stated": wall.stated.where,
        "unit": {"metres": guess.metres, "reason": guess.reason, "advice": guess.advice},
        "walls": _walls(construction),
        "centreline": _centreline(tube, construction),
        "openings": [describe_opening(wall, opening) for opening in construction.openings],
        "radius": {
            "mean_m": float(profile.radius.mean()),
            "least_m": float(profile.least.min()),
            "greatest_m": float(profile.greatest.max()),
        },
        "section": {
            "shape": profile.shape,
            "harmonics": [float(a) for a in np.median(profile.harmonics, axis=0)],
        },
        "narrowest": _narrowest(wall, profile, body_radius),
        "tightest": _tightest(wall, profile),
        "engine_agreement": {
            "rays": agreement.rays,
            "median_m": agreement.median,
            "largest_m": agreement.largest,
            "share_apart": agreement.apart,
        },
        "profile": _profile(profile, body_radius),
    }


def _walls(construction: Construction) -> dict[str, Any]:
    return {
        "vertices": construction.vertices,
        "faces": construction.faces,
        "duplicate_faces": construction.duplicate_faces,
        "double": construction.thickness is not None,
        "thickness_m": construction.thickness,
        "normals": construction.normals,
        "flipped_share": construction.flipped,
        "holes": construction.holes,
    }


def _centreline(tube: Tube, construction: Construction) -> dict[str, Any]:
    wall, found = tube.wall, tube.found
    return {
        "found": found is not None,
        "method": None if found is None else METHOD,
        "path": None if tube.centreline_path is None else str(tube.centreline_path),
        "sha256": tube.centreline_sha256,
        "length_m": tube.length,
        "start": _place(wall, tube.axis[0]),
        "end": _place(wall, tube.axis[-1]),
        "openings": _ends(tube, construction) if found is None else list(found.used),
        "capped": list(construction.capped),
        "notes": [] if found is None else list(found.notes),
    }


def _narrowest(wall: Wall, profile: Profile, body_radius: float) -> dict[str, Any]:
    at = profile.narrowest
    wall_distance = float(profile.clearance[at])
    return {
        "arc_length_m": float(profile.arc_length[at]),
        "place": _place(wall, profile.points[at]),
        "wall_distance_m": wall_distance,
        "body_radius_m": body_radius,
        "clearance_m": wall_distance - body_radius,
    }


def _tightest(wall: Wall, profile: Profile) -> dict[str, Any]:
    at = profile.tightest
    return {
        "arc_length_m": float(profile.arc_length[at]),
        "place": _place(wall, profile.points[at]),
        "curvature_per_m": float(profile.curvature[at]),
        "curvature_times_radius": float(profile.bend[at]),
    }


def _profile(profile: Profile, body_radius: float) -> dict[str, list[float | None]]:
    return {
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
    }


def lines(report: dict[str, Any], wall: Wall, scale_named: bool) -> Iterator[str]:
    """The report for people.

    Args:
        report: as `describe` gives it.
        wall: of the tube.
        scale_named: whether the user said what the scale is, and needs no advice.
    """
    yield report["mesh"]
    yield from _mesh_lines(report, wall, scale_named)
    yield from _centreline_lines(report["centreline"], wall)
    yield from _section_lines(report, wall)
    yield ""
    yield from _table(report["profile"])
    yield from report.get("files", ())


def _mesh_lines(report: dict[str, Any], wall: Wall, scale_named: bool) -> Iterator[str]:
    """Walls, unit and openings."""
    walls, unit = report["walls"], report["unit"]
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
    if unit["reason"] != report["stated"]:
        yield _row("", unit["reason"] + (f"; {unit['advice']}" if unit["advice"] and not scale_named else ""))
    for i, opening in enumerate(report["openings"], start=1):
        yield _row(
            "" if i > 1 else "openings",
            f"{i} at {place_in_file(wall, opening['place']['file'])}, radius {opening['radius_m']:.3g} m",
        )
    if not report["openings"]:
        yield _row("openings", "none")


def _centreline_lines(centreline: dict[str, Any], wall: Wall) -> Iterator[str]:
    """Where it comes from and runs, and how it was found."""
    ends = [
        f"opening {number}" if number is not None else "a cap" if capped else "a place inside"
        for number, capped in zip(centreline["openings"], centreline["capped"], strict=True)
    ]
    source = "found" if centreline["found"] else f"from {centreline['path']}"
    yield _row("centreline", f"{source}, {centreline['length_m']:.4g} m")
    yield _row("", f"from {ends[0]} at {place_in_file(wall, centreline['start']['file'])}")
    yield _row("", f"to {ends[1]} at {place_in_file(wall, centreline['end']['file'])}")
    if centreline["found"]:
        how, why = centreline["method"].split("; ")
        yield _row("", f"by {how};")
        yield _row("", why)
    for note in centreline["notes"]:
        yield _row("", note)


def _section_lines(report: dict[str, Any], wall: Wall) -> Iterator[str]:
    """Radius, shape, narrowest place, tightest bend, and what the engine sees."""
    radius, narrow, tight = report["radius"], report["narrowest"], report["tightest"]
    engine = report["engine_agreement"]
    yield _row(
        "radius",
        f"mean {radius['mean_m']:.4g} m, from {radius['least_m']:.4g} to {radius['greatest_m']:.4g} m; "
        f"length over radius {report['centreline']['length_m'] / radius['mean_m']:.1f}",
    )
    amplitudes = report["section"]["harmonics"]
    yield _row(
        "section",
        f"{report['section']['shape']}; ellipticity {amplitudes[1]:.2g}, lobes {max(amplitudes[2:]):.2g} R",
    )
    yield _row(
        "narrowest",
        f"{narrow['wall_distance_m']:.4g} m to the wall at {narrow['arc_length_m']:.4g} m, "
        f"{place_in_file(wall, narrow['place']['file'])}",
    )
    yield _row("", _room(narrow))
    bend_radius = 1.0 / tight["curvature_per_m"] if tight["curvature_per_m"] > 0.0 else np.inf
    yield _row(
        "tightest bend",
        f"radius {bend_radius:.4g} m, curvature x R {tight['curvature_times_radius']:.2f}, at "
        f"{tight['arc_length_m']:.4g} m, {place_in_file(wall, tight['place']['file'])}",
    )
    yield _row(
        "engine",
        f"its rays differ from perception's by {engine['median_m']:.2g} m in the median, {engine['largest_m']:.2g} m "
        f"at most; {100 * engine['share_apart']:.2g} % of {engine['rays']:,} by more than {WIDE_APART:g} R",
    )


def _room(narrow: dict[str, Any]) -> str:
    body, clearance = narrow["body_radius_m"], narrow["clearance_m"]
    if clearance > 0.0:
        return f"clearance: {clearance:.3g} m are free beside a drone of radius {body:g} m"
    return f"clearance: none for a drone of radius {body:g} m: {-clearance:.3g} m are missing"


def _table(profile: dict[str, list[float | None]]) -> Iterator[str]:
    """Some rows of the profile, at even arc lengths."""
    columns = (
        ("s", "m", "arc_length_m"), ("R", "m", "radius_m"),
        ("least", "m", "least_m"), ("greatest", "m", "greatest_m"), ("clearance", "m", "clearance_m"),
        ("curvature", "1/m", "curvature_per_m"), ("torsion", "1/m", "torsion_per_m"),
        ("ellipticity", "R", "ellipticity"), ("lobes", "R", "lobes"), ("open", "share", "open_share"),
    )  # fmt: skip
    for header in (0, 1):
        yield "".join(f"{column[header]:>12}" for column in columns)
    count = len(profile["arc_length_m"])
    for i in np.unique(np.linspace(0, count - 1, ROWS).astype(int)):
        values = [profile[key][i] for *_, key in columns]
        yield "".join(f"{'-' if value is None else f'{value:.4g}':>12}" for value in values)


def _row(name: str, text: str) -> str:
    return f"{name:<15}{text}"


def _place(wall: Wall, point: Floats) -> dict[str, list[float]]:
    """A place (3,) in the world frame and in the coordinates of the file."""
    return {"world_m": _plain(point), "file": _plain(wall.to_file(point[None])[0])}


def _ends(tube: Tube, construction: Construction) -> list[int | None]:
    """Numbers of the openings at which a centreline from a file starts and ends, None where it does so elsewhere."""
    numbers: list[int | None] = []
    for end, radius, capped in zip(
        tube.axis[[0, -1]], tube.radius[[0, -1]], construction.capped, strict=True
    ):
        ways = [float(np.linalg.norm(opening.centre - end)) for opening in construction.openings]
        near = bool(ways) and not capped and min(ways) < AT_OPENING * radius
        numbers.append(int(np.argmin(ways)) + 1 if near else None)
    return numbers


def describe_opening(wall: Wall, opening: Opening) -> dict[str, Any]:
    """An opening as JSON."""
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
