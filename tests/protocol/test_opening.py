"""How sessions come to be: names, stale and foreign segments, second clients, full memory, either side first."""

from __future__ import annotations

import errno
import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from protocol import layout
from protocol.agent import AgentSession, SessionSettings
from protocol.errors import HandshakeError, PeerLost, SessionError, Verdict
from protocol.layout import COMMAND, POSE
from protocol.memory import Segments, create_segment, open_segment, parse_rendezvous
from protocol.opening import attach_segments, create_segments
from protocol.physics import serve
from protocol.plant import CommandBatch, ResetBatch
from protocol.toy import ToyPlant

SETTINGS = SessionSettings(1, 0.1, 0.1)
DEAD_PID = 2**22 + 1  # beyond the kernel's largest pid

Start = Callable[..., subprocess.Popen[str]]


@pytest.mark.parametrize(
    "text",
    ["", "shm", "shm:", "shm:.hidden", "shm:a/b", "shm:a b", f"shm:{'x' * 65}", "file:", "file:relative/stem",
     "file:/no/such/folder/stem", "tcp:host"],
)  # fmt: skip
def test_a_bad_rendezvous_is_refused(text: str) -> None:
    """A rendezvous that cannot be one is refused with what was expected."""
    with pytest.raises(SessionError, match="rendezvous"):
        parse_rendezvous(text)


def leave_stale(rendezvous: str, pid: int, started: int = 0, magic: bytes = b"TUBE.CMD") -> None:
    """Leave segments behind as an agent does that was killed."""
    place = parse_rendezvous(rendezvous)
    for suffix, size in ((".cmd", layout.command_bytes(1)), (".pose", layout.pose_bytes(1))):
        segment = create_segment(place, suffix, size)
        layout.write_i64(segment.view, COMMAND["pid"], pid if suffix == ".cmd" else 0)
        layout.write_i64(segment.view, COMMAND["start_time"], started)
        if suffix == ".cmd":
            segment.view[:8] = magic
        segment.close()


def remove(segments: Segments) -> None:
    """Remove and unmap."""
    segments.unlink()
    segments.close()


def clear(rendezvous: str) -> None:
    """Remove segments that a test left on purpose."""
    for suffix in (".cmd", ".pose"):
        segment = open_segment(parse_rendezvous(rendezvous), suffix)
        if segment is not None:
            segment.unlink()
            segment.close()


@pytest.mark.parametrize("magic", [b"TUBE.CMD", bytes(8)])
def test_segments_of_a_dead_agent_are_replaced(
    rendezvous: str, caplog: pytest.LogCaptureFixture, magic: bytes
) -> None:
    """Stale segments, finished or not, give way to new ones, and the log says so."""
    leave_stale(rendezvous, DEAD_PID, magic=magic)
    with caplog.at_level(logging.WARNING, logger="protocol"):
        segments = create_segments(parse_rendezvous(rendezvous), 2)
    assert len(segments.command.view) == layout.command_bytes(2)
    assert not any(segments.command.view)
    assert [record.getMessage() for record in caplog.records if "stale" in record.getMessage()]
    remove(segments)


def test_a_pid_that_is_used_again_does_not_keep_a_session_alive(rendezvous: str) -> None:
    """Segments whose pid lives, but was started at another time, are stale."""
    leave_stale(rendezvous, os.getpid(), started=1)
    remove(create_segments(parse_rendezvous(rendezvous), 1))


def test_a_live_agents_name_is_refused(rendezvous: str) -> None:
    """The name of a session whose agent lives is refused with its pid, and that session is not touched."""
    segments = create_segments(parse_rendezvous(rendezvous), 1)
    AgentSession(segments.command.view, segments.pose.view, SETTINGS).close()
    with pytest.raises(SessionError, match=rf"agent \(pid {os.getpid()}\) is alive"):
        create_segments(parse_rendezvous(rendezvous), 1)
    again = open_segment(parse_rendezvous(rendezvous), ".cmd")
    assert again is not None
    again.close()
    remove(segments)


def test_a_lock_alone_keeps_a_session_alive(rendezvous: str) -> None:
    """A segment that another process has locked is in use, whatever its header says."""
    leave_stale(rendezvous, DEAD_PID)
    holder = (
        "import sys; from protocol.memory import *; s = open_segment(parse_rendezvous(sys.argv[1]), '.cmd'); "
        "print(s.lock(), flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", holder, rendezvous]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "True\n"
        with pytest.raises(SessionError, match="alive"):
            create_segments(parse_rendezvous(rendezvous), 1)
        process.communicate(timeout=20)
    remove(create_segments(parse_rendezvous(rendezvous), 1))


def test_foreign_segments_are_left_alone(rendezvous: str) -> None:
    """Something of that name that is no session's segment is never removed."""
    leave_stale(rendezvous, DEAD_PID, magic=b"precious")
    with pytest.raises(SessionError, match="no session's segment"):
        create_segments(parse_rendezvous(rendezvous), 1)
    with pytest.raises(HandshakeError, match=r"magic of the command segment: expected b'TUBE.CMD', found"):
        serve(rendezvous, ToyPlant(), attach_timeout=5.0)
    clear(rendezvous)


def test_a_full_memory_is_an_error_with_numbers(rendezvous: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """No room is said with what was expected and what is free; nothing stays behind."""

    def full(descriptor: int, offset: int, size: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(
        SessionError, match=r"no room for segment .*: expected \d+ free bytes in .*, found \d+"
    ):
        AgentSession.open(rendezvous, SETTINGS)


def test_a_folder_that_cannot_be_written_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the system says about the folder is passed on."""

    def refuse(*arguments: object) -> int:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(SessionError, match=r"cannot create segment .*Permission denied"):
        AgentSession.open(f"file:{tmp_path / 'stem'}", SETTINGS)


def test_physics_may_come_first(rendezvous: str, start: Start, resets: Callable[..., ResetBatch]) -> None:
    """A physics process that was started before the agent waits for the session."""
    server = start("serve", rendezvous)
    time.sleep(0.5)
    with AgentSession.open(rendezvous, SETTINGS, attach_timeout=20.0) as session:
        session.reset(resets())
    assert server.wait(20) == 0


def test_physics_waits_for_a_header_that_is_being_written(rendezvous: str) -> None:
    """Neither an empty segment nor one without its magic is taken for a session."""
    place = parse_rendezvous(rendezvous)
    segments = create_segments(place, 1)

    def finish() -> None:
        time.sleep(0.2)
        AgentSession(segments.command.view, segments.pose.view, SETTINGS)

    began = time.monotonic()
    thread = threading.Thread(target=finish)
    thread.start()
    attached = attach_segments(place, 10.0)
    assert time.monotonic() - began >= 0.2
    thread.join()
    attached.close()
    segments.unlink()


@pytest.mark.parametrize("magic", [b"TUBE.CMD", bytes(8)])
def test_physics_removes_stale_segments_and_waits_on(
    rendezvous: str,
    magic: bytes,
    start: Start,
    resets: Callable[..., ResetBatch],
    commands: Callable[..., CommandBatch],
    eventually: Callable[[Callable[[], bool]], None],
) -> None:
    """A physics process that finds the segments of a dead agent removes them and waits for a new one."""
    leave_stale(rendezvous, DEAD_PID, magic=magic)
    server = start("serve", rendezvous)
    kind, _, stem = rendezvous.partition(":")
    place = Path("/dev/shm") / stem if kind == "shm" else Path(stem)
    eventually(lambda: not list(place.parent.glob(f"{place.name}*")))
    with AgentSession.open(rendezvous, SETTINGS, attach_timeout=20.0) as session:
        session.reset(resets())
        assert session.step(commands()).step[0] == 1
    assert server.wait(20) == 0


def test_physics_gives_up_when_no_agent_comes(rendezvous: str) -> None:
    """Without a session in time physics says who is missing, where and for how long."""
    with pytest.raises(
        PeerLost, match=r"no session at .* within 0.1 s, found nothing of that name"
    ) as caught:
        serve(rendezvous, ToyPlant(), attach_timeout=0.1)
    assert (caught.value.verdict, caught.value.phase) == (Verdict.TOO_SLOW, "attach")
    leave_stale(rendezvous, DEAD_PID)
    with pytest.raises(PeerLost, match=r"stale segments of a dead agent"):
        serve(rendezvous, ToyPlant(), attach_timeout=0.1)


def test_physics_waits_for_a_segment_that_is_still_too_short(rendezvous: str) -> None:
    """A file that has not the bytes of a header yet is no error and is not removed."""
    segment = create_segment(parse_rendezvous(rendezvous), ".cmd", 100)
    with pytest.raises(PeerLost, match=r"within 0.6 s, found a file too short for a segment"):
        serve(rendezvous, ToyPlant(), attach_timeout=0.6)
    assert segment.path is not None
    assert segment.path.exists()
    segment.unlink()
    segment.close()


def test_the_agent_gives_up_when_nobody_attaches(rendezvous: str) -> None:
    """Without a physics process in time the agent says so and leaves nothing."""
    with pytest.raises(PeerLost, match=r"nobody attached to .* within 0.1 s") as caught:
        AgentSession.open(rendezvous, SETTINGS, attach_timeout=0.1)
    assert (caught.value.verdict, caught.value.phase) == (Verdict.TOO_SLOW, "attach")


def test_a_second_physics_process_is_turned_away(
    rendezvous: str, start: Start, resets: Callable[..., ResetBatch], commands: Callable[..., CommandBatch]
) -> None:
    """The second client leaves without a trace, and the first one's session does not notice."""
    first = start("serve", rendezvous)
    with AgentSession.open(rendezvous, SETTINGS, attach_timeout=20.0) as session:
        session.reset(resets())
        second = start("serve", rendezvous)
        _, said = second.communicate(timeout=20)
        assert second.returncode == 3
        assert f"another physics process (pid {first.pid}) serves this session" in said
        assert session.step(commands()).step[0] == 1
    assert first.wait(20) == 0


def test_a_session_is_served_once(rendezvous: str, start: Start) -> None:
    """After its physics process is gone a session takes no other one."""
    place = parse_rendezvous(rendezvous)
    segments = create_segments(place, 1)
    session = AgentSession(segments.command.view, segments.pose.view, SETTINGS)
    first = start("serve", rendezvous)
    patience = time.monotonic() + 20
    while layout.read_i64(segments.pose.view, POSE["magic"]) == 0:
        assert time.monotonic() < patience
        time.sleep(0.01)
    first.kill()
    first.wait()
    second = start("serve", rendezvous)
    _, said = second.communicate(timeout=20)
    assert f"physics process (pid {first.pid}) has served this session already" in said
    session.close()
    remove(segments)


def test_a_newer_segment_of_the_same_name_is_not_removed(rendezvous: str) -> None:
    """Who unlinks late removes its own segments, never those of the agent that came after."""
    place = parse_rendezvous(rendezvous)
    old = create_segments(place, 1)
    old.unlink()
    new = create_segments(place, 1)
    old.unlink()
    again = open_segment(place, ".cmd")
    assert again is not None
    again.close()
    old.close()
    remove(new)


def test_attaching_is_not_tracked(name: str) -> None:
    """A Python process that attached and ended does not take the segments away with it."""
    place = parse_rendezvous(f"shm:{name}")
    segments = create_segments(place, 1)
    attach = (
        "import sys; from protocol.memory import *; s = open_segment(parse_rendezvous(sys.argv[1]), '.cmd'); "
        "from multiprocessing import resource_tracker as t; assert t._resource_tracker._fd is None; s.close()"
    )
    subprocess.run([sys.executable, "-c", attach, f"shm:{name}"], check=True, timeout=20)
    assert Path(f"/dev/shm/{name}.cmd").exists()
    remove(segments)
