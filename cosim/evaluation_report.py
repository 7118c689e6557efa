"""What came of an evaluation, as the data of its JSON: a row a pilot and level, and every single episode."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

from agent_client.conditions import INERTIA_ALONE
from agent_client.evaluation import EpisodeResult, summarise, wilson
from cosim.evaluation_plan import EvaluateOptions, Plan, Variant
from cosim.named_settings import arguments_of, write_value
from cosim.pilots import PURE_PURSUIT, TUNED_PURSUIT, Pilot, PilotChoice
from cosim.versions import versions

PAPER: Final = (
    ("Pure Pursuit", ((0.66, 0.34, 0.699), (0.34, 0.66, 0.553), (0.73, 0.27, 0.532))),
    ("PPO", ((0.84, 0.16, 0.609), (0.71, 0.29, 0.526), (0.87, 0.13, 0.522))),
)
"""Success, exits and quality at the levels 0, 1, 2, 100 episodes each: the paper's table of its section "Comparison
with the Reference Algorithm". It tells neither collisions from exits nor time-outs."""

PAPER_SUCCESS: Final = tuple(success for success, _, _ in dict(PAPER)["PPO"])
"""Success rates of the paper's policy by level."""

PAPER_EPISODES: Final = 100


@dataclass(frozen=True)
class Entry:
    """What came of one pilot at one level of one variant."""

    variant: Variant
    choice: PilotChoice
    pilot: Pilot
    level: int
    results: tuple[EpisodeResult, ...]


def report_of(options: EvaluateOptions, plan: Plan, entries: Sequence[Entry]) -> dict[str, Any]:
    """The object of `--json`."""
    common = plan.variants[0]
    swept = set(common.values)
    ranges, recipe = common.conditions.ranges(), asdict(common.recipe)
    return {
        "seed": options.seed,
        "episodes": options.episodes,
        "levels": list(options.levels),
        "dynamics": plan.dynamics,
        "engine": plan.engine,
        "hard": options.settings.hard,
        "conditions": {name: span for name, span in ranges.items() if name not in swept},
        "changed": {name: span for name, span in common.conditions.changed().items() if name not in swept},
        "left_out": dict(plan.left_out),
        "recipe": {name: value for name, value in recipe.items() if name not in swept},
        "settings": arguments_of(*options.settings.resolve()),
        "tuning": {"domain": "tune", "episodes": options.tuning_episodes, "engine": plan.tuning_engine},
        "paper": _paper_rows(options.levels),
        "rows": [_row(plan, entry) for entry in entries],
        "versions": versions(),
    }


def _row(plan: Plan, entry: Entry) -> dict[str, Any]:
    score = asdict(summarise(entry.results))
    ratio = score["length_ratio"]
    row = {
        "policy": entry.choice.name,
        "dynamics": plan.dynamics,
        "engine": plan.engine,
        "level": entry.level,
        **score,
        "length_ratio": None if math.isnan(ratio) else ratio,
        "sees": entry.pilot.description["sees"],
        "dt": entry.pilot.dt,
    }
    if entry.choice.lookahead is not None:
        row |= {
            "lookahead": entry.choice.lookahead,
            "speed": entry.choice.speed or entry.pilot.settings.speed_max,
        }
    if len(entry.variant.values) == 1:
        ((name, value),) = entry.variant.values.items()
        row |= {"setting": name, "value": _plain(value)}
    else:
        row |= {name: _plain(value) for name, value in entry.variant.values.items()}
    return row


def _plain(value: Any) -> Any:
    """A range of no width is one number; several lengths stay a list."""
    if isinstance(value, tuple) and value[0] == value[-1]:
        return value[0]
    return value


def _paper_rows(levels: Sequence[int]) -> list[dict[str, Any]]:
    """The paper's figures; what it does not give is None."""
    return [
        {
            "policy": name,
            "level": level,
            "episodes": PAPER_EPISODES,
            "success": figures[level][0],
            "exit": figures[level][1],
            "collision": None,
            "timeout": None,
            "quality": figures[level][2],
            "mean_steps": None,
            "length_ratio": None,
            "success_ci95": wilson(round(PAPER_EPISODES * figures[level][0]), PAPER_EPISODES),
        }
        for level in levels
        for name, figures in PAPER
    ]


def episodes_of(plan: Plan, entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """Every episode with what it drew, and the command that flies its tube, start and draws under PyBullet.

    The command repeats the episode bit for bit (`launch_repeats`) where PyBullet flew it in the first place.
    """
    rows = []
    for entry in entries:
        variant = entry.variant
        settings = arguments_of(variant.conditions, variant.recipe)
        ranges = variant.conditions.ranges()
        if plan.engine == "kinematic":
            ranges = {name: span for name, span in ranges.items() if name not in INERTIA_ALONE}
        for result in entry.results:
            drawn = {name: float(result.conditions.get(name, low)) for name, (low, _) in ranges.items()}
            row = asdict(result) | {"outcome": result.outcome.name.lower(), "conditions": drawn}
            row["min_clearance_m"] = row.pop("min_clearance") - drawn["body_radius"]
            rows.append(
                {
                    "policy": entry.choice.name,
                    **{name: _plain(value) for name, value in variant.values.items()},
                    **row,
                    "launch": _launch(entry.choice, result, settings),
                    "launch_repeats": plan.engine == "bullet",
                }
            )
    return rows


def _launch(choice: PilotChoice, result: EpisodeResult, settings: Sequence[str]) -> str:
    """The `cosim launch` of an episode's tube, start and draws."""
    policy = PURE_PURSUIT if choice.name == TUNED_PURSUIT else choice.name
    words = ["cosim", "launch", "--tube", f"level={result.level},seed={result.seed}", "--policy", policy]
    for option, value in (("--lookahead", choice.lookahead), ("--speed", choice.speed)):
        if value is not None:
            words += [option, write_value(value)]
    return shlex.join([*words, *settings])
