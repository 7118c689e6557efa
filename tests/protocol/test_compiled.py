"""Machine code and the standard library exchange steps alike; neither is taken, or left, in silence."""

from __future__ import annotations

import hashlib
import logging
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol import compiled_choice, layout
from protocol.agent import AgentSession, SessionSettings
from protocol.errors import Refusal, RefusalCode, SessionError
from protocol.layout import COMMAND, Op
from protocol.plant import CommandBatch, PoseBatch, ResetBatch
from protocol.validation import command_check, command_refusal, commands_are_sound

WAYS = ("stdlib", "compiled")
SPEED_MAX = 10.0
LANES = 64


@pytest.fixture(params=WAYS)
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Each way of exchanging steps, demanded of this process and of those that it starts."""
    chosen: str = request.param
    if chosen == "compiled":
        pytest.importorskip("numba", reason="numba is not installed: pip install numba")
    monkeypatch.setenv(compiled_choice.ENVIRONMENT, chosen)
    return chosen


def fly(session: AgentSession, resets: ResetBatch, steps: int) -> str:
    """Fly commands that change with every step and lane; return the hash of all poses."""
    lanes = session.lanes
    commands, seen = CommandBatch.zeros(lanes), hashlib.sha256()
    seen.update(session.reset(resets).raw.tobytes())
    for step in range(steps):
        angle = 0.1 * step + np.arange(lanes)
        commands.direction[:] = np.stack([np.cos(angle), np.sin(angle), np.zeros(lanes)], axis=1)
        commands.speed[:], commands.compensation[:] = 1.0 + angle % 3.0, 1.0
        seen.update(session.step(commands).raw.tobytes())
    return seen.hexdigest()


def test_both_ways_give_the_same_poses(
    name: str, start: Callable[..., object], resets: Callable[..., ResetBatch]
) -> None:
    """A flight has the same hash of all its poses whichever way either side takes."""
    pytest.importorskip("numba", reason="numba is not installed: pip install numba")
    rendezvous, lanes, hashes = f"shm:{name}", 3, {}
    for ours in WAYS:
        for theirs in WAYS:
            with pytest.MonkeyPatch.context() as patch:
                patch.setenv(compiled_choice.ENVIRONMENT, theirs)
                start("serve", rendezvous)
                patch.setenv(compiled_choice.ENVIRONMENT, ours)
                with AgentSession.open(rendezvous, SessionSettings(lanes, 0.1, 0.025)) as session:
                    assert session.exchange.startswith(ours)
                    hashes[ours, theirs] = fly(session, resets(lanes), 40)
    assert len(set(hashes.values())) == 1, hashes


def test_a_refusal_leaves_either_session_alive(
    way: str,
    name: str,
    start: Callable[..., object],
    resets: Callable[..., ResetBatch],
    commands: Callable[..., CommandBatch],
) -> None:
    """What is out of range is refused by name and lane, counts no step, and the next step is taken."""
    start("serve", f"shm:{name}")
    with AgentSession.open(f"shm:{name}", SessionSettings(3, 0.1, 0.025)) as session:
        with pytest.raises(Refusal, match="reset") as never_reset:
            session.step(commands(3))
        assert never_reset.value.code == RefusalCode.NOT_RESET
        session.reset(resets(3))
        bad = commands(3)
        bad.speed[1] = 10.5
        for _ in range(2):
            with pytest.raises(Refusal, match="speed") as refused:
                session.step(bad)
            assert (refused.value.lane, session.steps) == (1, 0)
        assert session.step(commands(3)).step.tolist() == [1, 1, 1]
        assert session.steps == 1


def test_what_is_done_meanwhile_and_another_batch_change_nothing(
    way: str,
    name: str,
    start: Callable[..., object],
    resets: Callable[..., ResetBatch],
    commands: Callable[..., CommandBatch],
) -> None:
    """Steps with something to do meanwhile, and steps from another batch, are steps like others."""
    start("serve", f"shm:{name}")
    seen: list[int] = []
    with AgentSession.open(f"shm:{name}", SessionSettings(1, 0.1, 0.025)) as session:
        poses = session.reset(resets())
        for step in range(1, 9):
            session.step(commands(speed=0.5 * step), lambda: seen.append(int(poses.step[0])))
            session.step(commands(speed=0.5 * step))
            assert session.steps == poses.step[0] == 2 * step
            assert session.engine_seconds > 0.0
    assert seen == list(range(0, 16, 2))


class Halves:
    """The two sides' machine code over ordinary memory, taken in turns by hand."""

    def __init__(self, lanes: int) -> None:
        from protocol import compiled

        kernels = compiled.load_kernels(may_compile=True)
        self.command = memoryview(bytearray(layout.command_bytes(lanes)))
        self.pose = memoryview(bytearray(layout.pose_bytes(lanes)))
        self.sent, self.taken = CommandBatch.zeros(lanes), CommandBatch.zeros(lanes)
        self.made, self.seen = PoseBatch.zeros(lanes), PoseBatch.zeros(lanes)
        self.agent = kernels.desk(self.command, self.pose, self.sent, self.seen, SPEED_MAX)
        self.physics = kernels.desk(self.command, self.pose, self.taken, self.made, SPEED_MAX)

    def ask(self, number: int, due: int) -> None:
        """Publish a step request and wait for nothing."""
        assert self.agent.exchange(self.agent.address, number, due, 0) == -1

    def take(self, number: int, due: int) -> int:
        """Look once for a sound step request."""
        return self.physics.take(self.physics.address, number, due, 1)


@pytest.fixture(scope="module")
def halves() -> Iterator[Halves]:
    """Both sides over 64 lanes."""
    pytest.importorskip("numba", reason="numba is not installed: pip install numba")
    return Halves(LANES)


def sound_commands(raw: np.ndarray) -> None:
    """Fill in rows that nothing is wrong with."""
    raw[:] = 0.0
    raw[:, 0], raw[:, 3], raw[:, 4] = 1.0, SPEED_MAX, 2.0


NEAR_ONE = [math.sqrt(1.0 + side * 1e-6 * (1.0 + off)) for side in (-1, 1) for off in (-1e-9, 0.0, 1e-9)]
SPECIAL = (math.nan, math.inf, -math.inf, -1e-300, -0.0, 5e-324, 1e-3, 1.0, 1e200)
BOUNDS = (2.0, 2.0000000000000004, SPEED_MAX, math.nextafter(SPEED_MAX, 11.0))
ODD = (*SPECIAL, *BOUNDS, *NEAR_ONE)


@pytest.mark.parametrize("lanes", [1, 7, LANES])
def test_all_checks_of_commands_agree(lanes: int, halves: Halves) -> None:
    """Whatever stands in one word of one lane, all ways judge as the check of rows of one does."""
    batch = CommandBatch.zeros(lanes)
    quick = command_check(batch, SPEED_MAX)

    @settings(max_examples=200, deadline=None, database=None)
    @given(
        st.integers(0, 7), st.integers(0, lanes - 1), st.sampled_from(ODD) | st.floats(0.9999990, 1.0000010)
    )
    def check(word: int, lane: int, value: float) -> None:
        sound_commands(batch.raw)
        batch.raw[lane, word] = value
        rows = [row.data.cast("B") for row in batch.raw]
        expected = all(commands_are_sound(row, SPEED_MAX) for row in rows)
        assert commands_are_sound(batch.raw.data.cast("B"), SPEED_MAX) is expected
        refusal = command_refusal(batch, SPEED_MAX)
        assert (refusal is None) is expected
        assert refusal is None or refusal.lane == lane
        assert expected or not quick(), (
            "the quick check may leave a sound batch to the others, never take a bad one"
        )
        sound_commands(halves.sent.raw)
        halves.sent.raw[:lanes] = batch.raw
        halves.ask(1, 1)
        assert bool(halves.take(1, 1)) is expected

    check()
    sound_commands(batch.raw)
    assert quick()


def test_machine_code_takes_what_is_due_and_nothing_else(halves: Halves) -> None:
    """Of a request with any wrong word nothing is answered, and none that changed before its reply is."""
    sound_commands(halves.sent.raw)
    halves.ask(1, 1)
    assert halves.take(1, 1) == 1
    np.testing.assert_array_equal(halves.taken.raw, halves.sent.raw)
    words = halves.command.cast("q")
    for field, wrong in (("begin", 2), ("op", Op.RESET), ("step", 2), ("end", 0), ("doorbell", 3)):
        right, words[COMMAND[field].word] = words[COMMAND[field].word], wrong
        assert halves.take(1, 1) == 0, field
        if field in ("begin", "doorbell"):
            assert halves.physics.publish(halves.physics.address, 1, 1, 5) == 0, field
        words[COMMAND[field].word] = right
    assert halves.take(2, 2) == 0, "a request that was not made"


def test_machine_code_believes_a_reply_that_is_whole(halves: Halves) -> None:
    """The reply's time is returned and its poses copied if every word of it is as it must be, else -1."""
    halves.made.raw[:] = np.arange(LANES * 16).reshape(LANES, 16)
    halves.pose[:] = bytes(len(halves.pose))
    halves.ask(1, 1)
    assert halves.physics.publish(halves.physics.address, 1, 1, 1234) == 1
    agent, words = halves.agent, halves.pose.cast("q")
    assert agent.exchange(agent.address, 1, 1, 1) == 1234
    np.testing.assert_array_equal(halves.seen.raw, halves.made.raw)
    for field in ("doorbell", "begin", "status", "step", "end"):
        word = layout.POSE[field].word
        right, words[word] = words[word], 7
        assert agent.exchange(agent.address, 1, 1, 1) == -1, field
        words[word] = right


def test_without_numba_the_standard_library_is_taken_and_that_is_said(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Where numba is absent a session works and logs so; where it is demanded, the error says what to do."""
    monkeypatch.setitem(sys.modules, "numba", None)
    monkeypatch.delenv(compiled_choice.ENVIRONMENT, raising=False)
    with caplog.at_level(logging.INFO, "protocol"):
        assert compiled_choice.choose("agent", may_compile=True).kernels is None
    assert "agent exchanges steps by stdlib (numba is not installed: pip install numba)" in caplog.messages
    monkeypatch.setenv(compiled_choice.ENVIRONMENT, "compiled")
    with pytest.raises(
        SessionError, match=r"compiled cannot be had, numba is not installed: pip install numba"
    ):
        compiled_choice.choose("physics", may_compile=False)


def test_numba_is_not_loaded_unasked(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that has no other use for numba, or has one core, goes by the standard library, and says why."""
    monkeypatch.delenv(compiled_choice.ENVIRONMENT, raising=False)
    pytest.importorskip("numba", reason="numba is not installed: pip install numba")
    monkeypatch.setattr(compiled_choice, "_cores", lambda: 1)
    assert compiled_choice.choose("agent", may_compile=True).why == "this process has one core"
    monkeypatch.setattr(compiled_choice, "_cores", lambda: 2)
    assert compiled_choice.choose("agent", may_compile=True).kernels is not None
    monkeypatch.delitem(sys.modules, "numba")
    assert "no other use for numba" in compiled_choice.choose("agent", may_compile=True).why
    monkeypatch.setenv(compiled_choice.ENVIRONMENT, "stdlib")
    assert compiled_choice.choose("agent", may_compile=True).why == "PROTOCOL_EXCHANGE says so"
    monkeypatch.setenv(compiled_choice.ENVIRONMENT, "fast")
    with pytest.raises(SessionError, match="expected auto, compiled or stdlib, found 'fast'"):
        compiled_choice.choose("agent", may_compile=True)


def test_a_physics_process_does_not_compile_unasked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Without machine code of an earlier process it goes by the standard library: an agent waits for its answer."""
    compiled = pytest.importorskip("protocol.compiled", reason="numba is not installed: pip install numba")
    import numba

    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    compiled.load_kernels.cache_clear()
    with pytest.raises(compiled.NotCompiledYetError):
        compiled.load_kernels(may_compile=False)
    monkeypatch.delenv(compiled_choice.ENVIRONMENT, raising=False)
    monkeypatch.setattr(compiled_choice, "_cores", lambda: 2)
    choice = compiled_choice.choose("physics", may_compile=False)
    assert choice.kernels is None
    assert "NotCompiledYetError" in choice.why
