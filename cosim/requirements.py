"""The libraries that this project needs, read from its own description, and which of them are installed."""

from __future__ import annotations

import re
import shutil
import sys
import tomllib
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Final

DISTRIBUTION: Final = "tube-cosim"
_PROJECT: Final = Path(__file__).resolve().parents[1] / "pyproject.toml"
_REQUIREMENT: Final = re.compile(r"(?P<name>[\w.-]+)\s*(?:>=\s*(?P<minimum>[\d.]+))?")
_EXTRA: Final = re.compile(r"extra\s*==\s*['\"]([\w.-]+)['\"]")


@dataclass(frozen=True)
class Requirement:
    """One library, and what is there of it."""

    name: str
    minimum: str
    """Oldest version that will do; empty where any will."""
    installed: str | None
    """The version that is installed; None where it is not."""

    @property
    def complaint(self) -> str:
        """What is wrong with it; empty where nothing is."""
        if self.installed is None:
            return f"no {self.name}"
        if _numbers(self.installed) < _numbers(self.minimum):
            return f"{self.name} {self.installed}, expected {self.minimum} or later"
        return ""


def read_requirements(*, with_dev: bool) -> dict[str, tuple[Requirement, ...]]:
    """Requirements by extra, the name of those that are always needed being "".

    From the project's file in a checkout, and from what the installer noted elsewhere. `with_dev` says whether those
    that only the tests need are of interest.

    Raises:
        importlib.metadata.PackageNotFoundError: neither is there.
    """
    found: dict[str, list[Requirement]] = {"": []}
    if is_checkout():
        project = tomllib.loads(_PROJECT.read_text(encoding="utf-8"))["project"]
        lines = {"": project["dependencies"], **project["optional-dependencies"]}
        found = {extra: [_look_up(line) for line in needed] for extra, needed in lines.items()}
    else:
        for line in metadata.requires(DISTRIBUTION) or ():
            extra = _EXTRA.search(line)
            found.setdefault(extra.group(1) if extra else "", []).append(_look_up(line))
    return {extra: tuple(needed) for extra, needed in found.items() if with_dev or extra != "dev"}


def is_checkout() -> bool:
    """Whether the project runs out of its own folder, and not as it was installed elsewhere."""
    return _PROJECT.is_file() and f'name = "{DISTRIBUTION}"' in _PROJECT.read_text(encoding="utf-8")


def install_command(extra: str = "") -> str:
    """The command that installs the project where it runs, with one of its extras if one is named.

    The `pip` that a shell finds may belong to another Python, where `.venv/bin/cosim` was called by its path.
    """
    ours = Path(sys.executable)
    found = shutil.which("pip")
    pip = "pip" if found is not None and Path(found).parent == ours.parent else f"{_from_here(ours)} -m pip"
    target = f"--editable '{_from_here(_PROJECT.parent)}" if is_checkout() else f"'{DISTRIBUTION}"
    return f"{pip} install {target}{f'[{extra}]' if extra else ''}'"


def _from_here(path: Path) -> Path:
    """A path as it is shortest written in the working directory."""
    try:
        return path.relative_to(Path.cwd())
    except (OSError, ValueError):  # elsewhere, or a working directory that is gone
        return path


def _look_up(line: str) -> Requirement:
    match = _REQUIREMENT.match(line)
    assert match is not None  # the project's own description
    try:
        installed = metadata.version(match["name"])
    except metadata.PackageNotFoundError:
        installed = None
    return Requirement(match["name"], match["minimum"] or "", installed)


def _numbers(version: str) -> tuple[int, ...]:
    """Return the leading numbers of a version, so that versions compare: 2.10.0rc1 is (2, 10, 0)."""
    match = re.match(r"\d+(\.\d+)*", version)
    return tuple(map(int, match.group().split("."))) if match else ()
