"""A run on disk: one manifest, one append-only log of fixed-size records, and the hash chain over it.

The log `steps.bin` is the source of truth; every other format is made from it. Record 0 is the reset pose,
record k the control step k. The chain is h_k = SHA-256(h_{k-1} + command bytes + pose bytes), h_{-1} empty,
over the payload rows as they crossed the protocol and never over timings; the last h is `trajectory_hash`.
Beside it every record carries a CRC-32 of all its bytes, and the manifest its own SHA-256, so that whatever was
changed afterwards is found (`cosim verify`).
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import time
import zlib
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from agent_client.features import FEATURE_NAMES, FEATURES
from agent_client.flight import PHASES, FlightStep
from agent_client.reward import TERMS
from cosim.errors import OutputError
from protocol.plant import COMMAND_WORDS, POSE_WORDS

MANIFEST: Final = "manifest.json"
LOG: Final = "steps.bin"
FORMAT: Final = 2
DIGEST: Final = "manifest_sha256"

SYNC_NS: Final = 1_000_000_000
"""How often the log is put on the disk itself (ns): the most that a crash of the whole machine takes from a run."""

COMMAND_BYTES: Final = 8 * COMMAND_WORDS
POSE_BYTES: Final = 8 * POSE_WORDS


@dataclass(frozen=True)
class Column:
    """One field of a record: where it stands, its numpy type and shape, and what it means."""

    name: str
    type: str
    shape: tuple[int, ...]
    offset: int
    """First byte within the record."""
    unit: str
    frame: str
    labels: tuple[str, ...]
    """Names of the elements; of three without names they are x, y, z."""


_Field = tuple[str, str, tuple[int, ...], str, str, tuple[str, ...]]

PAYLOAD: Final[tuple[_Field, ...]] = (
    ("direction", "<f8", (3,), "1", "world", ()),
    ("commanded_speed", "<f8", (), "m/s", "", ()),
    ("compensation", "<f8", (), "weight", "", ()),
    ("command_reserved", "<f8", (3,), "1", "", ("0", "1", "2")),
    ("position", "<f8", (3,), "m", "world", ()),
    ("quaternion", "<f8", (4,), "1", "body to world", ("x", "y", "z", "w")),
    ("linear_velocity", "<f8", (3,), "m/s", "world", ()),
    ("angular_velocity", "<f8", (3,), "rad/s", "world", ()),
    ("sim_time", "<f8", (), "s", "", ()),
    ("contact_steps", "<i8", (), "inner steps", "", ()),
    ("step", "<i8", (), "control steps", "", ()),
)
"""Command row and pose row as they crossed the protocol (`protocol.plant`)."""

ADDED: Final[tuple[_Field, ...]] = (
    ("chain", "|u1", (32,), "1", "", ()),
    ("action", "<i8", (), "index", "", ()),
    ("entropy", "<f8", (), "nat", "of the policy's distribution over the actions", ()),
    ("phases", "<i8", (len(PHASES),), "ns", "", PHASES),
    ("recording", "<i8", (), "ns", "of the record before", ()),
    ("observation", "<f4", (len(FEATURES),), "1", "", FEATURE_NAMES),
    ("check", "<u4", (), "CRC-32 of the record with this field zero", "", ()),
)
"""What the flight adds: link of the hash chain, action (-1: none of the table) and the entropy of the choice (NaN:
no distribution), timings, observation, check sum."""

EPISODE: Final[dict[str, tuple[str, str, tuple[str, ...]]]] = {
    "reward": ("1", "", ()),
    "reward_terms": ("1", "", TERMS),
    "regime": ("1 visible, 2 memory, 3 blind", "", ()),
    "outcome": ("0 running, 1 success, 2 exit, 3 collision, 4 timeout", "", ()),
    "inside": ("1", "", ()),
    "contact": ("1", "", ()),
    "arc_length": ("m", "axis", ()),
    "axis_position": ("m", "world", ()),
    "tangent": ("1", "world", ()),
    "radial_distance": ("m", "", ()),
    "radius": ("m", "", ()),
    "clearance": ("m", "centre of the drone to the wall", ()),
    "progress": ("1", "", ()),
    "lidar": ("m", "front ring, then rear ring", ()),
    "target_visible": ("1", "", ()),
    "target_position": ("m", "world", ()),
    "memory_available": ("1", "", ()),
    "memory_direction": ("1", "world", ()),
    "memory_age": ("control steps", "", ()),
    "centring": ("1", "", ()),
    "alignment": ("1", "", ()),
    "quality": ("1", "so far", ()),
    "C_turn": ("1", "", ()),
}
"""Unit, frame and labels of what is told of the episode's own record (`agent_client.episodes`), which stands
whole at the end of every record: one copy in place of twenty."""


def columns(episode: np.dtype[np.void]) -> tuple[Column, ...]:
    """The fields of one record, by their offsets: command and pose, what the flight adds, the episode.

    Args:
        episode: dtype of the episode's own record.
    """
    found = []
    offset = 0
    for name, kind, shape, unit, frame, labels in (*PAYLOAD, *ADDED):
        found.append(Column(name, kind, shape, offset, unit, frame, labels))
        offset += np.dtype((kind, shape)).itemsize
    start = _episode_offset()
    assert episode.fields is not None
    for name, (unit, frame, labels) in EPISODE.items():
        field, at = episode.fields[name][:2]
        found.append(Column(name, field.base.str, field.shape, start + at, unit, frame, labels))
    return tuple(found)


def _episode_offset() -> int:
    """Where the episode's record begins: after all else, on a boundary of 8 bytes."""
    packed = sum(np.dtype((kind, shape)).itemsize for _, kind, shape, *_ in (*PAYLOAD, *ADDED))
    return -(-packed // 8) * 8


def record_dtype(fields: tuple[Column, ...], size: int) -> np.dtype[np.void]:
    """The dtype of a record of `size` bytes with these fields."""
    return np.dtype(
        {
            "names": [c.name for c in fields],
            "formats": [(c.type, c.shape) for c in fields],
            "offsets": [c.offset for c in fields],
            "itemsize": size,
        }
    )


def next_link(chain: bytes, payload: bytes) -> bytes:
    """The next 32-byte link of the hash chain; `payload` is a command row followed by its pose row."""
    return hashlib.sha256(chain + payload).digest()


def manifest_digest(manifest: dict[str, Any]) -> str:
    """SHA-256 over all of a manifest but its own digest, in hexadecimal."""
    rest = {key: value for key, value in manifest.items() if key != DIGEST}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def manifest_text(manifest: dict[str, Any]) -> str:
    """A manifest as it stands in its file, to the last character."""
    return json.dumps(manifest, indent=1, allow_nan=False) + "\n"


class Recorder:
    """Writes one flight of one lane; every record is with the operating system before the next is made.

    Once a second the log is put on the disk itself, which takes some milliseconds.

    Args:
        folder: the run folder, without a run in it.
        manifest: what is known before the first step.
        episode: dtype of the episode's own record.

    Raises:
        OutputError: the folder cannot be written.
    """

    def __init__(self, folder: Path, manifest: dict[str, Any], episode: np.dtype[np.void]) -> None:
        self.folder = folder
        fields = columns(episode)
        size = _episode_offset() + episode.itemsize
        self._row = np.zeros(1, record_dtype(fields, size))
        row, words = self._row[0], self._row.view(np.uint8)
        self._payload = words[: COMMAND_BYTES + POSE_BYTES]
        self._command = self._payload.view(np.float64)[:COMMAND_WORDS]
        self._pose = self._payload.view(np.float64)[COMMAND_WORDS:]
        self._link, self._phases, self._observation = row["chain"], row["phases"], row["observation"]
        self._action, self._recording = self._row["action"], self._row["recording"]
        self._entropy, self._check = self._row["entropy"], self._row["check"]
        self._record, self._episode = words.data, words[_episode_offset() :]
        self._chain = b""
        self._sync_due = 0
        self.records = 0
        self.manifest = manifest | {
            "format": FORMAT,
            "log": LOG,
            "record_bytes": size,
            "record": [asdict(column) for column in fields],
            "status": "running",
        }
        try:
            # Unbuffered: what is written survives the death of this process, however it dies.
            self._log = (folder / LOG).open("xb", buffering=0)
        except FileExistsError as error:
            raise OutputError(f"{folder / LOG}: expected no such file, found one: a run is there") from error
        except OSError as error:
            raise OutputError(f"{folder / LOG} cannot be written: {error.strerror}") from error
        self.write_manifest()

    @property
    def trajectory_hash(self) -> str:
        """Hexadecimal hash over all command and pose payloads so far."""
        return self._chain.hex()

    def write(self, step: FlightStep) -> None:
        """Append one control step, or the reset pose as the first record."""
        started = time.perf_counter_ns()
        self._command[:] = step.command[0]
        self._pose[:] = step.pose[0]
        self._chain = next_link(self._chain, self._payload.tobytes())
        self._link[:] = np.frombuffer(self._chain, np.uint8)
        self._action[0] = step.actions[0]
        self._entropy[0] = step.entropy[0]
        self._phases[:] = step.phases
        self._observation[:] = step.task.observation[0]
        # As bytes: copied field by field it would take ten times as long.
        self._episode[:] = step.task.episodes.view(np.uint8)
        self._check[0] = 0
        self._check[0] = zlib.crc32(self._record)
        try:
            if self._log.write(self._record) != len(self._record):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # a raw file may take half a record
            self.records += 1
            if started >= self._sync_due:
                os.fsync(self._log.fileno())
                self._sync_due = started + SYNC_NS
        except OSError as error:
            raise OutputError(
                f"{self.folder / LOG} cannot be written: {error.strerror}; {self.records} records stand"
            ) from error
        self._recording[0] = time.perf_counter_ns() - started

    def write_manifest(self) -> None:
        """Write the manifest so that a reader finds either the old one or the new one, whole."""
        path = self.folder / MANIFEST
        partial = path.with_suffix(".partial")
        self.manifest[DIGEST] = manifest_digest(self.manifest)
        try:
            with partial.open("w") as file:
                file.write(manifest_text(self.manifest))
                file.flush()
                os.fsync(file.fileno())  # on the disk before it takes the other's name
            partial.replace(path)
            if os.name == "posix":
                _sync_folder(self.folder)
        except OSError as error:
            with suppress(OSError):  # what matters is why it could not be written
                partial.unlink(missing_ok=True)
            raise OutputError(
                f"{path} cannot be written: {error.strerror}; {self.records} records stand in {LOG}"
            ) from error

    def close(self, status: str, outcome: dict[str, Any]) -> None:
        """Close, and say in the manifest how the run ended.

        Raises:
            OutputError: the manifest cannot be written, and goes on saying that the run is running.
        """
        self._log.close()
        self.manifest["status"] = status
        self.manifest["records"] = self.records
        self.manifest["trajectory_hash"] = self.trajectory_hash
        self.manifest["outcome"] = outcome
        self.write_manifest()


def _sync_folder(folder: Path) -> None:
    """Put the names of the files in a folder on the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
