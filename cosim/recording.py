"""A run on disk: one manifest, one append-only log of fixed-size records, and the hash chain over it.

The log `steps.bin` is the source of truth; every other format is made from it. Record 0 is the reset pose,
record k the control step k. The chain is h_k = SHA-256(h_{k-1} + command bytes + pose bytes), h_{-1} empty,
over the payload rows as they crossed the protocol and never over timings; the last h is `trajectory_hash`.
"""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np

from agent_client.features import FEATURE_NAMES, FEATURES
from agent_client.flight import PHASES, FlightStep
from agent_client.reward import TERMS
from cosim.errors import OutputError
from protocol.plant import COMMAND_WORDS, POSE_WORDS

MANIFEST: Final = "manifest.json"
LOG: Final = "steps.bin"
FORMAT: Final = 1
FLUSH_SECONDS: Final = 0.5

COMMAND_BYTES: Final = 8 * COMMAND_WORDS
POSE_BYTES: Final = 8 * POSE_WORDS


@dataclass(frozen=True)
class Column:
    """One field of a record: name, numpy type, shape, unit and frame."""

    name: str
    type: str
    shape: tuple[int, ...] = ()
    unit: str = "1"
    frame: str = ""
    labels: tuple[str, ...] = ()
    """Names of the elements, where they are not x, y, z."""


def columns(lidar_rays: int) -> tuple[Column, ...]:
    """The fields of one record, in the order of their bytes: command row, pose row, then what came of them.

    Args:
        lidar_rays: rays of both rings together.
    """
    return (
        Column("direction", "<f8", (3,), "1", "world"),
        Column("speed", "<f8", (), "m/s"),
        Column("compensation", "<f8", (), "weight"),
        Column("command_reserved", "<f8", (3,), labels=("0", "1", "2")),
        Column("position", "<f8", (3,), "m", "world"),
        Column("quaternion", "<f8", (4,), "1", "body to world", ("x", "y", "z", "w")),
        Column("linear_velocity", "<f8", (3,), "m/s", "world"),
        Column("angular_velocity", "<f8", (3,), "rad/s", "world"),
        Column("sim_time", "<f8", (), "s"),
        Column("contact_steps", "<i8", (), "inner steps"),
        Column("step", "<i8", (), "control steps"),
        Column("chain", "|u1", (32,)),
        Column("observation", "<f4", (len(FEATURES),), labels=FEATURE_NAMES),
        Column("action", "<i8"),
        Column("reward", "<f8"),
        Column("reward_terms", "<f8", (len(TERMS),), labels=TERMS),
        *TASK_COLUMNS,
        Column("lidar", "<f8", (lidar_rays,), "m", "front ring, then rear ring"),
        Column("phases", "<i8", (len(PHASES),), "ns", labels=PHASES),
        Column("recording", "<i8", (), "ns", "of the record before"),
    )


TASK_COLUMNS: Final = (
    Column("regime", "|i1"),
    Column("outcome", "|i1"),
    Column("inside", "|b1"),
    Column("contact", "|b1"),
    Column("target_visible", "|b1"),
    Column("memory_available", "|b1"),
    Column("target_position", "<f8", (3,), "m", "world"),
    Column("memory_direction", "<f8", (3,), "1", "world"),
    Column("arc_length", "<f8", (), "m"),
    Column("radial_distance", "<f8", (), "m"),
    Column("radius", "<f8", (), "m"),
    Column("clearance", "<f8", (), "m", "centre of the drone to the wall"),
    Column("progress", "<f8"),
    Column("alignment", "<f8"),
    Column("quality", "<f8"),
)
"""What is copied from the episode's own record (`agent_client.task.TaskStep` explains it) under its own name."""


def record_dtype(fields: tuple[Column, ...]) -> np.dtype[np.void]:
    """The packed little-endian dtype of a record."""
    return np.dtype([(c.name, c.type, c.shape) for c in fields])


def next_link(chain: bytes, payload: bytes) -> bytes:
    """The next 32-byte link of the hash chain; `payload` is a command row followed by its pose row."""
    return hashlib.sha256(chain + payload).digest()


class Recorder:
    """Writes one flight of one lane, flushed at least every second, so that a crash loses no more.

    Raises:
        OutputError: the folder cannot be written.
    """

    def __init__(self, folder: Path, manifest: dict[str, Any], lidar_rays: int) -> None:
        self.folder = folder
        fields = columns(lidar_rays)
        self._row = np.zeros(1, record_dtype(fields))
        words = self._row.view(np.uint8)[: COMMAND_BYTES + POSE_BYTES]
        self._payload = words
        self._command = words.view(np.float64)[:COMMAND_WORDS]
        self._pose = words.view(np.float64)[COMMAND_WORDS:]
        row = self._row[0]
        self._chain_bytes, self._observation = row["chain"], row["observation"]
        self._reward_terms, self._lidar, self._phases = row["reward_terms"], row["lidar"], row["phases"]
        names = [column.name for column in TASK_COLUMNS]
        self._task, self._names = self._row[names], names
        self._chain = b""
        self.records = 0
        self.recording_ns = 0
        """Time spent in `write` so far."""
        self.manifest = manifest | {
            "format": FORMAT,
            "log": LOG,
            "record": [asdict(column) for column in fields],
            "status": "running",
        }
        self.write_manifest()
        try:
            self._log: BinaryIO = (folder / LOG).open("xb", buffering=1 << 20)
        except OSError as error:
            raise OutputError(f"{folder / LOG} cannot be written: {error.strerror}") from error
        self._flushed = time.monotonic()

    @property
    def trajectory_hash(self) -> str:
        """Hexadecimal hash over all command and pose payloads so far."""
        return self._chain.hex()

    def write(self, step: FlightStep) -> None:
        """Append one control step, or the reset pose as the first record."""
        started = time.perf_counter_ns()
        task, row = step.task, self._row
        self._command[:] = step.command[0]
        self._pose[:] = step.pose[0]
        self._chain = next_link(self._chain, self._payload.tobytes())
        self._chain_bytes[:] = np.frombuffer(self._chain, np.uint8)
        self._observation[:] = task.observation[0]
        self._reward_terms[:] = task.reward_terms[0]
        self._lidar[:] = task.lidar[0]
        self._phases[:] = step.phases
        row["action"], row["reward"] = step.actions[0], task.reward[0]
        for name in self._names:
            row[name] = task.episodes[name]
        self._log.write(row.tobytes())
        self.records += 1
        if time.monotonic() - self._flushed > FLUSH_SECONDS:
            self.flush()
        row["recording"] = spent = time.perf_counter_ns() - started  # of the record before
        self.recording_ns += spent

    def flush(self) -> None:
        """Hand what is buffered to the operating system: it survives the death of this process."""
        self._log.flush()
        self._flushed = time.monotonic()

    def write_manifest(self) -> None:
        """Write the manifest so that a reader finds either the old one or the new one, whole."""
        path = self.folder / MANIFEST
        partial = path.with_suffix(".partial")
        try:
            partial.write_text(json.dumps(self.manifest, indent=1, allow_nan=False) + "\n")
            partial.replace(path)
        except OSError as error:
            raise OutputError(f"{path} cannot be written: {error.strerror}") from error

    def close(self, status: str, outcome: dict[str, Any]) -> None:
        """Flush, close and say in the manifest how the run ended."""
        self._log.close()
        self.manifest["status"] = status
        self.manifest["records"] = self.records
        self.manifest["outcome"] = outcome
        self.write_manifest()
