"""What pictures are made of, without drawing any: cameras, cut walls, senses, and the window's controls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from agent_client.settings import Settings
from cosim.cameras import FOLLOW_CLEAR, VIEW_ANGLE, Camera, follow, inside, overview
from cosim.scene import Surface, drone_surface
from cosim.senses import Sensors, lidar_rays, local_frames, view_border
from cosim.view_window import Controls
from cosim.winding import face_outwards

Floats = NDArray[np.float64]

SENSORS = Sensors.of_settings(Settings(), 1.0)


def project(camera: Camera, points: Floats) -> Floats:
    """Places of points (V, 3) in the picture, (V, 2), -1 to 1 from edge to edge of its height."""
    forward = camera.focus - camera.position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, camera.up)
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    seen = points - camera.position
    depth = seen @ forward
    assert depth.min() > 0.0, "behind the camera"
    plane = np.stack([seen @ right, seen @ up], axis=1)
    return plane / depth[:, None] / np.tan(np.radians(camera.angle / 2))  # type: ignore[no-any-return]


@pytest.mark.parametrize("stretch", [(30.0, 1.0, 1.0), (1.0, 1.0, 30.0), (5.0, 20.0, 4.0)])
@pytest.mark.parametrize("aspect", [0.7, 1.6])
def test_an_overview_holds_everything_and_fills_the_picture(
    stretch: tuple[float, float, float], aspect: float
) -> None:
    """Every point lies in the picture, and the outermost touch the free margin on two sides that face each other."""
    points = np.random.default_rng(3).normal(size=(1000, 3)) * stretch + (100.0, -50.0, 7.0)
    camera = overview(points, aspect)
    places = project(camera, points)
    assert camera.angle == VIEW_ANGLE
    assert np.abs(places[:, 0]).max() < aspect
    assert np.abs(places[:, 1]).max() < 1.0
    width, height = places[:, 0].max() - places[:, 0].min(), places[:, 1].max() - places[:, 1].min()
    assert width == pytest.approx(2.0 * aspect * 0.76, rel=0.01) or height == pytest.approx(1.46, rel=0.01)


def test_an_overview_of_a_straight_tube_is_from_its_side() -> None:
    """A tube that could be seen end-on, where it would be largest, is seen at full length."""
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (800, 3)) * (10.0, 1.0, 1.0)
    camera = overview(points, 1.5)
    towards = camera.focus - camera.position
    assert abs(towards[0]) < 0.3 * np.linalg.norm(towards)


@pytest.mark.parametrize("walls", [1, 2])
def test_an_overview_shows_how_a_tube_is_bent(walls: int) -> None:
    """A tube bent in an upright plane is not seen edge-on, also where its file has an inner and an outer wall."""
    x = np.linspace(-1.0, 1.0, 400)
    wall = 5.0 * np.stack([x, np.zeros(400), 1.5 * x**2], axis=1)
    around = np.stack([np.zeros(400), np.cos(300.0 * x), np.sin(300.0 * x)], axis=1)
    camera = overview(np.concatenate([wall + radius * around for radius in (1.0, 1.3)[:walls]]), 1.5)
    towards = camera.focus - camera.position
    assert abs(towards[1]) > 0.8 * np.linalg.norm(towards)


def test_a_following_camera_sees_the_drone_and_leaves_out_what_stands_before_it() -> None:
    """The drone is near the middle of the picture, and what is nearer than it by 2.5 R is not drawn."""
    position, tangent = np.array([4.0, 1.0, 2.0]), np.array([0.0, 0.6, 0.8])
    camera = follow(position, tangent, 2.0)
    assert np.abs(project(camera, position[None])).max() < 0.3
    distance = np.linalg.norm(camera.focus - camera.position)
    assert camera.nearest == pytest.approx(distance - 2.0 * FOLLOW_CLEAR)
    upright = follow(position, np.array([0.0, 0.0, 1.0]), 1.0)
    assert np.isfinite(upright.position).all()


def test_a_camera_inside_stays_in_the_tube_and_looks_along_it() -> None:
    """It stands less than half a radius beside the axis, behind the drone, and looks past it."""
    tangent, up = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    camera = inside(np.array([2.0, 0.2, 0.0]), np.zeros(3), tangent, up, 1.0)
    assert np.linalg.norm(camera.position[1:]) < 0.5
    assert (camera.focus - camera.position) @ tangent > 2.0
    rolled = inside(np.array([2.0, 0.2, 0.0]), np.zeros(3), tangent, tangent, 1.0)
    assert np.isfinite(rolled.position).all()


def cylinder(sides: int = 24, rings: int = 30) -> Surface:
    """An open tube of radius 1 along x from 0 to 10, wound outwards."""
    angle = 2.0 * np.pi * np.arange(sides) / sides
    x = np.linspace(0.0, 10.0, rings)
    vertices = np.stack(
        [np.repeat(x, sides), np.tile(np.cos(angle), rings), np.tile(np.sin(angle), rings)], axis=1
    )
    i = (np.arange(rings - 1)[:, None] * sides + np.arange(sides)).ravel()
    j = (np.arange(rings - 1)[:, None] * sides + (np.arange(sides) + 1) % sides).ravel()
    faces = np.concatenate([np.stack([i, j, i + sides], 1), np.stack([j, j + sides, i + sides], 1)])
    return Surface(vertices, faces.astype(np.int32))


def outward(surface: Surface) -> Floats:
    """Per triangle, how far its normal points away from the x axis, (F,)."""
    corners = surface.vertices[surface.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    away = corners.mean(axis=1) * (0.0, 1.0, 1.0)
    return np.einsum("ij,ij->i", normals, away)


@pytest.mark.parametrize("turned", ["none", "all", "some"])
def test_walls_face_outwards_whatever_their_winding(turned: str) -> None:
    """A tube wound outwards, inwards, or at random has all its triangles facing outwards afterwards."""
    surface = cylinder()
    faces = surface.faces.copy()
    if turned != "none":
        some = np.random.default_rng(2).random(len(faces)) < (1.0 if turned == "all" else 0.5)
        faces[some] = faces[some][:, ::-1]
    axis = np.stack([np.linspace(0.0, 10.0, 50), np.zeros(50), np.zeros(50)], axis=1)
    found = face_outwards(Surface(surface.vertices, faces), axis)
    assert (outward(found) > 0.0).all()
    assert np.array_equal(np.sort(found.faces, axis=1), np.sort(faces, axis=1))


def test_rays_of_the_lidar_stand_around_the_body() -> None:
    """They start ahead of the centre and behind it, go perpendicular to the body, and begin at its right."""
    turn = np.array([[0.0, 0.0, np.sin(np.pi / 4), np.cos(np.pi / 4)]])  # forward is world y
    origins, directions = lidar_rays(SENSORS, np.array([[1.0, 2.0, 3.0]]), turn)
    rays = SENSORS.rays
    assert origins.shape == directions.shape == (1, 2 * rays, 3)
    assert origins[0, :rays] == pytest.approx(np.tile([1.0, 2.0 + SENSORS.offset, 3.0], (rays, 1)))
    assert origins[0, rays:] == pytest.approx(np.tile([1.0, 2.0 - SENSORS.offset, 3.0], (rays, 1)))
    assert directions[0] @ [0.0, 1.0, 0.0] == pytest.approx(np.zeros(2 * rays), abs=1e-12)
    assert directions[0, 0] == pytest.approx([1.0, 0.0, 0.0])
    assert directions[0, rays // 4] == pytest.approx([0.0, 0.0, 1.0])
    assert local_frames(np.zeros((1, 3)), turn)[0, 0] == pytest.approx([0.0, 1.0, 0.0])


def test_the_border_of_the_view_is_where_the_camera_stops_seeing() -> None:
    """Every direction of the border has the field's half-angle in width or in height, and none more than it."""
    level = np.array([[0.0, 0.0, 0.0, 1.0]])
    border = view_border(SENSORS, np.zeros((1, 3)), level, sides=5)[0]
    width = np.abs(np.arctan2(-border[:, 1], border[:, 0]))
    height = np.abs(np.arctan2(border[:, 2], border[:, 0]))
    assert (width <= SENSORS.half_width + 1e-9).all()
    assert (height <= SENSORS.half_height + 1e-9).all()
    assert (np.isclose(width, SENSORS.half_width) | np.isclose(height, SENSORS.half_height)).all()
    corners = np.isclose(width, SENSORS.half_width) & np.isclose(height, SENSORS.half_height)
    assert corners.sum() == 4
    assert corners[::5].all()


def test_the_drone_is_a_ball_with_a_nose() -> None:
    """All its vertices but the nose lie on the collision sphere, and the nose is forward."""
    vertices = drone_surface(0.2, rings=6, sides=8).vertices
    assert np.linalg.norm(vertices[1:], axis=1) == pytest.approx(np.full(len(vertices) - 1, 0.2))
    assert vertices[0] == pytest.approx([0.38, 0.0, 0.0])


class Window:
    """Stands in for a stage: keeps what it is told, and draws nothing."""

    def __init__(self) -> None:
        self.slides: list[int] = []
        self.buttons: dict[str, Callable[[], None]] = {}
        self.play_shown = 0
        self.drawn = 0
        self.key: Callable[[str], None]
        self.slid: Callable[[int], None]

    def on_key(self, handler: Callable[[str], None]) -> None:
        """Keep who hears keys."""
        self.key = handler

    def slider(self, _last: int, handler: Callable[[int], None]) -> Callable[[int], None]:
        """Keep who is slid to, and where the slider is put."""
        self.slid = handler
        return self.slides.append

    def button(
        self, words: Sequence[str], _place: object, handler: Callable[[], None]
    ) -> Callable[[int], None]:
        """Keep who is pressed."""
        self.buttons[words[0].strip()] = handler

        def show(state: int) -> None:
            self.play_shown = state

        return show

    def text(self, *_: object, **__: object) -> None:
        """Nothing to read."""

    def draw(self) -> None:
        """Count."""
        self.drawn += 1


class Film:
    """Stands in for a playback of 11 records, 0.1 s apart."""

    last = 10
    view = "overview"

    def __init__(self) -> None:
        self.shown: list[int] = []
        times = np.arange(11) / 10.0
        self.leader: Any = SimpleNamespace(
            scene=SimpleNamespace(times=times),
            at=lambda time: int(np.clip(np.searchsorted(times, time + 1e-9, side="right") - 1, 0, 10)),
        )

    def show(self, k: int) -> None:
        """Keep the moment."""
        self.shown.append(k)

    def change_view(self, view: str, _k: int) -> None:
        """Keep the view."""
        self.view = view


@pytest.fixture
def window() -> Window:
    """A window that draws nothing."""
    return Window()


@pytest.fixture
def film() -> Film:
    """A playback that shows nothing."""
    return Film()


@pytest.fixture
def controls(window: Window, film: Film) -> Controls:
    """The controls of both, at moment 3 and twice the pace."""
    return Controls(window, film, 2.0, begin=3)  # type: ignore[arg-type]


def test_steps_go_on_and_back_and_stay_within_the_run(controls: Controls, window: Window) -> None:
    """Arrow keys and buttons move by one record; the first and the last one are the ends."""
    assert controls.moment == 3
    window.key("Right")
    window.buttons[">"]()
    assert controls.moment == 5
    window.key("Left")
    window.buttons["<"]()
    assert controls.moment == 3
    window.key("End")
    window.key("Right")
    assert controls.moment == 10
    window.key("Home")
    window.key("Left")
    assert controls.moment == 0
    assert window.slides[-1] == 0


def test_playing_follows_the_clock_and_stops_at_the_end(
    controls: Controls, window: Window, film: Film
) -> None:
    """At twice the pace 0.1 s of the clock are two records; at the end it pauses, and plays from the beginning."""
    window.key("space")
    began = controls._started[0]
    assert controls.playing
    assert window.play_shown == 1
    controls.advance(began + 0.1)
    assert controls.moment == 5
    controls.advance(began + 0.101)
    assert film.shown[-1] == 5
    assert film.shown.count(5) == 1, "what is shown already is not drawn again"
    controls.advance(began + 60.0)
    assert controls.moment == 10
    assert not controls.playing
    assert window.play_shown == 0
    window.buttons["Play"]()
    assert controls.playing
    assert controls.moment == 0


def test_sliding_and_stepping_pause(controls: Controls, window: Window) -> None:
    """Whoever takes hold of the time has it."""
    for hold in (lambda: window.slid(7), lambda: window.key("Right")):
        controls.toggle()
        hold()
        assert not controls.playing
    assert controls.moment == 8


def test_the_camera_goes_round_and_q_closes(controls: Controls, window: Window, film: Film) -> None:
    """c and the button change between the three views; q closes, an unknown key does nothing."""
    seen = []
    for press in (lambda: window.key("c"), window.buttons["View"], lambda: window.key("c")):
        press()
        seen.append(film.view)
    assert seen == ["follow", "inside", "overview"]
    window.key("x")
    assert controls.open
    window.key("q")
    assert not controls.open
