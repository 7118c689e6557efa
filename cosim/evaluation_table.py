"""An evaluation's report as text: the paper's table side by side, or a map."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping
from itertools import groupby
from typing import Any, Final

from cosim.named_settings import option_name, write_value

WIDTH: Final = 110
"""Of a line of prose."""

Row = Mapping[str, Any]

COLUMNS: Final = (
    ("success", 8), ("95 %", 13), ("exit", 6), ("collision", 10), ("time-out", 9), ("Q", 7), ("steps", 7),
    ("length", 7),
)  # fmt: skip

WORLDS: Final = {
    "kinematic": "in the kinematic world: no inertia; a wall is touched where the gap closes",
    "reference": "as a rigid body of the engine 'reference', in process: a wall is touched where the gap closes",
    "bullet": "as a rigid body in PyBullet, through the protocol: any contact with the wall is a failure",
}


def table_lines(report: Row) -> Iterator[str]:
    """The table: for each level, or value of a sweep and level, the paper's rows and those that were flown."""
    yield from wrapped(heading(report))
    for (value, level), group in groupby(report["rows"], key=lambda row: (row.get("value"), row["level"])):
        flown = list(group)
        setting = flown[0].get("setting")
        title = f"level {level}" if setting is None else f"{setting} {_text(value)}, level {level}"
        width = max(len(title) + 1, *(len(row["policy"]) + 9 for row in [*flown, *report["paper"]]))
        yield ""
        yield f"{title:{width}}" + "".join(f"{name:>{size}}" for name, size in COLUMNS)
        for row in report["paper"]:
            if row["level"] == level:
                yield _line(f"  {row['policy']} (paper)", row, width)
        for row in flown:
            yield _line(f"  {row['policy']}", row, width)
    yield ""
    yield from wrapped(legend(report))


def wrapped(lines: Iterator[str]) -> Iterator[str]:
    """Lines of a legend, broken at the table's width."""
    for line in lines:
        yield from textwrap.wrap(line, WIDTH, subsequent_indent="  ", break_on_hyphens=False)


def heading(report: Row) -> Iterator[str]:
    """What was flown, how often and under what."""
    yield (
        f"{report['episodes']} episodes a level, seed {report['seed']}, the same tubes and draws for all, flown "
        f"{WORLDS[report['engine']]}"
    )
    if report["settings"]:
        yield f"settings: {' '.join(report['settings'])}"
    if report["hard"]:
        ranges = [f"{name} {_text(span)}" for name, span in report["changed"].items()]
        if "curvature_cap" in report["recipe"]:  # not swept
            ranges.append(f"bends up to {report['recipe']['curvature_cap']:g} / R at level 2")
        yield f"hard conditions: {', '.join(ranges)}"
    if report["left_out"]:
        left_out = [f"{option_name(name)[2:]} {_text(span)}" for name, span in report["left_out"].items()]
        yield f"left out, since they mean nothing without inertia: {', '.join(left_out)}"


def _line(name: str, row: Row, width: int) -> str:
    low, high = row["success_ci95"]
    cells = (
        _percent(row["success"]),
        f"{100 * low:.1f}-{100 * high:.1f}",
        _percent(row["exit"]),
        _percent(row["collision"]),
        _percent(row["timeout"]),
        _number(row["quality"], 3),
        _number(row["mean_steps"], 1),
        _number(row["length_ratio"], 2),
    )
    return f"{name:{width}}" + "".join(
        f"{cell:>{size}}" for cell, (_, size) in zip(cells, COLUMNS, strict=True)
    )


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f}"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _text(value: Any) -> str:
    """A value or a range for people."""
    return write_value(tuple(value) if isinstance(value, list) else value).replace(":", " to ")


def legend(report: Row) -> Iterator[str]:
    """What was flown, and what each pilot knew."""
    yield (
        "success, exit, collision, time-out in %; 95 %: Wilson's interval of the success; Q: centring and alignment; "
        "length: steps over length / (v_max dt), of the successes, below 1 where corners are cut; the paper counts "
        "every failure as an exit"
    )
    rows = report["rows"]
    for name in dict.fromkeys(row["policy"] for row in rows):
        own = [row for row in rows if row["policy"] == name]
        text = f"{name} sees: {own[0]['sees']}"
        found = list(dict.fromkeys((row.get("lookahead"), row.get("speed")) for row in own))
        if found[0][0] is not None:
            text += "; look-ahead and speed " + ", ".join(f"{a:g} m at {v:g} m/s" for a, v in found[:6])
            text += ", ..." if len(found) > 6 else ""
        if name == "pure-pursuit-tuned":
            tuning = report["tuning"]
            text += f", found on {tuning['episodes']} other tubes (engine {tuning['engine']})"
        yield text


def map_lines(report: Row) -> Iterator[str]:
    """Success (%) over gain and compensation, a block for each pilot and level."""
    yield from wrapped(heading(report))
    rows = report["rows"]
    gains = sorted({row["gain"] for row in rows})
    cells = {(row["policy"], row["level"], row["gain"], row["compensation"]): row["success"] for row in rows}
    for name, level in dict.fromkeys((row["policy"], row["level"]) for row in rows):
        yield ""
        yield f"{name}, level {level}: success (%)"
        yield "compensation  gain" + "".join(f"{gain:>7g}" for gain in gains)
        for c in sorted({row["compensation"] for row in rows}, reverse=True):
            yield f"{c:12g}      " + "".join(f"{100 * cells[name, level, gain, c]:7.1f}" for gain in gains)
    yield ""
    yield from wrapped(legend(report))
