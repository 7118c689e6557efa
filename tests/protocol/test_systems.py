"""Other systems, as far as this one can stand in for them.

Windows' calls are stand-ins with the documented behaviour; of macOS the missing parts are taken away here.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import importlib
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from protocol import liveness, memory, waiting
from protocol.agent import AgentSession, SessionSettings
from protocol.errors import SessionError
from protocol.liveness import Life, life, start_time
from protocol.memory import create_segment, open_segment, parse_rendezvous
from protocol.physics import serve
from protocol.plant import CommandBatch, ResetBatch
from protocol.toy import ToyPlant

SETTINGS = SessionSettings(1, 0.1, 0.1)
Resets = Callable[..., ResetBatch]
Commands = Callable[..., CommandBatch]


# ---------------------------------------------------------------------------------------------------------------
# Windows


class StandIns:
    """What the two libraries of Windows do, by their documentation."""

    def __init__(self) -> None:
        self.processes: dict[int, tuple[bool, int]] = {}
        """Pid to whether it lives and when it was created."""
        self.forbidden: set[int] = set()
        """Pids of processes that may not be opened."""
        self.error = 0
        self.open_handles: list[int] = []

    def library(self, name: str, use_last_error: bool) -> SimpleNamespace:
        """kernel32, whose functions carry their types as ctypes' own do."""
        assert (name, use_last_error) == ("kernel32", True)
        names = {
            "OpenProcess": self._open,
            "WaitForSingleObject": self._wait,
            "GetProcessTimes": self._times,
            "CloseHandle": self._close,
        }
        return SimpleNamespace(**{key: _Function(call) for key, call in names.items()})

    def _open(self, access: int, inherit: bool, pid: int) -> int | None:
        assert access == 0x1000 | 0x100000  # PROCESS_QUERY_LIMITED_INFORMATION | SYNCHRONIZE
        if pid in self.forbidden or pid not in self.processes:
            self.error = 5 if pid in self.forbidden else 87  # ERROR_ACCESS_DENIED, ERROR_INVALID_PARAMETER
            return None
        self.open_handles.append(pid)
        return pid

    def _wait(self, handle: int, milliseconds: int) -> int:
        assert milliseconds == 0
        return 0x102 if self.processes[handle][0] else 0  # WAIT_TIMEOUT, WAIT_OBJECT_0

    def _times(self, handle: int, created: Any, *others: Any) -> int:
        created._obj.value = self.processes[handle][1]
        return 1

    def _close(self, handle: int) -> None:
        self.open_handles.remove(handle)


class _Function:
    """A foreign function: callable, with types that may be set."""

    def __init__(self, call: Callable[..., Any]) -> None:
        self._call = call
        self.argtypes: tuple[Any, ...] = ()
        self.restype: Any = None

    def __call__(self, *arguments: Any) -> Any:
        return self._call(*arguments)


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> Iterator[StandIns]:
    """This process as if it ran on Windows, as far as the protocol asks."""
    stand_ins = StandIns()
    stand_ins.processes[os.getpid()] = (True, 777)
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(ctypes, "WinDLL", stand_ins.library, raising=False)
    monkeypatch.setattr(ctypes, "get_last_error", lambda: stand_ins.error, raising=False)
    msvcrt = ModuleType("msvcrt")
    msvcrt.LK_NBLCK = 2  # type: ignore[attr-defined]
    msvcrt.locking = _lock_like_windows  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "msvcrt", msvcrt)
    monkeypatch.delitem(sys.modules, "protocol.windows", raising=False)
    module = importlib.import_module("protocol.windows")
    monkeypatch.setitem(sys.modules, "protocol.windows", module)
    monkeypatch.setattr("protocol.windows", module, raising=False)
    yield stand_ins
    assert stand_ins.open_handles == []


def _lock_like_windows(descriptor: int, mode: int, size: int) -> None:
    assert (mode, size, os.lseek(descriptor, 0, os.SEEK_CUR)) == (2, 1, 0)
    fcntl.lockf(
        descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB, 1
    )  # raises an OSError where it is taken, as that does


def test_life_of_a_process_on_windows(windows: StandIns) -> None:
    """Alive, ended and still held open, used again, another user's, unknown: by handle, never by a signal."""
    windows.processes |= {10: (True, 500), 11: (False, 500)}
    windows.forbidden.add(12)
    assert (start_time(10), start_time(13), start_time(12)) == (500, 0, 0)
    assert life(10, 500) is Life.RUNNING
    assert life(10, 0) is Life.RUNNING
    assert life(10, 499) is Life.DEAD
    assert life(11, 500) is Life.DEAD
    assert life(12, 500) is Life.RUNNING
    assert life(13, 500) is Life.DEAD
    assert life(2**40, 500) is Life.DEAD
    assert liveness.how_ended(13) == "its process is gone"


def test_a_session_over_files_on_windows(
    windows: StandIns, tmp_path: Path, resets: Resets, commands: Commands
) -> None:
    """The whole course, both sides in this process: handshake, steps, goodbye; the files go when they are closed."""
    fly_over(f"file:{tmp_path / 'session'}", resets(), commands())
    assert list(tmp_path.iterdir()) == []


def fly_over(rendezvous: str, resets: ResetBatch, commands: CommandBatch) -> None:
    """Serve in a thread, fly two steps here."""
    failures: list[BaseException] = []

    def physics_side() -> None:
        try:
            serve(rendezvous, ToyPlant(), attach_timeout=20.0)
        except BaseException as error:  # noqa: BLE001  it is looked at by the test
            failures.append(error)

    thread = threading.Thread(target=physics_side)
    thread.start()
    try:
        with AgentSession.open(rendezvous, SETTINGS, attach_timeout=20.0, reply_timeout=20.0) as session:
            session.reset(resets)
            assert [int(session.step(commands).step[0]) for _ in range(2)] == [1, 2]
    finally:
        thread.join(20.0)
    assert failures == []


def test_a_file_in_use_is_removed_when_its_other_users_are_gone(
    windows: StandIns, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Windows does not remove what is mapped: it is tried again for a while, and said if the file stays."""
    refusals = iter([PermissionError(errno.EACCES, "in use")] * 3)
    unlink = Path.unlink

    def busy(path: Path, missing_ok: bool = False) -> None:
        refusal = next(refusals, None)
        if refusal is not None:
            raise refusal
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", busy)
    segment = create_segment(parse_rendezvous(f"file:{tmp_path / 'a'}"), ".cmd", 8192)
    segment.unlink()
    assert [path.name for path in tmp_path.iterdir()] == ["a.cmd"]
    segment.close()
    assert list(tmp_path.iterdir()) == []

    monkeypatch.setattr(sys.modules["protocol.windows"], "REMOVAL_S", 0.0)
    refusals = iter([PermissionError(errno.EACCES, "in use")] * 100)
    segment = create_segment(parse_rendezvous(f"file:{tmp_path / 'b'}"), ".cmd", 8192)
    segment.unlink()
    with caplog.at_level(logging.WARNING, logger="protocol"):
        segment.close()
    assert "b.cmd stays behind: another process still maps it" in caplog.text


def test_a_newer_file_of_the_same_name_is_not_removed_on_windows(windows: StandIns, tmp_path: Path) -> None:
    """A name that stands for another file by now is left alone."""
    place = parse_rendezvous(f"file:{tmp_path / 'a'}")
    old = create_segment(place, ".cmd", 8192)
    (tmp_path / "a.cmd").unlink()
    create_segment(place, ".cmd", 8192).close()
    old.unlink()
    old.close()
    assert [path.name for path in tmp_path.iterdir()] == ["a.cmd"]


def test_files_are_locked_on_windows(windows: StandIns, tmp_path: Path) -> None:
    """Another process has byte 0: the claim is refused; it has it no more: the claim is granted."""
    path = tmp_path / "a.cmd"
    segment = create_segment(parse_rendezvous(f"file:{tmp_path / 'a'}"), ".cmd", 8192)
    holder = (
        "import fcntl, sys; f = open(sys.argv[1], 'r+b'); fcntl.lockf(f, fcntl.LOCK_EX, 1); "
        "print('held', flush=True); sys.stdin.read()"
    )
    sys.platform = "linux"  # for subprocess; the fixture restores it
    with subprocess.Popen(
        [sys.executable, "-c", holder, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        sys.platform = "win32"
        assert segment.lock() is False
        process.communicate(timeout=20)
    assert segment.lock() is True
    segment.close()


def test_shared_memory_is_claimed_by_a_name_on_windows(windows: StandIns, name: str) -> None:
    """There is no file to lock: a second name that exists already means that the segment is taken."""
    place = parse_rendezvous(f"shm:{name}")
    first = create_segment(place, ".pose", 8192)
    assert first.path is None
    second = open_segment(place, ".pose")
    assert second is not None
    assert (first.lock(), second.lock()) == (True, False)
    first.unlink()  # removes nothing: Windows does, with the last user
    first.close()
    second.close()
    assert {path.name for path in Path("/dev/shm").glob(f"{name}*")} == {f"{name}.pose", f"{name}.pose.lock"}
    for path in Path("/dev/shm").glob(f"{name}*"):
        path.unlink()


# ---------------------------------------------------------------------------------------------------------------
# macOS, and whatever else has neither /proc nor /dev/shm


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """This system without what macOS lacks."""
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setattr(liveness, "_HAS_PROC", False)
    monkeypatch.setattr(liveness, "_proc_stat", lambda pid: [])
    monkeypatch.setattr(memory, "SHM_FOLDER", tmp_path / "none")
    for function in ("posix_fallocate", "sched_yield", "waitid"):
        monkeypatch.delattr(os, function)


def test_a_session_over_files_on_a_bare_system(
    bare: None, tmp_path: Path, resets: Resets, commands: Commands
) -> None:
    """The whole course without reserved memory, start times, or a way to yield but a sleep of no length."""
    fly_over(f"file:{tmp_path / 'session'}", resets(), commands())
    assert list(tmp_path.iterdir()) == []


def test_shared_memory_is_not_offered_where_it_has_no_files(bare: None) -> None:
    """The refusal names the other transport."""
    with pytest.raises(SessionError, match=r"this system has no .*; use file:/path/stem"):
        parse_rendezvous("shm:name")


def test_life_of_a_process_by_its_pid_alone(bare: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without start times a pid that exists lives, also one that may not be signalled."""
    assert start_time(os.getpid()) == 0
    assert life(os.getpid(), 5) is Life.RUNNING
    assert life(2**22 + 1, 0) is Life.DEAD
    assert liveness.how_ended(2**22 + 1) == "its process is gone"

    def forbid(pid: int, number: int) -> None:
        raise PermissionError(errno.EPERM, "not permitted")

    monkeypatch.setattr(os, "kill", forbid)
    assert life(1, 0) is Life.RUNNING


def test_memory_is_reserved_by_writing_where_nothing_else_does_it(bare: None, tmp_path: Path) -> None:
    """The file has its size and its zeros, also where the system takes them in pieces; a full disk is an error."""
    written = []
    write = os.write

    def in_pieces(descriptor: int, data: memoryview) -> int:
        written.append(write(descriptor, data[:1000]))
        return written[-1]

    def full(descriptor: int, data: memoryview) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    place = parse_rendezvous(f"file:{tmp_path / 'a'}")
    os.write = in_pieces  # type: ignore[assignment]
    try:
        segment = create_segment(place, ".cmd", 8192)
        os.write = full  # type: ignore[assignment]
        with pytest.raises(SessionError, match=r"no room for segment .*expected 8192 free bytes"):
            create_segment(place, ".pose", 8192)
    finally:
        os.write = write
    assert sum(written) == len(segment.view) == 8192
    assert not any(segment.view)
    segment.unlink()
    segment.close()
    assert list(tmp_path.iterdir()) == []


def test_yielding_is_a_sleep_of_no_length_where_there_is_no_other(
    bare: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`time.sleep(0)` gives the rest of the time slice away there."""
    slept: list[float] = []
    monkeypatch.setattr(waiting.time, "sleep", slept.append)
    waiting.give_way()
    assert slept == [0]
