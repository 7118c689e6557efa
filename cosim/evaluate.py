"""`cosim evaluate`: several pilots on the same tubes and draws, beside the figures of the paper."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Final

import click

from agent_client.evaluation import draw_episodes
from cosim.errors import Terminated
from cosim.evaluation_plan import EvaluateOptions, Plan, make_plan
from cosim.evaluation_report import Entry, episodes_of, report_of
from cosim.evaluation_table import map_lines, table_lines
from cosim.folders import RESULTS, results_folder, write_results
from cosim.pilots import TUNED_PURSUIT, PilotChoice
from cosim.success_map import draw_map, require_matplotlib
from cosim.workers import BULLET_EPISODES, LANES, FlyJob, RunJobs, TuneJob, crew, do_jobs

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
    for note in (*plan.notes, *(note for pilot in plan.pilots.values() for note in pilot.notes)):
        click.echo(note, err=True)
    try:
        with results_folder(options.out), crew(options.workers) as run:
            entries = list(_fly(run, options, plan))
    except (KeyboardInterrupt, Terminated):
        click.echo("stopped before the end: no table; nothing was kept", err=True)
        raise
    report = report_of(options, plan, entries)
    if options.out is not None:
        write_results(options.out, report | {"flown": episodes_of(plan, entries)})
        if options.grid is not None:
            draw_map(options.out / MAP, report)
    if as_json:
        click.echo(json.dumps(report, allow_nan=False))
    else:
        for line in table_lines(report) if options.grid is None else map_lines(report):
            click.echo(line)
    if options.out is not None:
        again = (
            "which repeats it" if plan.engine == "bullet" else f"which is another world than {plan.engine!r}"
        )
        click.echo(
            f"every episode, and how to fly it in PyBullet, {again}: {options.out / RESULTS}", err=True
        )


def _fly(run: RunJobs, options: EvaluateOptions, plan: Plan) -> Iterator[Entry]:
    """Tune where it is asked for, then fly everything: in the order of variants, levels and pilots."""
    parts = [(variant, level) for variant in plan.variants for level in options.levels]
    tuned = [PilotChoice(TUNED_PURSUIT)] * len(parts)
    if tuned[0] in plan.pilots:
        tuning = [
            TuneJob(level, v.conditions, v.recipe, plan.tuning_engine, options.tuning_episodes, options.seed)
            for v, level in parts
        ]
        found = do_jobs(run, tuning, "tuning Pure Pursuit")
        tuned = [PilotChoice(TUNED_PURSUIT, None, best.lookahead, best.speed) for best in found]
    size = BULLET_EPISODES if plan.engine == "bullet" else LANES
    jobs: list[list[FlyJob]] = []
    for (variant, level), best in zip(parts, tuned, strict=True):
        episodes = tuple(draw_episodes(level, options.episodes, options.seed, variant.recipe))
        pilots = tuple(best if choice.name == TUNED_PURSUIT else choice for choice in plan.pilots)
        chunks = [episodes[at : at + size] for at in range(0, len(episodes), size)]
        jobs.append([FlyJob(pilots, chunk, variant.conditions, plan.engine) for chunk in chunks])
    flown = iter(do_jobs(run, [job for part in jobs for job in part], "flying"))
    for (variant, level), own in zip(parts, jobs, strict=True):
        results = [next(flown) for _ in own]
        for at, pilot in enumerate(plan.pilots.values()):
            ended = tuple(result for chunk in results for result in chunk[at])
            yield Entry(variant, own[0].pilots[at], pilot, level, ended)
