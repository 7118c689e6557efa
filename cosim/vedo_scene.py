"""The only file that imports vedo: a stage of shapes, seen in a window or drawn to a picture without a display.

It knows no run and no drone. Points are in the world frame (m), colours are "#rrggbb".
"""

from __future__ import annotations

import ctypes
import itertools
import os
import sys
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, Final

import numpy as np
import vedo
import vtkmodules.vtkRenderingOpenGL2  # noqa: F401  without it a window has no kind
from numpy.typing import NDArray
from vtkmodules.vtkCommonCore import vtkLogger
from vtkmodules.vtkRenderingCore import vtkRenderWindow

from cosim.cameras import Camera
from cosim.errors import NoDisplayError, ViewError
from cosim.film import Image
from cosim.scales import Scale
from cosim.scene import Surface
from protocol.signals import held_signals

Floats = NDArray[np.float64]
FONT: Final = "Calco"
INK: Final = "#22303c"
LETTER: Final = 0.57
"""Width of a letter of `FONT` over its height."""

_OSMESA: Final = ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")


@cache
def _table(colours: str) -> Floats:
    """The 256 colours of a scale, each red, green, blue."""
    return np.array(vedo.color_map(np.arange(256), colours, 0, 255))


class Shape:
    """One thing on the stage, which can be moved, painted, and hidden."""

    def __init__(self, mesh: Any) -> None:
        self._mesh = mesh

    def move(self, points: Floats) -> None:
        """Give its vertices new places; as many as before."""
        self._mesh.points = points

    def paint(self, colours: Image) -> None:
        """Colour its vertices, (V, 4) red, green, blue, opacity from 0 to 255."""
        self._mesh.pointcolors = colours

    def shade(self, values: Floats, scale: Scale) -> None:
        """Colour its vertices by values (V,)."""
        table = _table(scale.colours)
        low, high = scale.limits
        share = np.clip((values - low) / (high - low), 0.0, 1.0)
        opaque = np.ones((len(values), 1))
        self.paint((255.0 * np.hstack([table[np.rint(255.0 * share).astype(int)], opaque])).astype(np.uint8))

    def place(self, position: Floats, rotation: Floats) -> None:
        """Put its own frame there: position (3,), rotation (3, 3) with the frame's axes as columns."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation, position
        self._mesh.actor.SetUserMatrix(vedo.LinearTransform(matrix).T.GetMatrix())

    def show(self, wanted: bool) -> None:
        """Show or hide it."""
        self._mesh.actor.SetVisibility(wanted)


class Stage:
    """What is seen, and from where.

    Args:
        size: width and height (pixels).
        offscreen: draw to pictures, without a window or a display.
        title: of the window.
        sky: colours of the background, bottom and top.
        smooth: soften edges and let the sky's colours flow into one another, both of which take time where no
            graphics card draws.

    Raises:
        NoDisplayError: a window is wanted, and there is no display.
        ViewError: nothing can be drawn here; says what is missing.
    """

    def __init__(
        self,
        size: tuple[int, int],
        *,
        offscreen: bool,
        title: str,
        sky: tuple[str, str],
        smooth: bool,
    ) -> None:
        _prepare(offscreen)
        vedo.settings.multi_samples = 4 if smooth else 0
        self.size = size
        self._plotter = vedo.Plotter(
            size=size,
            offscreen=offscreen,
            title=title,
            bg=sky[0],
            bg2=sky[1] if smooth else None,
            interactive=False,
        )
        self._unit = _unit(size)
        """Texts grow with the picture."""
        self._fits: list[Callable[[], object]] = []
        """What gives them their size, and must be done again in a window of another size."""
        self._begun = self._closed = False

    def wall(self, surface: Surface, colour: str, *, cut: bool, ghost: float = 0.1) -> None:
        """Put up a tube's wall.

        Args:
            surface: its triangles, wound so that they face outwards where it is cut.
            colour: of the wall.
            cut: leave out whatever faces the camera, so that one looks into the tube from everywhere.
            ghost: opacity of what is left out; of the whole wall where it is not cut.
        """
        mesh = vedo.Mesh([surface.vertices, surface.faces], c=colour).clean()
        # Its winding decides what is left out, and must stay as it is.
        mesh.compute_normals(feature_angle=50, consistency=False)
        if cut:
            if ghost > 0.0:
                ghostly = mesh.clone().backface_culling(True).alpha(ghost).lighting("default")
                self._plotter.add(ghostly)
            mesh.frontface_culling(True).lighting(ambient=0.5, diffuse=0.55, specular=0.05)
            self._plotter.add(mesh)
        else:
            self._plotter.add(mesh.alpha(ghost).lighting(ambient=0.3, diffuse=0.75, specular=0.15))

    def rims(self, surface: Surface, colour: str) -> None:
        """Draw the open edges of a surface."""
        mesh = vedo.Mesh([surface.vertices, surface.faces]).clean()
        self._plotter.add(mesh.boundaries().c(colour).linewidth(2 * self._unit))

    def lines(self, pieces: Sequence[Floats], colour: str, width: float = 2.0, alpha: float = 1.0) -> Shape:
        """Draw polylines, each (M, 3)."""
        points = np.concatenate(pieces)
        ends = np.cumsum([0, *(len(piece) for piece in pieces)])
        runs = [list(range(a, b)) for a, b in itertools.pairwise(ends.tolist())]
        mesh = vedo.Mesh([points, [], runs], c=colour, alpha=alpha).linewidth(width * self._unit)
        return self._add(mesh.lighting("off"))

    def surface(self, surface: Surface, colour: str, *, alpha: float = 1.0, flat: bool = False) -> Shape:
        """Put up any surface; `flat` leaves out light and shade."""
        mesh = vedo.Mesh([surface.vertices, surface.faces], c=colour, alpha=alpha)
        return self._add(mesh.lighting("off") if flat else mesh.compute_normals().lighting("plastic"))

    def scale(self, scale: Scale) -> None:
        """Show at the right what the colours of a scale mean."""
        line = vedo.Line([(0.0, 0.0, 0.0), (0.0, 0.0, 1e-9)])
        line.pointdata["value"] = np.array(scale.limits)
        line.cmap(scale.colours, "value", vmin=scale.limits[0], vmax=scale.limits[1])
        line.add_scalarbar(
            scale.title,
            pos=((0.885, 0.08), (0.975, 0.5)),
            nlabels=5,
            label_format=":.2f",
            c=INK,
        )
        bar = line.scalarbar

        def fit() -> None:
            for words in (bar.GetTitleTextProperty(), bar.GetLabelTextProperty()):
                words.SetFontSize(int(14 * self._unit))
            bar.SetVerticalTitleSeparation(int(12 * self._unit))

        self._fit(fit)
        bar.SetDrawBackground(True)
        bar.GetBackgroundProperty().SetColor(1.0, 1.0, 1.0)
        bar.GetBackgroundProperty().SetOpacity(0.55)
        self._plotter.add(bar)

    def dot(self, colour: str, size: float) -> Shape:
        """Draw a round dot that is as large from everywhere (pixels), to be moved."""
        return self._add(vedo.Points([(0.0, 0.0, 0.0)], r=size * self._unit, c=colour).lighting("off"))

    def text(self, words: str, place: str, *, size: float = 1.0, colour: str = INK) -> Callable[[str], None]:
        """Write at a place such as "top-left"; returns what changes the words."""
        text = vedo.Text2D(words, pos=place, c=colour, font=FONT, bg="white", alpha=0.55)
        self._fit(lambda: text.size(size * self._unit))
        self._plotter.add(text)
        return text.text  # type: ignore[no-any-return]

    def numbers(self, places: Sequence[Floats], colour: str) -> None:
        """Write 1, 2, ... at points of the world, each (3,), in front of everything."""
        anchors = vedo.Points(np.array(places))
        anchors.pointdata["number"] = np.arange(1, len(places) + 1)
        anchors.pointdata.select("number")
        labels = anchors.labels2d(
            "number", precision=None, c="white", bc=colour, scale=0.9 * self._unit, font=FONT
        )
        self._plotter.add(labels)

    def legend(self, entries: Sequence[tuple[str, str]], *, size: float = 0.65) -> None:
        """Name colours at the top right: (name, colour) of each."""
        columns = 4 + max(len(name) for name, _ in entries)

        def write(words: str, colour: str, box: float) -> None:
            text = vedo.Text2D(words, c=colour, font=FONT, bg="white", alpha=box, bold=box == 0.0)

            def fit() -> None:
                letter = LETTER * text.size(size * self._unit).properties.GetFontSize()
                text.pos((0.995 - letter * columns / self.size[0], 0.995), "top-left")

            self._fit(fit)
            self._plotter.add(text)

        write("\n".join(f"   {name}" for name, _ in entries), INK, 0.55)
        for row, (_, colour) in enumerate(entries):
            write("\n" * row + 2 * "\u2014", colour, 0.0)

    def look(self, camera: Camera) -> None:
        """Look from there."""
        found = self._plotter.camera
        found.SetPosition(camera.position)
        found.SetFocalPoint(camera.focus)
        found.SetViewUp(camera.up)
        found.SetViewAngle(camera.angle)
        self._plotter.renderer.ResetCameraClippingRange()
        nearest, farthest = found.GetClippingRange()
        found.SetClippingRange(max(nearest, camera.nearest), farthest)

    def picture(self) -> Image:
        """Draw, and return what is seen."""
        self._begin()
        # The window whose picture is taken is the one that vedo holds for the current one.
        vedo.set_current_plotter(self._plotter)
        return np.ascontiguousarray(self._plotter.screenshot(asarray=True)[..., :3])

    def draw(self) -> None:
        """Draw to the window."""
        self._begin()
        self._plotter.render()

    def pump(self) -> bool:
        """Let the window answer to mouse and keys; whether it is still open."""
        self._begin()
        if not self._closed:
            with held_signals():  # VTK ends the process at once where Ctrl-C is raised out of a handler
                self._plotter.interactor.ProcessEvents()
                self._follow_window()
        return not self._closed

    def on_key(self, handler: Callable[[str], None]) -> None:
        """Call `handler` with the name of every key that is pressed, such as "space", "Left" or "c"."""
        self._plotter.add_callback(
            "KeyPress", lambda event: handler(str(event.keypress)), enable_picking=False
        )

    def slider(self, last: int, handler: Callable[[int], None]) -> Callable[[int], None]:
        """Put a slider from 0 to `last` below the scene; returns what moves it without calling `handler`."""
        slider = self._plotter.add_slider(
            lambda widget, _event: handler(round(widget.value)),
            0,
            last,
            value=0,
            pos=[(0.32, 0.06), (0.86, 0.06)],
            show_value=False,
            c=INK,
            slider_length=0.012,
            slider_width=0.022,
            tube_width=0.004,
        )

        def move(value: int) -> None:
            slider.value = value

        return move

    def button(
        self, words: Sequence[str], place: tuple[float, float], handler: Callable[[], None]
    ) -> Callable[[int], None]:
        """Put a button there, in shares of the window; returns what chooses which of its words it shows."""
        button = self._plotter.add_button(
            lambda _object, _event: handler(),
            states=list(words),
            c=["white"] * len(words),
            bc=[INK] * len(words),
            pos=place,
            font=FONT,
            bold=False,
        )
        self._fit(lambda: button.size(0.85 * self._unit))
        return button.status  # type: ignore[no-any-return]

    def close(self) -> None:
        """Take it down."""
        if self._begun:  # a window that was never drawn cannot be closed
            self._plotter.close()

    def _add(self, mesh: Any) -> Shape:
        self._plotter.add(mesh)
        return Shape(mesh)

    def _fit(self, fit: Callable[[], object]) -> None:
        fit()
        self._fits.append(fit)

    def _follow_window(self) -> None:
        """Fit the texts to the window where it was given another size."""
        size = tuple(self._plotter.window.GetSize())
        if size != self.size and min(size) > 0:
            self.size, self._unit = size, _unit(size)
            for fit in self._fits:
                fit()
            self._plotter.render()

    def _begin(self) -> None:
        if not self._begun:
            self._plotter.show(resetcam=False, interactive=False)
            if self._plotter.interactor is not None:
                # With an observer VTK leaves the end to it.
                self._plotter.interactor.AddObserver("ExitEvent", self._end)
            self._begun = True

    def _end(self, _caller: object, _event: str) -> None:
        self._closed = True


def _unit(size: tuple[int, int]) -> float:
    return min(size[1] / 600.0, size[0] / 900.0)


def _prepare(offscreen: bool) -> None:
    """Choose how to draw, and find out whether it works: where nothing does, VTK would take the process down.

    Raises:
        ViewError: no display for a window, or no library that draws without one.
    """
    vedo.settings.default_backend = "vtk"
    vedo.settings.default_font = FONT
    vedo.settings.enable_default_keyboard_callbacks = False
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    if sys.platform != "linux":
        return
    if offscreen and not os.environ.get("DISPLAY"):
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    kind = vtkRenderWindow().GetClassName()
    if not offscreen and kind != "vtkXOpenGLRenderWindow":
        display = os.environ.get("DISPLAY")
        found = f"DISPLAY={display}, which cannot be opened" if display else "none"
        raise NoDisplayError(f"a window: expected a display, found {found}")
    if kind == "vtkOSOpenGLRenderWindow" and not any(map(_loads, _OSMESA)):
        raise ViewError(
            "drawing without a display: expected EGL or OSMesa, found neither; "
            "apt-get install libegl1 libgl1-mesa-dri (or libosmesa6), or run under xvfb-run"
        )


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
