"""Two that come at the same moment: every interleaving that the model found to be dangerous, played by hand."""

from __future__ import annotations

import logging
import subprocess
import sys
from pathlib import Path

import pytest

from protocol import layout, memory, opening
from protocol.agent import AgentSession, SessionSettings
from protocol.errors import SessionError
from protocol.layout import COMMAND
from protocol.memory import COMMAND_SUFFIX, POSE_SUFFIX, Segment, Segments, open_segment, parse_rendezvous
from protocol.opening import attach_segments, create_segments, remove_if_dead

SETTINGS = SessionSettings(1, 0.1, 0.1)
DEAD_PID = 2**22 + 1  # beyond the kernel's largest pid
HOLDER = (
    "import sys; from protocol.memory import *; s = open_segment(parse_rendezvous(sys.argv[1]), '.cmd'); "
    "print(s.lock(), flush=True); sys.stdin.read()"
)


def leave(rendezvous: str) -> Segments:
    """Offer a session as an agent does that dies at once; its segments stay open here, to be compared."""
    segments = create_segments(parse_rendezvous(rendezvous), 1)
    AgentSession(segments.command.view, segments.pose.view, SETTINGS)
    layout.write_i64(segments.command.view, COMMAND["pid"], DEAD_PID)
    return segments


def both_stand(segments: Segments) -> bool:
    """Whether the names stand for these very segments."""
    return segments.command.stands() and segments.pose.stands()


def end(*all_segments: Segments) -> None:
    """Remove and unmap."""
    for segments in all_segments:
        segments.unlink()
        segments.close()


def test_an_agent_that_was_replaced_before_it_locked_leaves_the_newer_ones_alone(
    rendezvous: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An agent that stalls between creating `.cmd` and locking it looks again whether the name is still its own."""
    place = parse_rendezvous(rendezvous)
    newer: list[Segments] = []

    def stalls(*arguments: object) -> Segment:
        segment = memory.create_segment(*arguments)  # type: ignore[arg-type]
        monkeypatch.undo()
        segment.unlink()  # as one does that waited half a second for its magic
        newer.append(create_segments(place, 1))
        return segment

    monkeypatch.setattr(opening, "create_segment", stalls)
    with pytest.raises(SessionError, match="was taken by another at this moment"):
        create_segments(place, 1)
    assert both_stand(newer[0])
    end(*newer)


def test_physics_never_joins_one_sessions_command_to_anothers_pose(
    rendezvous: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A session that is replaced between the two openings is not attached to, the newer one is."""
    place = parse_rendezvous(rendezvous)
    sessions = [create_segments(place, 1)]
    AgentSession(sessions[0].command.view, sessions[0].pose.view, SETTINGS)

    def replaced(where: memory.Rendezvous, suffix: str) -> Segment | None:
        if suffix == POSE_SUFFIX:
            monkeypatch.undo()
            sessions[0].unlink()
            sessions.append(create_segments(place, 1))
            AgentSession(sessions[1].command.view, sessions[1].pose.view, SETTINGS)
        return open_segment(where, suffix)

    monkeypatch.setattr(opening, "open_segment", replaced)
    attached = attach_segments(place, 10.0)
    assert len(sessions) == 2
    identity = COMMAND["session"].bytes
    assert attached.command.view[identity] == sessions[1].command.view[identity]
    assert both_stand(attached)
    attached.close()
    end(*sessions)


def test_physics_opens_the_pose_segment_after_the_magic(
    rendezvous: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside a header that is still being written, a `.pose` is no session's yet; the finished one's is taken."""
    place = parse_rendezvous(rendezvous)
    segments = create_segments(place, 1)
    stale = segments.pose
    fresh: list[Segment] = []

    def finishes(where: memory.Rendezvous, suffix: str) -> Segment | None:
        segment = open_segment(where, suffix)
        if suffix == POSE_SUFFIX:  # meanwhile the agent replaces what it found, and writes its header
            monkeypatch.undo()
            stale.unlink()
            fresh.append(memory.create_segment(place, POSE_SUFFIX, layout.pose_bytes(1)))
            AgentSession(segments.command.view, fresh[0].view, SETTINGS)
        return segment

    monkeypatch.setattr(opening, "open_segment", finishes)
    attached = attach_segments(place, 10.0)
    assert both_stand(attached)
    attached.close()
    stale.close()
    end(Segments(segments.command, fresh[0]))


@pytest.mark.parametrize("remover", ["agent", "attaching physics", "leaving physics"])
def test_a_dead_agents_pose_segment_goes_first(
    rendezvous: str, remover: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever removes a dead agent's names removes `.cmd` last, under its lock, so that `.pose` is never alone."""
    place = parse_rendezvous(rendezvous)
    stale = leave(rendezvous)
    removed: list[str] = []
    unlink = Segment.unlink

    def note(segment: Segment) -> None:
        removed.append(Path(segment.name).suffix)
        unlink(segment)

    monkeypatch.setattr(Segment, "unlink", note)
    if remover == "agent":
        replaced = create_segments(place, 1)
        monkeypatch.undo()
        assert both_stand(replaced)
        end(replaced)
    elif remover == "attaching physics":
        assert opening._try_attach(place, patient=True)[0] is None
    else:
        remove_if_dead(stale)
    assert removed == [POSE_SUFFIX, COMMAND_SUFFIX]
    stale.close()


def test_a_leaving_physics_process_removes_nothing_without_the_lock(
    rendezvous: str, caplog: pytest.LogCaptureFixture
) -> None:
    """While another removes a dead agent's segments, they are left to it; the lock of one that died comes free."""
    stale = leave(rendezvous)
    stale.command.close()
    command = open_segment(parse_rendezvous(rendezvous), COMMAND_SUFFIX)
    assert command is not None
    mapped = Segments(command, stale.pose)
    call = [sys.executable, "-c", HOLDER, rendezvous]
    with subprocess.Popen(call, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "True\n"
        with caplog.at_level(logging.WARNING, logger="protocol"):
            remove_if_dead(mapped)
        assert "is left to the process that holds its lock" in caplog.text
        assert both_stand(mapped)
        holder.kill()
        holder.communicate(timeout=20)
    remove_if_dead(mapped)
    assert not command.stands()
    mapped.close()


def test_an_empty_segment_is_removed_and_no_other(rendezvous: str) -> None:
    """A name without a size goes; one with a size, or none at all, is left alone."""
    place = parse_rendezvous(rendezvous)
    path = memory.segment_path(place, COMMAND_SUFFIX)
    assert not memory.remove_empty(place, COMMAND_SUFFIX)
    path.touch()
    assert memory.remove_empty(place, COMMAND_SUFFIX)
    assert not path.exists()
    path.write_bytes(bytes(8))
    assert not memory.remove_empty(place, COMMAND_SUFFIX)
    path.unlink()
