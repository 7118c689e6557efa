"""A recorded run in other formats, streamed from its folder alone: CSV, NumPy archive, Parquet."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.errors import CosimError, OutputError
from cosim.recording import LOG, MANIFEST, Column
from cosim.runs import Run, element_names, read_run

CHUNK: Final = 8192
"""Records that are in memory at a time."""


def export(folder: Path, kind: str, output: Path | None = None) -> Path:
    """Write the run in `folder` as `kind` ("csv", "npz" or "parquet") and return the file's path.

    Raises:
        RunError: the folder holds no readable run.
        OutputError: the file cannot be written.
        CosimError: the library that the format needs is not installed.
    """
    run = read_run(folder)
    target = output if output is not None else folder / f"steps.{kind}"
    for own in (MANIFEST, LOG):
        if target.resolve() == (folder / own).resolve():
            raise OutputError(
                f"{target}: expected a file that is no part of the run, found the run's own {own}"
            )
    partial = target.with_name(f"{target.name}.partial")
    try:
        WRITERS[kind](run, partial)
        partial.replace(target)
    except OSError as error:
        raise OutputError(f"{target} cannot be written: {error.strerror}") from error
    finally:
        partial.unlink(missing_ok=True)
    return target


def _chunks(run: Run) -> Iterator[NDArray[np.void]]:
    for start in range(0, len(run.records), CHUNK):
        yield run.records[start : start + CHUNK]


def _scalars(records: NDArray[np.void], column: Column) -> list[NDArray[Any]]:
    values = records[column.name].reshape(len(records), -1)
    return [values[:, i] for i in range(values.shape[1])]


def _write_csv(run: Run, target: Path) -> None:
    with target.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([name for c in run.columns for name in element_names(c)])
        for records in _chunks(run):
            columns = [scalar.tolist() for c in run.columns for scalar in _scalars(records, c)]
            writer.writerows(zip(*columns, strict=True))


def _write_npz(run: Run, target: Path) -> None:
    with target.open("wb") as file:
        arrays: dict[str, Any] = {c.name: run.records[c.name] for c in run.columns}
        np.savez(file, manifest=np.array(json.dumps(run.manifest)), **arrays)


def _write_parquet(run: Run, target: Path) -> None:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise CosimError(
            "Parquet needs pyarrow; install it with: pip install 'tube-cosim[export]'"
        ) from error
    schema = pa.schema(
        [
            pa.field(name, pa.from_numpy_dtype(np.dtype(c.type)), metadata={"unit": c.unit, "frame": c.frame})
            for c in run.columns
            for name in element_names(c)
        ],
        metadata={"cosim.manifest": json.dumps(run.manifest)},
    )
    with pq.ParquetWriter(target, schema, compression="zstd") as writer:
        for records in _chunks(run):
            arrays = [np.ascontiguousarray(s) for c in run.columns for s in _scalars(records, c)]
            writer.write_table(pa.table(arrays, schema=schema))


WRITERS: Final[dict[str, Callable[[Run, Path], None]]] = {
    "csv": _write_csv,
    "npz": _write_npz,
    "parquet": _write_parquet,
}
