"""A run on disk: one manifest, one append-only log of fixed-size records, and the hash chain over it.

The log `steps.bin` is the source of truth; every other format is made from it. Record 0 is the reset pose,
record k the control step k. The chain is h_k = SHA-256(h_{k-1} + command bytes + pose bytes), h_{-1} empty,
over the payload rows as they crossed the protocol and never over timings; the last h is `trajectory_hash`.
"""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np

from agent_client.features import FEATURES
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
    """The fields of one record, in the order of their bytes."""
    return (
        Column("direction", "<f8", (3,), "1", "world"),
        Column("speed", "<f8", (), "m/s"),
        Column("compensation", "<f8", (), "weight"),
        Column("command_reserved", "<f8", (3,)),
        Column("position", "<f8", (3,), "m", "world"),
        Column("quaternion", "<f8", (4,), "1", "body to world", ("x", "y", "z", "w")),
        Column("linear_velocity", "<f8", (3,), "m/s", "world"),
        Column("angular_velocity", "<f8", (3,), "rad/s", "world"),
        Column("sim_time", "<f8", (), "s"),
        Column("contact_steps", "<i8"),
        Column("step", "<i8"),
        Column("chain", "|u1", (32,)),
        Column("observation", "<f4", (len(FEATURES),), "1", "", tuple(f.name for f in FEATURES)),
        Column("action", "<i4"),
        Column("reward", "<f8"),
        Column("reward_terms", "<f8", (len(TERMS),), "1", "", tuple(TERMS)),
        Column("regime", "|i1"),
        Column("outcome", "|i1"),
        Column("inside", "|i1"),
        Column("target_visible", "|i1"),
        Column("memory_available", "|i1"),
        Column("target_direction", "<f8", (3,), "1", "world"),
        Column("memory_direction", "<f8", (3,), "1", "world"),
        Column("arc_length", "<f8", (), "m"),
        Column("radial_distance", "<f8", (), "m"),
        Column("radius", "<f8", (), "m"),
        Column("clearance", "<f8", (), "m"),
        Column("lidar", "<f8", (lidar_rays,), "m", "front ring, then rear ring"),
        Column("entropy", "<f8", (), "nat"),
        Column("phases", "<i8", (len(PHASES),), "ns", "", PHASES),
        Column("recording", "<i8", (), "ns"),
    )


def record_dtype(fields: tuple[Column, ...]) -> np.dtype[np.void]:
    """The packed little-endian dtype of a record."""
    return np.dtype([(c.name, c.type, c.shape) for c in fields])


def next_link(chain: bytes, payload: bytes) -> bytes:
    """The next 32-byte link of the hash chain; `payload` is a command row followed by its pose row."""
    return hashlib.sha256(chain + payload).digest()


class Recorder:
    """Writes one flight of one lane, flushed at least every second, so that a crash loses no more."""

    def __init__(self, folder: Path, manifest: dict[str, Any], lidar_rays: int) -> None:
        self.folder = folder
        self._columns = columns(lidar_rays)
        self._row = np.zeros(1, record_dtype(self._columns))
        self._fields = {c.name: self._row[c.name] for c in self._columns}
        payload = self._row.view(np.uint8)[: COMMAND_BYTES + POSE_BYTES].view(np.float64)
        self._command, self._pose = payload[:COMMAND_WORDS], payload[COMMAND_WORDS:]
        self._chain = b""
        self.records = 0
        self.last_recording_ns = 0
        self.manifest = manifest | {
            "format": FORMAT,
            "log": LOG,
            "record": [c.__dict__ for c in self._columns],
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
        fields, task = self._fields, step.task
        self._command[:] = step.command
        self._pose[:] = step.pose
        self._chain = next_link(self._chain, self._payload.tobytes())
        fields["chain"][0] = self._links
        fields["observation"][0] = task.observation[0]
        self.records += 1
        self._log.write(self._row.tobytes())
        if time.monotonic() - self._flushed > FLUSH_SECONDS:
            self.flush()
        self.last_recording_ns = time.perf_counter_ns() - started

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
