"""Runs on a stage: tube, centreline, trajectories and drones, at one moment of simulated time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import NDArray

from cosim.cameras import INSIDE_BACK, Camera, follow, inside, overview
from cosim.drone_figure import KEY, DroneFigure, Sighting
from cosim.report_tube import simplify
from cosim.scales import Quantity, scale_of
from cosim.scene import Surface
from cosim.senses import local_frames
from cosim.tracks import Track
from cosim.winding import face_outwards
from meshes.embree import RayScene

if TYPE_CHECKING:
    from cosim.vedo_scene import Stage

Floats = NDArray[np.float64]
View = Literal["overview", "follow", "inside"]
VIEWS: Final[tuple[View, ...]] = ("overview", "follow", "inside")

WALL_COLOUR: Final = "#9fb0c0"
RIM_COLOUR: Final = "#5d6d7c"
AXIS_COLOUR: Final = "#e0a020"
DRONE_COLOUR: Final = "#d9382f"
RUN_COLOURS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Of several runs, in turn: told apart with any kind of colour vision."""

TRIANGLES: Final = 400_000
"""Of a wall that is drawn at most; rays are computed with all of them."""
MOST_POINTS: Final = 4000
"""Of a trajectory that is drawn."""
PATH_WIDTH: Final = 4.0
"""Of a trajectory (pixels)."""


class Playback:
    """Tracks on a stage, the first of them followed by the camera; moments are records of the longest one.

    Args:
        stage: an empty one.
        tracks: at least one.
        colour: what the trajectories are coloured by; None: a single one by its clearance, several each in a
            colour of its own.
        view: where the camera stands.
    """

    def __init__(self, stage: Stage, tracks: Sequence[Track], *, colour: Quantity | None, view: View) -> None:
        self._stage, self._tracks = stage, tracks
        self._view, self._turned = view, False
        self.leader = max(tracks, key=lambda track: float(track.scene.times[-1]))
        """The track whose records are the moments."""
        walls = _put_up(stage, tracks)
        own = [DRONE_COLOUR] if len(tracks) == 1 else [*RUN_COLOURS * len(tracks)][: len(tracks)]
        self._draw_paths(colour if colour or len(tracks) > 1 else "clearance", own)
        self._drones = [
            DroneFigure(
                stage,
                track.sensors,
                walls[id(track.scene.tube)],
                body_radius=track.body_radius,
                colour=shade,
            )
            for track, shade in zip(tracks, own, strict=True)
        ]
        names = [(track.name, shade) for track, shade in zip(tracks, own, strict=True)]
        stage.legend([*(names if len(tracks) > 1 else []), ("centreline", AXIS_COLOUR), *KEY])
        self._say = stage.text("", "top-left", size=0.8)
        self._overview = overview(
            np.concatenate([track.scene.tube.vertices for track in tracks]), stage.size[0] / stage.size[1]
        )

    @property
    def last(self) -> int:
        """Number of the last moment."""
        return self.leader.last

    def show(self, k: int) -> None:
        """Show moment k and look at it."""
        time = float(self.leader.scene.times[k])
        for track, drone in zip(self._tracks, self._drones, strict=True):
            i = track.at(time)
            record = track.record(i)
            drone.show(
                track.scene.positions[i],
                track.scene.quaternions[i],
                np.array(record["lidar"]),
                Sighting(
                    target=np.array(record["target_position"]) if record["target_visible"] else None,
                    memory=np.array(record["memory_direction"])
                    if record["memory_available"] and not record["target_visible"]
                    else None,
                ),
            )
        if len(self._tracks) == 1:
            self._say(self.leader.words(k))
        else:
            self._say("\n".join(track.brief(track.at(time)) for track in self._tracks))
        self._look(k)

    @property
    def view(self) -> View:
        """Where the camera stands."""
        return self._view

    def change_view(self, view: View, k: int) -> None:
        """Put the camera elsewhere, at moment k."""
        self._view, self._turned = view, False
        self._look(k)

    def _look(self, k: int) -> None:
        """Put the camera where the view wants it; an overview stays as the user has turned it."""
        if self._view != "overview" or not self._turned:
            self._stage.look(self._camera(k))
        self._turned = True

    def _camera(self, k: int) -> Camera:
        if self._view == "overview":
            return self._overview
        track = self.leader
        record = track.record(k)
        position, tangent = track.scene.positions[k], np.array(record["tangent"])
        radius = float(record["radius"])
        if self._view == "follow":
            return follow(position, tangent, radius)
        behind = float(record["arc_length"]) - INSIDE_BACK * radius
        up = local_frames(position[None], track.scene.quaternions[k][None])[0, 1]
        return inside(position, _axis_at(track, behind), tangent, up, radius)

    def _draw_paths(self, quantity: Quantity | None, own: Sequence[str]) -> None:
        values = [] if quantity is None else [track.values(quantity) for track in self._tracks]
        # The reward of the last step is worth all others together, and would leave them one colour.
        share = 0.02 if quantity == "reward" else 0.0
        low = min((float(np.quantile(v, share)) for v in values), default=0.0)
        high = max((float(np.quantile(v, 1.0 - share)) for v in values), default=1.0)
        scale = None
        if quantity is not None:
            scale = scale_of(quantity, low, high)
            self._stage.scale(scale)
        for i, track in enumerate(self._tracks):
            stride = max(1, -(-len(track.scene.positions) // MOST_POINTS))
            points = _moving(track.scene.positions[::stride])
            if points is None:
                continue
            path, kept = points
            line = self._stage.lines([path], own[i], PATH_WIDTH)
            if scale is not None:
                line.shade(values[i][::stride][kept], scale)


def _put_up(stage: Stage, tracks: Sequence[Track]) -> dict[int, RayScene]:
    """Put up every tube that is flown through once; returns what ends rays, by the tubes' ids."""
    walls: dict[int, RayScene] = {}
    shown: list[tuple[Surface, RayScene]] = []
    for track in tracks:
        tube = track.scene.tube
        same = next((rays for other, rays in shown if np.array_equal(other.vertices, tube.vertices)), None)
        if same is None:
            same = RayScene(tube.vertices, tube.faces)
            shown.append((tube, same))
            put_up_tube(stage, tube, track.centreline, TRIANGLES)
        walls[id(tube)] = same
    return walls


def put_up_tube(stage: Stage, tube: Surface, axis: Floats, most: int, ghost: float = 0.1) -> None:
    """Put up a wall, cut open, and its axis (M, 3); of more than `most` triangles a simpler wall, which says so.

    Raises:
        CosimError: it must be simplified, and the library for that is not installed.
    """
    drawn = tube
    if len(tube.faces) > most:
        drawn = simplify(tube, most)
        stage.text(
            f"wall drawn with {len(drawn.faces):,} of its {len(tube.faces):,} triangles",
            "bottom-right",
            size=0.6,
        )
    stage.wall(face_outwards(drawn, axis), WALL_COLOUR, cut=True, ghost=ghost)
    stage.rims(drawn, RIM_COLOUR)
    stage.lines([axis], AXIS_COLOUR, 2.0)


def _moving(points: Floats) -> tuple[Floats, NDArray[np.bool_]] | None:
    """The points without those at the place of their predecessor, and which those are; None for fewer than two."""
    kept = np.ones(len(points), dtype=bool)
    kept[1:] = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-9
    return (points[kept], kept) if kept.sum() > 1 else None


def _axis_at(track: Track, arc_length: float) -> Floats:
    """The axis of what was flown at an arc length (m), carried on straight before its beginning."""
    axis = track.scene.axis
    first = float(track.record(0)["arc_length"])
    along = first + np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(axis, axis=0), axis=1))])
    if arc_length < along[0] and len(axis) > 1:
        start = (axis[1] - axis[0]) / np.linalg.norm(axis[1] - axis[0])
        return axis[0] + (arc_length - along[0]) * start  # type: ignore[no-any-return]
    return np.array([np.interp(arc_length, along, axis[:, c]) for c in range(3)])
