"""Reading a run folder: its manifest and its log, also of a run that was cut short."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.errors import RunError
from cosim.recording import (
    ADDED,
    COMMAND_BYTES,
    EPISODE,
    FORMAT,
    MANIFEST,
    PAYLOAD,
    POSE_BYTES,
    Column,
    record_dtype,
)
from protocol.plant import COMMAND_WORDS

CHUNK: Final = 8192
"""Records that are in memory at a time."""

AXES: Final = ("x", "y", "z")


@dataclass(frozen=True)
class Run:
    """A recorded run, mapped read-only."""

    folder: Path
    manifest: dict[str, Any]
    columns: tuple[Column, ...]
    records: NDArray[np.void]
    """One record a control step, the reset pose first; the fields are `columns`."""


class _Described(dict[str, Any]):
    """An object in a manifest, which says whose it is where something is missing."""

    def __init__(self, path: Path, values: dict[str, Any]) -> None:
        super().__init__(values)
        self._path = path

    def __missing__(self, key: str) -> Any:
        raise RunError(f"{self._path}: expected {key!r}, found none: it is damaged, or of another version")


def read_run(folder: Path) -> Run:
    """Read a run folder; a log that was cut short ends with its last whole record.

    Raises:
        RunError: no folder, no manifest, a manifest of another format, or a log that does not fit it. What is
            missing in the manifest raises it where it is asked for.
    """
    path = folder / MANIFEST
    try:
        manifest = json.loads(path.read_text(), object_hook=lambda values: _Described(path, values))
    except OSError as error:
        raise RunError(f"{path}: expected the manifest of a run, found none ({error.strerror})") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise RunError(f"{path}: expected JSON, found text that is not ({error})") from error
    found = manifest.get("format") if isinstance(manifest, dict) else None
    if found != FORMAT:
        raise RunError(f"{path}: format: expected {FORMAT}, found {found}")
    try:
        columns = tuple(
            Column(**{**c, "shape": tuple(c["shape"]), "labels": tuple(c["labels"])})
            for c in manifest["record"]
        )
        log = folder / manifest["log"]
        dtype = record_dtype(columns, manifest["record_bytes"])
    except (KeyError, TypeError, ValueError, SyntaxError) as error:  # the last of a damaged numpy type
        raise RunError(f"{path}: the description of a record is damaged ({error})") from error
    if missing := {*(name for name, *_ in (*PAYLOAD, *ADDED)), *EPISODE} - set(dtype.names or ()):
        raise RunError(f"{path}: record: expected a field {min(missing)!r}, found none")
    try:
        count = log.stat().st_size // dtype.itemsize
        records = np.memmap(log, dtype, mode="r", shape=(count,)) if count else np.zeros(0, dtype)
    except OSError as error:
        raise RunError(f"{log}: expected the log of a run, found none ({error.strerror})") from error
    return Run(folder, manifest, columns, records)


def chunks(run: Run) -> Iterator[NDArray[np.void]]:
    """The records of a run, some thousands at a time; read and not mapped, so that memory stays bounded."""
    with (run.folder / run.manifest["log"]).open("rb") as log:
        for start in range(0, len(run.records), CHUNK):
            yield np.fromfile(log, run.records.dtype, min(CHUNK, len(run.records) - start))


def column(run: Run, name: str) -> NDArray[Any]:
    """One field of all records, (T, ...), as an array of its own."""
    return np.concatenate([records[name] for records in chunks(run)])


def payloads(records: NDArray[np.void]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Command rows (T, 8) and pose rows (T, 16) of records (T,), as they crossed the protocol, bit for bit."""
    rows = records.view(np.uint8).reshape(len(records), records.dtype.itemsize)
    words = np.ascontiguousarray(rows[:, : COMMAND_BYTES + POSE_BYTES]).view(np.float64)
    return words[:, :COMMAND_WORDS].copy(), words[:, COMMAND_WORDS:].copy()


def element_names(column: Column) -> list[str]:
    """Names of the scalar columns that a field becomes: `position_x`, `lidar_17`."""
    if not column.shape:
        return [column.name]
    size = int(np.prod(column.shape))
    labels = column.labels or (AXES if size == len(AXES) else tuple(str(i) for i in range(size)))
    return [f"{column.name}_{label}" for label in labels]
