"""`cosim train`: PPO by a preset, with a live display, a log, and checkpoints that a kill does not cost."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TextIO

import click

from agent_client.errors import TrainingOver
from agent_client.tubes import LEVELS
from cosim.errors import CosimError, OutputError, Terminated
from cosim.figures import draw_figures
from cosim.requirements import install_command
from cosim.sessions import server_session
from cosim.train_display import TrainingDisplay
from cosim.walls import WallRegistry, wall_slots
from physics_server.reference import ReferencePlant
from protocol.agent import AgentSession, SessionSettings
from protocol.twin import open_twin

if TYPE_CHECKING:  # torch is loaded only when training begins
    from agent_client.training_options import TrainingOptions

CHECKPOINT: Final = "policy.zip"
STATE: Final = "policy.state"
LOG: Final = "policy.csv"
ARGUMENTS: Final = "training.json"
"""The arguments of the command, kept for `--resume`."""


@dataclass(frozen=True)
class TrainArguments:
    """What the user asked of a training; None leaves it to the preset."""

    preset: str | None = None
    steps: int | None = None
    seed: int | None = None
    envs: int | None = None
    pool: int | None = None
    dynamics: str | None = None
    engine: str | None = None


def train(arguments: TrainArguments, out: Path | None, resume: Path | None) -> None:
    """Train, or go on training, in a folder: checkpoint, state, log, TensorBoard's logs and the two figures.

    Args:
        arguments: what was asked; with `resume` only `steps` may be given.
        out: folder of a new training, None for runs/training.
        resume: folder of a training to go on with.

    Raises:
        CosimError: arguments that contradict each other, or the extra `train` is not installed.
        OutputError: the folder cannot be written, or holds a training already.
        AgentError: there is nothing to resume, or a value out of range.
    """
    if resume is not None:
        if out is not None:
            raise CosimError("--resume: a training goes on in its own folder; leave out --out")
        folder, arguments = resume, _resumed(resume, arguments)
    else:
        folder = out or Path("runs/training")
        _refuse_training(folder)
        arguments = _completed(arguments)
    run = load_training()
    with _alone_in(folder, resume is None) as kept:
        if resume is None:
            _refuse_training(folder)  # once more: another may have begun and ended since
            _write_arguments(kept, arguments)
        written = _run(run, folder, arguments, resumed=resume is not None)
        for figure in draw_figures(folder / LOG, folder):
            click.echo(figure, err=True)
    click.echo(written)


def _run(run: Callable[..., Path], folder: Path, arguments: TrainArguments, *, resumed: bool) -> Path:
    """Train with the display; says on stderr what is left where it is stopped, and where all steps are done."""
    options = _options(folder, arguments)
    click.echo(_announcement(options, arguments, resumed=resumed), err=True)
    try:
        with TrainingDisplay(options.steps) as display:
            return run(
                options,
                display.update,
                _opener(arguments),
                **_walls(options, arguments),
                resume=resumed,
                on_note=lambda text: click.echo(text, err=True),
            )
    except TrainingOver:
        click.echo(f"all {options.steps:,} steps are done; for more, add --steps", err=True)
        return options.out
    except (KeyboardInterrupt, Terminated):
        if (folder / STATE).exists():
            text = f"training stopped; {options.out} is its last iteration; go on with: cosim train --resume {folder}"
        else:
            text = (
                f"training stopped before its first iteration was completed: {folder} holds no policy, only "
                f"arguments and logs; begin anew with --out {folder}"
            )
        click.echo(text, err=True)
        raise


def limit_spinning() -> None:
    """Have torch's threads wait for each other asleep, unless the user says otherwise; call before torch is loaded.

    By default they spin, which on a machine with other work takes 15 times as long.
    """
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")


def print_choices(preset: str | None) -> None:
    """Print what the paper leaves open and what the preset `paper` takes.

    Raises:
        CosimError: another preset, which goes beyond the paper.
    """
    if preset not in (None, "paper"):
        raise CosimError(f"--explain: expected --preset paper, found {preset}, which is not the paper's")
    from agent_client.paper import to_markdown

    click.echo(to_markdown())


def load_training() -> Callable[..., Path]:
    """`agent_client.training.train`, loaded with torch when it is first needed.

    Raises:
        CosimError: the extra `train` is not installed.
    """
    limit_spinning()
    try:
        from agent_client.training import train as run
    except ImportError as error:
        raise CosimError(
            f"training needs {error.name}; install it with: {install_command('train')}"
        ) from error
    return run


def _completed(arguments: TrainArguments) -> TrainArguments:
    """The arguments with the dynamics and the engine that are left to the preset.

    Raises:
        CosimError: an engine without inertia.
    """
    from agent_client.presets import PRESETS

    preset = arguments.preset or "robust"
    dynamics = arguments.dynamics or PRESETS[preset].dynamics
    if dynamics == "kinematic" and arguments.engine is not None:
        raise CosimError(
            f"--engine {arguments.engine}: kinematic dynamics have no engine; add --dynamics rigid-body"
        )
    engine = (arguments.engine or "reference") if dynamics == "rigid-body" else None
    return replace(arguments, preset=preset, dynamics=dynamics, engine=engine)


def _resumed(folder: Path, given: TrainArguments) -> TrainArguments:
    """The arguments that a training was begun with, and the new number of steps if one is given.

    Raises:
        CosimError: the folder holds no training or one of an unknown preset, or an argument is given that cannot
            change.
    """
    from agent_client.presets import PRESETS

    path = folder / ARGUMENTS
    try:
        begun = TrainArguments(**json.loads(path.read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise CosimError(
            f"--resume {folder}: expected the folder of a training, found no {ARGUMENTS} that can be read ({error})"
        ) from error
    if begun.preset not in PRESETS:
        raise CosimError(
            f"{path}: expected a preset out of {', '.join(PRESETS)}, found {begun.preset!r}; resume with the version "
            "that the training was begun with"
        )
    for field in fields(TrainArguments):
        value, before = getattr(given, field.name), getattr(begun, field.name)
        if field.name != "steps" and value not in (None, before):
            raise CosimError(
                f"--{field.name} {value}: expected that of the training that goes on, {before}; leave it out"
            )
    return begun if given.steps is None else replace(begun, steps=given.steps)


def _refuse_training(folder: Path) -> None:
    """Refuse a folder for a new training that holds one already.

    Raises:
        OutputError: it does.
    """
    for name in (CHECKPOINT, STATE):
        if (folder / name).exists():
            raise OutputError(
                f"--out {folder}: expected a folder without a training, found {name}; name another folder, or go "
                f"on with --resume {folder}"
            )


@contextmanager
def _alone_in(folder: Path, new: bool) -> Iterator[TextIO]:
    """Hold the folder of a training, by a lock on its arguments that the kernel releases even after a kill.

    Args:
        folder: of the training; made if it is new.
        new: whether it begins.

    Returns:
        The file of the arguments, open to be written.

    Raises:
        OutputError: another training runs in it, or it cannot be written.
    """
    option = "--out" if new else "--resume"
    with ExitStack() as stack:
        try:
            if new:
                folder.mkdir(parents=True, exist_ok=True)
            file = stack.enter_context((folder / ARGUMENTS).open("a"))
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError(
                f"{option} {folder}: expected a folder in which no training runs, found one that does; wait for its "
                "end, stop it, or name another folder"
            ) from None
        except OSError as error:
            raise OutputError(f"{option} {folder}: cannot be written: {error.strerror}") from error
        yield file


def _write_arguments(file: TextIO, arguments: TrainArguments) -> None:
    """Keep the arguments of a new training in the file that `_alone_in` holds.

    Raises:
        OutputError: it cannot be written.
    """
    try:
        file.truncate(0)
        file.write(json.dumps(asdict(arguments), indent=1) + "\n")
        file.flush()
    except OSError as error:
        raise OutputError(f"{file.name}: cannot be written: {error.strerror}") from error


def _options(folder: Path, arguments: TrainArguments) -> TrainingOptions:
    """The preset's options with what the user asked."""
    from agent_client.presets import PRESETS, without_inertia

    assert arguments.preset is not None
    options = PRESETS[arguments.preset].options
    if arguments.dynamics == "kinematic":
        options = without_inertia(options)
    lanes = arguments.envs or options.hyperparameters.lanes
    # PyBullet reads a wall in 0.1 s: with pools no larger than what stays registered, it reads each one once.
    pool = wall_slots(lanes) // LEVELS if arguments.engine == "bullet" else options.pool
    return replace(
        options,
        out=folder / CHECKPOINT,
        steps=arguments.steps or options.steps,
        seed=options.seed if arguments.seed is None else arguments.seed,
        pool=arguments.pool or pool,
        hyperparameters=replace(options.hyperparameters, lanes=lanes),
        tensorboard=folder / "tensorboard",
    )


def _announcement(options: TrainingOptions, arguments: TrainArguments, *, resumed: bool) -> str:
    engine = f" integrated by {arguments.engine}" if arguments.engine else ""
    anew = "; episodes that were under way begin anew" if resumed else ""
    if resumed and options.imitation is not None:
        anew += ", and a few rounds that count for nothing fill the memory of the imitation first"
    return (
        f"{'resuming' if resumed else 'training'} '{options.preset}' to {options.steps:,} steps, seed "
        f"{options.seed}: {options.hyperparameters.lanes} drones, {arguments.dynamics} dynamics{engine}, pools of "
        f"{options.pool:,} tubes a level{anew}"
    )


def _opener(
    arguments: TrainArguments,
) -> Callable[[SessionSettings], AbstractContextManager[AgentSession]] | None:
    """What opens the session of the dynamics; None for training's own kinematic world."""
    if arguments.engine == "reference":
        return lambda settings: open_twin(ReferencePlant(), settings)
    if arguments.engine == "bullet":
        return lambda settings: server_session(replace(settings, tube_slots=wall_slots(settings.lanes)))
    return None


def _walls(options: TrainingOptions, arguments: TrainArguments) -> dict[str, Any]:
    """How the walls reach an engine that has walls."""
    if arguments.engine != "bullet":
        return {}
    return {"register_walls": WallRegistry(wall_slots(options.hyperparameters.lanes))}
