"""`cosim evaluate`: several pilots on the same tubes and draws, beside the figures of the paper."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import click

from agent_client.evaluation import draw_episodes
from cosim.errors import OutputError
from cosim.evaluation_plan import EvaluateOptions, Plan, make_plan
from cosim.evaluation_report import Entry, episodes_of, report_of
from cosim.evaluation_table import map_lines, table_lines
from cosim.folders import make_folder, remove_empty
from cosim.live import counting
from cosim.pilots import TUNED_PURSUIT, PilotChoice
from cosim.success_map import draw_map, require_matplotlib
from cosim.workers import BULLET_EPISODES, LANES, FlyJob, Job, RunJobs, TuneJob, crew

RESULTS: Final = "results.json"
MAP: Final = "success_map.png"


def evaluate(options: EvaluateOptions, *, as_json: bool) -> None:
    """Fly, print the table or one JSON object, and write what `--out` asks for.

    Raises:
        CosimError, AgentError, MeshError: bad input; a `WorkerError` has the exit status of what went wrong.
        ProtocolError: a physics server failed.
    """
    plan = make_plan(options)
    if options.grid is not None:
        require_matplotlib()
    for pilot in plan.pilots.values():
        for note in pilot.notes:
            click.echo(note, err=True)
    with _results_folder(options.out), crew(options.workers) as run:
        entries = list(_fly(run, options, plan))
    report = report_of(options, plan, entries)
    if options.out is not None:
        _write(options.out / RESULTS, report | {"flown": episodes_of(plan, entries)})
        if options.grid is not None:
            draw_map(options.out / MAP, report)
    if as_json:
        click.echo(json.dumps(report, allow_nan=False))
    else:
        for line in table_lines(report) if options.grid is None else map_lines(report):
            click.echo(line)
    if options.out is not None:
        click.echo(f"every episode, and how to fly it in PyBullet: {options.out / RESULTS}", err=True)


def _fly(run: RunJobs, options: EvaluateOptions, plan: Plan) -> Iterator[Entry]:
    """Tune where it is asked for, then fly everything: in the order of variants, levels and pilots."""
    parts = [(variant, level) for variant in plan.variants for level in options.levels]
    tuned = [PilotChoice(TUNED_PURSUIT)] * len(parts)
    if tuned[0] in plan.pilots:
        tuning = [
            TuneJob(level, v.conditions, v.recipe, plan.tuning_engine, options.tuning_episodes, options.seed)
            for v, level in parts
        ]
        found = _do(run, tuning, "tuning Pure Pursuit")
        tuned = [PilotChoice(TUNED_PURSUIT, None, best.lookahead, best.speed) for best in found]
    size = BULLET_EPISODES if plan.engine == "bullet" else LANES
    jobs: list[list[FlyJob]] = []
    for (variant, level), best in zip(parts, tuned, strict=True):
        episodes = tuple(draw_episodes(level, options.episodes, options.seed, variant.recipe))
        pilots = tuple(best if choice.name == TUNED_PURSUIT else choice for choice in plan.pilots)
        chunks = [episodes[at : at + size] for at in range(0, len(episodes), size)]
        jobs.append([FlyJob(pilots, chunk, variant.conditions, plan.engine) for chunk in chunks])
    flown = iter(_do(run, [job for part in jobs for job in part], "flying"))
    for (variant, level), own in zip(parts, jobs, strict=True):
        results = [next(flown) for _ in own]
        for at, pilot in enumerate(plan.pilots.values()):
            ended = tuple(result for chunk in results for result in chunk[at])
            yield Entry(variant, own[0].pilots[at], pilot, level, ended)


def _do(run: RunJobs, jobs: Sequence[Job], what: str) -> list[Any]:
    """Results of jobs, with a bar while they are done."""
    results = []
    with counting(what, sum(job.weight for job in jobs)) as advance:
        for job, result in zip(jobs, run(jobs), strict=True):
            advance(job.weight)
            results.append(result)
    return results


@contextmanager
def _results_folder(folder: Path | None) -> Iterator[None]:
    """Create the folder of the results before all the flying; what was made goes again where that fails.

    Raises:
        OutputError: it holds results already, or cannot be written.
    """
    if folder is None:
        yield
        return
    if (folder / RESULTS).exists():
        raise OutputError(
            f"--out {folder}: expected a folder without {RESULTS}, found one; name another folder"
        )
    _, made = make_folder(folder)
    try:
        if not os.access(folder, os.W_OK | os.X_OK):
            raise OutputError(f"--out {folder}: expected a folder that can be written, found one that cannot")
        yield
    except BaseException:
        remove_empty(made)
        raise


def _write(path: Path, report: dict[str, Any]) -> None:
    try:
        path.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n")
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror}") from error
