"""A run as a table: CSV, NumPy archive, Parquet, streamed from the log."""

from __future__ import annotations

import csv
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.errors import CosimError
from cosim.recording import Column
from cosim.requirements import install_command
from cosim.runs import Run, chunks, element_names

CHAIN: Final = "chain"

Done = Callable[[float], None]


def _names(column: Column) -> list[str]:
    """Names of the columns that a field becomes; a link of the chain is one, in hexadecimal as in the manifest."""
    return [CHAIN] if column.name == CHAIN else element_names(column)


def _scalars(records: NDArray[np.void], column: Column) -> list[NDArray[Any]]:
    if column.name == CHAIN:
        return [np.array([link.tobytes().hex() for link in records[CHAIN]])]
    values = records[column.name].reshape(len(records), -1)
    return [values[:, i] for i in range(values.shape[1])]


def write_csv(run: Run, target: Path, done: Done) -> str:
    """Write one row a record, with every number exact; nothing is lost."""
    with target.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([name for c in run.columns for name in _names(c)])
        for records in chunks(run):
            columns = [scalar.tolist() for c in run.columns for scalar in _scalars(records, c)]
            writer.writerows(zip(*columns, strict=True))
            done(len(records))
    return ""


def write_npz(run: Run, target: Path, done: Done) -> str:
    """Write a NumPy archive: an array a field, and the manifest as text."""
    with zipfile.ZipFile(target, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
        with archive.open("manifest.npy", "w") as member:
            np.lib.format.write_array(member, np.array(json.dumps(run.manifest)), allow_pickle=False)
        for column in run.columns:
            header = {
                "descr": np.lib.format.dtype_to_descr(np.dtype(column.type)),
                "fortran_order": False,
                "shape": (len(run.records), *column.shape),
            }
            # Piece by piece, since `numpy.savez` wants whole arrays.
            with archive.open(f"{column.name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array_header_2_0(member, header)
                for records in chunks(run):
                    member.write(np.ascontiguousarray(records[column.name]).tobytes())
                    done(len(records) / len(run.columns))
    return ""


def write_parquet(run: Run, target: Path, done: Done) -> str:
    """Write Parquet with unit and frame of every column and the manifest in its metadata.

    Raises:
        CosimError: pyarrow is not installed.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise CosimError(f"Parquet needs pyarrow; install it with: {install_command('export')}") from error
    described = {name: {"unit": c.unit, "frame": c.frame} for c in run.columns for name in _names(c)}

    def kind(column: Column) -> Any:
        return pa.string() if column.name == CHAIN else pa.from_numpy_dtype(np.dtype(column.type))

    schema = pa.schema(
        [pa.field(name, kind(c), metadata=described[name]) for c in run.columns for name in _names(c)],
        # Of the file and not of a column alone: Polars and DuckDB show no other.
        metadata={"cosim.manifest": json.dumps(run.manifest), "cosim.columns": json.dumps(described)},
    )
    with pq.ParquetWriter(target, schema, compression="zstd") as writer:
        for records in chunks(run):
            arrays = [np.ascontiguousarray(s) for c in run.columns for s in _scalars(records, c)]
            writer.write_table(pa.table(arrays, schema=schema))
            done(len(records))
    return ""
