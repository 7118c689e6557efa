"""Run folders: where a run goes when nobody says, and refusing what cannot be written."""

from __future__ import annotations

import itertools
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from cosim.errors import USAGE, OutputError, exit_status
from cosim.recording import LOG, MANIFEST


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
    nearest = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not (nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK)):
        raise OutputError(
            f"--out {folder}: expected a folder that can be written, found {nearest}, which cannot"
        )


@contextmanager
def new_folder(out: Path | None, label: str) -> Iterator[Path]:
    """The run's folder: `out`, or a new one under runs/ named by time (UTC) and `label`.

    It goes again where no flight began because of bad input, since then there is nothing to keep.

    Raises:
        OutputError: it cannot be created.
    """
    folder = out if out is not None else _free_name(label)
    existed = folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"--out {folder}: cannot be created: {error.strerror}") from error
    try:
        yield folder
    except BaseException as error:
        if exit_status(error) == USAGE and not existed and not (folder / MANIFEST).exists():
            shutil.rmtree(folder)
        raise


def _free_name(label: str) -> Path:
    """A path under runs/ that does not exist."""
    stamp = datetime.now(UTC).strftime("%Y-%m-%d-%H%M%S")
    stem = Path("runs") / f"{stamp}-{label}"
    names = itertools.chain([stem], (stem.with_name(f"{stem.name}-{n}") for n in itertools.count(2)))
    return next(name for name in names if not name.exists())
