"""`cosim train`: PPO in the kinematic world, with a live line and a checkpoint that can be flown."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Final

import click

from cosim.errors import CosimError, OutputError

CHECKPOINT: Final = "policy.zip"


def train(preset: str, steps: int | None, seed: int, envs: int, out: Path) -> None:
    """Train, and write the checkpoint to `out`/policy.zip.

    Args:
        preset: "paper" for the paper's tubes and all of its features; "shipped" for the recipe of the shipped
            policy, which sees neither its place in the tube nor its progress.
        steps: control steps of all drones together, None for the preset's.
        seed: of tubes, starts and network.
        envs: drones side by side.
        out: folder of the checkpoint and of TensorBoard's logs.

    Raises:
        CosimError: the extra `train` is not installed.
        OutputError: the folder cannot be written.
    """
    try:
        from dataclasses import replace

        from agent_client.training import Progress, TrainingOptions, shipped_options
        from agent_client.training import train as run
    except ImportError as error:
        raise CosimError(
            f"training needs {error.name}; install the extra with: pip install 'tube-cosim[train]'"
        ) from error

    path = out / CHECKPOINT
    if path.exists():
        raise OutputError(
            f"--out {out}: expected a folder without a policy, found {path}; name another folder"
        )
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"--out {out}: cannot be created: {error.strerror}") from error
    if preset == "paper":
        options = TrainingOptions(path, seed=seed, preset=preset)
    else:
        options = shipped_options(path, seed=seed)
    options = replace(
        options,
        steps=steps or options.steps,
        hyperparameters=replace(options.hyperparameters, lanes=envs),
        tensorboard=out / "tensorboard",
    )
    live = sys.stderr is not None and sys.stderr.isatty()

    def show(progress: Progress) -> None:
        rate = "   -" if math.isnan(progress.success_rate) else f"{100.0 * progress.success_rate:4.0f}"
        line = (
            f"level {progress.level}  success {rate} %  return {progress.mean_return:7.1f}  "
            f"{progress.steps:,} of {progress.total_steps:,} steps  {progress.steps_per_second:6.0f} steps/s  "
            f"{progress.seconds_left:4.0f} s left"
        )
        # On a terminal one line that is drawn anew; elsewhere a line a batch.
        click.echo(f"\r{line}\033[K" if live else line, err=True, nl=not live)

    click.echo(
        f"training '{preset}' for {options.steps:,} steps; drawing tubes and compiling first", err=True
    )
    try:
        written = run(options, show)
    except BaseException:
        kept = f"its last checkpoint is {path}" if path.exists() else "no checkpoint was written yet"
        click.echo(f"\ntraining ended early; {kept}", err=True)
        raise
    if live:
        click.echo(err=True)
    click.echo(f"{written}")
