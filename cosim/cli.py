"""The command `cosim`: parses, calls, and turns errors into one sentence and an exit status."""

from __future__ import annotations

import io
import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, Final

import click

from cosim import (
    __version__,
    commands_flights,
    commands_protocol,
    commands_runs,
    commands_training,
    interrupts,
)
from cosim.errors import INTERNAL, SIGNALLED, exit_status

CONTEXT: Final = {"help_option_names": ["-h", "--help"], "max_content_width": 110}


class _Commands(click.Group):
    """All the commands, in the order in which they were added."""

    def make_context(self, *arguments: Any, **named: Any) -> click.Context:
        """Parse what precedes a command; --help and --version write here."""
        # None leaves colours to whether a stream is a terminal.
        plain = bool(os.environ.get("NO_COLOR")) or os.environ.get("TERM") == "dumb"
        named.setdefault("color", False if plain else None)
        with _unread_output():
            return super().make_context(*arguments, **named)

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command."""
        with _unread_output():
            return super().invoke(ctx)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The commands alone: the line of usage names the options, and all has to fit on a screen."""
        self.format_commands(ctx, formatter)

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names as they are listed."""
        return list(self.commands)


@click.group(cls=_Commands, context_settings=CONTEXT, options_metavar="[--version | --help]")
@click.version_option(__version__, prog_name="cosim")
def cosim() -> None:
    """Fly a learned policy through a tube, in lockstep with a physics engine.

    \b
    cosim launch --mesh tube.obj --scale radius=1   # the shipped policy flies it
    """


for _command in (
    commands_flights.launch,
    commands_flights.evaluate,
    commands_flights.replay,
    commands_runs.inspect,
    commands_runs.view,
    commands_runs.report,
    commands_runs.export,
    commands_runs.verify,
    commands_training.train,
    commands_training.figures,
    commands_training.ablate,
    commands_protocol.watch,
    commands_protocol.conformance,
    commands_protocol.doctor,
    commands_protocol.bench,
    commands_protocol.completion,
):
    cosim.add_command(_command)


def main() -> None:
    """Entry point of the console script; every error raised on purpose is one sentence on stderr."""
    interrupts.listen()
    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal may not have every letter; stderr is so already
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        status = _run()
    finally:
        interrupts.ignore()
    sys.exit(status)


def _run() -> int:
    """Run the command that was asked for, and return its exit status."""
    try:
        cosim.main(prog_name="cosim", standalone_mode=False)
    except click.ClickException as error:
        with suppress(OSError):  # nobody can be told
            error.show()
        return error.exit_code
    except SystemExit:
        raise
    except BaseException as error:  # noqa: BLE001  exit statuses are given here and nowhere else
        return _tell(error)
    return 0


def _tell(error: BaseException) -> int:
    """Say on stderr what was wrong, and return the exit status."""
    if isinstance(error, click.Abort):  # click's word for Ctrl-C, and for the end of a pipe
        error = error.__cause__ or KeyboardInterrupt()
    status, signal_number = exit_status(error), interrupts.pending()
    with suppress(OSError):  # nobody can be told
        if status is not None:
            _say(error)
        elif signal_number is None:  # else a library failed in a way of its own of being interrupted
            traceback.print_exception(error)
            click.echo(f"cosim: a fault of cosim itself ({type(error).__name__}); please report it", err=True)
    if signal_number is not None:
        return SIGNALLED + signal_number
    return INTERNAL if status is None else status


def _say(error: BaseException) -> None:
    """One sentence, and the notes that were added to it."""
    text = str(error)
    if isinstance(error, OSError):
        text = f"{error.filename or 'the output'} cannot be written: {error.strerror}"
        _leave_stdout()
    for line in (f"cosim: {text}" if text else "", *getattr(error, "__notes__", ())):
        if line:
            click.echo(line, err=True)


@contextmanager
def _unread_output() -> Iterator[None]:
    """End as SIGPIPE would where nobody reads the output any more; click would make 1 of it: "no success" here."""
    try:
        yield
    except BrokenPipeError as error:
        _leave_stdout()
        sys.exit(exit_status(error))


def _leave_stdout() -> None:
    """Forget what could not be written to stdout: Python would try once more at its exit, and complain."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
