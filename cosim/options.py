"""The options that every flying command shares, as one frozen object and one click decorator."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeVar

import click
from click.shell_completion import CompletionItem

from cosim.named_settings import NamedSettings
from cosim.screens import option, rare
from meshes.errors import MeshError
from meshes.scale import MeanRadius, parse_scale

SHIPPED_MESH: Final = "industrial.obj"
SHIPPED_POLICY: Final = "tube_ppo"
DEFAULT_PHYSICS_DT: Final = 1.0 / 240.0
DEFAULT_ATTACH_SECONDS: Final = 30.0

Place = int | tuple[float, float, float]
"""The number of an opening, from 1, or a point in the coordinates of the mesh's file."""

Command = TypeVar("Command", bound=Callable[..., Any])


@dataclass(frozen=True)
class TubeChoice:
    """A generated tube: the one that `cosim evaluate` draws for this level and seed."""

    level: int
    seed: int
    length: float | None = None
    """Of the axis over R, None for the recipe's."""


@dataclass(frozen=True)
class FlightOptions:
    """What the user asked of one flight; the fields are the options of `cosim launch`."""

    mesh: str | None = None
    """None for the shipped conduit."""
    tube: TubeChoice | None = None
    centerline: Path | None = None
    policy: str = SHIPPED_POLICY
    lookahead: float | None = None
    speed: float | None = None
    dt: float | None = None
    physics_dt: float = DEFAULT_PHYSICS_DT
    allow_mismatch: tuple[str, ...] = ()
    max_steps: int | None = None
    seed: int | None = None
    out: Path | None = None
    axes: str = "auto"
    scale: float | MeanRadius | None = None
    """None for the unit that the file states, or metres."""
    start_end: str = "first"
    entry: Place | None = None
    exit: Place | None = None
    realtime: float | None = None
    on_contact: str = "end"
    parameters: tuple[str, ...] = ()
    settings: NamedSettings = field(default_factory=NamedSettings)
    server: str | None = None
    connect: str | None = None
    session: str | None = None
    transport: str = "shm"
    attach_timeout: float = DEFAULT_ATTACH_SECONDS

    @property
    def start_seed(self) -> int:
        """The seed as given, else the tube's, else 0."""
        if self.seed is not None:
            return self.seed
        return 0 if self.tube is None else self.tube.seed


class Fraction(click.ParamType[float]):
    """A positive number of seconds, also as a fraction such as 1/240."""

    name = "seconds"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Read `0.004`, `1/240` or a number."""
        try:
            above, _, below = str(value).partition("/")
            seconds = float(above) / (float(below) if below else 1.0)
        except (ValueError, ZeroDivisionError):
            self.fail(f"expected seconds such as 0.1 or 1/240, found {value!r}", param, ctx)
        if not 0.0 < seconds < float("inf"):
            self.fail(f"expected a positive number of seconds, found {value!r}", param, ctx)
        return seconds


class TubeType(click.ParamType[TubeChoice]):
    """level=L,seed=N[,length=METRES over R]."""

    name = "tube"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> TubeChoice:
        """Read `level=2,seed=1234,length=40`."""
        pairs = [part.partition("=") for part in str(value).split(",")]
        given = {name.strip(): text for name, _, text in pairs}
        try:
            if len(given) != len(pairs) or not {"level", "seed"} <= set(given) <= {"level", "seed", "length"}:
                raise ValueError
            level, seed = int(given["level"]), int(given["seed"])
            length = float(given["length"]) if "length" in given else None
        except ValueError:
            self.fail(f"expected level=L,seed=N[,length=R], found {value!r}", param, ctx)
        if level not in (0, 1, 2):
            self.fail(f"level: expected 0, 1 or 2, found {level}", param, ctx)
        if not 0 <= seed < 2**63:
            self.fail(f"seed: expected a whole number from 0 to 2^63 - 1, found {seed}", param, ctx)
        return TubeChoice(level, seed, length)


class ScaleType(click.ParamType["float | MeanRadius"]):
    """Metres in one unit of a file, or radius=METRES."""

    name = "scale"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float | MeanRadius:
        """Read `0.001` or `radius=1`."""
        try:
            return parse_scale(str(value))
        except MeshError as error:
            self.fail(str(error), param, ctx)


class PlaceType(click.ParamType[Place]):
    """The number of an opening, or x,y,z."""

    name = "place"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Place:
        """Read `2` or `0,1.5,-3`."""
        try:
            numbers = [float(part) for part in str(value).split(",")]
            if len(numbers) == 1 and int(str(value)) >= 1:
                return int(str(value))
            x, y, z = numbers
            if not math.isfinite(x * y * z):
                raise ValueError
        except ValueError:
            self.fail(
                f"expected the number of an opening, or x,y,z in the coordinates of the file; found {value!r}",
                param, ctx,
            )  # fmt: skip
        return (x, y, z)


class SizeType(click.ParamType[tuple[int, int]]):
    """Width and height in pixels."""

    name = "size"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        """Read `1280x800`."""
        try:
            width, height = (int(part) for part in str(value).lower().split("x"))
            if not (64 <= width <= 8192 and 64 <= height <= 8192):
                raise ValueError
        except ValueError:
            self.fail(f"expected WIDTHxHEIGHT, each from 64 to 8192 pixels, found {value!r}", param, ctx)
        return width, height


class PolicyType(click.ParamType[str]):
    """The file of a checkpoint, or the name of a pilot that needs none."""

    name = "policy"

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Files, and the names."""
        names = [SHIPPED_POLICY, "pure-pursuit", "lidar-rule"]
        if param.multiple:  # in an evaluation, which tunes
            names.append("pure-pursuit-tuned")
        return [
            CompletionItem(incomplete, type="file"),
            *(CompletionItem(name) for name in names if name.startswith(incomplete)),
        ]


SCALE: Final = option("--scale", type=ScaleType(), metavar="F|radius=R",
                      help="Metres a unit of the file, or the mean radius (m).")  # fmt: skip
POLICY_HELP: Final = "checkpoint, pure-pursuit or lidar-rule"
AXES: Final = rare("--axes", type=click.Choice(["auto", "zup", "yup"]), default="auto", show_default=True,
                           help="Up axis of the files; auto follows the file or its format.")  # fmt: skip
ENDS: Final = (
    rare("--entry", type=PlaceType(), metavar="N|x,y,z",
                 help="Where a centreline to be found starts: an opening's number, or in the file's coordinates."),
    rare("--exit", type=PlaceType(), metavar="N|x,y,z", help="Where it ends [default: the other opening]."),
)  # fmt: skip


def _positive(ctx: click.Context, param: click.Parameter, value: float | None) -> float | None:
    """Refuse zero, negative and non-finite values."""
    if value is not None and not 0.0 < value < float("inf"):
        raise click.BadParameter(f"expected a positive number, found {value}", ctx, param)
    return value


_FLIGHT: Final = (
    option("--mesh", type=click.Path(), metavar="PATH", help=f"Tube mesh [default: {SHIPPED_MESH}]."),
    option("--tube", type=TubeType(), metavar="level=L,seed=N",
                 help="A generated tube; ,length=R also says how long."),
    rare("--centerline", type=click.Path(path_type=Path), metavar="PATH", default=None,
                 help="Centreline .obj [default: <mesh stem>_centerline.obj beside the mesh, else it is found]."),
    AXES,
    SCALE,
    *ENDS,
    rare("--start-end", type=click.Choice(["first", "last"]), default="first", show_default=True,
                 help="End of the centreline to start from."),
    option("--policy", type=PolicyType(), metavar="P", default=SHIPPED_POLICY,
                 help=f"Who flies: {POLICY_HELP}."),
    rare("--lookahead", type=float, callback=_positive, metavar="M",
                 help="Of Pure Pursuit (m) [default: 1; `cosim evaluate` takes the camera's 3]."),
    rare("--speed", type=float, callback=_positive, metavar="V",
                 help="Of Pure Pursuit (m/s) [default: 2]."),
    rare("--dt", type=Fraction(), metavar="S", help="Control step (s) [default: the checkpoint's]."),
    rare("--physics-dt", type=Fraction(), metavar="S", default=DEFAULT_PHYSICS_DT, show_default=False,
                 help="Inner step (s); dt must be a whole multiple [default: 1/240]."),
    rare("--allow-mismatch", type=click.Choice(["dt"]), multiple=True,
                 help="Fly although this differs from the checkpoint."),
    rare("--max-steps", type=click.IntRange(min=1, max=10**9), metavar="N",
                 help="Step limit [default: 1.5 length / (slowest speed x dt)]."),
    option("--seed", type=click.IntRange(0, 2**63 - 1), metavar="N",
                 help="Of start and conditions [default: 0, or the tube's]."),
    rare("--on-contact", type=click.Choice(["end", "continue"]), default="end", show_default=True,
                 help="End at the first contact, or count on."),
    option("--parameter", "parameters", multiple=True, metavar="NAME=VALUE",
                 help="Plant parameter, e.g. force_gain=2."),
    option("--realtime", type=float, callback=_positive, metavar="FACTOR",
                 help="Pace; 1 is wall clock [default: as fast as it can]."),
    option("--out", type=click.Path(path_type=Path), metavar="DIR",
                 help="Run folder [default: a new one in runs/]."),
    option("--server", metavar="COMMAND", help="Start your physics as COMMAND RENDEZVOUS."),
    rare("--connect", metavar="RENDEZVOUS", help="Wait for a peer that you start; never kill it."),
    rare("--session", metavar="NAME", help="Name of the session [default: a new one]."),
    rare("--transport", type=click.Choice(["shm", "file"]), default="shm", show_default=True,
                 help="Shared memory, or mapped files."),
    rare("--attach-timeout", type=float, callback=_positive, default=DEFAULT_ATTACH_SECONDS,
                 metavar="S", help="Patience for the peer's attach (s)."),
)  # fmt: skip


def _numbers(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[float, ...] | None:
    """Read distinct numbers with commas between them, in rising order."""
    if value is None:
        return None
    try:
        numbers = {float(part) for part in value.split(",")}
    except ValueError:
        raise click.BadParameter(f"expected numbers such as 1,2,4, found {value!r}", ctx, param) from None
    return tuple(sorted(numbers))


def _levels(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[int, ...] | None:
    """Read levels of the curriculum."""
    if value is None:
        return None
    levels = sorted(set(value.split(",")))
    if not set(levels) <= {"0", "1", "2"}:
        raise click.BadParameter(f"expected levels out of 0,1,2, found {value!r}", ctx, param)
    return tuple(map(int, levels))


_VIEW: Final = (
    option("--screenshot", type=click.Path(path_type=Path), metavar="F.png",
                 help="Write a picture, without a window."),
    option("--movie", type=click.Path(path_type=Path), metavar="F.mp4|F.gif", help="Write a film of a run."),
    option("--figure", type=click.Path(path_type=Path), metavar="F.png",
                 help="Write the paper's figure, Blender's view beside ours."),
    option("--step", type=click.IntRange(min=0), metavar="K",
                 help="Where to begin; of a picture [default: the middle]."),
    option("--camera", type=click.Choice(["overview", "follow", "inside"]), metavar="C",
                 help="overview, follow [default of films] or inside."),
    option("--colour", "--color", "colour", type=click.Choice(["clearance", "reward", "speed"]), metavar="C",
                 help="clearance, reward or speed [default: each run its own]."),
    option("--realtime", type=float, callback=_positive, metavar="FACTOR", default=1.0,
                 help="Pace; 1 is wall clock [default: 1]."),
    option("--size", type=SizeType(), default="1280x800", metavar="WxH", help="[default: 1280x800]"),
    rare("--centerline", type=click.Path(path_type=Path), metavar="PATH",
                 help="Of a mesh [default: <mesh stem>_centerline.obj beside it, else it is found]."),
    AXES,
    SCALE,
    *ENDS,
)  # fmt: skip


_INSPECT: Final = (
    option("--centerline", type=click.Path(path_type=Path), metavar="PATH",
                 help="[default: MESH_centerline.obj beside it, else it is found]"),
    option("--entry", type=PlaceType(), metavar="N|x,y,z",
                 help="Start it there: at an opening's number, or at a point."),
    option("--exit", type=PlaceType(), metavar="N|x,y,z", help="End it there."),
    option("--axes", type=click.Choice(["auto", "zup", "yup"]), default="auto",
                 help="Up axis [default: as the file or its format says]."),
    SCALE,
    option("--body-radius", type=float, callback=_positive, default=0.15, metavar="R",
                 help="Of the drone (m) [default: 0.15]."),
    option("--out", type=click.Path(path_type=Path), metavar="DIR",
                 help="Write pictures, numbers, and the centreline found."),
)  # fmt: skip


_EVALUATE: Final = (
    option("--policy", "policies", type=PolicyType(), multiple=True, metavar="P",
                 help="Checkpoint, or a pilot's name [default: all four]."),
    option("--levels", callback=_levels, metavar="L,L,...",
                 help="Of the curriculum [default: 0,1,2; 2 for a map]."),
    option("--episodes", type=click.IntRange(1, 1_000_000), metavar="N",
                 help="Tubes a level [default: 100; 40 a cell of a map]."),
    option("--seed", type=click.IntRange(0, 2**63 - 1), default=0, metavar="N",
                 help="Of tubes that training never sees [default: 0]."),
    option("--dynamics", type=click.Choice(["kinematic", "rigid-body"]), metavar="WORLD",
                 help="kinematic [default] or rigid-body."),
    option("--engine", type=click.Choice(["bullet", "reference"]), metavar="ENGINE",
                 help="Of rigid bodies, bullet [default] or reference."),
    rare("--tuning-episodes", type=click.IntRange(5, 100_000), metavar="N",
                 help="Tubes that tune Pure Pursuit [default: 100; 40 a cell of a map]."),
    option("--sweep", metavar="NAME=V1,V2,...", help="Evaluate each value of one named setting."),
    option("--map", "draw_map", is_flag=True,
                 help="Draw success over gain and compensation."),
    rare("--map-gains", callback=_numbers, metavar="G,G,...",
                 help="Columns of the map (1/s) [default: 1,1.5,2,3,4,6,8]."),
    rare("--map-compensations", callback=_numbers, metavar="C,C,...",
                 help="Rows of the map (weight) [default: 0.7,0.8,0.9,1,1.1]."),
    option("--workers", type=click.IntRange(1, 512), metavar="N",
                 help="Processes; change no result [default: the cores]."),
    option("--out", type=click.Path(path_type=Path), metavar="DIR",
                 help="Write results.json with every episode; the map."),
)  # fmt: skip


def flight_options(command: Command) -> Command:
    """Give a click command the options of a flight; they arrive as keyword arguments of FlightOptions."""
    return _with(_FLIGHT, command)


def evaluate_options(command: Command) -> Command:
    """Give a click command the options of an evaluation, for `cosim.evaluation_plan.read_options`."""
    return _with(_EVALUATE, command)


def view_options(command: Command) -> Command:
    """Give a click command the options of `cosim.view.ViewOptions`."""
    return _with(_VIEW, command)


def inspect_options(command: Command) -> Command:
    """Give a click command the options of `cosim.inspect.InspectOptions`."""
    return _with(_INSPECT, command)


def _with(options: tuple[Callable[[Command], Command], ...], command: Command) -> Command:
    for declare in reversed(options):
        command = declare(command)
    return command
