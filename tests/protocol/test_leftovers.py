"""Leftovers: what is proved dead is found and removed, and nothing else is touched."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import stamped

from protocol import handshake, layout
from protocol.agent import AgentSession, SessionSettings
from protocol.errors import SessionError
from protocol.handshake import Answer, Offer
from protocol.leftovers import Found, Standing, leftovers, remove, survey
from protocol.liveness import start_time
from protocol.memory import Rendezvous, parse_rendezvous
from protocol.observer import Observer
from protocol.toy import ToyPlant

PATIENCE_S = 20.0
LANES = 2

Eventually = Callable[[Callable[[], bool]], None]


def find(rendezvous: str) -> Found | None:
    """What a survey of everything says of one rendezvous."""
    place = parse_rendezvous(rendezvous)
    folders = [Path(place.stem).parent] if place.kind == "file" else []
    found = [one for one in survey(folders) if one.rendezvous == place]
    assert len(found) <= 1
    return found[0] if found else None


def standing(rendezvous: str) -> Standing | None:
    """How a rendezvous stands; None where nothing does."""
    found = find(rendezvous)
    return None if found is None else found.standing


@pytest.fixture
def dead_pid() -> int:
    """The pid of a process that is gone."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait(PATIENCE_S)
    return process.pid


class ByHand:
    """Segments as files, written by hand: of whoever, in whatever state."""

    def __init__(self, folder: Path) -> None:
        self.command, self.pose = folder / "session.cmd", folder / "session.pose"
        self.place = Rendezvous("file", str(folder / "session"))

    def write(self, agent: tuple[int, int], physics: tuple[int, int]) -> None:
        """Write both headers for processes of these pids and start times."""
        offer = Offer(SessionSettings(LANES, 0.1, 0.1), os.urandom(16), *agent)
        command, pose = bytearray(layout.command_bytes(LANES)), bytearray(layout.pose_bytes(LANES))
        handshake.write_offer(memoryview(command), offer)
        handshake.write_answer(memoryview(pose), offer, Answer(ToyPlant().describe(), *physics))
        self.command.write_bytes(command)
        self.pose.write_bytes(pose)

    def age(self) -> None:
        """Let the files be a minute old."""
        for path in (self.command, self.pose):
            if path.exists():
                os.utime(path, (time.time() - 60, time.time() - 60))

    @property
    def standing(self) -> Standing | None:
        """How the session stands."""
        return standing(str(self.place))


@pytest.fixture
def by_hand(tmp_path: Path) -> ByHand:
    """Segments to be written by hand."""
    return ByHand(tmp_path)


def test_a_session_is_dead_only_when_both_sides_are(rendezvous: str, eventually: Eventually) -> None:
    """Alive, then orphaned while the physics process stands still, then dead: only the last may be removed."""
    place = parse_rendezvous(rendezvous)
    with stamped.part("serve", rendezvous) as physics, stamped.part("fly", rendezvous, LANES) as agent:
        with Observer.attach(rendezvous, timeout=PATIENCE_S) as observer:
            eventually(lambda: observer.latest() is not None)
        assert standing(rendezvous) is Standing.LIVE
        with pytest.raises(SessionError, match=f"found live .*pid {agent.pid}.*left alone"):
            remove(place)
        physics.send_signal(signal.SIGSTOP)
        agent.kill()
        agent.wait()
        assert standing(rendezvous) is Standing.ORPHANED
        with pytest.raises(SessionError, match=f"found orphaned .*pid {physics.pid}.*left alone"):
            remove(place)
        physics.kill()
        physics.wait()
    found = find(rendezvous)
    assert found is not None
    assert found.standing is Standing.DEAD
    assert found.why == f"agent (pid {agent.pid}) is dead, physics (pid {physics.pid}) is dead"
    assert found.size == layout.command_bytes(LANES) + layout.pose_bytes(LANES)
    remove(place)
    assert find(rendezvous) is None
    remove(place)  # nothing is left to do


def test_an_agent_that_dies_before_anybody_attached_leaves_leftovers(
    rendezvous: str, eventually: Eventually
) -> None:
    """An offer without a physics side is live with its agent and dead without."""
    with stamped.part("fly", rendezvous, LANES):
        eventually(lambda: stamped.offered(rendezvous))
        assert standing(rendezvous) is Standing.LIVE
    assert standing(rendezvous) is Standing.DEAD
    remove(parse_rendezvous(rendezvous))


def test_a_session_of_this_process_is_live_and_keeps_its_lock(rendezvous: str) -> None:
    """A survey in the agent's own process does not open its segments, which would cost it its lock."""
    with AgentSession.offer(rendezvous, SessionSettings(1, 0.1, 0.1)):
        found = find(rendezvous)
        assert found is not None
        assert (found.standing, found.why) == (Standing.LIVE, "it is of this process itself")
        with pytest.raises(SessionError, match="left alone"):
            remove(parse_rendezvous(rendezvous))
        code = (
            "import sys; from pathlib import Path; from protocol.leftovers import survey; "
            "found = survey([Path(sys.argv[2])]); "
            "print([one.standing.value for one in found if str(one.rendezvous) == sys.argv[1]])"
        )
        folder = Path(parse_rendezvous(rendezvous).stem).parent
        command = [sys.executable, "-c", code, rendezvous, str(folder)]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE_S)
        assert done.stdout.strip() == "['live']"


def test_a_pid_that_is_used_again_proves_death(by_hand: ByHand) -> None:
    """The start time tells the owner from whoever has its pid today."""
    me = os.getpid()
    by_hand.write((me, start_time(me)), (me, start_time(me)))
    assert by_hand.standing is Standing.LIVE
    by_hand.write((me, start_time(me) - 1), (me, start_time(me)))
    assert by_hand.standing is Standing.ORPHANED
    by_hand.write((me, start_time(me) - 1), (me, start_time(me) - 1))
    assert by_hand.standing is Standing.DEAD
    remove(by_hand.place)
    assert not by_hand.command.exists()
    assert not by_hand.pose.exists()


@pytest.mark.parametrize("suffix", ["cmd", "pose"])
def test_a_held_lock_proves_life_whatever_the_pid_says(by_hand: ByHand, dead_pid: int, suffix: str) -> None:
    """The owner may be of another container, whose pids mean nothing here; its lock does."""
    by_hand.write((dead_pid, 1), (dead_pid, 1))
    assert by_hand.standing is Standing.DEAD
    path = by_hand.command.with_suffix(f".{suffix}")
    code = (
        "import fcntl, sys; file = open(sys.argv[1], 'r+b'); fcntl.lockf(file, fcntl.LOCK_EX, 1); "
        "print('locked', flush=True); sys.stdin.read()"
    )
    holder = subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "locked\n"
        assert by_hand.standing is (Standing.LIVE if suffix == "cmd" else Standing.ORPHANED)
        with pytest.raises(SessionError, match="left alone"):
            remove(by_hand.place)
        assert path.exists()
    finally:
        holder.communicate("", PATIENCE_S)
    assert by_hand.standing is Standing.DEAD


def test_a_header_that_was_never_finished_is_given_its_time(by_hand: ByHand) -> None:
    """Zeros of the right size may be a session in the making; half a second later, unlocked, they are a leftover."""
    by_hand.command.write_bytes(bytes(layout.command_bytes(LANES)))
    assert by_hand.standing is Standing.UNFINISHED
    by_hand.pose.write_bytes(bytes(layout.pose_bytes(LANES)))
    assert by_hand.standing is Standing.UNFINISHED
    with pytest.raises(SessionError, match="found unfinished"):
        remove(by_hand.place)
    by_hand.age()
    assert by_hand.standing is Standing.DEAD
    remove(by_hand.place)
    assert by_hand.standing is None


def test_an_agent_killed_between_its_two_segments_leaves_no_trace(by_hand: ByHand) -> None:
    """A second segment that has a name and no size yet goes with the first."""
    by_hand.command.write_bytes(bytes(layout.command_bytes(LANES)))
    by_hand.pose.touch()
    by_hand.age()
    remove(by_hand.place)
    assert not by_hand.command.exists()
    assert not by_hand.pose.exists()


def test_a_pose_segment_alone_is_judged_by_its_own_writer(by_hand: ByHand, dead_pid: int) -> None:
    """An agent killed over its tidying up leaves one segment, which goes once the physics process is dead."""
    me = os.getpid()
    by_hand.write((dead_pid, 1), (me, start_time(me)))
    by_hand.command.unlink()
    by_hand.age()
    assert by_hand.standing is Standing.ORPHANED
    by_hand.write((dead_pid, 1), (dead_pid, 1))
    by_hand.command.unlink()
    assert by_hand.standing is Standing.UNFINISHED
    by_hand.age()
    assert by_hand.standing is Standing.DEAD
    remove(by_hand.place)
    assert by_hand.standing is None


@pytest.mark.parametrize(
    "content", [b"somebody's notes", bytes(5000), b"ELSEWISE" + bytes(layout.command_bytes(1) - 8)]
)
def test_foreign_files_are_left_alone(by_hand: ByHand, content: bytes) -> None:
    """A short file, zeros of a size that no session has, another magic: none of them is ours to remove."""
    by_hand.command.write_bytes(content)
    by_hand.age()
    assert by_hand.standing is Standing.FOREIGN
    with pytest.raises(SessionError, match="found foreign"):
        remove(by_hand.place)
    assert by_hand.command.read_bytes() == content


def test_a_foreign_file_in_the_second_place_protects_the_first(by_hand: ByHand, dead_pid: int) -> None:
    """Nothing is removed under a name of which one file is somebody else's."""
    by_hand.write((dead_pid, 1), (dead_pid, 1))
    by_hand.pose.write_bytes(b"somebody's notes")
    assert by_hand.standing is Standing.FOREIGN
    with pytest.raises(SessionError, match=r"session\.pose is no segment"):
        remove(by_hand.place)
    assert by_hand.command.exists()


def test_links_folders_and_empty_files_are_passed_over(
    tmp_path: Path, by_hand: ByHand, dead_pid: int
) -> None:
    """What is no ordinary file with something in it is not even looked at."""
    by_hand.write((dead_pid, 1), (dead_pid, 1))
    (tmp_path / "link.cmd").symlink_to(by_hand.command)
    (tmp_path / "folder.cmd").mkdir()
    (tmp_path / "empty.cmd").touch()
    found = [one for one in survey([tmp_path]) if one.rendezvous.kind == "file"]
    assert [one.rendezvous for one in found] == [by_hand.place]
    assert [one for one in leftovers([tmp_path]) if one.rendezvous.kind == "file"] == found


def test_looking_takes_no_lock(by_hand: ByHand, dead_pid: int) -> None:
    """A survey leaves the locks free and the bytes as they are: an agent may take the name at the same time."""
    by_hand.write((dead_pid, 1), (dead_pid, 1))
    before = by_hand.command.read_bytes(), by_hand.command.stat().st_mtime_ns
    assert by_hand.standing is Standing.DEAD
    with by_hand.command.open("r+b") as file:
        fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1)
    assert (by_hand.command.read_bytes(), by_hand.command.stat().st_mtime_ns) == before
