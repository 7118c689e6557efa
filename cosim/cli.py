"""The command `cosim`: parses, calls, and turns errors into one sentence and an exit status."""

from __future__ import annotations

import os
import signal
import sys
import traceback
from types import FrameType
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
from cosim.errors import INTERNAL, Terminated, exit_status

CONTEXT: Final = {"help_option_names": ["-h", "--help"], "max_content_width": 110}


class _Commands(click.Group):
    """All the commands, in the order in which they were added.

    Where nobody reads their output any more they end as SIGPIPE would end them.
    """

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command. Of a closed pipe click would make 1, which means "no success" here."""
        try:
            return super().invoke(ctx)
        except BrokenPipeError as error:
            # Python flushes once more at its exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            sys.exit(exit_status(error))

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names as they are listed."""
        return list(self.commands)


@click.group(cls=_Commands, context_settings=CONTEXT)
@click.version_option(__version__, prog_name="cosim")
def cosim() -> None:
    """Fly a learned drone policy through a tube, in lockstep with a physics engine.

    \b
    cosim launch                           the shipped policy through the shipped conduit
    cosim launch --mesh M.obj --policy P   your tube, your policy
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


def _interrupted(number: int, _frame: FrameType | None) -> None:
    """Ctrl-C or SIGTERM: the first one ends the command in order, and another must not cut the cleaning up short."""
    for deaf_to in (signal.SIGINT, signal.SIGTERM):
        signal.signal(deaf_to, signal.SIG_IGN)
    error = KeyboardInterrupt if number == signal.SIGINT else Terminated
    interrupts.remember(error)
    raise error


def main() -> None:
    """Entry point of the console script; every error raised on purpose is one sentence on stderr."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupted)
    try:
        cosim.main(prog_name="cosim", standalone_mode=False)
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
