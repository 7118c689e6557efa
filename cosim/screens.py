"""Help that fits on a screen of 24 lines: commands show what is often needed, and all the rest with --help-all."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any, Final

import click

EXIT_NO_SUCCESS: Final = 1
"""Of a command that was asked whether something succeeds, where it did not."""
EXIT_FAILED_CHECK: Final = 1
"""Of a command that checks something, where it is not as it must be."""

_ALL: Final = "cosim.help_all"


class Option(click.Option):
    """An option whose bounds are said in its help or not at all: a range of 19 digits fills a line."""

    def get_help_extra(self, ctx: click.Context) -> Any:
        """What is said behind the help, without the range of numbers."""
        extra = super().get_help_extra(ctx)
        extra.pop("range", None)
        return extra


class FiniteRange(click.FloatRange):
    """A number within bounds; NaN is in none, though no comparison says so, and infinity is no number of seconds."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parse a number and refuse what is not finite."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"expected a finite number, found {value}", param, ctx)
        return number


class OutputFile(click.Path):
    """A file to write; refused before any work where it is a folder, or where there is no folder to write it to."""

    def __init__(self) -> None:
        super().__init__(dir_okay=False, writable=True, path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Look at its folder."""
        path = super().convert(value, param, ctx)
        assert isinstance(path, Path)
        if not path.parent.is_dir():
            self.fail(f"{path}: expected a folder {path.parent} to write it to, found none", param, ctx)
        return path


class Rare(Option):
    """An option that only --help-all shows."""

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """The line of help, if all of them are wanted."""
        return super().get_help_record(ctx) if ctx.meta.get(_ALL) else None


class Command(click.Command):
    """A command with --help-all where it has options that --help leaves out."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Refuse an empty value, which is what a shell makes of a variable that is not set: a path would be "."."""
        if not ctx.resilient_parsing:
            for before, word in zip(["", *args], args, strict=False):
                if not word or (word.startswith("--") and word.endswith("=")):
                    name = word.rstrip("=") or before
                    option = f"{name}: " if name.startswith("-") else ""
                    raise click.UsageError(f"{option}expected a value, found an empty string", ctx)
        return super().parse_args(ctx, args)

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """The declared options, then the two helps."""
        *declared, help_option = super().get_params(ctx)
        if not self.leaves_out(declared):
            return [*declared, help_option]
        more = click.Option(
            ["--help-all"], is_flag=True, is_eager=True, expose_value=False, callback=_help_all,
            help="Show all options.",
        )  # fmt: skip
        return [*declared, more, help_option]

    def leaves_out(self, declared: list[click.Parameter]) -> bool:
        """Whether --help does not show everything."""
        return any(isinstance(param, Rare) for param in declared)


def shows_all(ctx: click.Context) -> bool:
    """Whether --help-all was asked for."""
    return bool(ctx.meta.get(_ALL))


def _help_all(ctx: click.Context, _param: click.Parameter, wanted: bool) -> None:
    if wanted:
        ctx.meta[_ALL] = True
        click.echo(ctx.get_help(), color=ctx.color)
        ctx.exit()


command = partial(click.command, cls=Command)
option = partial(click.option, cls=Option)
rare = partial(click.option, cls=Rare)
json_option = option("--json", "as_json", is_flag=True, help="One JSON object on stdout, nothing else.")
