"""The import arrows and folders of the house, kept true."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("protocol", "meshes", "physics_server", "agent_client", "cosim")

MAY_IMPORT = {
    "protocol": set[str](),
    "meshes": set[str](),
    "physics_server": {"protocol", "meshes"},
    "agent_client": {"protocol", "meshes"},
    "cosim": {"protocol", "meshes", "physics_server", "agent_client"},
}
"""Who may import whom among our own packages."""

ONE_IMPORTER = {
    "pybullet": "physics_server",
    "multiprocessing.shared_memory": "protocol",
    "embreex": "meshes",
    "vedo": "cosim",
    "pyarrow": "cosim",
}
"""Heavy or delicate modules that exactly one file of one package imports."""

LEARNING_FILES = {
    "agent_client/environment.py",
    "agent_client/gym_env.py",
    "agent_client/imitation.py",
    "agent_client/training.py",
    "agent_client/training_state.py",
    "agent_client/sb3_policy.py",
    "cosim/gym.py",  # registers the ids, which is all that it does
}
"""The only files that import torch, stable-baselines3 or gymnasium."""


def imported_modules(path: Path) -> Iterator[str]:
    """Dotted names of all modules that a file imports, at the top or inside of functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def files_of(package: str) -> list[Path]:
    """All Python files of a package but authoring scripts that run in Blender's own environment."""
    return [path for path in sorted((ROOT / package).rglob("*.py")) if path.name != "author.py"]


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_imports_only_what_the_arrows_allow(package: str) -> None:
    """No file of a package imports one of ours that the map does not allow."""
    allowed = MAY_IMPORT[package] | {package}
    for path in files_of(package):
        for name in imported_modules(path):
            top = name.split(".")[0]
            assert top not in PACKAGES or top in allowed, f"{path.relative_to(ROOT)} imports {name}"


@pytest.mark.parametrize(("module", "package"), ONE_IMPORTER.items())
def test_a_heavy_library_has_one_importer(module: str, package: str) -> None:
    """Heavy libraries enter through at most one file, in the package that is their home."""
    importers = [
        path
        for name in PACKAGES
        for path in files_of(name)
        if any(f"{found}.".startswith(f"{module}.") for found in imported_modules(path))
    ]
    assert len(importers) <= 1, f"{module} is imported by {importers}"
    assert all(path.is_relative_to(ROOT / package) for path in importers)


def test_learning_libraries_stay_in_the_learning_files() -> None:
    """Torch, stable-baselines3 and gymnasium are imported by the learning files alone."""
    for package in PACKAGES:
        for path in files_of(package):
            tops = {name.split(".")[0] for name in imported_modules(path)}
            if tops & {"torch", "stable_baselines3", "gymnasium"}:
                assert path.relative_to(ROOT).as_posix() in LEARNING_FILES, path


def test_protocol_needs_the_standard_library_and_numpy_alone() -> None:
    """The protocol package works with nothing installed but numpy; one file of it may use numba."""
    for path in files_of("protocol"):
        allowed = {"numpy", "protocol"}
        if path == ROOT / "protocol/compiled.py":
            allowed |= {"numba", "llvmlite"}
        for name in imported_modules(path):
            top = name.split(".")[0]
            assert top in sys.stdlib_module_names or top in allowed, f"{path} imports {name}"


def test_importing_the_sessions_loads_no_compiler() -> None:
    """The file with the machine code is imported when a session asks for it, and not before."""
    code = (
        "import sys, protocol.agent, protocol.physics, protocol.twin\n"
        "print({'numba', 'llvmlite'} & set(sys.modules))"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT, timeout=60)
    assert done.stdout.strip() == "set()", done.stdout + done.stderr


def test_no_package_under_tests() -> None:
    """A package under tests/ would be imported in place of the project's own."""
    assert not list((ROOT / "tests").rglob("__init__.py"))


def test_launching_the_shipped_policy_imports_no_learning_library() -> None:
    """Nothing on the path of `cosim launch` imports torch, vedo or trimesh."""
    code = (
        "import sys, cosim.launch, agent_client.flight, agent_client.policy\n"
        "heavy = {'torch', 'stable_baselines3', 'gymnasium', 'vedo', 'trimesh', 'pybullet'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT, timeout=60)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr
