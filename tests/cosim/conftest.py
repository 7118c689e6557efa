"""Flights as a user starts them: `cosim launch` as a subprocess, each with a session name of its own."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from flights import Done, leftovers, run_cosim


@pytest.fixture
def session_name() -> Iterator[str]:
    """A name that no other session has; nothing under it may be left at the end."""
    name = f"test-{uuid.uuid4().hex[:12]}"
    yield name
    assert leftovers(name) == []


@pytest.fixture
def fly(tmp_path: Path, session_name: str) -> Callable[..., Done]:
    """`cosim launch --json` into a folder of the test, with more arguments."""

    def launch(*arguments: str, out: str = "run") -> Done:
        return run_cosim(
            "launch",
            "--json",
            "--session",
            session_name,
            "--out",
            str(tmp_path / out),
            *arguments,
            cwd=tmp_path,
        )

    return launch


@pytest.fixture(scope="session")
def conduit_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Done, Path]:
    """One flight of the shipped policy through the shipped conduit, and its folder."""
    folder = tmp_path_factory.mktemp("conduit")
    done = run_cosim("launch", "--json", "--out", str(folder / "run"), cwd=folder)
    return done, folder / "run"
