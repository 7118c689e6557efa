"""`cosim view`: recorded runs or a mesh, in a window, in a picture, in a film."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from cosim import interrupts
from cosim.errors import NoDisplayError, ViewError
from cosim.film import check_outputs, write_film, write_picture
from cosim.live import counting, working
from cosim.mesh_view import MeshChoice, draw_figure, put_up_mesh
from cosim.options import SHIPPED_MESH
from cosim.playback import Playback, View
from cosim.requirements import install_command
from cosim.scales import Quantity
from cosim.tracks import Track, read_tracks
from meshes.tube import INDUSTRIAL
from protocol.signals import held_signals

if TYPE_CHECKING:
    from cosim.film import Image
    from cosim.vedo_scene import Stage

SIZE: Final = (1280, 800)
SKY: Final = ("#ffffff", "#dfe7ee")
"""Background: bottom and top."""
FASTEST: Final = 30.0
"""Frames a second of a film at most; of a run with shorter steps some are left out."""


@dataclass(frozen=True)
class ViewOptions:
    """What is looked at, from where, and what becomes of it."""

    sources: tuple[Path, ...] = ()
    """Run folders, or one mesh; empty for the shipped conduit."""
    mesh: MeshChoice = field(default_factory=MeshChoice)
    """How a mesh is to be read."""
    screenshot: Path | None = None
    movie: Path | None = None
    figure: Path | None = None
    step: int | None = None
    """Of the picture, or where the window begins; None for the middle of the run, or its beginning."""
    camera: View | None = None
    """None: the overview in pictures and windows, and along with the drone in films."""
    colour: Quantity | None = None
    realtime: float = 1.0
    """Pace of films and of playing."""
    size: tuple[int, int] = SIZE
    """Of the window or the pictures (pixels)."""

    @property
    def offscreen(self) -> bool:
        """Whether files are wanted and no window."""
        return any(path is not None for path in (self.screenshot, self.movie, self.figure))


def read_options(sources: tuple[Path, ...], given: dict[str, Any]) -> ViewOptions:
    """The options of the command as one object; `given` holds those of the mesh beside the others."""
    names = {one.name for one in fields(MeshChoice)}
    mesh = MeshChoice(**{name: value for name, value in given.items() if name in names})
    rest = {name: value for name, value in given.items() if name not in names}
    return ViewOptions(sources=sources, mesh=mesh, **rest)


def view(options: ViewOptions) -> None:
    """Show runs or a mesh, or write the pictures and films that are wanted.

    Raises:
        CosimError, MeshError: what is to be shown cannot be read.
        ViewError: vedo is missing, or there is no display for a window.
        OutputError: a file cannot be written.
    """
    check_outputs(options.screenshot, options.movie)
    check_outputs(options.figure, None)
    runs = [source for source in options.sources if source.is_dir()]
    if runs and len(runs) < len(options.sources):
        raise ViewError("expected run folders or one mesh, found both")
    try:
        if runs:
            with working("reading the runs" if len(runs) > 1 else "reading the run"):
                tracks = read_tracks(runs)
            _view_runs(options, tracks)
        else:
            _view_mesh(options)
    except NoDisplayError as error:
        error.add_note(
            "without a display give --screenshot FILE.png or --movie FILE.mp4, or run under xvfb-run"
        )
        raise


def open_stage(
    size: tuple[int, int],
    *,
    offscreen: bool,
    title: str = "cosim view",
    sky: tuple[str, str] = SKY,
    smooth: bool = True,
) -> Stage:
    """An empty stage.

    Raises:
        ViewError: vedo is missing, or there is nothing to draw on.
    """
    # Ctrl-C waits: in the midst of vedo's imports, which come as they are needed, it would look like a missing one.
    with held_signals():
        try:
            from cosim.vedo_scene import Stage
        except ImportError as error:
            raise ViewError(
                f"viewing needs {error.name or error}; install it with: {install_command('view')}"
            ) from error
        return Stage(size, offscreen=offscreen, title=title, sky=sky, smooth=smooth)


def _view_runs(options: ViewOptions, tracks: tuple[Track, ...]) -> None:
    if options.figure is not None:
        raise ViewError("--figure: expected a mesh, found a run; name the mesh that it was flown in")
    for track in tracks:
        if track.note:
            click.echo(f"{track.run.folder}: {track.note}", err=True)
    stage = open_stage(
        options.size, offscreen=options.offscreen, title=f"cosim view - {tracks[0].run.folder}"
    )
    try:
        with working("building the scene"):
            playback = Playback(stage, tracks, colour=options.colour, view=options.camera or "overview")
        if options.step is not None and options.step > playback.last:
            raise ViewError(f"--step: expected 0 to {playback.last}, found {options.step}")
        if options.screenshot is not None:
            playback.show(playback.last // 2 if options.step is None else options.step)
            _written(options.screenshot, stage.picture())
        if options.movie is not None:
            playback.change_view(options.camera or "follow", 0)
            _film(options.movie, stage, playback, options.realtime)
        if not options.offscreen:
            from cosim.view_window import Controls

            Controls(stage, playback, options.realtime, options.step or 0).run()
    finally:
        stage.close()


def _film(path: Path, stage: Stage, playback: Playback, realtime: float) -> None:
    """A film in which simulated time goes by at `realtime` times its pace, as far as steps allow."""
    times = playback.leader.scene.times
    step = float(times[-1] - times[0]) / max(playback.last, 1) or 0.1
    stride = max(1, math.ceil(realtime / (step * FASTEST) - 1e-9))
    moments = [*range(0, playback.last, stride), playback.last]

    def frames(advance: Callable[[int], None]) -> Iterator[Image]:
        for k in moments:
            interrupts.check()
            playback.show(k)
            yield stage.picture()
            advance(1)

    with counting(f"filming {path.name}", len(moments)) as advance:
        write_film(path, frames(advance), realtime / (step * stride))
    click.echo(path)


def _view_mesh(options: ViewOptions) -> None:
    named = options.sources or (Path(SHIPPED_MESH),)
    if len(named) > 1:
        raise ViewError(f"expected one mesh, or run folders; found {', '.join(map(str, named))}")
    for name, given in (("--movie", options.movie), ("--step", options.step), ("--colour", options.colour)):
        if given is not None:
            raise ViewError(f"{name}: expected a run, found a mesh, in which nothing moves")
    path = INDUSTRIAL if str(named[0]) == SHIPPED_MESH and not named[0].is_file() else named[0]
    if not path.is_file():
        raise ViewError(f"{path}: expected a run folder or the file of a mesh, found neither")
    with working(f"reading {path.name}"):
        tube = options.mesh.read(path)
    if tube.note:
        click.echo(tube.note, err=True)
    if options.figure is not None:
        with working("drawing the figure"):
            figure = draw_figure(tube, options.size, open_stage)
        _written(options.figure, figure)
    if options.screenshot is None and options.figure is not None:
        return
    stage = open_stage(options.size, offscreen=options.offscreen, title=f"cosim view - {path.name}")
    try:
        with working("building the scene"):
            put_up_mesh(stage, tube, options.camera or "overview")
        if options.screenshot is not None:
            _written(options.screenshot, stage.picture())
        else:
            from cosim.view_window import stay_open

            stay_open(stage)
    finally:
        stage.close()


def _written(path: Path, image: Image) -> None:
    write_picture(path, image)
    click.echo(path)
