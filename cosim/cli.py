"""The command `cosim`: parses, calls, and turns errors into one sentence and an exit status."""

from __future__ import annotations

import os
import signal
import sys
import traceback
from pathlib import Path
from types import FrameType
from typing import Any, Final

import click

from cosim import __version__
from cosim.errors import INTERNAL, PEER, Terminated, exit_status
from cosim.named_settings import SettingsCommand, take_settings
from cosim.options import FlightOptions, evaluate_options, flight_options, view_options

EXIT_NO_SUCCESS: Final = 1
FORMATS: Final = ("csv", "npz", "parquet", "tum", "mcap", "gltf", "usd")
"""Of `cosim.export`, whose imports a command's help does not wait for."""
EXIT_FAILED_CHECK: Final = 1

_COUNT: Final = click.IntRange(min=1)
_SEED: Final = click.IntRange(0, 2**31)

CONTEXT: Final = {"help_option_names": ["-h", "--help"], "max_content_width": 110}


class _Commands(click.Group):
    """All the commands; where nobody reads their output any more they end as SIGPIPE would end them."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command. Of a closed pipe click would make 1, which means "no success" here."""
        try:
            return super().invoke(ctx)
        except BrokenPipeError as error:
            os.dup2(
                os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno()
            )  # Python flushes once more at its exit
            sys.exit(exit_status(error))


@click.group(cls=_Commands, context_settings=CONTEXT)
@click.version_option(__version__, prog_name="cosim")
def cosim() -> None:
    """Fly a learned drone policy through a tube, in lockstep with a physics engine.

    \b
    cosim launch                           the shipped policy through the shipped conduit
    cosim launch --mesh M.obj --policy P   your tube, your policy
    """


@cosim.command(cls=SettingsCommand, short_help="Fly a policy through a tube in a separate physics process.")
@flight_options
@click.option("--require-success", is_flag=True, help="Exit 1 unless the outcome is success.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout, nothing else.")
def launch(require_success: bool, as_json: bool, **options: Any) -> None:
    """Fly a policy through a tube in a separate physics process.

    \b
    cosim launch --mesh industrial.obj --policy tube_ppo --seed 3
    cosim launch --tube level=2,seed=1234 --hard
    """
    from cosim.launch import launch as run

    settings = take_settings(options)
    report = run(FlightOptions(settings=settings, **options), as_json=as_json)
    if require_success and report["outcome"] != "success":
        sys.exit(EXIT_NO_SUCCESS)


@cosim.command(short_help="Write a recorded run in another format.")
@click.argument("run", type=click.Path(path_type=Path))
@click.option("--format", "kind", type=click.Choice(FORMATS), required=True)
@click.option("--output", "-o", type=click.Path(path_type=Path), help="File [default: RUN/steps.<format>].")
def export(run: Path, kind: str, output: Path | None) -> None:
    """Write a recorded run in another format, from its folder alone.

    \b
    csv, npz, parquet  every number of every step, with units and frames
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


@cosim.command(short_help="Write one HTML page of runs and evaluations, which needs no network.")
@click.argument("sources", type=click.Path(path_type=Path), nargs=-1, required=True, metavar="RUN...")
@click.option(
    "--out", type=click.Path(path_type=Path), metavar="FILE.html", help="Page [default: RUN/report.html]."
)
def report(sources: tuple[Path, ...], out: Path | None) -> None:
    """Write one HTML page with replay in 3-D, plots, timings, settings and hashes; it opens from disk.

    RUN is a run folder, or the results.json of `cosim evaluate --out`. Several runs are overlaid; an evaluation's
    failures are linked to those of their runs that are given.

    \b
    cosim report runs/2026-...
    cosim report runs/ppo runs/pure-pursuit --out comparison.html
    """
    from cosim.report import report as write

    click.echo(write(sources, out))


@cosim.command(short_help="Show runs or a mesh in 3-D, or write pictures and films of them.")
@click.argument("sources", nargs=-1, type=click.Path(path_type=Path), metavar="[RUN ...|MESH]")
@view_options
def view(sources: tuple[Path, ...], **options: Any) -> None:
    """Show recorded runs, or a MESH with its centreline and openings, in a window; [default: the shipped mesh].

    The tube is cut open towards the camera. Keys: space plays, arrows step, c changes the camera, q quits.

    \b
    cosim view runs/2026-...
    cosim view runs/ppo runs/pure-pursuit --movie race.mp4 --camera follow
    cosim view tube.stl --screenshot tube.png
    """
    from cosim.view import read_options
    from cosim.view import view as run

    run(read_options(sources, options))


@cosim.command(short_help="Check a recorded run, and replay its commands through fresh physics.")
@click.argument("run", type=click.Path(path_type=Path))
@click.option("--mesh", type=click.Path(path_type=Path), metavar="PATH", help="Where its tube is now.")
@click.option(
    "--server", metavar="COMMAND", help="Physics process, the rendezvous appended [default: the run's]."
)
@click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout, nothing else.")
def verify(run: Path, mesh: Path | None, server: str | None, as_json: bool) -> None:
    """Check that a run is whole, and that a fresh physics process makes the same poses of its commands, bit for bit.

    Exits 1 and names step and quantity where the data, the mesh or the policy were changed or the poses differ.
    Versions of software that differ are named, and fail only by what they do to the poses.

    \b
    cosim verify runs/2026-...
    """
    from cosim.verify import verify as run_verification

    if not run_verification(run, mesh=mesh, server=server, as_json=as_json):
        sys.exit(EXIT_NO_SUCCESS)


@cosim.command(short_help="Let another policy fly on from a step of a recorded run.")
@click.argument("run", type=click.Path(path_type=Path))
@click.option("--policy", required=True, metavar="PATH|pure-pursuit|lidar-rule", help="Who flies on.")
@click.option(
    "--from-step", type=click.IntRange(min=0), required=True, metavar="K", help="The last step of the run."
)
@click.option(
    "--server", metavar="COMMAND", help="Physics process, the rendezvous appended [default: the run's]."
)
@click.option(
    "--out", type=click.Path(path_type=Path), metavar="DIR", help="Run folder [default: a new one in runs/]."
)
@click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout, nothing else.")
def replay(
    run: Path, policy: str, from_step: int, server: str | None, out: Path | None, as_json: bool
) -> None:
    """Rebuild the state at step K of a run by sending its commands again, then let another policy fly on.

    Both flights are the same up to K, bit for bit, which is checked; the table compares what came after.

    \b
    cosim replay runs/2026-... --policy pure-pursuit --from-step 120
    """
    from cosim.replay import replay as run_replay

    run_replay(run, policy=policy, from_step=from_step, server=server, out=out, as_json=as_json)


@cosim.command(short_help="Train a policy.")
@click.option(
    "--preset",
    type=click.Choice(["paper", "quick", "robust", "robust-ppo"]),
    help="Recipe [default: robust].",
)
@click.option(
    "--steps", type=click.IntRange(min=1), help="Control steps of all drones [default: the preset's]."
)
@click.option(
    "--seed", type=click.IntRange(0, 2**32 - 1), help="Of tubes, starts, network [default: the preset's]."
)
@click.option("--envs", type=click.IntRange(min=1), help="Drones side by side [default: the preset's].")
@click.option("--pool", type=click.IntRange(min=1), help="Tubes a level [default: 1000; fewer with bullet].")
@click.option(
    "--dynamics", type=click.Choice(["kinematic", "rigid-body"]), help="World [default: the preset's]."
)
@click.option(
    "--engine", type=click.Choice(["reference", "bullet"]), help="Of rigid bodies [default: reference]."
)
@click.option(
    "--resume", type=click.Path(path_type=Path), metavar="DIR", help="Go on with the training in DIR."
)
@click.option(
    "--out", type=click.Path(path_type=Path), metavar="DIR", help="Folder [default: runs/training]."
)
@click.option(
    "--explain", is_flag=True, help="Print what the paper leaves open and what 'paper' takes; train nothing."
)
def train(out: Path | None, resume: Path | None, explain: bool, **arguments: Any) -> None:
    """Train a policy and write it as a checkpoint that flies.

    \b
    paper       PPO: the paper's task, features, curriculum, literal reward and hyperparameters
    quick       PPO: above the paper's success rates in the least time
    robust      the shipped policy's: inertia, noise, hard tubes; imitates a teacher that sees the axis
    robust-ppo  the same task by PPO through the curriculum

    The folder gets policy.zip, policy.csv (a row an iteration), TensorBoard's logs, success.png and return.png.
    A training that was stopped or killed goes on after its last iteration, with new episodes:

    \b
    cosim train --preset quick --seed 1 --out runs/mine
    cosim train --resume runs/mine
    """
    from cosim.train import TrainArguments, print_choices
    from cosim.train import train as run

    if explain:
        print_choices(arguments["preset"])
    else:
        run(TrainArguments(**arguments), out, resume)


@cosim.command(short_help="Draw success rate and return of a training by iteration.")
@click.argument("folder", type=click.Path(path_type=Path), metavar="DIR")
def figures(folder: Path) -> None:
    """Draw the paper's two figures of a training, also of one that still runs: success.png and return.png in DIR.

    \b
    cosim figures runs/mine
    """
    from cosim.figures import draw_figures

    for path in draw_figures(folder / "policy.csv", folder):
        click.echo(path)


@cosim.command(
    cls=SettingsCommand, short_help="Fly pilots through many unseen tubes, beside the paper's figures."
)
@evaluate_options
@click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout, nothing else.")
def evaluate(as_json: bool, **options: Any) -> None:
    """Fly pilots through the same unseen tubes, and print the paper's table side by side.

    \b
    cosim evaluate --policy tube_ppo --policy pure-pursuit-tuned --dynamics rigid-body --hard
    cosim evaluate --dynamics rigid-body --engine reference --sweep gain=1,2,4,8
    """
    from cosim.evaluate import evaluate as run
    from cosim.evaluation_plan import read_options

    run(read_options(options), as_json=as_json)


@cosim.command(short_help="Train without memory, camera, curriculum and so on, and compare.")
@click.option("--variants", metavar="A,B,...", help="Only these [default: all].")
@click.option(
    "--preset",
    type=click.Choice(["paper", "quick", "robust-ppo"]),
    default="quick",
    help="Recipe [default: quick].",
)
@click.option(
    "--dynamics", type=click.Choice(["kinematic", "rigid-body"]), help="World [default: the preset's]."
)
@click.option("--hard", is_flag=True, help="Train and fly under the hard conditions.")
@click.option("--unknown-tube", is_flag=True, help="Hide progress and offset from every policy.")
@click.option("--steps", type=_COUNT, metavar="N", help="Of a training [default: the preset's].")
@click.option("--seeds", type=_COUNT, metavar="N", default=3, help="Trainings of each [default: 3].")
@click.option(
    "--seed", type=_SEED, metavar="N", default=0, help="First of them, and of the tubes flown [default: 0]."
)
@click.option("--episodes", type=_COUNT, metavar="N", default=100, help="Tubes a level [default: 100].")
@click.option("--envs", type=_COUNT, metavar="N", help="Drones side by side [default: the preset's].")
@click.option("--pool", type=_COUNT, metavar="N", help="Tubes a level to train in [default: 1000].")
@click.option(
    "--workers",
    type=click.IntRange(1, 512),
    metavar="N",
    help="Processes; change no result [default: the cores].",
)
@click.option(
    "--out", type=click.Path(path_type=Path), metavar="DIR", help="Keep results.json, checkpoints, logs."
)
@click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout, nothing else.")
def ablate(variants: str | None, workers: int | None, as_json: bool, **options: Any) -> None:
    """Train and fly a recipe with one thing changed at a time, and print a table beside the paper's claims.

    \b
    full            the recipe itself      no-position     no progress, no offset from the axis
    no-memory       nothing remembered     no-curriculum   all levels from the first episode on
    no-camera       LiDAR alone            literal-reward  the paper's reward, paid per step
    no-rear-lidar   front ring alone       per-metre       the reward paid per metre of progress
    no-lidar        camera alone           one-regime      the reward's blind terms, whatever is seen

    A longer budget shows what loiters under the literal reward:

    \b
    cosim ablate --variants full,literal-reward --steps 2600000 --out runs/ablation
    """
    from cosim.ablate import AblateOptions
    from cosim.ablate import ablate as run

    names = None if variants is None else tuple(name.strip() for name in variants.split(","))
    cores = len(os.sched_getaffinity(0))
    run(AblateOptions(variants=names, workers=workers or cores, **options), as_json=as_json)


@cosim.command(short_help="Measure round trip, control loop and start-up, or training, on this machine.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout, nothing else.")
@click.option("--quick", is_flag=True, help="Fewer samples: a look, not a measurement.")
@click.option(
    "--training", is_flag=True, help="The speed of training instead: environment, PPO, past the paper."
)
@click.option(
    "--protocol", is_flag=True, help="The protocol instead: against the field, the floor, idle, lanes."
)
@click.option(
    "--png", type=click.Path(path_type=Path), metavar="FILE", help="With --protocol: draw all round trips."
)
@click.option("--only", metavar="A,B,...", help="With --protocol: these ways alone [default: all].")
def bench(
    as_json: bool, quick: bool, training: bool, protocol: bool, png: Path | None, only: str | None
) -> None:
    """Measure the protocol's round trip, the whole control loop and the start-up, side by side in one run.

    \b
    cosim bench --quick
    cosim bench --protocol --png round_trips.png     against UDP, Pipe, ZeroMQ, gRPC, iceoryx2, PyBullet, C
    """
    if training and protocol:
        raise click.UsageError("--training and --protocol: expected one of them, found both")
    if not protocol and (png is not None or only is not None):
        raise click.UsageError(
            f"--{'png' if png is not None else 'only'} is an option of --protocol, which is not given"
        )
    if protocol:
        from cosim.bench_protocol import bench_protocol

        names = tuple(name.strip() for name in only.split(",")) if only is not None else ()
        bench_protocol(as_json=as_json, quick=quick, png=png, only=names)
        return
    from cosim.bench import bench as run

    run(as_json=as_json, quick=quick, training=training)


@cosim.command(short_help="Show the live state of a running session, without disturbing it.")
@click.argument("session", required=False)
@click.option(
    "--interval",
    type=click.FloatRange(min=0.01),
    metavar="S",
    help="Between two reports [default: 0.1 on a terminal, else 1].",
)
@click.option(
    "--wait", type=click.FloatRange(min=0.0), default=0.0, metavar="S", help="For a session to come."
)
@click.option("--once", is_flag=True, help="One report, then the end.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object a line.")
def watch(as_json: bool, **options: Any) -> None:
    """Show the live state of SESSION (a name, shm:NAME or file:/path/stem), or of the only one that runs.

    Reads shared memory and writes nothing. Ends with the session and says why: 0 after its goodbye, else 3.
    Ctrl-C ends the watching alone.

    \b
    cosim launch --session mine --realtime 1 &
    cosim watch mine --wait 10
    """
    from cosim.watch import WatchOptions
    from cosim.watch import watch as run

    if not run(WatchOptions(**options), as_json=as_json):
        sys.exit(PEER)


@cosim.command(short_help="Say what this machine has and lacks, and what dead sessions left on it.")
@click.option(
    "--clean", is_flag=True, help="Remove segments of sessions proved dead, and forgotten scratch folders."
)
@click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout, nothing else.")
def doctor(clean: bool, as_json: bool) -> None:
    """Look at Python, libraries, shared memory, leftovers, cores, clock and optional programs, with what to do.

    Exit status 1 where something failed; warnings are about what is optional.

    \b
    cosim doctor --clean
    """
    from cosim.doctor import doctor as run

    if not run(clean=clean, as_json=as_json):
        sys.exit(EXIT_FAILED_CHECK)


@cosim.command(short_help="Prove a physics side or an agent in any language against the protocol.")
@click.option(
    "--server",
    metavar="COMMAND",
    help="Physics side, started as COMMAND RENDEZVOUS for every rule; {} in COMMAND stands for RENDEZVOUS.",
)
@click.option("--agent", metavar="COMMAND", help="Agent, started likewise.")
@click.option(
    "--transport",
    type=click.Choice(["shm", "file"]),
    default="shm",
    show_default=True,
    help="Of the segments.",
)
@click.option(
    "--level", "levels", metavar="A,B,...", help="core, robustness, lanes, performance [default: all]."
)
@click.option("--rule", "names", metavar="NAME", multiple=True, help="This rule alone; may be repeated.")
@click.option(
    "--timeout",
    type=click.FloatRange(min=0.1, max=3600.0),
    metavar="SECONDS",
    default=10.0,
    show_default=True,
    help="To start or to answer.",
)
@click.option("--junit", type=click.Path(path_type=Path), metavar="FILE", help="Write JUnit XML as well.")
@click.option("--list", "as_list", is_flag=True, help="Name the rules and run none.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout, nothing else.")
def conformance(as_list: bool, as_json: bool, **options: Any) -> None:
    """Prove any program against the rules of the protocol, which protocol/README.md specifies.

    Exit status 0 if every required rule holds, else 1. A rule is skipped where the program says that it cannot do
    what the rule is about.

    \b
    cosim conformance --server "python -m physics_server"
    cosim conformance --server ./server --transport file --level core,lanes --junit conformance.xml
    cosim conformance --agent "python -m protocol.conformance.toy_agent" --json
    cosim conformance --agent "cosim launch --max-steps 30 --connect" --level core
    """
    from cosim.conformance import ConformanceOptions
    from cosim.conformance import conformance as run

    if not run(ConformanceOptions(**options), as_json=as_json, as_list=as_list):
        sys.exit(EXIT_FAILED_CHECK)


def _interrupted(number: int, _frame: FrameType | None) -> None:
    """Ctrl-C or SIGTERM: the first one ends the command in order, and another must not cut the cleaning up short."""
    for deaf_to in (signal.SIGINT, signal.SIGTERM):
        signal.signal(deaf_to, signal.SIG_IGN)
    raise KeyboardInterrupt if number == signal.SIGINT else Terminated


def main() -> None:
    """Entry point of the console script; every error raised on purpose is one sentence on stderr."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupted)
    try:
        cosim.main(standalone_mode=False)
    except click.exceptions.Exit as done:
        sys.exit(done.exit_code)
    except click.Abort:
        sys.exit(exit_status(KeyboardInterrupt()))
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except SystemExit:
        raise
    except BaseException as error:  # noqa: BLE001  exit statuses are given here and nowhere else
        status = exit_status(error)
        if status is None:
            traceback.print_exc()
            click.echo(f"cosim: a fault of cosim itself ({type(error).__name__}); please report it", err=True)
            sys.exit(INTERNAL)
        for line in (f"cosim: {error}" if str(error) else "", *getattr(error, "__notes__", ())):
            if line:
                click.echo(line, err=True)
        sys.exit(status)
