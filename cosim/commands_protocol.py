"""Commands about sessions and this machine: `watch`, `conformance`, `doctor`, `bench`, `completion`.

Each parses its options and calls the module of its name, which is imported when the command runs.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Final

import click

from cosim.errors import PEER
from cosim.protocol_bars import WAYS
from cosim.screens import EXIT_FAILED_CHECK, FiniteRange, OutputFile, command, json_option, option, rare

PROGRAM: Final = "cosim"


@command(short_help="Show the live state of a running session.")
@click.argument("session", required=False)
@option(
    "--interval",
    type=FiniteRange(min=0.01),
    metavar="S",
    help="Between two reports [default: 0.1 on a terminal, else 1].",
)
@option("--wait", type=FiniteRange(min=0.0), default=0.0, metavar="S", help="For a session to come.")
@option("--once", is_flag=True, help="One report, then the end.")
@option("--json", "as_json", is_flag=True, help="One JSON object a line.")
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


@command(short_help="Prove a physics side or an agent against the protocol.")
@option(
    "--server",
    metavar="COMMAND",
    help="Physics side; RENDEZVOUS is appended, or put for {}.",
)
@option("--agent", metavar="COMMAND", help="Agent, started likewise.")
@option(
    "--transport",
    type=click.Choice(["shm", "file"]),
    default="shm",
    metavar="NAME",
    help="shm [default] or file.",
)
@option("--level", "levels", metavar="A,B", help="core, robustness, lanes, performance [default: all].")
@option("--rule", "names", metavar="NAME", multiple=True, help="This rule alone; may be repeated.")
@option(
    "--timeout",
    type=FiniteRange(min=0.1, max=3600.0),
    metavar="S",
    default=10.0,
    help="To start or to answer [default: 10].",
)
@option("--junit", type=OutputFile(), metavar="FILE", help="Write JUnit XML as well.")
@option("--failed", "failed_only", is_flag=True, help="Leave out of the text the rules that passed.")
@option("--list", "as_list", is_flag=True, help="Name the rules and run none.")
@json_option
def conformance(as_list: bool, as_json: bool, failed_only: bool, **options: Any) -> None:
    """Prove a program against the rules of the protocol (protocol/README.md).

    Exits 1 unless every required rule holds. What a program says that it cannot do is skipped.

    \b
    cosim conformance --server ./server --transport file --junit report.xml
    cosim conformance --agent "cosim launch --max-steps 30 --connect" --level core
    """
    from cosim.conformance import ConformanceOptions
    from cosim.conformance import conformance as run

    if not run(ConformanceOptions(**options), as_json=as_json, as_list=as_list, failed_only=failed_only):
        sys.exit(EXIT_FAILED_CHECK)


@command(short_help="Check this machine, and what dead sessions left on it.")
@option("--clean", is_flag=True, help="Remove what is proved dead or forgotten.")
@json_option
def doctor(clean: bool, as_json: bool) -> None:
    """Look at Python, libraries, shared memory, leftovers, cores, clock and optional programs, with what to do.

    Exit status 1 where something failed; warnings are about what is optional.

    \b
    cosim doctor --clean
    """
    from cosim.doctor import doctor as run

    if not run(clean=clean, as_json=as_json):
        sys.exit(EXIT_FAILED_CHECK)


@command(short_help="Measure round trips, control loop, start-up, runs, training.")
@json_option
@option("--quick", is_flag=True, help="Fewer samples: a look, not a measurement.")
@option("--training", is_flag=True, help="Training instead: environment, PPO, past the paper.")
@option("--runs", is_flag=True, help="What surrounds a flight: live viewer, verify, report.")
@option("--protocol", is_flag=True, help="The protocol: against the field, lanes, observers.")
@option("--png", type=OutputFile(), metavar="FILE", help="With --protocol: draw all round trips.")
@rare(
    "--only",
    metavar="A,B,...",
    help=f"With --protocol: these ways alone, out of {', '.join(WAYS)} [default: all].",
)
def bench(
    as_json: bool,
    quick: bool,
    training: bool,
    runs: bool,
    protocol: bool,
    png: Path | None,
    only: str | None,
) -> None:
    """Measure the protocol's round trip, the whole control loop and the start-up, side by side in one run.

    \b
    cosim bench --quick
    cosim bench --protocol --png trips.png   # against UDP, ZeroMQ, gRPC, ...
    """
    parts = {"--training": training, "--runs": runs, "--protocol": protocol}
    if sum(parts.values()) > 1:
        found = " and ".join(name for name, given in parts.items() if given)
        raise click.UsageError(f"{', '.join(parts)}: expected one of them, found {found}")
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

    run(as_json=as_json, quick=quick, training=training, runs=runs)


@command(short_help="Print what makes a shell complete cosim's commands.")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@click.pass_context
def completion(ctx: click.Context, shell: str) -> None:
    """Print the script that makes SHELL complete commands, options and their values.

    \b
    eval "$(cosim completion bash)"   # in ~/.bashrc
    eval "$(cosim completion zsh)"    # in ~/.zshrc, after compinit
    cosim completion fish > ~/.config/fish/completions/cosim.fish
    """
    from click.shell_completion import get_completion_class

    kind = get_completion_class(shell)
    assert kind is not None  # click has all three
    click.echo(kind(ctx.find_root().command, {}, PROGRAM, f"_{PROGRAM.upper()}_COMPLETE").source())
