"""What the page of `cosim report` holds of an evaluation: its table, its failures, and which were flown again."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from cosim.errors import RunError
from cosim.evaluation_table import heading, legend
from cosim.pilots import PURE_PURSUIT, TUNED_PURSUIT
from cosim.runs import Run

EPISODE: Final = (
    "policy", "level", "seed", "outcome", "steps", "progress", "min_clearance_m", "conditions", "launch",
    "launch_repeats",
)  # fmt: skip
"""What an episode must say of itself."""


def read_results(path: Path) -> dict[str, Any]:
    """Read what `cosim evaluate --out` wrote.

    Raises:
        RunError: the file cannot be read or holds something else.
    """
    try:
        found = json.loads(path.read_text())
    except OSError as error:
        raise RunError(f"{path}: expected results of an evaluation, found none ({error.strerror})") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise RunError(f"{path}: expected JSON, found text that is not ({error})") from error
    if isinstance(found, dict) and "trained_under" in found:
        raise RunError(
            f"{path}: expected results of `cosim evaluate --out`, found those of `cosim ablate`, which hold no "
            "episodes; fly its policies side by side (cosim evaluate --policy VARIANT/seed0.zip --policy ... "
            "--out DIR) and give that folder"
        )
    if not (isinstance(found, dict) and {"rows", "paper", "flown"} <= found.keys()):
        raise RunError(f"{path}: expected rows and episodes of `cosim evaluate --out`, found neither")
    for episode in found["flown"]:
        if missing := [name for name in EPISODE if name not in episode]:
            raise RunError(
                f"{path}: expected of each episode {', '.join(EPISODE)}; found none of {', '.join(missing)}: "
                "results of another version of cosim; evaluate again"
            )
    return found


def describe_evaluation(path: Path, results: Mapping[str, Any], runs: Sequence[Run]) -> dict[str, Any]:
    """The table and the failures as JSON; of each failure, which of the runs flew it again.

    Args:
        path: of the results.
        results: from `read_results`.
        runs: that are on the same page.
    """
    flown = results["flown"]
    failures = [episode for episode in flown if episode["outcome"] != "success"]
    return {
        "folder": shlex.quote(str(path.parent)),
        "heading": list(heading(results)),
        "legend": list(legend(results)),
        "rows": results["rows"],
        "paper": results["paper"],
        "episodes": len(flown),
        "failures": [
            {name: episode[name] for name in EPISODE if name != "conditions"}
            | {"run": _flown_again(episode, runs)}
            for episode in failures
        ],
    }


def _flown_again(episode: Mapping[str, Any], runs: Sequence[Run]) -> int | None:
    """Number of the run of the same tube, start, pilot and draws; None where there is none."""
    names = {episode["policy"], PURE_PURSUIT if episode["policy"] == TUNED_PURSUIT else episode["policy"]}
    for number, run in enumerate(runs):
        manifest, last = run.manifest, run.records[-1]
        tube, drawn = manifest.get("tube"), manifest["conditions"]["drawn"]
        if (
            tube is not None
            and (tube["level"], tube["seed"]) == (episode["level"], episode["seed"])
            and names & {manifest["policy"]["name"], manifest["options"]["policy"]}
            and all(drawn.get(name) == value for name, value in episode["conditions"].items())
            and (not episode["launch_repeats"] or int(last["step"]) == episode["steps"])
        ):
            return number
    return None
