"""A recorded run in other formats, from its folder alone."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from cosim.errors import OutputError
from cosim.export_robotics import write_mcap, write_tum
from cosim.export_scene import write_gltf, write_usd
from cosim.export_tables import write_csv, write_npz, write_parquet
from cosim.live import counting
from cosim.recording import LOG, MANIFEST
from cosim.runs import Run, read_run


@dataclass(frozen=True)
class Format:
    """A format that runs are written in."""

    suffix: str
    """Of its files where none is named."""
    write: Callable[[Run, Path, Callable[[float], None]], str]
    """(run, file, told how many records more were written) -> what is not as it was flown, for people."""


FORMATS: Final[dict[str, Format]] = {
    "csv": Format(".csv", write_csv),
    "npz": Format(".npz", write_npz),
    "parquet": Format(".parquet", write_parquet),
    "tum": Format(".tum", write_tum),
    "mcap": Format(".mcap", write_mcap),
    "gltf": Format(".glb", write_gltf),
    "usd": Format(".usd", write_usd),
}


def export(folder: Path, kind: str, output: Path | None = None) -> tuple[Path, str]:
    """Write the run in `folder` as `kind`, a key of FORMATS.

    Returns:
        The file, and what in it is not as it was flown (empty where all is).

    Raises:
        RunError: the folder holds no readable run.
        OutputError: the file cannot be written.
        CosimError: the library that the format needs is not installed.
    """
    run, form = read_run(folder), FORMATS[kind]
    target = output if output is not None else folder / f"steps{form.suffix}"
    for own in (MANIFEST, LOG):
        if target.resolve() == (folder / own).resolve():
            raise OutputError(
                f"{target}: expected a file that is no part of the run, found the run's own {own}"
            )
    if not len(run.records):
        raise OutputError(f"{folder}: expected a run with at least its reset pose, found no whole record")
    partial = target.with_name(f"{target.stem}.partial{target.suffix}")
    try:
        with counting(f"writing {target.name}", len(run.records)) as done:
            note = form.write(run, partial, done)
        partial.replace(target)
    except OSError as error:
        elsewhere = "; --out FILE writes it elsewhere" if output is None else ""
        raise OutputError(f"{target} cannot be written: {error.strerror or error}{elsewhere}") from error
    finally:
        with suppress(OSError):  # of a folder that cannot be written, where nothing was
            partial.unlink(missing_ok=True)
    return target, note
