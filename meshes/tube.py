"""Tubes from files: the wall, and the centreline that runs inside it."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from meshes.centreline import parse_centreline, resample
from meshes.errors import CentrelineError
from meshes.formats import Axes, AxesChoice
from meshes.geometry import Bools, Floats
from meshes.obj import read_bytes
from meshes.scale import MeanRadius
from meshes.wall import Wall, read_wall, to_world

if TYPE_CHECKING:
    from meshes.centreline_finding import FoundCentreline  # at run time only where one is looked for

INDUSTRIAL = Path(__file__).parent / "industrial" / "industrial.obj"
"""The shipped conduit."""

LONGEST_STEP = 0.1
"""Longest step of a resampled centreline (m)."""
LEAST_STEPS = 200
"""Steps that a short tube has at least."""
LENGTHS = (1e-3, 1e5)
"""Shortest and longest centreline (m): what lies outside is a wrong unit, not a tube."""
TRIAL_EXTENT = 100.0
"""Diagonal of the bounding box (m) at which a tube is measured that is to become so wide."""
RING = 36
"""Rays over which the local radius is the mean."""
LEAST_HITS = RING // 2 + 1
"""Rays of a ring that must meet a wall: from outside of a convex wall fewer than half of them can. The rest may
leave through a side opening, or near an end through a mouth that is not square to the centreline."""
WIDEST_JOINT = 1.0
"""Fewer may meet one where segments of a tube leave a gap between them, up to so many radii long."""


@dataclass(frozen=True)
class Tube:
    """A wall and its centreline, resampled at M even arc lengths from the end where the drone starts."""

    wall: Wall
    axis: Floats  # (M, 3)
    """Points of the centreline (m), world frame."""
    tangent: Floats  # (M, 3)
    """Unit tangents, away from the start."""
    radius: Floats  # (M,)
    """Local radius R (m): mean distance of the wall's inner surface from the axis in the local section."""
    arc_length: Floats  # (M,)
    """From the start (m)."""
    step: float
    """Arc length between neighbouring points (m)."""
    length: float
    """Length of the centreline (m)."""
    centreline_path: Path | None
    """None where the centreline was found from the wall."""
    centreline_sha256: str
    """Of the bytes of the centreline's file; of a found one, of its points in the file's coordinates."""
    found: FoundCentreline | None = None
    """How the centreline was found, where it was."""

    @property
    def path(self) -> Path:
        """Where the wall was read from."""
        return self.wall.path

    @property
    def sha256(self) -> str:
        """Of the bytes of the wall's file, in hexadecimal."""
        return self.wall.sha256

    @property
    def axes(self) -> Axes:
        """Axes of both files."""
        return self.wall.axes

    @property
    def scale(self) -> float:
        """Metres in one unit of both files."""
        return self.wall.scale


def read_tube(
    mesh: str | Path,
    centreline: str | Path | None = None,
    axes: AxesChoice = "auto",
    scale: float | MeanRadius | None = None,
    start_end: Literal["first", "last"] = "first",
    entry: ArrayLike | None = None,
    exit: ArrayLike | None = None,
) -> Tube:
    """Read a wall, read or find its centreline, and check that the one runs inside the other.

    Args:
        mesh: the file of the wall.
        centreline: the .obj of the centreline; None for `<mesh stem>_centerline.obj` beside the mesh. Where that
            is absent, or `entry` or `exit` is given, the centreline is found from the wall.
        axes: of both files, see `read_wall`.
        scale: metres in one unit of both files, see `read_wall`.
        start_end: the end of the centreline where the drone starts; "first" is the one whose vertex stands
            first in the file, or the found one's first.
        entry: where to start: a point (3,) in the coordinates of the file, or the number of an opening, see
            `find_centreline`.
        exit: where to end.

    Raises:
        MeshReadError: either file cannot be read.
        CentrelineError: the centreline cannot be found, is no single open path, has a length out of `LENGTHS`,
            or leaves the tube; or one is named, and ends for another.
    """
    if centreline is not None and not (entry is None and exit is None):
        raise CentrelineError(
            f"{centreline}: expected a centreline or an entry and an exit, found both: a centreline has its own ends"
        )
    if isinstance(scale, MeanRadius):
        return _read_as_wide(mesh, scale.metres, centreline, axes, start_end, entry, exit)
    return _tube_in(read_wall(mesh, axes, scale), centreline, start_end, entry, exit)


def _read_as_wide(
    mesh: str | Path,
    radius: float,
    centreline: str | Path | None,
    axes: AxesChoice,
    start_end: Literal["first", "last"],
    entry: ArrayLike | None,
    exit: ArrayLike | None,
) -> Tube:
    """Read a tube at the scale at which its mean radius is as wanted (m), whatever its unit."""
    from meshes.sections import mean_radius

    wall = read_wall(mesh, axes)
    extent = float(np.linalg.norm(np.ptp(wall.vertices, axis=0))) or 1.0
    tube = _tube_in(wall.rescaled(wall.scale * TRIAL_EXTENT / extent), centreline, start_end, entry, exit)
    factor = radius / mean_radius(tube.wall.scene, tube.axis, tube.tangent)
    metres = tube.scale * factor
    if tube.found is None:
        return read_tube(mesh, centreline, tube.axes, metres, start_end)
    return _tube_of_found(tube.wall.rescaled(metres), tube.found.scaled(factor), start_end)


def _tube_in(
    wall: Wall,
    centreline: str | Path | None,
    start_end: Literal["first", "last"],
    entry: ArrayLike | None,
    exit: ArrayLike | None,
) -> Tube:
    path = None if entry is not None or exit is not None else _find_centreline_file(wall.path, centreline)
    if path is None:
        return _tube_of_found(wall, _find(wall, entry, exit), start_end)
    content = read_bytes(path)
    points = to_world(parse_centreline(content, path), wall.axes, wall.scale, path)
    return _tube(wall, points, path, hashlib.sha256(content).hexdigest(), start_end)


def _find(wall: Wall, entry: ArrayLike | None, exit: ArrayLike | None) -> FoundCentreline:
    # Here, since scipy takes a while that others do not need.
    from meshes.centreline_finding import find_centreline

    ends = (
        end
        if end is None or isinstance(end, int)
        else wall.to_world(np.reshape(end, (1, 3)).astype(float))[0]
        for end in (entry, exit)
    )
    return find_centreline(wall, *ends)


def _tube_of_found(wall: Wall, found: FoundCentreline, start_end: Literal["first", "last"]) -> Tube:
    sha256 = hashlib.sha256(np.ascontiguousarray(wall.to_file(found.points)).tobytes()).hexdigest()
    return replace(_tube(wall, found.points, None, sha256, start_end), found=found)


def _tube(
    wall: Wall, points: Floats, path: Path | None, sha256: str, start_end: Literal["first", "last"]
) -> Tube:
    if start_end == "last":
        points = points[::-1]
    length = _length(points, wall.scale, path or wall.path)
    axis, tangent = resample(points, min(LONGEST_STEP, length / LEAST_STEPS))
    tube = Tube(
        wall=wall,
        axis=axis,
        tangent=tangent,
        radius=np.zeros(len(axis)),
        arc_length=np.linspace(0.0, length, len(axis)),
        step=length / (len(axis) - 1),
        length=length,
        centreline_path=path,
        centreline_sha256=sha256,
    )
    return replace(tube, radius=_local_radius(tube))


def _find_centreline_file(mesh: Path, named: str | Path | None) -> Path | None:
    """The file of the centreline; None where none is named and none lies beside the mesh."""
    if named is not None:
        path = Path(named)
        if _is_missing(path):
            raise CentrelineError(f"{path}: expected the centreline of {mesh} here, found no such file")
        return path
    path = mesh.with_name(f"{mesh.stem}_centerline.obj")
    return None if _is_missing(path) else path


def _is_missing(path: Path) -> bool:
    """Whether nothing is there; what is there and cannot be read is left to `read_bytes` to explain."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return True
    except OSError:
        return False
    return False


def _length(points: Floats, scale: float, path: Path) -> float:
    """Length (m) of a polyline (P, 3) that is plausible for a tube; CentrelineError for any other."""
    with np.errstate(under="ignore"):
        length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    shortest, longest = LENGTHS
    if not shortest <= length <= longest:
        raise CentrelineError(
            f"{path}: scale: expected one that makes the centreline {shortest:g} m to {longest:g} m long, found "
            f"{scale:g} metres a unit, which makes it {length:.4g} m; check the unit of the file"
        )
    return length


def _local_radius(tube: Tube) -> Floats:
    """Mean wall distance over a ring of rays in each local section, (M,).

    A section that some rays leave through an opening has no such mean: it takes the radius between those of its
    whole neighbours, since the rays that remain would favour one side.

    Raises:
        CentrelineError: a point has too few walls around it, and does not stand in a joint, or a wall lies between
            neighbouring points.
    """
    origins = tube.axis.copy()
    # At the very ends half of the rays could pass the rim: look from half a step inside.
    origins[0] += tube.tangent[0] * tube.step / 2
    origins[-1] -= tube.tangent[-1] * tube.step / 2
    directions = _ring(tube.tangent)
    distances = tube.wall.scene.distances(
        np.repeat(origins, RING, axis=0), directions.reshape(-1, 3), np.inf
    ).reshape(-1, RING)
    hit = np.isfinite(distances)

    hits = hit.sum(axis=1)
    crossed = np.zeros(len(hits), dtype=bool)
    crossed[1:] = tube.wall.scene.blocked(tube.axis[:-1], tube.axis[1:])
    bare = hits < LEAST_HITS
    wrong = crossed | (bare & ~_in_joints(tube, bare, hits == RING, distances))
    if wrong.any():
        i = int(np.argmax(wrong))
        found = f"{RING - hits[i]} of {RING} rays around it that meet no wall"
        if crossed[i]:
            found += " and the wall crossed by it"
        raise CentrelineError(
            f"{tube.centreline_path or 'found'}: expected a centreline inside of the tube {tube.path.name}, found at "
            f"arc length {tube.arc_length[i]:.2f} m of {tube.length:.2f} m {found}; "
            f"{wrong.sum()} of {len(wrong)} points are wrong: check that both files have the same axes and unit"
        )
    radius = np.where(hit, distances, 0.0).sum(axis=1) / np.maximum(hits, 1)
    whole = hits == RING
    if whole.any():
        radius = np.interp(tube.arc_length, tube.arc_length[whole], radius[whole])
    return radius  # type: ignore[no-any-return]


def _in_joints(tube: Tube, bare: Bools, whole: Bools, distances: Floats) -> Bools:
    """Which of the bare points (M,) stand in a short gap between two segments of the tube, (M,)."""
    in_joints = np.zeros(len(bare), dtype=bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], bare.astype(np.int8), [0]])))
    for first, stop in edges.reshape(-1, 2):
        before, behind = np.flatnonzero(whole[:first])[-1:], stop + np.flatnonzero(whole[stop:])[:1]
        if not (len(before) and len(behind)):
            continue
        gap = tube.arc_length[behind[0]] - tube.arc_length[before[0]] - tube.step
        in_joints[first:stop] = gap <= WIDEST_JOINT * distances[[before[0], behind[0]]].mean()
    return in_joints


def _ring(tangent: Floats) -> Floats:
    """Directions (M, RING, 3) evenly around unit tangents (M, 3)."""
    least_aligned = np.eye(3)[np.argmin(np.abs(tangent), axis=1)]
    side = np.cross(tangent, least_aligned)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(tangent, side)
    angle = np.linspace(0.0, 2 * np.pi, RING, endpoint=False)
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return cos * side[:, None] + sin * other[:, None]  # type: ignore[no-any-return]
