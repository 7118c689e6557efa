"""A run for the tools of robotics: a trajectory in TUM's format, and MCAP with Foxglove's schemas.

TUM is what `evo` and most SLAM benchmarks read. MCAP holds, against simulated time: `/tf` and `/drone/pose`,
`/drone/velocity`, `/drone/command`, `/drone/state`, one scan for each LiDAR ring, and once `/tube` (the centreline).
Messages are JSON, each topic with its schema.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from agent_client.reward import Regime
from agent_client.task import Outcome
from cosim import __version__
from cosim.errors import CosimError
from cosim.requirements import install_command
from cosim.runs import Run, chunks
from cosim.scene import read_axis

Done = Callable[[float], None]

WORLD: Final = "world"
DRONE: Final = "drone"
TUM_COLUMNS: Final = "timestamp tx ty tz qx qy qz qw"

_RINGS: Final = (("front", 1.0), ("rear", -1.0))
_RING_TURN: Final = {"x": 0.5, "y": -0.5, "z": -0.5, "w": 0.5}
"""From a ring's own frame, in which rays turn about z from x, to the body's: x along right, y along up."""


def write_tum(run: Run, target: Path, done: Done) -> str:
    """Write one line a record: simulated time (s), position (m) and quaternion x y z w, body to world."""
    with target.open("w", encoding="utf-8") as file:
        file.write(f"# {TUM_COLUMNS}\n")
        for records in chunks(run):
            rows = np.column_stack([records["sim_time"], records["position"], records["quaternion"]])
            file.writelines(" ".join(map(repr, row)) + "\n" for row in rows.tolist())
            done(len(records))
    return ""


@dataclass(frozen=True)
class Topic:
    """One stream of messages: its name, its schema, and the messages of a record."""

    name: str
    schema_name: str
    schema: dict[str, Any]
    message: Callable[[_Record], dict[str, Any]]


@dataclass(frozen=True)
class _Record:
    """A record of the log as Python's own types, and what is the same all along."""

    values: dict[str, Any]
    rays: int
    offset: float

    @property
    def time(self) -> int:
        """Simulated time (ns)."""
        return round(1e9 * float(self.values["sim_time"]))

    @property
    def timestamp(self) -> dict[str, int]:
        """Simulated time as Foxglove's schemas write it."""
        return {"sec": self.time // 10**9, "nsec": self.time % 10**9}


def write_mcap(run: Run, target: Path, done: Done) -> str:
    """Write an MCAP file that Foxglove opens: poses, velocity, commands, state, scans and the centreline.

    Raises:
        CosimError: the package mcap is not installed.
    """
    try:
        from mcap.writer import (
            Writer,  # the format's own library: chunks, index and compression as readers expect
        )
    except ImportError as error:
        raise CosimError(
            f"MCAP needs the package mcap; install it with: {install_command('export')}"
        ) from error
    lidar = run.manifest["settings"]["lidar"]
    fields = [c.name for c in run.columns if c.name not in ("chain", "observation", "phases")]
    with target.open("wb") as file:
        writer: Any = Writer(file)
        writer.start(library=f"tube-cosim {__version__}")
        writer.add_metadata("tube-cosim", {"manifest": json.dumps(run.manifest)})
        channels = [(_channel(writer, topic), topic.message) for topic in TOPICS]
        tube = _channel(writer, TUBE)
        _add(writer, tube, 0, _centreline(run))
        for records in chunks(run):
            columns = {name: records[name].tolist() for name in fields}
            for i in range(len(records)):
                record = _Record(
                    {name: column[i] for name, column in columns.items()}, lidar["rays"], lidar["offset"]
                )
                for channel, message in channels:
                    _add(writer, channel, record.time, message(record))
            done(len(records))
        writer.finish()
    return ""


def _channel(writer: Any, topic: Topic) -> int:
    schema = writer.register_schema(topic.schema_name, "jsonschema", json.dumps(topic.schema).encode())
    channel: int = writer.register_channel(topic.name, "json", schema)
    return channel


def _add(writer: Any, channel: int, time: int, message: dict[str, Any]) -> None:
    writer.add_message(channel, time, json.dumps(message).encode(), time)


def _xyz(values: Sequence[float]) -> dict[str, float]:
    return dict(zip("xyz", values, strict=True))


def _xyzw(values: Sequence[float]) -> dict[str, float]:
    return dict(zip("xyzw", values, strict=True))


def _pose(record: _Record) -> dict[str, Any]:
    pose = {"position": _xyz(record.values["position"]), "orientation": _xyzw(record.values["quaternion"])}
    return {"timestamp": record.timestamp, "frame_id": WORLD, "pose": pose}


def _transform(record: _Record) -> dict[str, Any]:
    return {
        "timestamp": record.timestamp,
        "parent_frame_id": WORLD,
        "child_frame_id": DRONE,
        "translation": _xyz(record.values["position"]),
        "rotation": _xyzw(record.values["quaternion"]),
    }


def _velocity(record: _Record) -> dict[str, Any]:
    return {name: _xyz(record.values[f"{name}_velocity"]) for name in ("linear", "angular")}


def _command(record: _Record) -> dict[str, Any]:
    values = record.values
    return {
        "direction": _xyz(values["direction"]),
        "speed": values["commanded_speed"],
        "compensation": values["compensation"],
        "action": values["action"],
        **_finite({"entropy": values["entropy"]}),
    }


def _state(record: _Record) -> dict[str, Any]:
    values = record.values
    regime = values["regime"]
    return {
        "step": values["step"],
        "outcome": Outcome(values["outcome"]).name.lower(),
        "regime": Regime(regime).name.lower() if regime else "none",
        **_finite({name: values[name] for name in STATE}),
        "contact_steps": values["contact_steps"],
    }


def _scan(ring: int) -> Callable[[_Record], dict[str, Any]]:
    side = _RINGS[ring][1]

    def message(record: _Record) -> dict[str, Any]:
        rays = record.rays
        return {
            "timestamp": record.timestamp,
            "frame_id": DRONE,
            "pose": {"position": _xyz((side * record.offset, 0.0, 0.0)), "orientation": _RING_TURN},
            "start_angle": 0.0,
            "end_angle": 2.0 * math.pi * (rays - 1) / rays,
            "ranges": record.values["lidar"][ring * rays : (ring + 1) * rays],
            "intensities": [],
        }

    return message


def _centreline(run: Run) -> dict[str, Any]:
    axis, *_ = read_axis(run)
    line = {
        "type": 0,  # a strip
        "pose": {"position": _xyz((0.0, 0.0, 0.0)), "orientation": _xyzw((0.0, 0.0, 0.0, 1.0))},
        "thickness": 2.0,
        "scale_invariant": True,
        "points": [_xyz(point) for point in axis.tolist()],
        "color": {"r": 0.95, "g": 0.75, "b": 0.2, "a": 1.0},
        "colors": [],
        "indices": [],
    }
    entity = {
        "timestamp": {"sec": 0, "nsec": 0},
        "frame_id": WORLD,
        "id": "centreline",
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": False,
        "metadata": [],
        **{kind: [] for kind in _OTHER_SHAPES},
        "lines": [line],
    }
    return {"deletions": [], "entities": [entity]}


def _finite(values: dict[str, float]) -> dict[str, float]:
    """The values without those that are not there: JSON has no NaN."""
    return {name: value for name, value in values.items() if math.isfinite(value)}


def _object(**properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


def _array(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


_OTHER_SHAPES: Final = ("arrows", "cubes", "spheres", "cylinders", "triangles", "texts", "models")
"""Of an entity of a Foxglove scene, beside lines."""

STATE: Final = (
    "progress",
    "arc_length",
    "clearance",
    "radius",
    "alignment",
    "quality",
    "reward",
    "memory_age",
)

_NUMBER: Final = {"type": "number"}
_WHOLE: Final = {"type": "integer"}
_TEXT: Final = {"type": "string"}
_TRUTH: Final = {"type": "boolean"}
_TIME: Final = _object(sec=_WHOLE, nsec=_WHOLE)
_VECTOR: Final = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION: Final = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE: Final = _object(position=_VECTOR, orientation=_QUATERNION)
_STAMPED: Final = {"timestamp": _TIME, "frame_id": _TEXT}
_SCAN: Final = _object(
    **_STAMPED,
    pose=_POSE,
    start_angle=_NUMBER,
    end_angle=_NUMBER,
    ranges=_array(_NUMBER),
    intensities=_array(_NUMBER),
)

TOPICS: Final = (
    Topic(
        "/tf",
        "foxglove.FrameTransform",
        _object(
            timestamp=_TIME,
            parent_frame_id=_TEXT,
            child_frame_id=_TEXT,
            translation=_VECTOR,
            rotation=_QUATERNION,
        ),
        _transform,
    ),
    Topic("/drone/pose", "foxglove.PoseInFrame", _object(**_STAMPED, pose=_POSE), _pose),
    Topic("/drone/velocity", "tube_cosim.Velocity", _object(linear=_VECTOR, angular=_VECTOR), _velocity),
    Topic(
        "/drone/command",
        "tube_cosim.Command",
        _object(direction=_VECTOR, speed=_NUMBER, compensation=_NUMBER, action=_WHOLE, entropy=_NUMBER),
        _command,
    ),
    Topic(
        "/drone/state",
        "tube_cosim.State",
        _object(
            step=_WHOLE,
            outcome=_TEXT,
            regime=_TEXT,
            **dict.fromkeys(STATE, _NUMBER),
            contact_steps=_WHOLE,
        ),
        _state,
    ),
    *(
        Topic(f"/drone/lidar/{name}", "foxglove.LaserScan", _SCAN, _scan(i))
        for i, (name, _) in enumerate(_RINGS)
    ),
)
_COLOUR: Final = _object(r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_LINE: Final = _object(
    type=_WHOLE,
    pose=_POSE,
    thickness=_NUMBER,
    scale_invariant=_TRUTH,
    points=_array(_VECTOR),
    color=_COLOUR,
    colors=_array(_COLOUR),
    indices=_array(_WHOLE),
)
_ENTITY: Final = _object(
    **_STAMPED,
    id=_TEXT,
    lifetime=_TIME,
    frame_locked=_TRUTH,
    metadata=_array(_object(key=_TEXT, value=_TEXT)),
    lines=_array(_LINE),
    **dict.fromkeys(_OTHER_SHAPES, _array(_object())),
)
TUBE: Final = Topic(
    "/tube",
    "foxglove.SceneUpdate",
    _object(
        deletions=_array(_object(timestamp=_TIME, type=_WHOLE, id=_TEXT)),
        entities=_array(_ENTITY),
    ),
    lambda _: {},
)
"""Written once, at the beginning."""
