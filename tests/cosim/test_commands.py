"""The other commands: help, training, benchmarks."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest
from click.shell_completion import ShellComplete
from click.testing import CliRunner
from flights import DEADLINE, ROOT, command, environment, run_cosim, run_here

from cosim import __version__
from cosim.cli import cosim
from cosim.evaluation_plan import POLICIES
from cosim.pilots import TUNED_PURSUIT

ROUND_TRIPS = {"shm_two_cores", "shm_one_core", "pipe", "udp", "udp_one_core"}
QUANTILES = {"p50_us", "p99_us", "p999_us"}
PHASES = {"wait", "physics", "rays", "features", "policy", "recording", "other"}


@pytest.mark.parametrize("name", ["", *cosim.commands])
def test_help_fits_on_a_screen(name: str) -> None:
    """Every command's help fits on 80 columns and 24 lines, the prompt's included, and shows an example."""
    done = CliRunner().invoke(cosim, [*name.split(), "--help"], prog_name="cosim", terminal_width=80)
    assert done.exit_code == 0
    lines = done.stdout.splitlines()
    assert lines[0].startswith(f"Usage: cosim {name}".strip())
    assert len(lines) <= 23
    assert max(map(len, lines)) <= 80
    assert any(line.strip().startswith(("cosim", "eval")) and name in line for line in lines[1:])


def test_help_all_names_what_help_leaves_out() -> None:
    """The rare options and the named settings appear, and nothing that --help shows is lost."""
    short, long = (
        CliRunner().invoke(cosim, ["launch", option]).stdout for option in ("--help", "--help-all")
    )
    assert "--physics-dt" not in short
    assert "--physics-dt" in long
    assert "--lidar-noise [0 m]" in long
    for line in short.splitlines():
        if line.strip().startswith("--"):
            assert line.split()[0] in long


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_shells_complete_commands(shell: str, tmp_path: Path) -> None:
    """The script asks the program itself, which answers with the commands that begin so."""
    done = run_here("completion", shell)
    assert done.status == 0
    assert "_COSIM_COMPLETE" in done.stdout
    asked = {"_COSIM_COMPLETE": f"{shell}_complete", "COMP_WORDS": "cosim exp"}
    asked["COMP_CWORD"] = "exp" if shell == "fish" else "1"
    answer = subprocess.run(
        command(), check=False, capture_output=True, text=True, cwd=tmp_path, timeout=DEADLINE,
        env=environment() | asked,
    )  # fmt: skip
    assert "export" in answer.stdout
    assert "launch" not in answer.stdout


def test_policies_complete_to_files_and_names() -> None:
    """Names of pilots that need no file, those that are there to be flown, and the shell's files."""
    for command_name, pilots in (("launch", set(POLICIES) - {TUNED_PURSUIT}), ("evaluate", set(POLICIES))):
        completion = ShellComplete(cosim, {}, "cosim", "_COSIM_COMPLETE")
        items = completion.get_completions([command_name, "--policy"], "")
        assert {item.value for item in items if item.type == "plain"} == pilots
        assert [item.value for item in items if item.type == "file"] == [""]


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (("launch", "--mesh", ""), "--mesh: "),
        (("launch", "--out="), "--out: "),
        (("verify", ""), ""),
        (("export", "run", "--format", "csv", "-o", ""), "-o: "),
    ],
)
def test_an_empty_value_is_refused(arguments: tuple[str, ...], name: str) -> None:
    """What a shell makes of a variable that is not set is no path and no default."""
    done = run_here(*arguments)
    assert done.status == 2
    assert f"Error: {name}expected a value, found an empty string" in done.stderr


@pytest.mark.parametrize(
    "arguments", [("report", "run"), ("export", "run", "--format", "csv"), ("bench", "--protocol")]
)
def test_a_file_is_refused_before_the_work(arguments: tuple[str, ...], tmp_path: Path) -> None:
    """A folder in its place, or no folder to write it to, is said before anything is read or measured."""
    option = "--png" if arguments[0] == "bench" else "--out"
    (tmp_path / "file").touch()
    done = run_here(*arguments, option, str(tmp_path / "file" / "x"))
    assert (done.status, "expected a folder" in done.stderr) == (2, True)
    done = run_here(*arguments, option, str(tmp_path))
    assert (done.status, "is a directory" in done.stderr) == (2, True)


@pytest.mark.parametrize(
    ("variables", "coloured"), [({}, True), ({"NO_COLOR": "1"}, False), ({"TERM": "dumb"}, False)]
)
def test_colours_can_be_refused(variables: dict[str, str], coloured: bool) -> None:
    """On a terminal there are some, but for NO_COLOR and for a terminal that has none."""
    ours, theirs = pty.openpty()
    done = subprocess.run(
        command("doctor"), check=False, stdout=theirs, cwd=ROOT, timeout=DEADLINE,
        env=environment() | {"TERM": "xterm", "NO_COLOR": ""} | variables,
    )  # fmt: skip
    os.close(theirs)
    with os.fdopen(ours, "rb") as terminal:
        said = terminal.read1()
    assert done.returncode in (0, 1)
    assert b"python" in said
    assert (b"\x1b" in said) == coloured


def test_the_version_is_told() -> None:
    """`cosim --version` names program and version."""
    done = run_here("--version")
    assert (done.status, done.stdout.strip()) == (0, f"cosim, version {__version__}")


def test_output_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    """A full disk under stdout is one sentence and status 2; a pipe that nobody reads ends as by SIGPIPE."""
    here = {
        "cwd": tmp_path,
        "env": environment(),
        "timeout": DEADLINE,
        "stderr": subprocess.PIPE,
        "text": True,
    }
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command("--version"), check=False, stdout=full, **here)
    assert (done.returncode, done.stderr) == (
        2, "cosim: the output cannot be written: No space left on device\n",
    )  # fmt: skip
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as unread:
        done = subprocess.run(command("--version"), check=False, stdout=unread, **here)
    assert (done.returncode, done.stderr) == (141, "")


def test_letters_that_a_terminal_lacks_are_no_fault(tmp_path: Path) -> None:
    """Output in Latin 1, which has no Greek letters: written in another way."""
    done = subprocess.run(
        command("train", "--explain"), check=False, capture_output=True, cwd=tmp_path, timeout=DEADLINE,
        env=environment() | {"PYTHONIOENCODING": "latin-1"},
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"\\u0394" in done.stdout


def test_help_waits_for_no_heavy_import(tmp_path: Path) -> None:
    """`cosim --help` loads neither numpy nor anything that takes as long."""
    heavy = "{'numpy', 'numba', 'rich', 'vedo'}"
    code = f"import sys; from cosim.cli import cosim; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd=tmp_path,
        timeout=DEADLINE, env=environment(),
    )  # fmt: skip
    assert done.stdout.strip() == "[]"


def test_an_unknown_command_is_bad_usage(tmp_path: Path) -> None:
    """Usage errors exit with 2 and name what was not understood."""
    done = run_cosim("fly", cwd=tmp_path)
    assert done.status == 2
    assert "fly" in done.stderr


def test_bench_reports_every_figure(tmp_path: Path) -> None:
    """`cosim bench --json` prints one object with the promised keys, all of them positive times and ratios."""
    done = run_cosim("bench", "--json", "--quick", cwd=tmp_path)
    assert done.status == 0, done.stderr
    assert len(done.stdout.splitlines()) == 1
    report = done.report
    assert set(report["round_trip"]) == ROUND_TRIPS
    for row in report["round_trip"].values():
        assert set(row) == QUANTILES
        assert 0.0 < row["p50_us"] <= row["p99_us"] <= row["p999_us"]
    assert set(report["loop"]["phases_us"]) == PHASES
    assert report["loop"]["steps_per_second"] > 0.0
    assert report["loop"]["ratio_to_limit"] > 0.0
    assert report["startup_s"] > 0.0
