"""What came of ablations, as text: a line a variant, and what each of them changed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any, Final

from cosim.evaluation_table import WORLDS, wrapped
from cosim.named_settings import write_value

Row = Mapping[str, Any]

COLUMNS: Final = (
    ("level 0", 16),
    ("level 1", 16),
    ("level 2", 16),
    ("time-outs", 12),
    ("steps", 12),
    ("passed", 11),
    ("paper", 11),
)


def table_lines(report: Row) -> Iterator[str]:
    """The table."""
    yield from wrapped(_heading(report))
    yield ""
    groups = [list(group) for _, group in groupby(report["rows"], key=lambda row: row["variant"])]
    width = max(len(rows[0]["variant"]) for rows in groups)
    yield " " * width + "".join(f"{name:>{size}}" for name, size in COLUMNS)
    for rows in groups:
        cells = zip(_cells(rows), COLUMNS, strict=True)
        yield f"{rows[0]['variant']:{width}}" + "".join(f"{cell:>{size}}" for cell, (_, size) in cells)
    yield ""
    yield from wrapped(_legend(report, groups))


def _heading(report: Row) -> Iterator[str]:
    first, last = report["seeds"][0], report["seeds"][-1]
    seeds = f"seed {first}" if first == last else f"seeds {first} to {last}"
    yield (
        f"preset '{report['preset']}', {report['steps']:,} steps, {seeds}; "
        f"{report['episodes']} unseen tubes a level, the same for all (of seed {report['seed']}), trained and flown "
        f"{WORLDS[report['engine']]}"
    )
    trained, flown = report["trained_under"], report["flown_under"]
    if trained or flown:
        yield f"trained under: {_ranges(trained)}"
        yield f"flown under: {_ranges(flown)}{', hard tubes' if report['hard'] else ''}"
    hidden = report["masked"]
    yield (
        f"no policy sees {', '.join(hidden)}"
        if hidden
        else "all 37 features are seen but for a variant's masks"
    )


def _ranges(ranges: Mapping[str, Any]) -> str:
    texts = [f"{name} {write_value(tuple(span)).replace(':', ' to ')}" for name, span in ranges.items()]
    return ", ".join(texts) or "the usual conditions"


def _cells(rows: Sequence[Row]) -> Iterator[str]:
    for row in rows:
        low, high = row["success_range"]
        yield f"{100 * row['success']:.1f} ({100 * low:.0f}-{100 * high:.0f})"
    yield "/".join(f"{100 * row['timeout']:.0f}" for row in rows)
    yield "/".join(f"{row['mean_steps']:.0f}" for row in rows)
    steps, seeds = rows[0]["steps_to_paper"], len(rows[0]["seeds"])
    yield "-" if steps is None else f"{steps / 1000:.0f}k {rows[0]['seeds_past_paper']}/{seeds}"
    yield rows[0]["claim"]


def _legend(report: Row, groups: Sequence[Sequence[Row]]) -> Iterator[str]:
    last = 100 * report["paper"]["success"][-1]
    yield (
        "level 0, 1, 2: success in %, mean over the seeds (lowest-highest); time-outs in %, and mean steps of an "
        f"episode, by level; passed: steps of training until success at level 2 was above the paper's {last:.0f} %, "
        "mean of the seeds that did, and how many did; paper: its own figures, or its claim in a word"
    )
    for rows in groups:
        yield f"{rows[0]['variant']}: {rows[0]['changed']}"
    if report["left_out"]:
        yield f"left out, since the preset is so already: {', '.join(report['left_out'])}"
