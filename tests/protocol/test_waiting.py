"""Waiting and liveness, without a session."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable

import pytest

from protocol import waiting
from protocol.errors import PeerLost, Verdict
from protocol.liveness import Life, describe_exit, how_ended, life, start_time
from protocol.waiting import Peer, Waiter, spin

Eventually = Callable[[Callable[[], bool]], None]


@pytest.fixture
def words() -> memoryview:
    """A few words of memory."""
    return memoryview(bytearray(4096)).cast("q")


def make_waiter(words: memoryview, pid: int = 0, started: int = 0, deadline: float | None = None) -> Waiter:
    """A waiter on word 400 of a segment without farewell."""
    return Waiter(words, 400, Peer("physics", pid, started, words.cast("B")), deadline)


def test_spinning_returns_what_it_sees(words: memoryview) -> None:
    """A short wait returns the new value at once, or the old one when its polls are used up."""
    assert spin(words, 0, 0, 3) == 0
    words[0] = 5
    assert spin(words, 0, 0, 3) == 5


@pytest.mark.parametrize("delay", [0.0, 0.01, 0.15])
def test_a_wait_ends_with_the_doorbell(words: memoryview, delay: float) -> None:
    """Polling, yielding or sleeping: the wait returns the new value."""
    waiter = make_waiter(words)
    timer = threading.Timer(delay, words.__setitem__, (400, 7))
    timer.start()
    assert waiter(0, 1, "step") == 7
    timer.join()


def test_polling_in_vain_is_given_up_but_for_a_trial(
    words: memoryview, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the peer rings only once this side yields, waits soon yield at once, and poll again now and then."""
    waiter = make_waiter(words)
    monkeypatch.setattr(waiting, "give_way", lambda: words.__setitem__(400, words[400] + 1))
    polls = []
    for number in range(2 * waiting.TRIAL):
        polls.append(waiter.polls)
        assert waiter(number, 1, "step") == number + 1
    trials = [number for number, count in enumerate(polls) if count == waiting.POLLS]
    assert trials == [*range(waiting.IN_VAIN), waiting.TRIAL]
    assert set(polls) == {1, waiting.POLLS}


def test_an_answer_that_polling_finds_forgives_what_was_in_vain(
    words: memoryview, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Waits in vain that are not one after the other leave polling as it is."""
    waiter = make_waiter(words)
    monkeypatch.setattr(waiting, "give_way", lambda: words.__setitem__(400, words[400] + 1))
    for number in range(20):
        if number % 2:
            words[400] = number + 1
        assert waiter(number, 1, "step") == number + 1
        assert waiter.polls == waiting.POLLS


def test_a_deadline_is_kept(words: memoryview) -> None:
    """Without an answer in time the verdict is too slow, with step and phase."""
    began = time.monotonic()
    with pytest.raises(PeerLost, match="lost physics at step 9, phase reset: no answer") as caught:
        make_waiter(words, deadline=0.1)(0, 9, "reset")
    assert time.monotonic() - began >= 0.1
    assert caught.value.verdict is Verdict.TOO_SLOW


def test_an_answer_before_death_counts(words: memoryview) -> None:
    """A peer that rang and then died has answered."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    started = start_time(process.pid)
    process.wait()
    waiter = make_waiter(words, process.pid, started)
    words[400] = 1
    waiter._look(0, 0.02, 1, "step")
    words[400] = 0
    with pytest.raises(PeerLost):
        waiter._look(0, 0.02, 1, "step")


def sleeper() -> subprocess.Popen[bytes]:
    """A process that sleeps."""
    return subprocess.Popen(["sleep", "60"])


def test_life_of_a_process(eventually: Eventually) -> None:
    """Running, stopped, running again, a zombie, gone."""
    process = sleeper()
    started = start_time(process.pid)
    assert started > 0
    assert life(process.pid, started) is Life.RUNNING
    process.send_signal(signal.SIGSTOP)
    eventually(lambda: life(process.pid, started) is Life.STOPPED)
    process.send_signal(signal.SIGCONT)
    eventually(lambda: life(process.pid, started) is Life.RUNNING)
    process.kill()
    eventually(lambda: life(process.pid, started) is Life.DEAD)  # a zombie: nobody has waited for it
    assert how_ended(process.pid) == "killed by SIGKILL"
    assert process.wait() == -signal.SIGKILL  # its status was left for us
    assert life(process.pid, started) is Life.DEAD
    assert how_ended(process.pid) == "its process is gone"


def test_a_pid_used_again_is_another_process() -> None:
    """The same pid with another start time is not the process that was meant; unknown times are not compared."""
    assert life(os.getpid(), start_time(os.getpid()) + 1) is Life.DEAD
    assert life(os.getpid(), 0) is Life.RUNNING


def test_no_pid_is_no_death() -> None:
    """A peer that gives no pid is taken to live."""
    assert life(0, 0) is Life.RUNNING


@pytest.mark.parametrize(
    ("code", "words"),
    [(0, "exit code 0"), (3, "exit code 3"), (-9, "killed by SIGKILL"), (-99, "killed by signal 99")],
)
def test_exit_codes_in_words(code: int, words: str) -> None:
    """An exit code or a signal is named as people know it."""
    assert describe_exit(code) == words


def test_a_launcher_that_knows_later_is_asked_again(words: memoryview) -> None:
    """Where the kernel says dead before the launcher knows why, the launcher gets a moment."""
    answers = iter([None, None, "exit code 4"])
    peer = Peer("physics", 2**22 + 1, 5, words.cast("B"), lambda: next(answers, "exit code 4"))
    with pytest.raises(PeerLost, match="exit code 4"):
        peer.check(1, "step")
