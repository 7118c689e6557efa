"""`cosim ablate`: what the parts of a recipe are good for, by training without each of them, several seeds each."""

from __future__ import annotations

import json
import statistics
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import click

from agent_client.ablations import ABLATIONS, Ablation, first_passed, masked
from agent_client.conditions import HARD, Conditions
from agent_client.evaluation import Score, draw_episodes, summarise
from agent_client.presets import PRESETS, UNKNOWN_TUBE, Dynamics, without_inertia
from agent_client.training_log import Progress
from agent_client.training_options import TrainingOptions
from agent_client.tubes import HARD_TUBES, LEVELS, PAPER_TUBES, TubeRecipe
from cosim.ablation_table import table_lines
from cosim.errors import CosimError, Terminated
from cosim.evaluation_report import PAPER_SUCCESS
from cosim.folders import RESULTS, results_folder, write_results
from cosim.pilots import PilotChoice
from cosim.versions import versions
from cosim.workers import LANES, Engine, FlyJob, RunJobs, TrainJob, crew, do_jobs


@dataclass(frozen=True)
class AblateOptions:
    """What the user asked for; None leaves it to the preset."""

    variants: tuple[str, ...] | None = None
    """Names of ablations, None for all."""
    preset: str = "quick"
    dynamics: Dynamics | None = None
    hard: bool = False
    unknown_tube: bool = False
    steps: int | None = None
    seeds: int = 3
    seed: int = 0
    episodes: int = 100
    envs: int | None = None
    pool: int | None = None
    workers: int = 1
    out: Path | None = None


@dataclass(frozen=True)
class Variant:
    """One ablation of the base: what is trained, once a seed, and what its policies are flown under."""

    ablation: Ablation
    options: TrainingOptions
    conditions: Conditions


@dataclass(frozen=True)
class Plan:
    """What is trained and flown."""

    engine: Engine
    dynamics: Dynamics
    base: TrainingOptions
    variants: tuple[Variant, ...]
    left_out: tuple[str, ...]
    """Names of ablations that would change nothing of the base."""
    conditions: Conditions
    """That everything is flown under but for a variant's own."""
    recipe: TubeRecipe
    """Of the tubes that it is flown in."""
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class Trial:
    """What came of one seed of a variant."""

    seed: int
    log: tuple[Progress, ...]
    scores: tuple[Score, ...]
    """By level."""


def ablate(options: AblateOptions, *, as_json: bool) -> None:
    """Train and fly every variant, print the table or one JSON object, and write what `--out` asks for.

    Raises:
        CosimError: bad input, or the extra `train` is not installed; a `WorkerError` has the exit status of what
            went wrong.
        OutputError: the folder cannot be written, or holds results already.
    """
    plan = make_plan(options)
    try:
        with ExitStack() as stack:
            stack.enter_context(results_folder(options.out))
            folder = options.out or Path(stack.enter_context(TemporaryDirectory(prefix="cosim-ablate-")))
            run = stack.enter_context(crew(options.workers))
            logs = _train(run, plan, folder)
            scores = _fly(run, plan, folder, options)
    except (KeyboardInterrupt, Terminated):
        out = options.out
        trained = out is not None and any(
            _checkpoint(out, variant, seed).exists() for variant in plan.variants for seed in plan.seeds
        )
        kept = f"what was trained is in {out}" if trained else "nothing was kept"
        click.echo(f"stopped before the end: no table; {kept}", err=True)
        raise
    rows = [
        row
        for at, variant in enumerate(plan.variants)
        for row in _rows(variant, [Trial(n, logs[at][k], scores[at][k]) for k, n in enumerate(plan.seeds)])
    ]
    report = _report(options, plan, rows, steps=logs[0][0][-1].steps)
    if options.out is not None:
        write_results(options.out, report)
    if as_json:
        click.echo(json.dumps(report, allow_nan=False))
    else:
        for line in table_lines(report):
            click.echo(line)
    if options.out is not None:
        click.echo(f"checkpoints and logs beside {options.out / RESULTS}", err=True)


def make_plan(options: AblateOptions) -> Plan:
    """What the options mean.

    Raises:
        CosimError: an unknown variant, or only variants that change nothing.
    """
    preset = PRESETS[options.preset]
    dynamics = options.dynamics or preset.dynamics
    conditions, recipe = (HARD, HARD_TUBES) if options.hard else (Conditions(), PAPER_TUBES)
    if dynamics == "kinematic":
        conditions = conditions.without_inertia()
    base = _base(options, conditions)
    if dynamics == "kinematic":
        base = without_inertia(base)
    variants, left_out = [], []
    for ablation in _named(options.variants):
        changed = ablation.apply(base)
        if changed == base and ablation is not ABLATIONS[0]:
            left_out.append(ablation.name)
            continue
        changed = replace(changed, preset=f"{base.preset} {ablation.name}")
        variants.append(Variant(ablation, changed, conditions.with_ranges(ablation.conditions)))
    if not variants:
        raise CosimError(
            f"--variants {','.join(left_out)}: expected one that changes the preset '{options.preset}', found it so "
            "already"
        )
    return Plan(
        engine="kinematic" if dynamics == "kinematic" else "reference",
        dynamics=dynamics,
        base=base,
        variants=tuple(variants),
        left_out=tuple(left_out),
        conditions=conditions,
        recipe=recipe,
        seeds=tuple(range(options.seed, options.seed + options.seeds)),
    )


def _named(names: Sequence[str] | None) -> list[Ablation]:
    """The ablations of these names, in the order of the table.

    Raises:
        CosimError: there is none of a name.
    """
    known = [ablation.name for ablation in ABLATIONS]
    for name in names or ():
        if name not in known:
            raise CosimError(f"--variants: expected names out of {', '.join(known)}; found {name!r}")
    return [ablation for ablation in ABLATIONS if names is None or ablation.name in names]


def _base(options: AblateOptions, conditions: Conditions) -> TrainingOptions:
    """The preset with what the user asked.

    One torch thread, so that the policies are the same however many processes train them.
    """
    base = PRESETS[options.preset].options
    lanes = options.envs or base.hyperparameters.lanes
    base = replace(
        base,
        steps=options.steps or base.steps,
        pool=options.pool or base.pool,
        hyperparameters=replace(base.hyperparameters, lanes=lanes),
        threads=1,
    )
    if options.unknown_tube:
        base = masked(base, UNKNOWN_TUBE)
    if options.hard:
        base = replace(base, tubes=(HARD_TUBES,), world=replace(base.world, conditions=conditions))
    return base


def _checkpoint(folder: Path, variant: Variant, seed: int) -> Path:
    return folder / variant.ablation.name / f"seed{seed}.zip"


def _train(run: RunJobs, plan: Plan, folder: Path) -> list[list[tuple[Progress, ...]]]:
    """Train every variant with every seed; the logs by variant and seed."""
    asked = [(variant, seed) for variant in plan.variants for seed in plan.seeds]
    jobs = [
        TrainJob(replace(variant.options, out=_checkpoint(folder, variant, seed), seed=seed), plan.engine)
        for variant, seed in asked
    ]
    click.echo(
        f"training {len(jobs)} policies of {plan.base.steps:,} steps: {len(plan.variants)} variants with "
        f"{len(plan.seeds)} seeds each",
        err=True,
    )

    def tell(at: int, log: Sequence[Progress]) -> None:
        variant, seed = asked[at]
        last = log[-1]
        click.echo(
            f"trained {at + 1} of {len(jobs)}: {variant.ablation.name}, seed {seed}: level {last.level} after "
            f"{last.steps:,} steps, time-outs {100 * last.timeout_rate:.0f} %",
            err=True,
        )

    logs = iter(do_jobs(run, jobs, "training", tell))
    return [[next(logs) for _ in plan.seeds] for _ in plan.variants]


def _fly(run: RunJobs, plan: Plan, folder: Path, options: AblateOptions) -> list[list[tuple[Score, ...]]]:
    """Fly every policy at every level; the scores by variant, seed and level."""
    jobs: list[list[FlyJob]] = []
    for variant in plan.variants:
        pilots = tuple(
            PilotChoice(f"{variant.ablation.name} seed {seed}", _checkpoint(folder, variant, seed))
            for seed in plan.seeds
        )
        for level in range(LEVELS):
            episodes = tuple(draw_episodes(level, options.episodes, options.seed, plan.recipe))
            chunks = [episodes[at : at + LANES] for at in range(0, len(episodes), LANES)]
            jobs.append([FlyJob(pilots, chunk, variant.conditions, plan.engine) for chunk in chunks])
    flown = iter(do_jobs(run, [job for part in jobs for job in part], "flying"))
    by_level = []
    for part in jobs:
        results = [next(flown) for _ in part]
        by_level.append(
            [summarise([end for chunk in results for end in chunk[k]]) for k in range(len(plan.seeds))]
        )
    return [
        [tuple(by_level[LEVELS * at + level][k] for level in range(LEVELS)) for k in range(len(plan.seeds))]
        for at in range(len(plan.variants))
    ]


SHOWN: Final = ("success", "exit", "collision", "timeout", "mean_steps")
"""Fields of a score that a row has the mean over the seeds of."""


def _rows(variant: Variant, trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """A row a level: means over the seeds, the range of success, and each seed alone."""
    ablation = variant.ablation
    passed = {trial.seed: first_passed(trial.log, PAPER_SUCCESS[-1]) for trial in trials}
    reached = [steps for steps in passed.values() if steps is not None]
    rows = []
    for level in range(LEVELS):
        scores = {trial.seed: asdict(trial.scores[level]) for trial in trials}
        success = [score["success"] for score in scores.values()]
        rows.append(
            {
                "variant": ablation.name,
                "changed": ablation.changed,
                "claim": ablation.claim,
                "level": level,
                **{name: statistics.fmean(score[name] for score in scores.values()) for name in SHOWN},
                "success_range": [min(success), max(success)],
                "steps_to_paper": statistics.fmean(reached) if reached else None,
                "seeds_past_paper": len(reached),
                "seeds": [
                    {"seed": seed, **{name: score[name] for name in SHOWN}, "steps_to_paper": passed[seed]}
                    for seed, score in scores.items()
                ],
            }
        )
    return rows


def _report(
    options: AblateOptions, plan: Plan, rows: Sequence[Mapping[str, Any]], *, steps: int
) -> dict[str, Any]:
    """The object of `--json`."""
    base = plan.base
    return {
        "preset": options.preset,
        "dynamics": plan.dynamics,
        "engine": plan.engine,
        "hard": options.hard,
        "masked": list(base.world.settings.masked_features),
        "steps": steps,
        "envs": base.hyperparameters.lanes,
        "pool": base.pool,
        "seeds": list(plan.seeds),
        "episodes": options.episodes,
        "seed": options.seed,
        "trained_under": base.world.conditions.changed(),
        "flown_under": plan.conditions.changed(),
        "left_out": list(plan.left_out),
        "paper": {"success": list(PAPER_SUCCESS)},
        "rows": list(rows),
        "versions": versions(),
    }
