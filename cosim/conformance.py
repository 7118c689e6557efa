"""`cosim conformance`: prove any program against the rules of the protocol."""

from __future__ import annotations

import json
import shlex
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import click

from cosim.errors import OutputError, PeerCommandError
from protocol.conformance.report import SCHEMA, TextReport, json_report, junit_report
from protocol.conformance.rule import Level, Outcome, Result, Rule
from protocol.conformance.run import RULES, conforms, run_suite, select
from protocol.layout import VERSION_MAJOR, VERSION_MINOR

_COLOURS: Final = {Outcome.PASSED: "green", Outcome.FAILED: "red", Outcome.SKIPPED: "yellow"}


@dataclass(frozen=True)
class ConformanceOptions:
    """What is to be proved; the fields are the options of the command."""

    server: str | None
    agent: str | None
    transport: str
    levels: str | None
    names: tuple[str, ...]
    timeout: float
    junit: Path | None


def conformance(
    options: ConformanceOptions, *, as_json: bool, as_list: bool, failed_only: bool = False
) -> bool:
    """Run the rules and print the report, or list them; returns whether every required one holds.

    With `failed_only` the text leaves out the rules that passed.

    Raises:
        click.UsageError: neither or both sides were named, or a level or rule is unknown.
        PeerCommandError: the command cannot be run.
        OutputError: the JUnit file cannot be written.
    """
    side, command = _side(options, needed=not as_list)
    if as_list:
        _list([side] if side else list(RULES), options, as_json=as_json)
        return True
    assert command is not None
    _check_command(side, command)
    rules = _rules(side, options)
    results: list[Result] = []
    version = f"{VERSION_MAJOR}.{VERSION_MINOR}"
    heading = f"{side} {command!r} over {options.transport}, protocol {version}"
    text = None if as_json else TextReport(heading, _paint, failed_only=failed_only)
    whole = len(RULES[side])
    try:
        _run(rules, command, options, results, text)
    finally:  # an interruption loses nothing of what was run
        if options.junit is not None and results:
            _write(options.junit, junit_report(results, side, options.transport, whole))
        if text is not None:
            _say(text.sums(whole))
        elif results:
            click.echo(json.dumps(json_report(results, side, command, options.transport, whole)))
    return conforms(results)


def _side(options: ConformanceOptions, *, needed: bool) -> tuple[str, str | None]:
    given = {"server": options.server, "agent": options.agent}
    named = [(side, command) for side, command in given.items() if command is not None]
    if len(named) == 1:
        return named[0]
    if named or needed:
        raise click.UsageError("expected one of --server COMMAND and --agent COMMAND")
    return "", None


def _check_command(side: str, command: str) -> None:
    """Refuse a command that cannot be run, once and not by every rule."""
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise PeerCommandError(f"--{side}: expected a command, found {command!r} ({error})") from error
    if not words or shutil.which(words[0]) is None:
        found = _why_not(words[0]) if words else "an empty string"
        raise PeerCommandError(f"--{side}: expected a program that can be run, found {found}")


def _why_not(program: str) -> str:
    """Say why a program cannot be run, and where it was looked for."""
    path, where = Path(program), "" if Path(program).is_absolute() else f" in {Path.cwd()}"
    if "/" not in program:
        hint = f"; ./{program} is the one in {Path.cwd()}" if path.is_file() else ""
        return f"no program {program!r} on PATH{hint}"
    if path.is_dir():
        return f"{program!r}{where}, a folder"
    if path.exists():
        return f"{program!r}{where}, which is not executable: chmod +x {shlex.quote(program)}"
    return f"no such file: {program!r}{where}"


def _rules(side: str, options: ConformanceOptions) -> list[Rule]:
    values = {level.value: level for level in Level}
    wanted = [] if options.levels is None else [name.strip() for name in options.levels.split(",")]
    for name in wanted:
        if name not in values:
            raise click.UsageError(f"--level: expected some of {', '.join(values)}, found {name!r}")
    for name in options.names:
        if name not in RULES[side]:
            raise click.UsageError(
                f"--rule: there is no rule {name!r} for the {side}; cosim conformance --list names all"
            )
    rules = select(side, [values[name] for name in wanted], options.names)
    if not rules:
        raise click.UsageError("no rule of these names is of these levels")
    return rules


def _run(
    rules: Sequence[Rule],
    command: str,
    options: ConformanceOptions,
    results: list[Result],
    text: TextReport | None,
) -> None:
    """Run the rules and gather their results, which the text shows as they come.

    A terminal on stderr has a line that says which rule is run.
    """
    live, begun = sys.stderr.isatty(), 0

    def on_start(rule: Rule) -> None:
        nonlocal begun
        begun += 1
        if live:
            click.echo(f"\r\033[K{begun}/{len(rules)} {rule.level.value} {rule.name}", err=True, nl=False)

    def clear() -> None:
        if live:
            click.echo("\r\033[K", err=True, nl=False)

    def on_end(result: Result) -> None:
        results.append(result)
        if text is not None:
            clear()
            _say(text.add(result))

    if text is not None:
        _say(text.heading)
    try:
        run_suite(rules, command, options.transport, options.timeout, on_start, on_end)
    finally:
        clear()


def _say(lines: Sequence[str]) -> None:
    for line in lines:
        click.echo(line)


def _list(sides: Sequence[str], options: ConformanceOptions, *, as_json: bool) -> None:
    """Name the rules of the sides, of the names and levels that were chosen."""
    unknown = [name for name in options.names if not any(name in RULES[side] for side in sides)]
    if unknown:
        raise click.UsageError(f"--rule: there is no rule {unknown[0]!r}; cosim conformance --list names all")
    listed: list[tuple[str, Rule]] = []
    for side in sides:
        names = tuple(name for name in options.names if name in RULES[side])
        if names or not options.names:
            listed += [(side, rule) for rule in _rules(side, replace(options, names=names))]
    if as_json:
        click.echo(json.dumps({"schema": SCHEMA, "rules": [_described(*each) for each in listed]}))
        return
    for side, rule in listed:
        optional = "" if rule.required else " (not required)"
        click.echo(f"{side:6}  {rule.level.value:11}  {rule.section:>2}  {rule.name}: {rule.title}{optional}")


def _described(side: str, rule: Rule) -> dict[str, str | bool]:
    return {
        "side": side,
        "name": rule.name,
        "level": rule.level.value,
        "section": rule.section,
        "title": rule.title,
        "required": rule.required,
    }


def _paint(text: str, outcome: Outcome) -> str:
    """Colour a word; click takes colours away where stdout is no terminal."""
    return click.style(text, fg=_COLOURS[outcome])


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"--junit {path}: cannot be written: {error.strerror}") from error
