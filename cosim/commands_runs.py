"""Commands about runs and meshes: `inspect`, `view`, `report`, `export`, `verify`.

Each parses its options and calls the module of its name, which is imported when the command runs.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Final

import click

from cosim.options import inspect_options, view_options
from cosim.screens import EXIT_NO_SUCCESS, OutputFile, command, json_option, option

FORMATS: Final = ("csv", "npz", "parquet", "tum", "mcap", "gltf", "usd")
"""Of `cosim.export`, whose imports a command's help does not wait for."""


@command(short_help="Say whether a mesh can be flown, and what its tube is like.")
@click.argument("mesh", type=click.Path(path_type=Path))
@inspect_options
@json_option
def inspect(mesh: Path, as_json: bool, **options: Any) -> None:
    """Find the centreline of a MESH and say what its tube is like, by arc length.

    Reads .obj, .stl, .ply, .off, .glb, .gltf and .dae. Exits 2 with the reason and the place where there is no tube
    to fly.

    \b
    cosim inspect tube.stl --out inspection
    cosim inspect cave.obj --entry 1 --exit 3 --scale radius=1
    """
    from cosim.inspect import InspectOptions
    from cosim.inspect import inspect as run

    run(InspectOptions(mesh, **options), as_json=as_json)


@command(short_help="Show runs or a mesh in 3-D; write pictures and films.")
@click.argument("sources", nargs=-1, type=click.Path(path_type=Path), metavar="[RUN ...|MESH]")
@view_options
def view(sources: tuple[Path, ...], **options: Any) -> None:
    """Show runs, or a MESH with its centreline and openings, in a window.

    Keys: space plays, arrows step, c changes the camera, q quits.

    \b
    cosim view runs/2026-...
    cosim view runs/ppo runs/pure-pursuit --movie race.mp4 --camera follow
    cosim view tube.stl --screenshot tube.png
    """
    from cosim.view import read_options
    from cosim.view import view as run

    run(read_options(sources, options))


@command(short_help="Write one HTML page of runs and evaluations.")
@click.argument("sources", type=click.Path(path_type=Path), nargs=-1, required=True, metavar="RUN...")
@option("--out", type=OutputFile(), metavar="FILE", help="Page [default: RUN/report.html].")
@option(
    "--fly",
    type=click.IntRange(min=0),
    default=0,
    metavar="N",
    help="Fly an evaluation's first N failures again, and link each to its replay.",
)
def report(sources: tuple[Path, ...], out: Path | None, fly: int) -> None:
    """Write one HTML page with replay in 3-D, plots, timings, settings and hashes; it opens from disk.

    RUN is a run folder, or the folder of `cosim evaluate --out`. Several runs are overlaid; an evaluation's failures
    are linked to those of their runs that are given or flown again.

    \b
    cosim report runs/2026-...
    cosim report runs/ppo runs/pure-pursuit --out comparison.html
    cosim report runs/evaluation --fly 20
    """
    from cosim.report import report as write

    click.echo(write(sources, out, fly))


@command(short_help="Write a recorded run in another format.")
@click.argument("run", type=click.Path(path_type=Path))
@option("--format", "kind", type=click.Choice(FORMATS), metavar="NAME", required=True, help="One of these.")
@option(
    "--out",
    "--output",
    "-o",
    "output",
    type=OutputFile(),
    metavar="FILE",
    help="[default: RUN/steps.<format>]",
)
def export(run: Path, kind: str, output: Path | None) -> None:
    """Write a recorded run in another format, from its folder alone.

    \b
    parquet, npz, csv  every number of every step; units and frames but in csv
    tum                trajectory for `evo` and SLAM benchmarks
    mcap               poses, scans, commands and state for Foxglove
    gltf, usd          animated scene for Blender, Unity and web viewers

    \b
    cosim export runs/2026-... --format parquet
    """
    from cosim.export import export as write

    path, note = write(run, kind, output)
    if note:
        click.echo(note, err=True)
    click.echo(path)


@command(short_help="Check a run, and replay its commands through fresh physics.")
@click.argument("run", type=click.Path(path_type=Path))
@option("--mesh", type=click.Path(path_type=Path), metavar="PATH", help="Where its tube is now.")
@option("--policy", type=click.Path(path_type=Path), metavar="PATH", help="Where its policy is now.")
@option("--server", metavar="COMMAND", help="Start your physics as COMMAND RENDEZVOUS.")
@json_option
def verify(run: Path, mesh: Path | None, policy: Path | None, server: str | None, as_json: bool) -> None:
    """Check that a run is whole, and that a fresh physics process makes the same poses of its commands, bit for bit.

    Exits 1 and names step and quantity where the data, the mesh or the policy were changed or the poses differ.
    Versions of software that differ are named, and fail only by what they do to the poses.

    \b
    cosim verify runs/2026-...
    """
    from cosim.verify import verify as run_verification

    if not run_verification(run, mesh=mesh, policy=policy, server=server, as_json=as_json):
        sys.exit(EXIT_NO_SUCCESS)
