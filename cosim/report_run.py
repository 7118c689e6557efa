"""What the page of `cosim report` holds of one run: its story in words and numbers, and an array a curve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from agent_client.flight import PHASES
from agent_client.lidar import ring_sectors
from agent_client.task import Outcome
from cosim.report_axis import axis_curvature
from cosim.report_ending import as_shown, describe_ending
from cosim.runs import Run, column
from cosim.scene import Scene

Floats = NDArray[np.float64]
AddArray = Callable[[NDArray[Any]], int]
"""Puts an array into the page and returns the number by which the page knows it."""

BINS: Final = 60
"""Of the histograms of time."""
SHORTEST: Final = 1e-7
"""Least time that a histogram shows (s): its axis is logarithmic."""

_TEXTS: Final = {
    "wait": "the exchange, without the engine's own time",
    "physics": "the engine's own time",
    "rays": "LiDAR and lines of sight",
    "features": "all other perception, judgement and reward",
    "policy": "the controller",
    "recording": "of the log, while physics works on the next step",
}


_STATUS: Final = {
    "running": "its manifest was never finished: the run was cut short, or still flies",
    "interrupted": "the run was interrupted",
    "failed": "the run ended with an error",
}


@dataclass(frozen=True)
class Kept:
    """Which records of a run the page holds: every `stride`-th and the last."""

    stride: int
    index: NDArray[np.int64]

    @classmethod
    def of(cls, records: int, stride: int) -> Kept:
        """Out of `records`, every `stride`-th and the last one."""
        index = np.arange(0, records, stride)
        return cls(stride, index if index[-1] == records - 1 else np.append(index, records - 1))


def describe_run(
    run: Run, scene: Scene, axis: tuple[Floats, Floats] | None, kept: Kept, add: AddArray
) -> dict[str, Any]:
    """All that the page tells of a run but its tube, as JSON with the numbers of its arrays.

    Args:
        run: with at least one record.
        scene: of the run.
        axis: all of it, from `whole_axis`.
        kept: the records that go into the page; figures and distributions are made of all.
        add: takes the arrays.
    """
    manifest = run.manifest
    settings = manifest["settings"]
    curvature = axis_curvature(run, axis)
    notes = (_STATUS.get(manifest["status"]), _continued(manifest), scene.note)
    return {
        "name": run.folder.resolve().name,
        "folder": str(run.folder),
        "tube_name": tube_name(manifest),
        "policy": manifest["policy"]["name"],
        "seed": manifest["options"]["seed"],
        "status": manifest["status"],
        **_story(run),
        "records": len(run.records),
        "stride": kept.stride,
        "dt": manifest["session"]["dt"],
        "notes": [note for note in notes if note],
        "ending": describe_ending(run, scene, curvature),
        "body_radius": manifest["parameters"]["body_radius"],
        "lidar": settings["lidar"],
        "camera": settings["camera"] | {"field_of_view": manifest["conditions"]["drawn"]["field_of_view"]},
        "memory_steps": settings["memory"]["steps"],
        "terms": list(_labels(run, "reward_terms")),
        "phases": phase_rows(run),
        "drone": {
            "vertices": add(_single(scene.drone.vertices)),
            "faces": add(scene.drone.faces.astype(np.uint16)),
        },
        "series": {name: add(values) for name, values in _series(run, scene, curvature, kept.index).items()},
        "manifest": {name: value for name, value in manifest.items() if name != "record"},
    }


def tube_name(manifest: dict[str, Any]) -> str:
    """What a tube is called: a generated one by its draw, any other by its file."""
    drawn = manifest.get("tube")
    if drawn is None:
        return Path(manifest["mesh"]["path"]).name
    return f"level {drawn['level']} tube, seed {drawn['seed']}"


def _continued(manifest: dict[str, Any]) -> str:
    """Whose flight a replayed run began with."""
    continued = manifest.get("continues")
    if continued is None:
        return ""
    step, pilot = continued["from_step"], manifest["policy"]["name"]
    return f"steps 1 to {step} are those of {continued['run']}, sent again; {pilot} flew on from there"


def _story(run: Run) -> dict[str, Any]:
    """How the run went, also of one whose manifest was never finished."""
    told = run.manifest.get("outcome") or {}
    last = run.records[-1]
    ended = Outcome(int(last["outcome"]))
    clearance = column(run, "clearance")
    narrowest = int(clearance.argmin())
    return {
        "outcome": "cut short" if ended is Outcome.RUNNING else ended.name.lower(),
        "steps": int(last["step"]),
        "sim_time": float(last["sim_time"]),
        "progress": _number(last["progress"]),
        "length": run.manifest["mesh"]["length_m"],
        "quality": _number(last["quality"]),
        "gap": _number(clearance[narrowest] - run.manifest["parameters"]["body_radius"]),
        "gap_time": as_shown(run.records["sim_time"][narrowest]),
        "contacts": int(np.count_nonzero(column(run, "contact"))),
        "steps_per_second": told.get("steps_per_second"),
        "trajectory_hash": run.manifest.get("trajectory_hash") or last["chain"].tobytes().hex(),
    }


def _series(run: Run, scene: Scene, curvature: Floats, index: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    """Everything that the page draws or reads out step by step; lengths in m, times in s."""

    records = run.records[index]

    def single(name: str) -> NDArray[np.float32]:
        return _single(records[name])

    def flag(name: str) -> NDArray[np.uint8]:
        return records[name].astype(np.uint8)

    reach = run.manifest["settings"]["lidar"]["reach"]
    front, rear = np.split(records["lidar"] / reach, 2, axis=1)
    return {
        "time": _single(scene.times[index]),
        "step": records["step"].astype(np.int32),
        "position": _single(scene.positions[index]),
        "quaternion": _single(scene.quaternions[index]),
        "tangent": single("tangent"),
        "arc_length": single("arc_length"),
        "radius": single("radius"),
        "clearance": single("clearance"),
        "curvature": _single(curvature[index]),
        "velocity": single("linear_velocity"),
        "direction": single("direction"),
        "speed": _single(np.linalg.norm(records["linear_velocity"], axis=1)),
        "commanded_speed": single("commanded_speed"),
        "alignment": single("alignment"),
        "centring": single("centring"),
        "quality": single("quality"),
        "reward": single("reward"),
        "reward_terms": single("reward_terms"),
        "regime": flag("regime"),
        # Not from the observation, where they are zero for a policy that was not shown them.
        "S_F": _single(ring_symmetry(front)),
        "S_R": _single(ring_symmetry(rear)),
        "C_turn": single("C_turn"),
        "target_visible": flag("target_visible"),
        "target_position": single("target_position"),
        "memory_available": flag("memory_available"),
        "memory_direction": single("memory_direction"),
        "memory_age": single("memory_age"),
        "entropy": single("entropy"),
        "action": records["action"].astype(np.int16),
        "contact": flag("contact"),
        "step_time": _single(1e-9 * records["phases"].sum(axis=1)),
        # To 1/255 of the range: for the eye.
        "lidar": np.rint(255.0 / reach * records["lidar"]).astype(np.uint8),
    }


def ring_symmetry(readings: Floats) -> Floats:
    """S = 1 - (|right - left| + |top - bottom|) / 2 of a LiDAR ring (T, rays), readings over the range; (T,)."""
    sectors = ring_sectors(readings.shape[1])
    right, top, left, bottom = (readings[:, sectors == k].mean(axis=1) for k in range(4))
    symmetry: Floats = 1.0 - 0.5 * (np.abs(right - left) + np.abs(top - bottom))
    return symmetry


def phase_rows(run: Run) -> dict[str, Any]:
    """Where the time of a step went: a row for the whole step, one a phase, one for recording; in seconds.

    Each row has its histogram over the bins between `edges`, which all share.
    """
    steps = run.records["step"] > 0
    if not steps.any():
        return {"edges": [], "rows": []}
    phases = 1e-9 * column(run, "phases")[steps].astype(np.float64)
    total = phases.sum(axis=1)
    parts = {"step": total} | {name: phases[:, i] for i, name in enumerate(PHASES)}
    parts["recording"] = 1e-9 * column(run, "recording")[steps].astype(np.float64)
    highest = max(float(part.max()) for part in parts.values())
    lowest = max(SHORTEST, min(float(np.quantile(part, 0.01)) for part in parts.values()))
    edges = np.geomspace(lowest, max(highest, 2.0 * lowest), BINS + 1)
    rows = [
        {
            "name": name,
            "text": _TEXTS.get(name, ""),
            "share": None if name == "recording" else float(part.sum() / total.sum()),
            "p50": float(np.median(part)),
            "p99": float(np.quantile(part, 0.99)),
            "max": float(part.max()),
            "counts": np.histogram(np.clip(part, edges[0], edges[-1]), edges)[0].tolist(),
        }
        for name, part in parts.items()
    ]
    return {"edges": edges.tolist(), "rows": rows}


def _labels(run: Run, name: str) -> tuple[str, ...]:
    return next(field.labels for field in run.columns if field.name == name)


def _number(value: Any) -> float | None:
    """For JSON, which knows no NaN and no infinity."""
    return float(value) if np.isfinite(value) else None


def _single(values: NDArray[Any]) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, np.float32)
