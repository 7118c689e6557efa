"""Interrupts around the making and the removal of shared memory: nothing is left, whenever they come."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from protocol.agent import AgentSession, SessionSettings
from protocol.memory import Segments
from protocol.signals import held_signals

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 20.0
MOMENTS = 24
OPEN_ALONE = """
import signal, sys
import protocol.agent as agent
for number in (signal.SIGINT, signal.SIGTERM):  # SIGINT too: a job in the background is born deaf to it
    signal.signal(number, signal.default_int_handler)
print("ready", flush=True)
sys.stdin.readline()
try:
    agent.AgentSession.open(sys.argv[1], agent.SessionSettings(1000, 0.1, 0.1), attach_timeout=20.0)
except KeyboardInterrupt:
    sys.exit(130)
"""


class ToldToStop(Exception):  # noqa: N818  what a test's own handler raises
    """A signal came."""


@pytest.fixture(params=[signal.SIGINT, signal.SIGTERM])
def number(request: pytest.FixtureRequest) -> Iterator[signal.Signals]:
    """A signal whose handler raises ToldToStop."""

    def stop(number: int, frame: object) -> None:
        raise ToldToStop

    before = signal.signal(request.param, stop)
    yield request.param
    assert signal.getsignal(request.param) is stop
    signal.signal(request.param, before)


def test_an_agent_interrupted_while_it_opens_leaves_nothing(name: str) -> None:
    """SIGINT and SIGTERM at random moments around the creation: no segment is left, and nothing but ours is said."""
    moments = random.Random(7)
    for turn in range(MOMENTS):
        process = subprocess.Popen(
            [sys.executable, "-c", OPEN_ALONE, f"shm:{name}-{turn}"],
            cwd=ROOT, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip
        try:
            assert process.stdin is not None
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            process.stdin.write("go\n")
            process.stdin.flush()
            segment = Path(f"/dev/shm/{name}-{turn}.cmd")
            patience = time.monotonic() + PATIENCE_S
            while turn % 4 and not segment.exists() and time.monotonic() < patience:
                pass  # a sleep would miss the moment
            aim = time.perf_counter() + moments.uniform(0, 0.002)
            while time.perf_counter() < aim:
                pass
            process.send_signal(signal.SIGINT if turn % 2 else signal.SIGTERM)
            _, said = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
            process.communicate()
        assert "BufferError" not in said
        assert list(Path("/dev/shm").glob(f"{name}-{turn}.*")) == []


def test_a_held_signal_comes_at_the_end(number: signal.Signals) -> None:
    """The body runs to its end, then the usual handler is called; held twice over it is the outer end."""
    done = []

    def body() -> None:
        with held_signals():
            with held_signals():
                os.kill(os.getpid(), number)
                done.append("inner")
            done.append("outer")

    with pytest.raises(ToldToStop):
        body()
    assert done == ["inner", "outer"]


def test_a_signal_is_held_also_where_another_thread_gets_it(number: signal.Signals) -> None:
    """A signal that the system gives to another thread does not interrupt the body either."""
    done = []

    def body() -> None:
        with held_signals():
            thread = threading.Thread(target=lambda: signal.pthread_kill(threading.get_ident(), number))
            thread.start()
            thread.join()
            done.append("joined")

    with pytest.raises(ToldToStop):
        body()
    assert done == ["joined"]


def test_other_threads_hold_nothing_and_may_try(number: signal.Signals) -> None:
    """Outside of the main thread, where Python runs no handlers, holding changes no handler."""
    usual = signal.getsignal(number)
    seen = []

    def body() -> None:
        with held_signals():
            seen.append(signal.getsignal(number))

    thread = threading.Thread(target=body)
    thread.start()
    thread.join()
    assert seen == [usual]


def test_a_removal_is_not_cut_short(
    name: str, number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A signal that comes while the segments are removed waits until both are gone."""
    unlink = Segments.unlink

    def interrupted(segments: Segments) -> None:
        os.kill(os.getpid(), number)
        unlink(segments)

    monkeypatch.setattr(Segments, "unlink", interrupted)
    with pytest.raises(ToldToStop):
        AgentSession.open(f"shm:{name}", SessionSettings(1, 0.1, 0.1), attach_timeout=0.05)
    assert list(Path("/dev/shm").glob(f"{name}.*")) == []
