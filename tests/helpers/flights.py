"""Running `cosim` as a user does: as a subprocess, with a deadline."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from click.testing import CliRunner

from cosim.cli import cosim
from cosim.errors import exit_status

ROOT = Path(__file__).resolve().parents[2]
DEADLINE = 240.0
"""Seconds after which a subprocess of a test is given up: compiling may be part of it."""


@dataclass(frozen=True)
class Done:
    """How a command ended."""

    status: int
    stdout: str
    stderr: str

    @property
    def report(self) -> dict[str, Any]:
        """The object that --json prints as the last line of stdout."""
        return dict(json.loads(self.stdout.splitlines()[-1]))


def command(*arguments: str) -> list[str]:
    """The command line of `cosim` with these arguments."""
    return [sys.executable, "-m", "cosim", *arguments]


def environment() -> dict[str, str]:
    """Our environment, with the project importable from wherever the command runs."""
    return os.environ | {"PYTHONPATH": str(ROOT)}


def run_cosim(*arguments: str, cwd: Path) -> Done:
    """Run `cosim` to its end."""
    done = subprocess.run(
        command(*arguments),
        check=False,
        capture_output=True,
        text=True,
        cwd=cwd,
        env=environment(),
        timeout=DEADLINE,
    )
    return Done(done.returncode, done.stdout, done.stderr)


def run_here(*arguments: str) -> Done:
    """Run `cosim` in this process, for what starts no other: its status and all that it says."""
    result = CliRunner().invoke(cosim, arguments)
    error = result.exception
    if error is None or isinstance(error, SystemExit):
        return Done(result.exit_code, result.stdout, result.stderr)
    status = exit_status(error)
    if status is None:
        raise error
    return Done(status, result.stdout, f"{result.stderr}cosim: {error}\n")


def leftovers(session: str) -> list[str]:
    """Shared memory whose name contains that of the session."""
    return [path.name for path in Path("/dev/shm").iterdir() if session in path.name]


def manifest_of(folder: Path) -> dict[str, Any]:
    """The manifest of a run."""
    return dict(json.loads((folder / "manifest.json").read_text()))


def gone(pid: int) -> bool:
    """Whether a process has ended (a zombie has)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] in "ZX"
    except FileNotFoundError:
        return True


def wait_until(holds: Callable[[], object]) -> None:
    """Poll until something holds, or fail at the deadline."""
    deadline = time.monotonic() + DEADLINE
    while not holds():
        assert time.monotonic() < deadline, "deadline passed"
        time.sleep(0.02)
