"""`cosim report`: runs and evaluations as one HTML page that needs no network and nothing beside it.

The page is `report_page/`: markup, style and scripts as they stand there, with the data put in. Numbers travel as
JSON, arrays as one deflated block of bytes in base64.
"""

from __future__ import annotations

import base64
import html
import json
import time
import zlib
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim import __version__
from cosim.errors import OutputError, RunError
from cosim.folders import RESULTS
from cosim.live import working
from cosim.recording import LOG, MANIFEST
from cosim.report_axis import whole_axis
from cosim.report_evaluation import describe_evaluation, read_results
from cosim.report_failures import flown_failures, fly_failures
from cosim.report_run import Kept, describe_run
from cosim.report_tube import describe_tube
from cosim.runs import Run, read_run
from cosim.scene import Scene, read_scene

PAGE: Final = "report.html"
"""Name of the page where none is given."""
RECORDS: Final = 25_000
"""Records that a page holds, of all its runs together; of more, every second, third and so on."""
TRIANGLES: Final = 80_000
"""Triangles that a page holds, of all its tubes together; of more, each tube keeps the same share."""
SCRIPTS: Final = (
    "data.js", "shapes.js", "tube.js", "senses.js", "ending.js", "view.js", "plan.js", "dial.js", "charts.js",
    "plots.js", "tables.js", "evaluation.js", "player.js", "page.js",
)  # fmt: skip
"""Parts of the page's one script, in order."""

_ALIGNMENT: Final = 8


class Arrays:
    """The arrays of a page, one after the other in one block."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []
        self._size = 0
        self.index: list[dict[str, Any]] = []
        """Of each array its type, shape and first byte."""

    def add(self, values: NDArray[Any]) -> int:
        """Add an array and return its number."""
        little = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
        raw = little.tobytes()
        self.index.append({"type": little.dtype.str[1:], "shape": list(values.shape), "at": self._size})
        padding = bytes(-len(raw) % _ALIGNMENT)
        self._pieces += [raw, padding]
        self._size += len(raw) + len(padding)
        return len(self.index) - 1

    def packed(self) -> str:
        """All of them, deflated, in base64."""
        return base64.b64encode(zlib.compress(b"".join(self._pieces), 6)).decode()


def report(sources: Sequence[Path], out: Path | None = None, fly: int = 0) -> Path:
    """Write the page of runs and evaluations.

    Args:
        sources: run folders, and `results.json` of `cosim evaluate --out` or the folder that it is in.
        out: the page; None for report.html in the first folder.
        fly: failures of each evaluation that are flown again first; those that were before are shown anyway.

    Returns:
        The page.

    Raises:
        RunError: a source is neither, or a run holds no record.
        OutputError: the page cannot be written.
    """
    results = {path: read_results(path) for source in sources if (path := _results_in(source)) is not None}
    if fly and not results:
        raise RunError(
            "--fly: expected results of `cosim evaluate --out`, found runs alone: nothing to fly again"
        )
    for path, found in results.items():
        fly_failures(path, found, fly)
    again = [folder for path, found in results.items() for folder in flown_failures(path, found)]
    given = [
        source.parent if source.name == MANIFEST else source
        for source in sources
        if _results_in(source) is None
    ]
    runs = [read_run(folder) for folder in dict.fromkeys((*given, *again))]
    for run in runs:
        if not len(run.records):
            raise RunError(
                f"{run.folder}: expected at least the record of the reset pose, found no whole record"
            )
    first = sources[0]
    target = out if out is not None else (first if first.is_dir() else first.parent) / PAGE
    if target.name in (MANIFEST, LOG, RESULTS):
        raise OutputError(f"{target}: expected the name of a page, found that of the data")
    arrays = Arrays()
    with working(f"building {target.name}"):
        described, tubes = _describe(runs, arrays)
    evaluations = [describe_evaluation(path, found, runs) for path, found in results.items()]
    data = {
        "made": {"cosim": __version__, "at": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())},
        "runs": described,
        "tubes": tubes,
        "evaluations": evaluations,
        "arrays": arrays.index,
    }
    _write(target, page(data, arrays.packed()))
    return target


def page(data: dict[str, Any], arrays: str) -> str:
    """The page with its data in it."""
    folder = files("cosim") / "report_page"

    def part(name: str) -> str:
        return (folder / name).read_text(encoding="utf-8")

    # No "</script>" can stand inside of a script: in JSON, "<" is as well written \u003c.
    content = {
        "title": html.escape(_title(data)),
        "style": part("page.css"),
        "data": json.dumps(data, allow_nan=False).replace("<", "\\u003c"),
        "arrays": arrays,
        "three": part("three.min.js"),
        "script": "\n".join(part(name) for name in SCRIPTS),
    }
    pieces = part("page.html").split("%%")
    return "".join(content[piece] if i % 2 else piece for i, piece in enumerate(pieces))


def _title(data: dict[str, Any]) -> str:
    runs = data["runs"]
    if data["evaluations"]:
        return "Evaluation"
    return runs[0]["name"] if len(runs) == 1 else f"{len(runs)} runs"


def _results_in(source: Path) -> Path | None:
    """The results of an evaluation that a source is or holds; None for a run folder."""
    if source.is_file() and source.name != MANIFEST:
        return source
    return source / RESULTS if (source / RESULTS).is_file() and not (source / MANIFEST).exists() else None


def _describe(runs: Sequence[Run], arrays: Arrays) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The runs, and the tubes that they were flown in: one for all that share it."""
    stride = -(-sum(len(run.records) for run in runs) // RECORDS)
    scenes, axes = [read_scene(run) for run in runs], [whole_axis(run) for run in runs]
    keys = [_tube_key(run, scene) for run, scene in zip(runs, scenes, strict=True)]
    shown = list(dict.fromkeys(keys))
    flown_in = [[scene for scene, own in zip(scenes, keys, strict=True) if own == key] for key in shown]
    share = TRIANGLES / max(sum(len(own[0].tube.faces) for own in flown_in), 1)
    whole = {key: axis[0] for key, axis in zip(keys, axes, strict=True) if axis is not None}
    tubes = [
        describe_tube(own, whole.get(key), share, arrays.add)
        for key, own in zip(shown, flown_in, strict=True)
    ]
    described = [
        describe_run(run, scene, axis, Kept.of(len(run.records), stride), arrays.add)
        | {"tube": shown.index(key)}
        for run, scene, axis, key in zip(runs, scenes, axes, keys, strict=True)
    ]
    return described, tubes


def _tube_key(run: Run, scene: Scene) -> tuple[Any, ...]:
    """Runs of the same key were flown in the same walls; a tube that had to be rebuilt is a run's own."""
    mesh = run.manifest["mesh"]
    return (mesh["sha256"], mesh["axes"], mesh["scale"], str(run.folder) if scene.note else "")


def _write(target: Path, text: str) -> None:
    partial = target.with_name(f"{target.name}.partial")
    try:
        partial.write_text(text, encoding="utf-8")
        partial.replace(target)
    except OSError as error:
        raise OutputError(f"{target} cannot be written: {error.strerror}") from error
    finally:
        partial.unlink(missing_ok=True)
