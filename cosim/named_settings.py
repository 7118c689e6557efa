"""The named settings of tubes and flights as options of a command, made from the tables that define them.

A command that is declared with `cls=SettingsCommand` takes one option for each row of `CONDITIONS` and of
`TUBE_SETTINGS`, `--shape` and `--hard`. They are left out of the list of options, which would fill two screens,
and stand in a few lines below it; `--list-settings` says what each means.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

from cosim.screens import Command, shows_all

if TYPE_CHECKING:  # the tables are imported when a command needs them: `cosim --help` starts without numba
    from agent_client.conditions import Condition, Conditions, Range
    from agent_client.tubes import TubeRecipe


@dataclass(frozen=True)
class NamedSettings:
    """What the user chose: a preset, and settings by name that differ from it."""

    hard: bool = False
    conditions: Mapping[str, Range] = field(default_factory=dict)
    """Ranges by the names of CONDITIONS."""
    tubes: Mapping[str, Any] = field(default_factory=dict)
    """Values of fields of TubeRecipe by name."""

    def resolve(self) -> tuple[Conditions, TubeRecipe]:
        """The conditions and the recipe of the tubes that are meant.

        Raises:
            SettingsError: a value out of its bounds.
        """
        from agent_client.conditions import HARD, Conditions
        from agent_client.tubes import HARD_TUBES, PAPER_TUBES

        conditions = (HARD if self.hard else Conditions()).with_ranges(self.conditions)
        return conditions, replace(HARD_TUBES if self.hard else PAPER_TUBES, **self.tubes)


def take_settings(options: dict[str, Any]) -> NamedSettings:
    """Take the named settings out of a command's keyword arguments."""
    conditions, tubes = _tables()
    named = {row.name: options.pop(row.name) for row in (*conditions, *tubes)}
    named["shape"] = options.pop("shape")
    given = {name: value for name, value in named.items() if value is not None}
    ranges = {row.name: given.pop(row.name) for row in conditions if row.name in given}
    return NamedSettings(options.pop("hard"), ranges, given)


def arguments_of(conditions: Conditions, recipe: TubeRecipe) -> list[str]:
    """The options that give these conditions and this recipe again, as few as they can be."""
    from agent_client.conditions import HARD, Conditions
    from agent_client.tubes import HARD_TUBES, PAPER_TUBES

    plain = _differences(conditions, recipe, Conditions(), PAPER_TUBES)
    hard = ["--hard", *_differences(conditions, recipe, HARD, HARD_TUBES)]
    return plain if len(plain) <= len(hard) else hard


def parse_setting(name: str, text: str) -> Any:
    """Read the value of a setting as its option would.

    Raises:
        click.BadParameter: it is out of bounds or cannot be read.
        KeyError: no such setting.
    """
    for option in settings_options():
        if option.name == name:
            return option.type.convert(text, option, None)
    raise KeyError(name)


def setting_names() -> list[str]:
    """Names of all settings."""
    conditions, tubes = _tables()
    return [row.name for row in (*conditions, *tubes)] + ["shape"]


def idle_settings(
    names: Collection[str], conditions: Conditions, recipe: TubeRecipe, levels: Collection[int]
) -> Iterator[tuple[str, str]]:
    """Those of the named settings that change nothing under the others, each with the reason.

    Args:
        names: of the settings that the user chose.
        conditions: that are flown under.
        recipe: of the tubes that are flown through.
        levels: of these tubes.
    """
    from agent_client.tubes import changed_by_cap

    if "mass" in names and max(conditions.drag[1], conditions.gust[1]) == 0.0:
        yield "mass", "the law scales the force with the mass; without --drag or --gust it changes nothing"
    if "lobe_count" in names and recipe.lobes[1] == 0.0:
        yield "lobe_count", "without lobes it changes nothing; add --lobes"
    kept = [str(level) for level in sorted(levels) if not changed_by_cap(recipe.shape, level)]
    if "curvature_cap" in names and kept:
        yield (
            "curvature_cap",
            f"at level {' and '.join(kept)} it changes nothing: these are the paper's own curves",
        )


def write_value(value: Any) -> str:
    """A value as its option takes it."""
    if isinstance(value, str):
        return value
    numbers = value if isinstance(value, tuple) else (value,)
    if numbers[0] == numbers[-1]:
        numbers = numbers[:1]
    return ":".join(f"{number:g}" if float(f"{number:g}") == number else repr(number) for number in numbers)


def _differences(
    conditions: Conditions, recipe: TubeRecipe, usual: Conditions, usual_recipe: TubeRecipe
) -> list[str]:
    ranges, tubes = usual.ranges(), asdict(usual_recipe)
    words = []
    for name, value in [*conditions.ranges().items(), *asdict(recipe).items()]:
        if value != (ranges | tubes)[name]:
            text = ",".join(map(write_value, value)) if name == "lengths" else write_value(value)
            words += [option_name(name), text]
    return words


def option_name(name: str) -> str:
    """The option of a setting."""
    return f"--{name.replace('_', '-')}"


class SettingType(click.ParamType[Any]):
    """A number or a range low:high within the bounds of a setting; some settings take one number, or several."""

    name = "value"

    def __init__(self, row: Condition) -> None:
        self._row = row

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Read `2`, `1.5:6`, or for lengths `20,40`."""
        from agent_client.errors import SettingsError

        row, one = self._row, self._row.name == "curvature_cap"
        try:
            if row.name == "lengths":
                lengths = tuple(_number(part) for part in str(value).split(","))
                for length in lengths:
                    row.check(length, length)
                return lengths
            low, colon, high = str(value).partition(":")
            span = _number(low), _number(high if colon else low)
            if one and colon:
                raise ValueError
            row.check(*span)
        except ValueError:
            form = "a number" if one or row.name == "lengths" else "a number or a range low:high"
            self.fail(f"expected {form}, found {value!r}", param, ctx)
        except SettingsError as error:
            self.fail(str(error), param, ctx)
        return span[0] if one else span


def _number(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError
    return number


@cache
def settings_options() -> tuple[click.Option, ...]:
    """One hidden option for each setting."""
    from agent_client.tubes import TUBE_SHAPES

    conditions, tubes = _tables()
    options = [
        click.Option([option_name(row.name), row.name], type=SettingType(row), metavar=row.unit, hidden=True)
        for row in (*conditions, *tubes)
    ]
    options.append(click.Option(["--shape"], type=click.Choice(TUBE_SHAPES), hidden=True))
    return tuple(options)


class SettingsCommand(Command):
    """A command that takes the named settings too."""

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """The declared options, then those of the settings."""
        hard = click.Option(["--hard"], is_flag=True, help="The hard conditions, in hard tubes.")
        listing = click.Option(
            ["--list-settings"], is_flag=True, is_eager=True, expose_value=False, callback=_list_settings,
            help="Name the settings --gain, --shape, ..., and end.",
        )  # fmt: skip
        *declared, more, help_option = super().get_params(ctx)
        return [*declared, hard, listing, *settings_options(), more, help_option]

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """The settings too, which click leaves out as hidden."""
        found = super().shell_complete(ctx, incomplete)
        if incomplete.startswith("--"):
            names = (setting.opts[0] for setting in settings_options())
            found += [CompletionItem(name) for name in names if name.startswith(incomplete)]
        return found

    def leaves_out(self, declared: list[click.Parameter]) -> bool:
        """The named settings are listed by --help-all alone."""
        return True

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Name the settings, with unit and default, where all is wanted."""
        if not shows_all(ctx):
            return
        text = " ".join(f"{name}\u00a0[{default}]" for name, default in _defaults())
        lines = textwrap.wrap(text, formatter.width - 2, break_on_hyphens=False)
        formatter.write("\nNamed settings, each a value, or a range low:high that every flight draws from:\n")
        formatter.write("".join(f"  {line}\n" for line in lines).replace("\u00a0", " "))


def _defaults() -> list[tuple[str, str]]:
    """Option with unit, and default, of every setting."""
    from agent_client.conditions import Conditions
    from agent_client.tubes import PAPER_TUBES

    conditions, tubes = _tables()
    values = Conditions().ranges() | asdict(PAPER_TUBES)
    rows = [(row.name, "" if row.unit == "1" else row.unit) for row in (*conditions, *tubes)]
    pairs = []
    for name, unit in [*rows, ("shape", "")]:
        default = values[name]
        text = ",".join(map(write_value, default)) if name == "lengths" else write_value(default)
        # Spaces that must not be broken keep an option and its default on one line.
        pairs.append((option_name(name), f"{text} {unit}".strip().replace(" ", "\u00a0")))
    return pairs


def _list_settings(ctx: click.Context, _param: click.Parameter, wanted: bool) -> None:
    """Print the tables and end."""
    if not wanted:
        return
    from agent_client.tubes import TUBE_SHAPES

    defaults = dict(_defaults())
    for title, rows in zip(("Conditions of a flight", "Tubes"), _tables(), strict=True):
        click.echo(f"{title}:")
        for row in rows:
            option = option_name(row.name)
            bounds = f"{row.lowest:g} to {row.highest:g}"
            click.echo(f"  {option:20} {defaults[option]:>14}  {bounds:>12}  {row.meaning}")
    click.echo(f"  {'--shape':20} {defaults['--shape']:>14}  {'':>12}  of the axis: {', '.join(TUBE_SHAPES)}")
    ctx.exit()


def _tables() -> tuple[tuple[Condition, ...], tuple[Condition, ...]]:
    from agent_client.conditions import CONDITIONS
    from agent_client.tubes import TUBE_SETTINGS

    return CONDITIONS, TUBE_SETTINGS
