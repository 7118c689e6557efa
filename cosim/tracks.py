"""Recorded runs as a viewer shows them: what is drawn of each, by which colours, and what is said at each step."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from agent_client.judge import Outcome
from agent_client.reward import Regime
from cosim.errors import RunError
from cosim.runs import Run, column, read_run
from cosim.scales import Quantity
from cosim.scene import Scene, read_scene, where_is
from cosim.senses import Sensors
from meshes.centreline import parse_centreline
from meshes.errors import MeshError
from meshes.wall import to_world
from protocol.layout import Axes

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Track:
    """A run, and what is drawn of it; T records, the reset pose first."""

    name: str
    """For legends; no other track that is shown with it has the same."""
    run: Run
    scene: Scene
    centreline: Floats  # (M, 3)
    """Of the whole tube (m); of the part that was flown where there is no more of it."""
    note: str
    """What is not as it was flown, for people; empty where all is."""
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
            f"{100.0 * float(record['progress']):.1f} % of {self.length:.1f} m{self._end(k)}\n"
            f"{speed:.2f} m/s   gap {self._gap(record):.2f} m   target {self._target(record)}{touched}"
        )

    def brief(self, k: int) -> str:
        """What there is to say of record k beside others, in one line."""
        record = self.record(k)
        return (
            f"{self.name}   {self.scene.times[k]:.1f} s   {100.0 * float(record['progress']):.1f} %   "
            f"gap {self._gap(record):.2f} m{self._end(k)}"
        )

    def _gap(self, record: Any) -> float:
        return float(record["clearance"]) - self.body_radius

    def _target(self, record: Any) -> str:
        return _SEEN[Regime(int(record["regime"]))]

    def _end(self, k: int) -> str:
        """How the run ends; in capitals where it does."""
        outcome = Outcome(int(self.record(self.last)["outcome"]))
        if outcome is Outcome.RUNNING:
            return "   cut short" if k == self.last else ""
        return f"   {outcome.name}" if k == self.last else f"   ends in {outcome.name.lower()}"


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
        _read_track(run, name if often[name] == 1 else f"{name} ({run.folder.name})")
        for name, run in zip(names, runs, strict=True)
    )


def _read_track(run: Run, name: str) -> Track:
    scene = read_scene(run)
    # A tube that is rebuilt from what was flown has no more of a centreline.
    centreline, note = (scene.axis, scene.note) if scene.note else _read_centreline(run, scene)
    return Track(
        name=name,
        run=run,
        scene=scene,
        centreline=centreline,
        note=note,
        sensors=Sensors.of_manifest(run.manifest),
        body_radius=run.manifest["parameters"]["body_radius"],
        length=run.manifest["mesh"]["length_m"],
    )


def _read_centreline(run: Run, scene: Scene) -> tuple[Floats, str]:
    """The centreline from its file, or of the part that was flown and why."""
    described = run.manifest["mesh"]
    path = where_is(run, described["centreline"])
    try:
        content = path.read_bytes()
        if hashlib.sha256(content).hexdigest() == described["centreline_sha256"]:
            points = parse_centreline(content, path)
            return to_world(points, Axes[described["axes"]].name, described["scale"], path), ""  # type: ignore[arg-type]
        why = f"{path} is not the centreline of the flight"
    except OSError as error:
        why = f"{path} cannot be read ({error.strerror})"
    except MeshError as error:
        why = str(error)
    return scene.axis, f"{why}; the centreline shown is that of the part that was flown"
