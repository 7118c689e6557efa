"""What is flown through: the tube of a mesh, its centreline given or found, or a generated tube."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from agent_client.tubes import TubeRecipe, draw_tube
from cosim.errors import OutputError
from cosim.options import SHIPPED_MESH, FlightOptions
from cosim.pilots import existing_file
from cosim.recording import MANIFEST
from meshes.errors import CentrelineError
from meshes.formats import AxesChoice
from meshes.geometry import Geometry
from meshes.mesh_geometry import MeshGeometry
from meshes.scale import MeanRadius, guess_unit
from meshes.tube import INDUSTRIAL, Tube, read_tube
from meshes.wall import place
from protocol.plant import TubeReference

if TYPE_CHECKING:
    from meshes.centreline_finding import FoundCentreline  # at run time only where one is looked for

TUBE_FILES: Final = ("tube.obj", "tube_centerline.obj")
"""Wall and centreline of a generated tube, in the run folder."""

ROOM: Final = 2.0
"""Least advised distance from the centre of a tube to its wall, over the drone's radius."""

USUAL_RADIUS: Final = (0.5, 2.0)
"""Mean radius (m) of tubes that suit the drone, which is 0.15 m and was trained at 1 m."""


@dataclass(frozen=True)
class Conduit:
    """What is flown through."""

    geometry: Geometry
    """As perception sees it."""
    reference: TubeReference
    """Its wall, as physics is told of it."""
    length: float
    """Of the axis (m)."""
    description: dict[str, Any]
    """For the manifest: `mesh`, and `tube` where it was generated."""
    notes: tuple[str, ...] = ()
    """What was chosen for the user: scale, axes, ends."""
    written: tuple[Path, ...] = ()
    """Files of the tube that were written into the run folder."""


def find_mesh(options: FlightOptions) -> Path | None:
    """The mesh that the options name, None for a generated tube.

    Raises:
        CosimError: no such file.
    """
    if options.tube is not None:
        return None
    return existing_file("mesh", options.mesh or SHIPPED_MESH, SHIPPED_MESH, INDUSTRIAL)


def read_conduit(options: FlightOptions, mesh: Path, folder: Path, body_radius: float) -> Conduit:
    """The tube of a mesh; a centreline that is found, or stands in the folder of another run, is written to `folder`.

    Args:
        options: name centreline, axes, scale and ends.
        mesh: file of the wall.
        folder: of the run.
        body_radius: of the drone (m).

    Raises:
        MeshError: the mesh or its centreline cannot be used, or the drone does not fit through.
        OutputError: the folder holds a centreline already, or cannot be written.
    """
    axes: AxesChoice = "yup" if options.axes == "yup" else "zup" if options.axes == "zup" else "auto"
    start_end: Literal["first", "last"] = "last" if options.start_end == "last" else "first"
    tube = read_tube(mesh, options.centerline, axes, options.scale, start_end, options.entry, options.exit)
    found = tube.found
    check_room(tube, body_radius)
    written: tuple[Path, ...] = ()
    if found is not None:
        # Flown along as it is written, to the last bit: what is made of the folder is made of the same.
        written = (_store_centreline(tube, found, folder),)
        try:
            tube = read_tube(mesh, written[0], tube.axes, tube.scale, start_end)
        except BaseException:
            written[0].unlink(missing_ok=True)
            raise
    centreline = tube.centreline_path
    if found is None and centreline is not None and (centreline.parent / MANIFEST).exists():
        written = (centreline := _copy_centreline(centreline, folder),)
    reference = TubeReference(str(tube.path.resolve()), tube.axes, tube.scale, tube.sha256)
    described = _describe(tube.path, reference, centreline, tube.centreline_sha256, tube.length)
    described["found"] = None if found is None else _describe_found(tube, found)
    described["companions"] = dict(tube.wall.companions)
    notes = (*_scale_notes(tube, options), *(() if found is None else _found_notes(tube, found, options)))
    return Conduit(
        MeshGeometry([tube]), reference, tube.length, {"mesh": described, "tube": None}, notes, written
    )


def generate_conduit(options: FlightOptions, recipe: TubeRecipe, folder: Path) -> Conduit:
    """The tube that `cosim evaluate` draws for this level and seed; its wall and centreline are written to `folder`.

    Physics reads the file, perception sees the swept curve itself: as in the evaluation, to the last bit.

    Raises:
        CurveError: no such tube was found.
        OutputError: the folder holds such files, or cannot be written.
    """
    from cosim.walls import write_wall
    from meshes.sweep import write_centreline_obj
    from meshes.swept_geometry import SweptGeometry

    chosen = options.tube
    assert chosen is not None
    if chosen.length is not None:
        recipe = replace(recipe, lengths=(chosen.length,))
    tube = draw_tube(chosen.level, (chosen.seed,), "evaluate", recipe)
    wall, centreline = (folder / name for name in TUBE_FILES)
    for path in (wall, centreline):
        _refuse_existing(path)
    try:
        reference = write_wall(wall, tube)
        write_centreline_obj(centreline, tube.points)
    except OSError as error:
        wall.unlink(missing_ok=True)
        raise OutputError(f"{folder}: the tube cannot be written: {error.strerror}") from error
    sha256 = hashlib.sha256(centreline.read_bytes()).hexdigest()
    described = {"level": chosen.level, "seed": chosen.seed, "domain": "evaluate", "recipe": asdict(recipe)}
    mesh = _describe(wall, reference, centreline, sha256, tube.length)
    return Conduit(
        SweptGeometry([tube]),
        reference,
        tube.length,
        {"mesh": mesh, "tube": described},
        (),
        (wall, centreline),
    )


def _describe(
    wall: Path, reference: TubeReference, centreline: Path | None, centreline_sha256: str, length: float
) -> dict[str, Any]:
    return {
        "path": str(wall.resolve()),
        "sha256": reference.sha256,
        "axes": reference.axes,
        "scale": reference.scale,
        "centreline": None if centreline is None else str(centreline.resolve()),
        "centreline_sha256": centreline_sha256,
        "length_m": length,
    }


def _describe_found(tube: Tube, found: FoundCentreline) -> dict[str, Any]:
    """How the centreline was found; places in the coordinates of the file."""
    places = tube.wall.to_file(np.array([opening.centre for opening in found.openings]).reshape(-1, 3))
    ends = tube.wall.to_file(found.points[[0, -1]])
    return {
        "openings": places.tolist(),
        "used": list(found.used),
        "capped": list(found.capped),
        "ends": ends.tolist(),
        "notes": list(found.notes),
    }


def _store_centreline(tube: Tube, found: FoundCentreline, folder: Path) -> Path:
    """Write a found centreline into the run folder, in the coordinates of the mesh's file."""
    from meshes.sweep import write_centreline_obj

    path = folder / f"{tube.path.stem}_centerline.obj"  # as it is looked for beside the mesh
    _refuse_existing(path)
    try:
        write_centreline_obj(path, tube.wall.to_file(found.points), digits=17)
    except OSError as error:
        path.unlink(missing_ok=True)
        raise OutputError(f"{folder}: the centreline cannot be written: {error.strerror}") from error
    return path


def _copy_centreline(centreline: Path, folder: Path) -> Path:
    """Copy the centreline of another run into the run folder, which then needs no other."""
    path = folder / centreline.name
    _refuse_existing(path)
    try:
        path.write_bytes(centreline.read_bytes())
    except OSError as error:
        path.unlink(missing_ok=True)
        raise OutputError(f"{folder}: the centreline cannot be written: {error.strerror}") from error
    return path


def _refuse_existing(path: Path) -> None:
    if path.exists():
        raise OutputError(f"--out {path.parent}: expected a folder without {path.name}, found one")


def check_room(tube: Tube, body_radius: float) -> None:
    """Refuse a tube that is too narrow for the drone, of some radius (m), along a centreline that was found.

    A centreline of the user's may pass closer to the wall than the drone does.

    Raises:
        CentrelineError: it is too narrow; says where, and what scale makes it wide enough.
    """
    if tube.found is None:
        return
    from meshes.inspection import clearance_of  # scipy comes with it, which a given centreline does not need

    # The drone comes no closer to the ends than half a radius, where there may be caps.
    to_end = np.minimum(tube.arc_length, tube.length - tube.arc_length)
    clearance = np.where(to_end < 0.5 * tube.radius, np.inf, clearance_of(tube.wall, tube.axis))
    i = int(np.argmin(clearance))
    if clearance[i] <= body_radius:
        raise CentrelineError(
            f"{tube.path}: expected room for the drone, whose radius is {body_radius:g} m, found "
            f"{clearance[i]:.3g} m from the centre to the wall at {place(tube.wall, tube.axis[i])}, "
            f"{tube.arc_length[i]:.3g} m along of {tube.length:.3g} m; a larger scale makes it wider: --scale "
            f"radius={ROOM * body_radius / clearance[i] * tube.radius.mean():.2g} or more"
        )


def _scale_notes(tube: Tube, options: FlightOptions) -> Iterator[str]:
    """Scale and axes, where the user left them open."""
    mean = float(tube.radius.mean())
    stated = tube.wall.stated
    if isinstance(options.scale, MeanRadius):
        yield f"scale: {tube.scale:.6g} m a unit, for a mean radius of {mean:.3g} m"
    elif options.scale is None and stated.unit is not None:
        yield f"scale: {tube.scale:g} m a unit, as {stated.where}"
    if not USUAL_RADIUS[0] <= mean <= USUAL_RADIUS[1]:
        yield f"scale: a mean radius of {mean:.3g} m, where tubes of 1 m suit the drone (--scale radius=1)"
        guess = guess_unit(mean / tube.scale, stated)
        if options.scale is None and guess.advice:
            yield f"scale: taken as {tube.scale:g} m a unit, but {guess.reason}; {guess.advice}"
    if options.axes == "auto" and stated.axes is not None:
        yield f"axes: {'Y' if tube.axes == 'yup' else 'Z'} up, as {stated.where}"


def _found_notes(tube: Tube, found: FoundCentreline, options: FlightOptions) -> Iterator[str]:
    """The ends that were chosen, in the coordinates of the file, and what else there is to know."""
    ends = []
    for end, number, capped in zip(found.points[[0, -1]], found.used, found.capped, strict=True):
        what = f"opening {number}" if number is not None else "a cap" if capped else "a place inside"
        ends.append(f"{what} at {place(tube.wall, end)}")
    if options.start_end == "last":
        ends.reverse()
    openings = len(found.openings)
    yield (
        f"centreline: found, {tube.length:.3g} m from {ends[0]} to {ends[1]}; the tube has "
        f"{openings or 'no'} opening{'' if openings == 1 else 's'}"
    )
    for note in found.notes:
        yield f"mesh: {note}"
