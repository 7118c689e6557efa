"""Other systems and processors, as far as this one can stand in for them.

Fences are called where they must be: what becomes visible at a fence alone is read, and what is published at one is
whole. Windows' calls are stand-ins with the documented behaviour; of macOS the missing parts are taken away here.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import importlib
import logging
import os
import platform
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from protocol import agent, handshake, layout, liveness, memory, physics, waiting
from protocol.agent import AgentSession, SessionSettings
from protocol.errors import SessionError
from protocol.handshake import Answer, read_farewell, read_offer, write_answer, write_farewell
from protocol.layout import COMMAND, POSE, Farewell
from protocol.liveness import Life, life, start_time
from protocol.memory import create_segment, open_segment, parse_rendezvous
from protocol.physics import PhysicsSession, serve
from protocol.plant import CommandBatch, ResetBatch
from protocol.toy import ToyPlant
from protocol.twin import open_twin

SETTINGS = SessionSettings(1, 0.1, 0.1)
Resets = Callable[..., ResetBatch]
Commands = Callable[..., CommandBatch]


# ---------------------------------------------------------------------------------------------------------------
# Fences


@pytest.mark.parametrize("machine", ["x86_64", "AMD64", "i686"])
def test_x86_needs_no_fence(machine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A processor that keeps the order of stores is not slowed down."""
    monkeypatch.setattr(platform, "machine", lambda: machine)
    assert memory._find_fence() is None


@pytest.mark.parametrize(
    ("system", "machine", "call"),
    [
        ("linux", "aarch64", ("libatomic.so.1", "atomic_thread_fence", (5,))),
        ("linux", "riscv64", ("libatomic.so.1", "atomic_thread_fence", (5,))),
        ("darwin", "arm64", ("libSystem.dylib", "OSMemoryBarrier", ())),
        ("win32", "ARM64", ("kernel32.dll", "FlushProcessWriteBuffers", ())),
    ],
)
def test_other_processors_get_the_fence_of_their_system(
    system: str, machine: str, call: tuple[str, str, tuple[int, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sequentially consistent (5 of C11's memory orders), from the library that has it there."""
    calls = []

    class Library:
        def __init__(self, name: str) -> None:
            self.name = name

        def __getattr__(self, function: str) -> Callable[..., None]:
            return lambda *arguments: calls.append((self.name, function, arguments))

    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(ctypes, "CDLL", Library)
    fence = memory._find_fence()
    assert fence is not None
    fence()
    assert calls == [call]


def test_the_fence_of_this_system_can_be_called(monkeypatch: pytest.MonkeyPatch) -> None:
    """The name that is looked for on Linux is one that its libatomic has."""
    try:
        ctypes.CDLL("libatomic.so.1")
    except OSError:
        pytest.skip("libatomic is not installed: apt-get install libatomic1")
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    fence = memory._find_fence()
    assert fence is not None
    fence()


def test_without_a_fence_no_session_is_opened(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the processor reorders and nothing stops it, opening says so and leaves nothing; importing works."""

    def no_library(name: str) -> None:
        raise OSError(errno.ENOENT, name)

    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    monkeypatch.setattr(ctypes, "CDLL", no_library)
    monkeypatch.setattr(handshake, "FENCE", memory._find_fence())
    with pytest.raises(
        SessionError, match=r"aarch64\) reorders stores .* expected atomic_thread_fence in libatomic"
    ):
        AgentSession.open(f"shm:{name}", SETTINGS, attach_timeout=5.0)


def test_everything_is_written_before_the_fence_and_the_doorbell_behind_it(
    monkeypatch: pytest.MonkeyPatch, resets: Resets, commands: Commands
) -> None:
    """One step: both fences of either side, in turn, and what stands in the segments at each."""
    with open_twin(ToyPlant(), SETTINGS) as session:
        session.reset(resets())
        command, pose, sent = session._command, session._pose, commands(speed=3.0)
        before = bytes(pose[layout.pose_rows(1)])
        notes: list[tuple[str, list[int], list[int], bool, bool]] = []

        def note(who: str) -> Callable[[], None]:
            def fence() -> None:
                notes.append(
                    (
                        who,
                        [layout.read_i64(command, COMMAND[name]) for name in ("begin", "end", "doorbell")],
                        [layout.read_i64(pose, POSE[name]) for name in ("begin", "end", "doorbell")],
                        bytes(command[layout.command_rows(1)]) == sent.raw.tobytes(),
                        bytes(pose[layout.pose_rows(1)]) != before,
                    )
                )

            return fence

        monkeypatch.setattr(agent, "FENCE", note("agent"))
        monkeypatch.setattr(physics, "FENCE", note("physics"))
        session.step(sent)
        monkeypatch.undo()
    assert notes == [
        ("agent", [2, 2, 1], [1, 1, 1], True, False),
        ("physics", [2, 2, 2], [1, 1, 1], True, False),
        ("physics", [2, 2, 2], [2, 2, 1], True, True),
        ("agent", [2, 2, 2], [2, 2, 2], True, True),
    ]


def test_physics_reads_a_request_behind_the_fence(monkeypatch: pytest.MonkeyPatch, resets: Resets) -> None:
    """A doorbell that is seen before the words it stands for: they are read after the fence, which brings them."""
    command = memoryview(bytearray(layout.command_bytes(1)))
    pose = memoryview(bytearray(layout.pose_bytes(1)))
    AgentSession(command, pose, SETTINGS)
    session = PhysicsSession(command.toreadonly(), pose, ToyPlant())
    layout.write_i64(command, COMMAND["doorbell"], 1)

    def arrive() -> None:
        command[layout.reset_rows(1)] = resets(mass=2.0).raw.tobytes()
        layout.REQUEST.pack_into(command, COMMAND["begin"].offset, 1, 2, 0, 1)

    monkeypatch.setattr(physics, "FENCE", arrive)
    assert session.answer(1)
    assert layout.REPLY.unpack_from(pose, POSE["begin"].offset)[:3] == (1, 0, 0)
    assert session._resets.parameters[0, 0] == 2.0


def test_the_agent_reads_a_reply_behind_the_fence(
    monkeypatch: pytest.MonkeyPatch, commands: Commands
) -> None:
    """The same on the other side: poses and words that arrive with the fence are those that are taken."""
    command = memoryview(bytearray(layout.command_bytes(1)))
    pose = memoryview(bytearray(layout.pose_bytes(1)))
    session = AgentSession(command, pose, SETTINGS)
    write_answer(pose, read_offer(command), Answer(ToyPlant().describe(), 1, 0))
    rung = []

    def arrive() -> None:
        if rung:
            struct.pack_into("<5q", pose, POSE["begin"].offset, 1, 0, 1, 7, 1)
            struct.pack_into("<3d", pose, layout.pose_rows(1).start, 1.0, 2.0, 3.0)

    def ring(old: int, step: int, phase: str) -> int:
        rung.append(old + 1)
        return old + 1

    monkeypatch.setattr(agent, "FENCE", arrive)
    session.attached(ring)
    assert session.step(commands()).position.tolist() == [[1.0, 2.0, 3.0]]


def test_headers_and_farewells_are_read_behind_the_fence(monkeypatch: pytest.MonkeyPatch) -> None:
    """A magic or a farewell that is seen before what it stands for."""
    whole, other = (memoryview(bytearray(layout.command_bytes(1))) for _ in range(2))
    AgentSession(whole, memoryview(bytearray(layout.pose_bytes(1))), SETTINGS)
    write_farewell(whole, Farewell.FAILED, "the engine stopped")

    def arrive() -> None:
        other[:] = whole

    monkeypatch.setattr(handshake, "FENCE", arrive)
    other[:8] = whole[:8]
    assert handshake.magic(other) == b"TUBE.CMD"
    assert read_offer(other).settings == SETTINGS
    other[COMMAND["farewell_text"].bytes] = bytes(1016)
    assert read_farewell(other) == (Farewell.FAILED, "the engine stopped")


def test_magic_and_farewell_are_written_behind_the_fence(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the fence the header and the text stand, and the words that publish them do not."""
    command = memoryview(bytearray(layout.command_bytes(1)))
    pose = memoryview(bytearray(layout.pose_bytes(1)))
    seen: list[list[tuple[bytes, bool]]] = []

    def note() -> None:
        seen.append([(bytes(view[:8]).strip(b"\0"), any(view[16:])) for view in (command, pose)])

    monkeypatch.setattr(handshake, "FENCE", note)
    session = AgentSession(command, pose, SETTINGS)
    assert seen == [[(b"", True), (b"", False)]]
    write_answer(pose, session._offer, Answer(ToyPlant().describe(), 1, 0))
    assert seen[1:] == [[(b"TUBE.CMD", True), (b"", True)]]
    told = []
    monkeypatch.setattr(
        handshake, "FENCE", lambda: told.append((bytes(command[1024:1032]), bytes(command[1032:1036])))
    )
    write_farewell(command, Farewell.STOPPED, "done")
    assert told == [(bytes(8), b"done")]


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
