"""The log of a training: one row an iteration, kept as CSV beside the checkpoint."""

from __future__ import annotations

import csv
import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np

from agent_client.errors import TrainingError

RECENT: Final = 300
"""Episodes over which running means are taken."""

Ended: TypeAlias = tuple[bool, bool, float, float]
"""One episode that ended: success, time-out, return, control steps."""


@dataclass(frozen=True)
class Progress:
    """Where a training stands after a batch was collected; a row of the log."""

    iteration: int
    steps: int
    """Control steps of all lanes together, of resumed parts too."""
    total_steps: int
    level: int
    success_rate: float
    """Over the last 300 episodes at this level; NaN before the first ended."""
    mean_return: float
    """Of the last 300 episodes at any level, not scaled; NaN before the first ended."""
    mean_steps: float
    """Length of those episodes (control steps)."""
    timeout_rate: float
    """Share of time-outs among those episodes: it rises when a policy begins to loiter."""
    batch_episodes: int
    """Episodes that ended in this iteration."""
    batch_success: float
    """Success rate of those; NaN where none ended."""
    batch_return: float
    """Mean return of those, not scaled."""
    steps_per_second: float
    """Since training began or was resumed."""
    seconds_left: float


_WHOLE: Final = ("iteration", "steps", "total_steps", "level", "batch_episodes")


class EpisodeMeans:
    """Running means over the last episodes, and over those of an iteration."""

    def __init__(self, recent: Iterable[Ended] = ()) -> None:
        self.recent: Final[deque[Ended]] = deque(recent, maxlen=RECENT)
        self._batch: list[Ended] = []

    def add(self, info: dict[str, Any]) -> None:
        """Count an episode, as `agent_client.environment` reports it."""
        outcome = info["outcome"]
        ended = (outcome == "success", outcome == "timeout", float(info["r"]), float(info["l"]))
        self.recent.append(ended)
        self._batch.append(ended)

    def take(self) -> dict[str, Any]:
        """The means by the names of Progress; begins a new iteration."""
        _, timeout, mean_return, steps = _means(self.recent)
        success, _, batch_return, _ = _means(self._batch)
        count = len(self._batch)
        self._batch = []
        return {
            "mean_return": mean_return,
            "mean_steps": steps,
            "timeout_rate": timeout,
            "batch_episodes": count,
            "batch_success": success,
            "batch_return": batch_return,
        }


def _means(episodes: Sequence[Ended] | deque[Ended]) -> list[float]:
    if not episodes:
        return [math.nan] * 4
    means: list[float] = np.array(episodes, dtype=np.float64).mean(axis=0).tolist()
    return means


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """What is done inside writes a file of a training.

    Raises:
        TrainingError: it cannot be written; says why.
    """
    try:
        yield
    except OSError as error:
        raise TrainingError(f"{path}: cannot be written: {error.strerror or error}") from error


def cut_log(path: Path, iterations: int) -> int:
    """Begin a log, or take back the rows after an iteration, which a killed training wrote and then lost.

    In one piece: after a kill the file is the old one or the new one.

    Returns:
        How many rows up to that iteration are missing, as after a copy without the log.

    Raises:
        TrainingError: it cannot be written.
    """
    rows: list[str] = []
    if iterations and path.exists():
        text = path.read_text(errors="replace")
        whole = text[: text.rfind("\n") + 1].splitlines()[1:]
        rows = [row for row in whole if _number_of(row) in range(1, iterations + 1)]
    temporary = path.with_name(f".{path.name}.new")
    with writing(path):
        try:
            temporary.write_text(
                "\n".join([",".join(field.name for field in fields(Progress)), *rows]) + "\n"
            )
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    return iterations - len(rows)


def _number_of(row: str) -> int | None:
    """The iteration of a row, None where it is none."""
    first = row.split(",", 1)[0]
    return int(first) if first.isdecimal() else None


def append_log(path: Path, progress: Progress) -> None:
    """Add the row of an iteration.

    Raises:
        TrainingError: it cannot be written.
    """
    with writing(path), path.open("a", newline="") as file:
        csv.writer(file, lineterminator="\n").writerow(astuple(progress))


def read_log(path: Path) -> list[Progress]:
    """Read a log, also of a training that still runs; a last row that is half written is left out.

    Raises:
        TrainingError: there is no log, or it is none.
    """
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise TrainingError(f"{path}: expected the log of a training, found none ({error})") from error
    whole = text[: text.rfind("\n") + 1]
    names = [field.name for field in fields(Progress)]
    reader = csv.DictReader(whole.splitlines())
    if reader.fieldnames != names:
        raise TrainingError(f"{path}: expected the columns {', '.join(names)}, found {reader.fieldnames}")
    try:
        rows: list[dict[str, Any]] = [
            {name: int(row[name]) if name in _WHOLE else float(row[name]) for name in names} for row in reader
        ]
        return [Progress(**row) for row in rows]
    except (TypeError, ValueError) as error:
        raise TrainingError(
            f"{path}: expected numbers in every row, found something else ({error})"
        ) from error
