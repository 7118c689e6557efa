"""Commands that train: `train`, `figures`, `ablate`.

Each parses its options and calls the module of its name, which is imported when the command runs.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Final

import click

from cosim.screens import command, json_option, option, rare

_COUNT: Final = click.IntRange(min=1)
_SEED: Final = click.IntRange(0, 2**31)


_dynamics_option = rare(
    "--dynamics",
    type=click.Choice(["kinematic", "rigid-body"]),
    metavar="WORLD",
    help="kinematic or rigid-body [default: the preset's].",
)


@command(short_help="Train a policy.")
@option(
    "--preset",
    type=click.Choice(["paper", "quick", "robust", "robust-ppo"]),
    metavar="NAME",
    help="Recipe [default: robust].",
)
@option("--steps", type=_COUNT, metavar="N", help="Of all drones together [default: the preset's].")
@option(
    "--seed",
    type=click.IntRange(0, 2**32 - 1),
    metavar="N",
    help="Of tubes, starts, network [default: the preset's].",
)
@rare("--envs", type=_COUNT, metavar="N", help="Drones side by side [default: the preset's].")
@rare("--pool", type=_COUNT, metavar="N", help="Tubes a level [default: 1000; fewer with bullet].")
@_dynamics_option
@rare(
    "--engine",
    type=click.Choice(["reference", "bullet"]),
    metavar="ENGINE",
    help="Of rigid bodies, reference [default] or bullet.",
)
@option("--resume", type=click.Path(path_type=Path), metavar="DIR", help="Go on with the training in DIR.")
@option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Folder [default: runs/training].")
@option("--explain", is_flag=True, help="Say what the paper leaves open and what 'paper' takes.")
def train(out: Path | None, resume: Path | None, explain: bool, **arguments: Any) -> None:
    """Train a policy and write it as a checkpoint that flies.

    \b
    paper       PPO: the paper's task, reward and hyperparameters
    quick       PPO: above the paper's rates in the least time
    robust      the shipped policy's: imitates a teacher that sees the axis
    robust-ppo  its task (inertia, noise, hard tubes) by PPO

    What was stopped or killed goes on after its last iteration, with --resume.

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


@command(short_help="Draw success rate and return of a training by iteration.")
@click.argument("folder", type=click.Path(path_type=Path), metavar="DIR")
def figures(folder: Path) -> None:
    """Draw the paper's two figures of a training into DIR, also of one that still runs.

    \b
    cosim figures runs/mine
    """
    from cosim.figures import draw_figures

    for path in draw_figures(folder / "policy.csv", folder):
        click.echo(path)


@command(short_help="Train with one thing changed at a time, and compare.")
@option("--variants", metavar="A,B,...", help="Only these [default: all].")
@option(
    "--preset",
    type=click.Choice(["paper", "quick", "robust-ppo"]),
    metavar="NAME",
    default="quick",
    help="paper, quick [default] or robust-ppo.",
)
@_dynamics_option
@rare("--hard", is_flag=True, help="Train and fly under the hard conditions.")
@rare("--unknown-tube", is_flag=True, help="Hide progress and offset from every policy.")
@option("--steps", type=_COUNT, metavar="N", help="Of a training [default: the preset's].")
@option("--seeds", type=_COUNT, metavar="N", default=3, help="Trainings of each [default: 3].")
@option("--seed", type=_SEED, metavar="N", default=0, help="First of them, and of the tubes [default: 0].")
@option("--episodes", type=_COUNT, metavar="N", default=100, help="Tubes a level [default: 100].")
@rare("--envs", type=_COUNT, metavar="N", help="Drones side by side [default: the preset's].")
@rare("--pool", type=_COUNT, metavar="N", help="Tubes a level to train in [default: 1000].")
@rare(
    "--workers",
    type=click.IntRange(1, 512),
    metavar="N",
    help="Processes; change no result [default: the cores].",
)
@option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Keep results.json, checkpoints, logs.")
@json_option
def ablate(variants: str | None, workers: int | None, as_json: bool, **options: Any) -> None:
    """Train and fly a recipe with one thing changed at a time, and compare.

    \b
    full           the recipe itself   no-position     no progress, no offset
    no-memory      nothing remembered  no-curriculum   all levels from the start
    no-camera      LiDAR alone         literal-reward  the paper's, paid per step
    no-rear-lidar  front ring alone    per-metre       paid per metre of progress
    no-lidar       camera alone        one-regime      the reward's blind terms

    \b
    cosim ablate --variants full,literal-reward --steps 2600000 --out runs/rewards
    """
    from cosim.ablate import AblateOptions
    from cosim.ablate import ablate as run

    names = None if variants is None else tuple(name.strip() for name in variants.split(","))
    cores = len(os.sched_getaffinity(0))
    run(AblateOptions(variants=names, workers=workers or cores, **options), as_json=as_json)
