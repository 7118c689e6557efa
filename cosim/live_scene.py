"""What the live viewer shows: tube, drone, its way so far, and what is computed of its senses."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from cosim.cameras import INSIDE_BACK, Camera, follow, inside, overview
from cosim.drone_figure import DroneFigure, Sighting, arrow, frame_along
from cosim.film import write_picture
from cosim.playback import AXIS_COLOUR, DRONE_COLOUR, PATH_WIDTH, RIM_COLOUR, RUN_COLOURS, VIEWS, WALL_COLOUR
from cosim.report_tube import simplify
from cosim.scene import Surface
from cosim.senses import local_frames
from cosim.view import open_stage
from cosim.view_window import NAP_S, QUIT
from cosim.winding import face_outwards
from meshes.tube import read_tube

if TYPE_CHECKING:
    from cosim.live_view import Watched
    from protocol.observer import Observer, Snapshot
    from protocol.plant import PoseBatch

Floats = NDArray[np.float64]

SIZE: Final = (960, 600)
FRAME_SIZE: Final = (480, 320)
COMMAND_COLOUR: Final = "#12a150"
TRIANGLES: Final = 60_000
"""Of the wall that is drawn at most; rays are computed with all of them."""
TRAIL_POINTS: Final = 1500
"""Of the way that is drawn; twice as many are thinned out."""


class LiveScene:
    """A stage that follows a session.

    Args:
        what: is watched.

    Raises:
        ViewError: vedo is missing, or there is no display.
        MeshError: the mesh cannot be read.
    """

    def __init__(self, what: Watched) -> None:
        self._frames = None if what.frames is None else Path(what.frames)
        self._body_radius = what.body_radius
        size = FRAME_SIZE if self._frames else SIZE
        stage = open_stage(size, offscreen=self._frames is not None, title="cosim launch", smooth=False)
        self._stage = stage
        tube = read_tube(what.mesh, what.centreline, what.axes, what.scale, what.start_end)  # type: ignore[arg-type]
        self._tube = tube
        surface = Surface(tube.wall.vertices, tube.wall.faces)
        if len(surface.faces) > TRIANGLES:
            surface = simplify(surface, TRIANGLES)
        stage.wall(face_outwards(surface, tube.axis), WALL_COLOUR, cut=True, ghost=0.0)
        stage.rims(surface, RIM_COLOUR)
        stage.lines([tube.axis], AXIS_COLOUR, 2.0)
        self._drone = DroneFigure(
            stage, what.sensors, tube.wall.scene, body_radius=what.body_radius, colour=DRONE_COLOUR
        )
        self._command = stage.surface(arrow(), COMMAND_COLOUR)
        self._trail = stage.lines([np.zeros((TRAIL_POINTS, 3))], RUN_COLOURS[0], PATH_WIDTH)
        self._way: list[Floats] = []
        self._say = stage.text("waiting for the first pose", "top-left")
        self._overview = overview(surface.vertices, size[0] / size[1])
        self._view = VIEWS.index("follow")
        self._seen = -1
        self.open = True
        stage.look(self._overview)
        if self._frames is None:
            stage.on_key(self._press)
            stage.text("c camera   q close: the flight goes on", "bottom-left", size=0.6)

    def draw(self, observer: Observer) -> None:
        """Draw the newest pose, if it was not drawn yet."""
        snapshot = observer.latest()
        if snapshot is not None and snapshot.number != self._seen:
            self._seen = snapshot.number
            if np.any(snapshot.poses.quaternion[0]):  # else the lane was not reset yet
                self._show(snapshot, observer)
        if self._frames is None:
            self._stage.draw()
        elif snapshot is not None:
            picture = self._stage.picture()
            write_picture(self._frames / f"frame-{snapshot.step:06d}.png", picture, quickly=True)

    def wait(self, until: float) -> None:
        """Answer to mouse and keys until a time of the monotonic clock (s)."""
        while self.open and (left := until - time.monotonic()) > 0.0:
            if self._frames is None and not self._stage.pump():
                self.open = False
            time.sleep(min(NAP_S, left))

    def linger(self, seconds: float) -> None:
        """Leave the last picture for a while, or until the window is closed."""
        if self._frames is None:
            self.wait(time.monotonic() + seconds)

    def close(self) -> None:
        """Take it down."""
        self._stage.close()

    def _press(self, key: str) -> None:
        if key in QUIT:
            self.open = False
        elif key == "c":
            self._view = (self._view + 1) % len(VIEWS)
            if VIEWS[self._view] == "overview":
                self._stage.look(self._overview)

    def _show(self, snapshot: Snapshot, observer: Observer) -> None:
        poses = snapshot.poses
        position, quaternion = poses.position[0], poses.quaternion[0]
        self._drone.show(position, quaternion, None, Sighting(None, None))
        request = observer.request()
        direction = np.zeros(3) if request is None else request.commands.direction[0]
        speed = 0.0 if request is None else float(request.commands.speed[0])
        self._command.show(speed > 0.0 and bool(np.any(direction)))
        if speed > 0.0 and np.any(direction):
            length = 4.0 * speed * self._body_radius
            self._command.place(position, length * frame_along(direction / np.linalg.norm(direction)))
        self._show_trail(position)
        tube = self._tube
        i = int(np.argmin(np.linalg.norm(tube.axis - position, axis=1)))
        self._say(self._words(snapshot, float(tube.arc_length[i]), speed))
        if VIEWS[self._view] != "overview":
            self._stage.look(self._camera(i, poses))

    def _words(self, snapshot: Snapshot, along: float, commanded: float) -> str:
        poses, length = snapshot.poses, self._tube.length
        moving = float(np.linalg.norm(poses.linear_velocity[0]))
        touched = "   CONTACT" if poses.contact_steps[0] else ""
        return (
            f"LIVE   step {snapshot.step}   {poses.sim_time[0]:.1f} s   {100.0 * along / length:.1f} % of "
            f"{length:.1f} m\n{moving:.2f} m/s   commanded {commanded:.2f} m/s{touched}"
        )

    def _show_trail(self, position: Floats) -> None:
        way = self._way
        if not way or np.linalg.norm(position - way[-1]) > 0.02:
            way.append(position.copy())
        if len(way) > TRAIL_POINTS:
            del way[1:-1:2]
        self._trail.move(np.array(way + [way[-1]] * (TRAIL_POINTS - len(way))))

    def _camera(self, i: int, poses: PoseBatch) -> Camera:
        tube, position = self._tube, poses.position[0]
        tangent, radius = tube.tangent[i], float(tube.radius[i])
        if VIEWS[self._view] == "follow":
            return follow(position, tangent, radius)
        back = INSIDE_BACK * radius
        behind = tube.axis[max(i - round(back / tube.step), 0)]
        up = local_frames(poses.position, poses.quaternion)[0, 1]
        return inside(position, behind, tangent, up, radius)
