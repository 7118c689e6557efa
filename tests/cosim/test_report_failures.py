"""Failures of an evaluation that `cosim report --fly` flies again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from flights import run_here
from pages import evaluation_results, read_page

from cosim.errors import RunError
from cosim.report import report
from cosim.report_failures import FAILURES


def results_with(folder: Path, *launches: str, **changed: Any) -> Path:
    """Results in a folder, with a failure for each command that would fly it again."""
    results = evaluation_results()
    failed = results["flown"][1] | {"launch_repeats": False} | changed
    results["flown"] = [failed | {"launch": launch} for launch in launches]
    (folder / "results.json").write_text(json.dumps(results))
    return folder


def test_a_failure_is_flown_again_once_and_linked(tmp_path: Path) -> None:
    """--fly 1 flies the first of two failures and links its run; later reports fly nothing and link it still."""
    command = "cosim launch --tube level=0,seed=7 --policy lidar-rule --max-steps 5"
    source = results_with(tmp_path, command, "cosim launch --nonsense", level=0)
    done = run_here("report", str(source), "--fly", "1")
    assert (done.status, done.stderr) == (0, "")
    (flown,) = (tmp_path / FAILURES).iterdir()
    changed = (flown / "steps.bin").stat().st_mtime_ns
    for page in (tmp_path / "report.html", report([source], tmp_path / "again.html", fly=1)):
        data = read_page(page).data
        assert [run["name"] for run in data["runs"]] == [flown.name]
        assert [failure["run"] for failure in data["evaluations"][0]["failures"]] == [0, 0]
    assert (flown / "steps.bin").stat().st_mtime_ns == changed


@pytest.mark.parametrize("command", ["python -c pass", "cosim bench", "cosim"])
def test_no_command_but_a_launch_is_run(command: str, tmp_path: Path) -> None:
    """Results are a file from anywhere: another command in it is refused, and nothing is made of it."""
    with pytest.raises(RunError, match="expected a command that begins with `cosim launch`"):
        report([results_with(tmp_path, command)], fly=1)
    assert [path.name for path in tmp_path.iterdir()] == ["results.json"]


def test_runs_alone_have_nothing_to_fly_again(tmp_path: Path) -> None:
    """--fly without results is refused before anything is read."""
    done = run_here("report", str(tmp_path), "--fly", "3")
    assert (done.status, "nothing to fly again" in done.stderr) == (2, True)
