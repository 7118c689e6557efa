"""The failures of an evaluation, flown again so that the page of `cosim report` has their replays."""

from __future__ import annotations

import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from cosim.errors import RunError
from cosim.live import counting
from cosim.recording import MANIFEST

FAILURES: Final = "failures"
"""Folder of their runs, beside the results."""
DEADLINE: Final = 600.0
"""Seconds after which one flight is given up."""


def failures_of(results: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Every failed episode and the name of its run's folder: its number among all episodes, and the pilot."""
    for number, episode in enumerate(results["flown"]):
        if episode["outcome"] != "success":
            yield f"{number:05d}-{Path(episode['policy']).stem}", episode


def flown_failures(path: Path, results: Mapping[str, Any]) -> list[Path]:
    """Run folders of the failures that were flown again before."""
    folders = (path.parent / FAILURES / name for name, _ in failures_of(results))
    return [folder for folder in folders if (folder / MANIFEST).is_file()]


def fly_failures(path: Path, results: Mapping[str, Any], most: int) -> None:
    """Fly the first failures of an evaluation again, each by its own command; those that were are kept.

    Args:
        path: of the results; the runs go into `failures` beside them.
        results: from `read_results`.
        most: failures that have a run in the end, these included that had one.

    Raises:
        RunError: a command did not fly; it says why.
    """
    wanted = list(failures_of(results))[:most]
    left = [
        (folder, episode["launch"])
        for name, episode in wanted
        if not ((folder := path.parent / FAILURES / name) / MANIFEST).is_file()
    ]
    with counting("flying failures again", len(left)) as count:
        for folder, command in left:
            _fly(folder, command)
            count(1)


def _fly(folder: Path, command: str) -> None:
    words = shlex.split(command)
    if words[:2] != ["cosim", "launch"]:  # results are a file from anywhere: nothing else in it is run
        raise RunError(f"launch: expected a command that begins with `cosim launch`, found {command!r}")
    arguments = [sys.executable, "-m", *words, "--out", str(folder)]
    try:
        done = subprocess.run(arguments, check=False, capture_output=True, text=True, timeout=DEADLINE)
    except subprocess.TimeoutExpired as error:
        raise RunError(
            f"{command}: expected a flight within {DEADLINE:g} s, found none; fly it by hand"
        ) from error
    if done.returncode != 0:
        said = done.stderr.strip().splitlines() or ["nothing on stderr"]
        raise RunError(
            f"{command}: expected a flight, found exit status {done.returncode}: {said[-1]}; a report without "
            "--fly shows the table and this command"
        )
