"""Folders of runs and results: where a run goes when nobody says, and refusing what cannot be written."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from cosim.errors import PEER, OutputError, exit_status
from cosim.recording import LOG, MANIFEST
from cosim.supervise import LOGS
from protocol.signals import held_signals

RESULTS: Final = "results.json"
"""File of what many flights came to."""


def check_folder(out: Path | None) -> None:
    """Refuse, before anything is started, a folder that cannot become a run's.

    Raises:
        OutputError: it holds a run already, or cannot be written.
    """
    folder = out if out is not None else Path("runs")
    for name in (MANIFEST, LOG):
        if out is not None and (out / name).exists():
            raise OutputError(
                f"--out {out}: expected a folder without a run, found {name}: already a run there"
            )
    try:
        nearest = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    except OSError as error:
        raise OutputError(
            f"--out {folder}: the working directory cannot be used: {error.strerror}"
        ) from error
    if not (nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK)):
        raise OutputError(
            f"--out {folder}: expected a folder that can be written, found {nearest}, which cannot"
        )


@contextmanager
def new_folder(out: Path | None, label: str) -> Iterator[Path]:
    """The run's folder: `out`, or a new one under runs/ named by time (UTC) and `label`.

    Where no flight began, because of bad input or Ctrl-C, everything that was made goes again. Where the
    physics process failed, its logs are kept.

    Raises:
        OutputError: it cannot be created.
    """
    folder, made = make_folder(out) if out is not None else _make_free(label)
    try:
        yield folder
    except BaseException as error:
        if exit_status(error) != PEER and not (folder / MANIFEST).exists():
            for name in LOGS:
                (folder / name).unlink(missing_ok=True)
            remove_empty(made)
        raise


@contextmanager
def results_folder(folder: Path | None) -> Iterator[None]:
    """Create the folder of the results before all the flying; what was made goes again where that fails.

    Raises:
        OutputError: it holds results already, or cannot be written.
    """
    if folder is None:
        yield
        return
    if (folder / RESULTS).exists():
        raise OutputError(
            f"--out {folder}: expected a folder without {RESULTS}, found one; name another folder"
        )
    _, made = make_folder(folder)
    try:
        if not os.access(folder, os.W_OK | os.X_OK):
            raise OutputError(f"--out {folder}: expected a folder that can be written, found one that cannot")
        yield
    except BaseException:
        remove_empty(made)
        raise


def write_results(folder: Path, report: dict[str, Any]) -> None:
    """Write the results into their folder.

    Raises:
        OutputError: they cannot be written.
    """
    path = folder / RESULTS
    try:
        path.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n")
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror}") from error


def remove_empty(folders: list[Path]) -> None:
    """Remove folders, the innermost first, that nothing is in."""
    for path in folders:
        with suppress(OSError):  # not empty: something of the user's is in it
            path.rmdir()


def make_folder(folder: Path, *, new: bool = False) -> tuple[Path, list[Path]]:
    """Create a folder; returns it, and which folders were made for it, the innermost first.

    Raises:
        OutputError: it cannot be created.
        FileExistsError: it exists, and is to be `new`.
    """
    made = [path for path in (folder, *folder.absolute().parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=not new)
    except OSError as error:
        if new and isinstance(error, FileExistsError):
            raise
        raise OutputError(f"--out {folder}: cannot be created: {error.strerror}") from error
    return folder, made


def _make_free(label: str) -> tuple[Path, list[Path]]:
    """Create a folder under runs/ that did not exist."""
    stamp = datetime.now(UTC).strftime("%Y-%m-%d-%H%M%S")
    stem = Path("runs") / f"{stamp}-{label}"
    for number in itertools.count(1):
        try:
            return make_folder(stem if number == 1 else stem.with_name(f"{stem.name}-{number}"), new=True)
        except FileExistsError:
            continue
    raise AssertionError


@contextmanager
def scratch_folder(prefix: str) -> Iterator[Path]:
    """A temporary folder that is gone at the end, whenever Ctrl-C comes.

    `tempfile.TemporaryDirectory` loses the folder where an interrupt comes while it makes or removes it.
    """
    folder: Path | None = None
    try:
        with held_signals():
            folder = Path(tempfile.mkdtemp(prefix=prefix))
        yield folder
    finally:
        if folder is not None:
            with held_signals():
                shutil.rmtree(folder, ignore_errors=True)
