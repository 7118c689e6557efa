"""Commands that fly: `launch`, `evaluate`, `replay`.

Each parses its options and calls the module of its name, which is imported when the command runs.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from cosim.named_settings import SettingsCommand, take_settings
from cosim.options import POLICY_HELP, FlightOptions, PolicyType, evaluate_options, flight_options
from cosim.screens import EXIT_NO_SUCCESS, command, json_option, option, rare


@command(cls=SettingsCommand, short_help="Fly a policy through a tube, physics in its own process.")
@flight_options
@option("--view", is_flag=True, help="Show it live in a window, at --realtime 1.")
@click.option("--view-frames", type=click.Path(path_type=Path, exists=True, file_okay=False), hidden=True)
@rare("--require-success", is_flag=True, help="Exit 1 unless the outcome is success.")
@json_option
def launch(
    view: bool, view_frames: Path | None, require_success: bool, as_json: bool, **options: Any
) -> None:
    """Fly a policy through a tube in a separate physics process.

    \b
    cosim launch --mesh industrial.obj --policy tube_ppo --seed 3
    cosim launch --tube level=2,seed=1234 --hard
    """
    from cosim.launch import launch as run
    from cosim.live_view import ViewChoice

    settings = take_settings(options)
    choice = ViewChoice(view_frames) if view or view_frames is not None else None
    report = run(FlightOptions(settings=settings, **options), as_json=as_json, view=choice)
    if require_success and report["outcome"] != "success":
        sys.exit(EXIT_NO_SUCCESS)


@command(cls=SettingsCommand, short_help="Fly pilots through unseen tubes, and print the paper's table.")
@evaluate_options
@json_option
def evaluate(as_json: bool, **options: Any) -> None:
    """Fly pilots through the same unseen tubes, and print the paper's table.

    \b
    cosim evaluate --policy tube_ppo --dynamics rigid-body --hard
    cosim evaluate --dynamics rigid-body --engine reference --sweep gain=1,2,4,8
    """
    from cosim.evaluate import evaluate as run
    from cosim.evaluation_plan import read_options

    run(read_options(options), as_json=as_json)


@command(short_help="Let another policy fly on from a step of a run.")
@click.argument("run", type=click.Path(path_type=Path))
@option("--policy", type=PolicyType(), required=True, metavar="P", help=f"Who flies on: {POLICY_HELP}.")
@option(
    "--from-step",
    type=click.IntRange(min=0),
    required=True,
    metavar="K",
    help="Last step of the run that is repeated.",
)
@option("--mesh", type=click.Path(path_type=Path), metavar="PATH", help="Where its tube is now.")
@option("--server", metavar="COMMAND", help="Start your physics as COMMAND RENDEZVOUS.")
@option(
    "--out", type=click.Path(path_type=Path), metavar="DIR", help="Run folder [default: a new one in runs/]."
)
@json_option
def replay(
    run: Path,
    policy: str,
    from_step: int,
    mesh: Path | None,
    server: str | None,
    out: Path | None,
    as_json: bool,
) -> None:
    """Rebuild the state at step K of a run by sending its commands again, then let another policy fly on.

    Both flights are the same up to K, bit for bit, which is checked; the table compares what came after.

    \b
    cosim replay runs/2026-... --policy pure-pursuit --from-step 120
    """
    from cosim.replay import replay as run_replay

    run_replay(run, policy=policy, from_step=from_step, mesh=mesh, server=server, out=out, as_json=as_json)
