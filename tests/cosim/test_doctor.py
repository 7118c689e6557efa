"""`cosim doctor`: each check on machines that have and lack things, and what --clean may remove."""

from __future__ import annotations

import os
import re
import shutil
import time
import tomllib
from collections import namedtuple
from collections.abc import Callable
from pathlib import Path

import pytest
import stamped
from flights import ROOT, run_cosim, run_here

from cosim import doctor
from cosim.doctor import Check, Level
from cosim.requirements import Requirement, read_requirements
from protocol import leftovers
from protocol.leftovers import survey
from protocol.memory import Rendezvous

PATIENCE_S = 20.0

Usage = namedtuple("Usage", "total used free")


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for temporary files of the test's own; shared memory of others is out of sight."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(leftovers, "SHM_FOLDER", tmp_path / "no shared memory")
    return tmp_path


@pytest.fixture
def leave_dead_session(temporary: Path) -> Callable[[], Rendezvous]:
    """Make a session whose agent was killed before anybody attached."""

    def make() -> Rendezvous:
        place = Rendezvous("file", str(temporary / "dead"))
        with stamped.part("fly", place, 1):
            until(lambda: stamped.offered(place))
        return place

    return make


def until(holds: Callable[[], bool]) -> None:
    """Wait until something holds."""
    patience = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < patience, "it never came true"
        time.sleep(0.01)


def check_of(name: str, checks: list[Check]) -> Check:
    """The one check of a name."""
    (found,) = [check for check in checks if check.name == name]
    return found


def test_this_machine_can_fly(tmp_path: Path) -> None:
    """Where the tests run nothing fails: status 0, one line a check, and all of it on one screen."""
    done = run_cosim("doctor", cwd=tmp_path)
    assert done.status == 0
    lines = done.stdout.splitlines()
    assert len(lines) <= 40
    assert all(re.match(r"(ok|warn|fail) +|  +-> |\d+ in order, ", line) for line in lines)
    assert lines[-1].endswith(" 0 failed")


def test_json_has_the_same_checks(temporary: Path) -> None:
    """--json prints one object with every check: name, level, what was found, what to do."""
    done = run_here("doctor", "--json")
    assert done.report["ok"] is True
    names = [check["name"] for check in done.report["checks"]]
    assert {"python", "packages", "shared memory", "segments", "cores", "clock", "fence"} <= set(names)
    assert len(names) == len(set(names))
    for check in done.report["checks"]:
        assert set(check) == {"name", "level", "found", "advice"}
        assert check["level"] == "ok" or check["advice"]


def test_a_failed_check_is_status_1(monkeypatch: pytest.MonkeyPatch) -> None:
    """One failure is enough for status 1; the line under it says what to do."""
    monkeypatch.setattr(
        doctor, "look", lambda _: iter([Check("python", Level.FAIL, "2.7", "install another")])
    )
    done = run_here("doctor")
    assert done.status == 1
    assert done.stdout.splitlines()[:2] == ["fail python         2.7", f"{'':<20}-> install another"]


def test_clean_removes_the_dead_and_spares_the_living(
    temporary: Path, leave_dead_session: Callable[[], Rendezvous]
) -> None:
    """Leftovers are found and kept, then removed by --clean; a session that goes on and foreign files stay."""
    dead = leave_dead_session()
    live = Rendezvous("file", str(temporary / "live"))
    (temporary / "notes.cmd").write_bytes(b"somebody's notes")
    with stamped.part("serve", live), stamped.part("fly", live, 1) as agent:
        until(lambda: len(survey([temporary])) == 3)
        found = doctor.check_segments(clean=False)
        assert found.level is Level.WARN
        assert found.found.startswith(f"1 live session, {dead} (agent (pid ")
        assert "--clean" in found.advice
        assert Path(f"{dead.stem}.cmd").exists()
        assert doctor.check_segments(clean=True) == Check(
            "segments", Level.OK, "1 live session, 1 dead removed"
        )
        assert sorted(path.name for path in temporary.iterdir()) == ["live.cmd", "live.pose", "notes.cmd"]
        assert agent.poll() is None
        agent.kill()
        agent.wait()
        until(lambda: len(survey([temporary])) == 1)  # the physics process tidies up


def test_what_cannot_be_removed_is_named(
    leave_dead_session: Callable[[], Rendezvous], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A leftover that resists stays in the list, with the reason."""
    dead = leave_dead_session()
    monkeypatch.setattr("protocol.memory.Segment.lock", lambda _: False)
    check = doctor.check_segments(clean=True)
    assert check.level is Level.WARN
    assert f"{dead}: {dead.stem}.cmd was taken at this moment" in check.found


def test_forgotten_scratch_folders_are_removed_when_nobody_uses_them(temporary: Path) -> None:
    """Only folders of our names that are a day old, and in which no process has a file open, are removed."""
    old = time.time() - 2 * doctor.OLD_S
    names = [
        "cosim-train-abcd12_3",
        "cosim-verify-00000000",
        "cosim-mine",
        "cosim-train-young123",
        "other-abcd1234",
    ]
    for name in names:
        (temporary / name).mkdir()
        (temporary / name / "file").touch()
        if "young" not in name:
            os.utime(temporary / name, (old, old))
    with (temporary / "cosim-verify-00000000" / "file").open():
        found = doctor.check_scratch(temporary, clean=False)
        assert (found.level, found.found) == (
            Level.WARN,
            f"1 forgotten for more than a day: {temporary / 'cosim-train-abcd12_3'}",
        )
        cleaned = doctor.check_scratch(temporary, clean=True)
    assert (cleaned.level, cleaned.found) == (Level.OK, f"1 forgotten ones removed from {temporary}")
    assert sorted(path.name for path in temporary.iterdir()) == sorted(names[1:])


def test_every_scratch_folder_of_ours_is_known() -> None:
    """Whatever prefix the code gives to a temporary folder is one that the doctor looks for."""
    prefixes = {
        prefix
        for package in ("cosim", "protocol", "agent_client", "physics_server", "meshes")
        for path in (ROOT / package).rglob("*.py")
        for prefix in re.findall(
            r"(?:mkdtemp|TemporaryDirectory|scratch_folder)\(\s*(?:prefix=)?\"([^\"]+)\"", path.read_text()
        )
    }
    assert len(prefixes) > 5
    assert [prefix for prefix in prefixes if not doctor.SCRATCH.fullmatch(f"{prefix}abcd_123")] == []


def test_missing_and_old_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    """A needed library that is missing or too old fails, an optional one warns; both say what to install."""
    needed = (Requirement("numpy", "2.0", "1.26.4"), Requirement("click", "8.1", "8.10.0"))
    extra = (Requirement("torch", "2.6", None), Requirement("vedo", "", "2024.5"))
    failed, warned = doctor.check_packages({"": needed, "train": extra})
    assert (failed.level, failed.found) == (Level.FAIL, "numpy 1.26.4, expected 2.0 or later")
    assert (warned.level, warned.found) == (Level.WARN, "no torch")
    assert "[train]" in warned.advice


def test_requirements_are_those_of_the_project() -> None:
    """Every requirement of the project's description is looked up, by extra."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    found = read_requirements(with_dev=True)
    assert {extra: len(needed) for extra, needed in found.items()} == {
        "": len(project["dependencies"]),
        **{extra: len(lines) for extra, lines in project["optional-dependencies"].items()},
    }
    numpy = next(requirement for requirement in found[""] if requirement.name == "numpy")
    assert (numpy.minimum, numpy.complaint) == ("2.0", "")
    assert "dev" not in read_requirements(with_dev=False)


@pytest.mark.parametrize(
    ("total", "free", "level", "word"),
    [
        (64 * 2**20, 60 * 2**20, Level.OK, "small, as containers have it"),
        (64 * 2**20, 100_000, Level.WARN, "256 lanes"),
        (64 * 2**20, 5_000, Level.FAIL, "1 lane"),
        (2**34, 2**33, Level.OK, "8.6 GB free of 17.2 GB"),
    ],
)
def test_room_in_shared_memory(
    monkeypatch: pytest.MonkeyPatch, total: int, free: int, level: Level, word: str
) -> None:
    """Too little for one lane fails, too little for 256 warns, a container's 64 MB is enough and is said."""
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(total, total - free, free))
    check = doctor.check_shared_memory()
    assert (check.level, word in check.found) == (level, True)
    assert (level is Level.OK) or "--shm-size" in check.advice


def test_one_core_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that is bound to one core is told what that means."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        check = doctor.check_cores()
    finally:
        os.sched_setaffinity(0, before)
    assert check.level is Level.WARN
    assert check.found == f"1 usable of {os.cpu_count()}"
    assert "take turns" in check.advice


def test_a_coarse_clock_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock of 16 ms warns."""
    monkeypatch.setattr(time, "perf_counter_ns", iter(n // 100 * 16_000_000 for n in range(1000)).__next__)
    check = doctor.check_clock()
    assert (check.level, "seen to tick in 16000000 ns" in check.found) == (Level.WARN, True)


def test_a_wish_that_no_session_knows_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """A misspelt way of exchange is found before a session refuses it."""
    monkeypatch.setenv("PROTOCOL_EXCHANGE", "fast")
    assert doctor.check_exchange().level is Level.FAIL
    monkeypatch.setenv("PROTOCOL_EXCHANGE", "stdlib")
    assert doctor.check_exchange() == Check(
        "exchange", Level.OK, "the standard library (PROTOCOL_EXCHANGE=stdlib)"
    )


def test_missing_programs_name_their_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without Mono, compiler, spin and display there are warnings, each with what to install."""
    monkeypatch.setattr(shutil, "which", lambda _: None)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    checks = list(doctor.check_programs())
    assert [check.level for check in checks] == [Level.WARN] * 4
    assert check_of("C# (Mono)", checks).found == "no mcs, no mono"
    assert all("apt-get install" in check.advice for check in checks)


def test_a_display_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Either kind of display will do."""
    assert doctor.check_display({"WAYLAND_DISPLAY": "wayland-0"}).level is Level.OK
    assert doctor.check_display({"DISPLAY": ":1"}).found == "DISPLAY=:1"
