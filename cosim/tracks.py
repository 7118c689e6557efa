"""Recorded runs as a viewer shows them: what is drawn of each, by which colours, and what is said at each step."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from agent_client.judge import Outcome
from agent_client.reward import Regime
from cosim.errors import RunError
from cosim.runs import Run, column, read_run
from cosim.scene import Scene, read_scene
from cosim.senses import Sensors

Floats = NDArray[np.float64]
Quantity = Literal["clearance", "reward", "speed"]

TITLES: Final[dict[str, str]] = {
    "clearance": "gap to wall\n(m)",
    "reward": "reward\nper step",
    "speed": "speed\n(m/s)",
}
"""Of the scale of a quantity that colours a trajectory. The gap is that between body and wall."""
MAPS: Final[dict[str, str]] = {"clearance": "RdYlBu", "reward": "RdYlBu", "speed": "viridis"}


@dataclass(frozen=True)
class Track:
    """A run, and what is drawn of it; T records, the reset pose first."""

    name: str
    """For legends; no other track that is shown with it has the same."""
    run: Run
    scene: Scene
    sensors: Sensors
    body_radius: float
    """(m)"""
    length: float
    """Of the tube's axis (m)."""

    @property
    def last(self) -> int:
        """Number of the last record."""
        return len(self.scene.times) - 1

    def record(self, k: int) -> Any:
        """Record k as it stands in the log."""
        return self.run.records[k]

    def at(self, time: float) -> int:
        """The record that was made last at a simulated time (s)."""
        return int(np.clip(np.searchsorted(self.scene.times, time + 1e-9, side="right") - 1, 0, self.last))

    def values(self, quantity: Quantity) -> Floats:
        """A quantity of every record, (T,)."""
        if quantity == "speed":
            return np.linalg.norm(column(self.run, "linear_velocity"), axis=1)  # type: ignore[no-any-return]
        if quantity == "clearance":
            return column(self.run, "clearance") - self.body_radius
        return column(self.run, "reward")

    def words(self, k: int) -> str:
        """What there is to say of record k, in two lines."""
        record = self.record(k)
        speed = float(np.linalg.norm(record["linear_velocity"]))
        touched = "   CONTACT" if record["contact"] else ""
        return (
            f"step {k} of {self.last}   {self.scene.times[k]:.1f} s   "
            f"{100.0 * float(record['progress']):.1f} % of {self.length:.1f} m{self._end(record)}\n"
            f"{speed:.2f} m/s   gap {self._gap(record):.2f} m   target {self._target(record)}{touched}"
        )

    def brief(self, k: int) -> str:
        """What there is to say of record k beside others, in one line."""
        record = self.record(k)
        return (
            f"{self.name}   {self.scene.times[k]:.1f} s   {100.0 * float(record['progress']):.1f} %   "
            f"gap {self._gap(record):.2f} m{self._end(record)}"
        )

    def _gap(self, record: Any) -> float:
        return float(record["clearance"]) - self.body_radius

    def _target(self, record: Any) -> str:
        return _SEEN[Regime(int(record["regime"]))]

    def _end(self, record: Any) -> str:
        outcome = Outcome(int(record["outcome"]))
        return "" if outcome is Outcome.RUNNING else f"   {outcome.name}"


_SEEN: Final = {Regime.VISIBLE: "in view", Regime.MEMORY: "remembered", Regime.BLIND: "lost"}


def read_tracks(folders: Sequence[Path]) -> tuple[Track, ...]:
    """Read runs to be shown together.

    Raises:
        RunError: a folder that holds no readable run, or one without a whole record.
    """
    runs = [read_run(folder) for folder in folders]
    for run in runs:
        if not len(run.records):
            raise RunError(
                f"{run.folder}: expected a run with at least its reset pose, found no whole record"
            )
    names = [str(run.manifest["policy"]["name"]) for run in runs]
    often = Counter(names)
    return tuple(
        Track(
            name=name if often[name] == 1 else f"{name} ({run.folder.name})",
            run=run,
            scene=read_scene(run),
            sensors=Sensors.of_manifest(run.manifest),
            body_radius=run.manifest["parameters"]["body_radius"],
            length=run.manifest["mesh"]["length_m"],
        )
        for name, run in zip(names, runs, strict=True)
    )
