"""A mesh on a stage: its wall, centreline and openings, and the paper's figure of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from cosim.cameras import INSIDE_BACK, Camera, follow, inside, overview
from cosim.drone_figure import frame_along
from cosim.errors import ViewError
from cosim.playback import AXIS_COLOUR, RIM_COLOUR, WALL_COLOUR, View
from cosim.scene import Surface
from cosim.winding import face_outwards
from meshes.errors import CentrelineError
from meshes.formats import AxesChoice
from meshes.scale import MeanRadius
from meshes.tube import read_tube
from meshes.wall import read_wall

if TYPE_CHECKING:
    from cosim.film import Image
    from cosim.vedo_scene import Stage
    from meshes.openings import Opening  # at run time only where one is looked for

Floats = NDArray[np.float64]

OPENING_COLOUR: Final = "#c2185b"
"""Of the rings around openings, and of their numbers."""
BLENDER_SKY: Final = ("#393939", "#484848")
BLENDER_WALL: Final = "#c4c4c4"
BLENDER_LINE: Final = "#ff9d33"
BLENDER_GRID: Final = "#5c5c5c"
"""As Blender's solid view draws: an opaque grey surface, a selected edge, the floor."""
_PANELS: Final = (
    "(a) conduit as in Blender's solid view",
    "(b) conduit in vedo",
    "(c) centreline as in Blender",
    "(d) centreline in vedo",
)


@dataclass(frozen=True)
class MeshChoice:
    """How a mesh is to be read; see `meshes.tube.read_tube`."""

    centerline: Path | None = None
    axes: AxesChoice = "auto"
    scale: float | MeanRadius | None = None
    entry: tuple[float, float, float] | int | None = None
    exit: tuple[float, float, float] | int | None = None

    def read(self, path: Path) -> ViewedMesh:
        """Read the mesh, with its centreline if it has one or one can be found.

        Raises:
            MeshError: the mesh cannot be read.
        """
        try:
            tube = read_tube(path, self.centerline, self.axes, self.scale, "first", self.entry, self.exit)
        except CentrelineError as error:
            scale = None if isinstance(self.scale, MeanRadius) else self.scale
            wall = read_wall(path, self.axes, scale)
            surface, note = Surface(wall.vertices, wall.faces), f"no centreline is shown: {error}"
            return ViewedMesh(path, surface, None, None, self._openings(path), note)
        found = tube.found
        openings = () if found is None else found.openings
        note = "" if found is None else "the centreline shown was found from the mesh"
        return ViewedMesh(
            path, Surface(tube.wall.vertices, tube.wall.faces), tube.axis, tube.radius, openings, note
        )

    def _openings(self, path: Path) -> tuple[Opening, ...]:
        """The openings of a mesh that does not say which of them are meant; none where it has not as many."""
        if self.entry is not None or self.exit is not None:
            return ()
        try:
            tube = read_tube(path, None, self.axes, None, "first", 1, 2)
        except CentrelineError:
            return ()
        assert tube.found is not None
        factor = self.scale / tube.scale if isinstance(self.scale, float) else 1.0
        return tuple(opening.scaled(factor) for opening in tube.found.openings)


@dataclass(frozen=True)
class ViewedMesh:
    """A mesh and what is known of the tube that it is."""

    path: Path
    surface: Surface
    axis: Floats | None  # (M, 3)
    """Centreline (m), world frame; None where there is none."""
    radius: Floats | None  # (M,)
    """Local radius (m)."""
    openings: tuple[Opening, ...]
    """Those that were found; numbered from 1."""
    note: str
    """What a user should know; may be empty."""


def put_up_mesh(stage: Stage, mesh: ViewedMesh, view: View) -> None:
    """Show a mesh: cut open where its centreline is known, else translucent.

    Raises:
        ViewError: a view along a centreline, which is not known.
    """
    stage.rims(mesh.surface, RIM_COLOUR)
    size = f"{len(mesh.surface.faces)} triangles"
    if mesh.axis is None or mesh.radius is None:
        stage.wall(mesh.surface, WALL_COLOUR, cut=False, ghost=0.35)
    else:
        stage.wall(face_outwards(mesh.surface, mesh.axis), WALL_COLOUR, cut=True)
        stage.lines([mesh.axis], AXIS_COLOUR, 3.0)
        length = float(np.linalg.norm(np.diff(mesh.axis, axis=0), axis=1).sum())
        size = f"centreline {length:.3g} m   median radius {np.median(mesh.radius):.3g} m   {size}"
    if mesh.openings:
        stage.lines([_ring(opening) for opening in mesh.openings], OPENING_COLOUR, 3.0)
        stage.numbers([o.centre + 0.3 * o.radius * o.outward for o in mesh.openings], OPENING_COLOUR)
    stage.text(f"{mesh.path.name}\n{size}", "top-left")
    stage.look(_camera(mesh, view, stage.size))


def draw_figure(mesh: ViewedMesh, size: tuple[int, int], open_stage: Callable[..., Stage]) -> Image:
    """The paper's figure of the conduit: it and its centreline in Blender and in vedo.

    All four panels are drawn by vedo; those on the left in the manner of Blender's solid view.

    Raises:
        ViewError: the mesh has no centreline.
    """
    if mesh.axis is None:
        raise ViewError("--figure: expected a mesh with a centreline, found none")
    width, height = size[0] // 2, size[1] // 2
    camera = overview(mesh.surface.vertices, width / height)
    panels = []
    for number, caption in enumerate(_PANELS):
        blender, line = number % 2 == 0, number >= 2
        stage = open_stage((width, height), offscreen=True, **({"sky": BLENDER_SKY} if blender else {}))
        try:
            if blender:
                _draw_floor(stage, mesh.surface.vertices)
            if line:
                stage.lines([mesh.axis], BLENDER_LINE if blender else AXIS_COLOUR, 3.0)
            elif blender:
                stage.wall(mesh.surface, BLENDER_WALL, cut=False, ghost=1.0)
            if not blender:
                stage.wall(mesh.surface, WALL_COLOUR, cut=False, ghost=0.12 if line else 0.4)
                stage.lines([mesh.axis], AXIS_COLOUR, 4.0 if line else 2.5)
            stage.text(caption, "bottom-left", size=1.1)
            stage.look(camera)
            panels.append(stage.picture())
        finally:
            stage.close()
    return np.vstack([np.hstack(panels[:2]), np.hstack(panels[2:])])


def _camera(mesh: ViewedMesh, view: View, size: tuple[int, int]) -> Camera:
    if view == "overview":
        return overview(mesh.surface.vertices, size[0] / size[1])
    if mesh.axis is None or mesh.radius is None:
        raise ViewError(f"--camera {view}: expected a centreline to look along, found none")
    i = len(mesh.axis) // 2
    tangent = mesh.axis[min(i + 1, len(mesh.axis) - 1)] - mesh.axis[max(i - 1, 0)]
    tangent /= np.linalg.norm(tangent)
    radius = float(mesh.radius[i])
    if view == "follow":
        return follow(mesh.axis[i], tangent, radius)
    behind = mesh.axis[i] - INSIDE_BACK * radius * tangent
    return inside(mesh.axis[i], behind, tangent, np.array([0.0, 0.0, 1.0]), radius)


def _draw_floor(stage: Stage, vertices: Floats) -> None:
    """A floor of squares under a tube, its middle lines red along x and green along y."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    extent = float((high - low).max())
    square = 10.0 ** np.floor(np.log10(extent / 4.0))
    first, last = np.floor(low / square) * square, np.ceil(high / square) * square
    x, y = (np.arange(first[c] - square, last[c] + 1.5 * square, square) for c in (0, 1))
    z = float(low[2])
    along_x = [np.array([[x[0], v, z], [x[-1], v, z]]) for v in y]
    along_y = [np.array([[v, y[0], z], [v, y[-1], z]]) for v in x]
    stage.lines(along_x + along_y, BLENDER_GRID, 1.0)
    if y[0] <= 0.0 <= y[-1]:
        stage.lines([np.array([[x[0], 0.0, z], [x[-1], 0.0, z]])], "#a0383f", 1.5)
    if x[0] <= 0.0 <= x[-1]:
        stage.lines([np.array([[0.0, y[0], z], [0.0, y[-1], z]])], "#6a9a2d", 1.5)


def _ring(opening: Opening) -> Floats:
    """A closed ring around an opening, (49, 3)."""
    rotation = frame_along(opening.outward)
    angle = np.linspace(0.0, 2.0 * np.pi, 49)[:, None]
    around: Floats = np.cos(angle) * rotation[:, 1] + np.sin(angle) * rotation[:, 2]
    return opening.centre + 1.05 * opening.radius * around
