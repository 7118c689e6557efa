"""Fences: what becomes visible at a fence alone is read, and what is published at one is whole.

Off x86 a fence keeps the processor from reordering stores. Here it is replaced by one that brings the words which may
only be read behind it, or notes those which must stand before it.
"""

from __future__ import annotations

import ctypes
import errno
import platform
import struct
import sys
from collections.abc import Callable

import pytest

from protocol import agent, handshake, layout, memory, physics
from protocol.agent import AgentSession, SessionSettings
from protocol.errors import SessionError
from protocol.handshake import Answer, read_farewell, read_offer, write_answer, write_farewell
from protocol.layout import COMMAND, POSE, Farewell
from protocol.physics import PhysicsSession
from protocol.plant import CommandBatch, ResetBatch
from protocol.toy import ToyPlant
from protocol.twin import open_twin

SETTINGS = SessionSettings(1, 0.1, 0.1)
Resets = Callable[..., ResetBatch]
Commands = Callable[..., CommandBatch]


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
