"""Run folders: where a run goes when nobody says, and refusing what cannot be written."""

from __future__ import annotations

import os
from datetime import UTC, datetime
from pathlib import Path

from cosim.errors import OutputError
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


def make_folder(out: Path | None, label: str) -> Path:
    """Create the run's folder: `out`, or a new one under runs/ named by time (UTC) and `label`.

    Raises:
        OutputError: it cannot be created.
    """
    if out is None:
        stamp = datetime.now(UTC).strftime("%Y-%m-%d-%H%M%S")
        stem = Path("runs") / f"{stamp}-{label}"
        out = stem
        count = 1
        while out.exists():
            count += 1
            out = stem.with_name(f"{stem.name}-{count}")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"--out {out}: cannot be created: {error.strerror}") from error
    return out
