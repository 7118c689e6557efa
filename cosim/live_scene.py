"""What the live viewer shows: tube, drone, its way so far, and what is computed of its senses."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from cosim.cameras import INSIDE_BACK, Camera, follow, inside, overview
from cosim.drone_figure import KEY as SENSES_KEY
from cosim.drone_figure import DroneFigure, arrow, frame_along
from cosim.film import write_picture
from cosim.live_senses import LiveSenses, Sensed
from cosim.playback import AXIS_COLOUR, DRONE_COLOUR, PATH_WIDTH, RUN_COLOURS, VIEWS, put_up_tube
from cosim.scales import scale_of
from cosim.scene import Surface
from cosim.senses import local_frames
from cosim.view import open_stage
from cosim.view_window import QUIT
from meshes.tube import read_tube

if TYPE_CHECKING:
    from cosim.live_view import Watched
    from protocol.observer import Observer, Snapshot
    from protocol.plant import PoseBatch

Floats = NDArray[np.float64]

SIZE: Final = (800, 500)
"""Of the window at first (pixels). Without a graphics card a picture takes its time by the pixel: 20 ms here."""
FRAME_SIZE: Final = (480, 320)
COMMAND_COLOUR: Final = "#d81b8c"
KEY: Final = (
    ("centreline", AXIS_COLOUR),
    ("command", COMMAND_COLOUR),
    *SENSES_KEY,
)
"""What the colours mean."""
HELP: Final = "c camera   q close: the flight goes on   way through the poses seen"
NAP_S: Final = 0.025
"""Between two looks at the session (s): each takes a core from it for a moment where it has all of them."""
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
        put_up_tube(stage, surface, tube.axis, TRIANGLES, ghost=0.0)
        self._drone = DroneFigure(
            stage, what.sensors, tube.wall.scene, body_radius=what.body_radius, colour=DRONE_COLOUR
        )
        self._command = stage.surface(arrow(), COMMAND_COLOUR)
        self._trail = stage.lines([np.zeros((TRAIL_POINTS, 3))], RUN_COLOURS[0], PATH_WIDTH)
        self._scale = scale_of("clearance", 0.0, float(np.median(tube.radius)) - what.body_radius)
        stage.scale(self._scale)
        self._senses = LiveSenses(tube, what.sensors, what.memory_steps, what.body_radius)
        self._sensed: Sensed | None = None
        """At the pose that was seen last."""
        self._seen = -1
        self._way: list[tuple[Floats, float]] = []
        """Places where the drone was seen, and the gap there (m)."""
        stage.legend(KEY)
        self._say = stage.text("waiting for the first pose", "top-left", size=0.8)
        self._overview = overview(surface.vertices, size[0] / size[1])
        self._view = VIEWS.index("follow")
        self._drawn = -1
        self.open = True
        stage.look(self._overview)
        if self._frames is None:
            stage.on_key(self._press)
            stage.text(HELP, "bottom-left", size=0.6)

    def draw(self, observer: Observer) -> None:
        """Draw the newest pose, if it was not drawn yet."""
        snapshot = self._look(observer)
        if snapshot is not None and snapshot.number != self._drawn:
            self._drawn = snapshot.number
            if self._sensed is not None:
                self._show(snapshot, self._sensed, observer)
        if self._frames is None:
            self._stage.draw()
        elif snapshot is not None:
            picture = self._stage.picture()
            write_picture(self._frames / f"frame-{snapshot.step:06d}.png", picture, quickly=True)

    def wait(self, until: float, observer: Observer) -> None:
        """Answer to mouse and keys until a time of the monotonic clock (s); its way goes through every pose seen."""
        while self.open and (left := until - time.monotonic()) > 0.0:
            if self._frames is None and not self._stage.pump():
                self.open = False
            self._look(observer)
            time.sleep(min(NAP_S, left))

    def linger(self, seconds: float, observer: Observer) -> None:
        """Leave the last picture for a while, or until the window is closed."""
        if self._frames is None:
            self.wait(time.monotonic() + seconds, observer)

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

    def _look(self, observer: Observer) -> Snapshot | None:
        """The newest pose; what is sensed there is worked out, and the way goes on to it."""
        snapshot = observer.latest()
        if snapshot is not None and snapshot.number != self._seen and _has_pose(snapshot):
            self._seen = snapshot.number
            position, quaternion = snapshot.poses.position[0].copy(), snapshot.poses.quaternion[0]
            sensed = self._sensed = self._senses.sense(snapshot.step, position, quaternion)
            way = self._way
            if not way or np.linalg.norm(position - way[-1][0]) > 0.02:
                way.append((position, sensed.gap))
            if len(way) > TRAIL_POINTS:
                del way[1:-1:2]
        return snapshot

    def _show(self, snapshot: Snapshot, sensed: Sensed, observer: Observer) -> None:
        poses = snapshot.poses
        position, quaternion = poses.position[0], poses.quaternion[0]
        self._drone.show(position, quaternion, None, sensed.sighting)
        request = observer.request()
        direction = np.zeros(3) if request is None else request.commands.direction[0]
        speed = 0.0 if request is None else float(request.commands.speed[0])
        self._command.show(speed > 0.0 and bool(np.any(direction)))
        if speed > 0.0 and np.any(direction):
            length = 4.0 * speed * self._body_radius
            self._command.place(position, length * frame_along(direction / np.linalg.norm(direction)))
        way = self._way + [self._way[-1]] * (TRAIL_POINTS - len(self._way))
        self._trail.move(np.array([place for place, _ in way]))
        self._trail.shade(np.array([gap for _, gap in way]), self._scale)
        self._say(self._words(snapshot, sensed, speed))
        if VIEWS[self._view] != "overview":
            self._stage.look(self._camera(round(sensed.along / self._tube.step), poses))

    def _words(self, snapshot: Snapshot, sensed: Sensed, commanded: float) -> str:
        poses, length = snapshot.poses, self._tube.length
        moving = float(np.linalg.norm(poses.linear_velocity[0]))
        touched = "   CONTACT" if poses.contact_steps[0] else ""
        return (
            f"LIVE   step {snapshot.step}   {poses.sim_time[0]:.1f} s   {100.0 * sensed.along / length:.1f} % of "
            f"{length:.1f} m\n{moving:.2f} m/s   commanded {commanded:.2f} m/s   gap {sensed.gap:.2f} m{touched}"
        )

    def _camera(self, i: int, poses: PoseBatch) -> Camera:
        tube, position = self._tube, poses.position[0]
        tangent, radius = tube.tangent[i], float(tube.radius[i])
        if VIEWS[self._view] == "follow":
            return follow(position, tangent, radius)
        back = INSIDE_BACK * radius
        behind = tube.axis[max(i - round(back / tube.step), 0)]
        up = local_frames(poses.position, poses.quaternion)[0, 1]
        return inside(position, behind, tangent, up, radius)


def _has_pose(snapshot: Snapshot) -> bool:
    """Whether the lane was reset: before that its words are zero."""
    return bool(np.any(snapshot.poses.quaternion[0]))
