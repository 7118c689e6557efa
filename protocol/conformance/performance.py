"""Rules of speed: ratios within one run alone, since no machine is like another."""

from __future__ import annotations

import os
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from protocol import handshake
from protocol.conformance.raw_agent import RawAgent
from protocol.conformance.rig import Rig
from protocol.conformance.rule import Failure, Level, Skip, demand, server_rule
from protocol.conformance.sound import commands, done, fly, resets
from protocol.layout import Op

SLEEPLESS: Final = 20.0
"""How many times the round trip of loopback UDP a step of one inner step may take."""
IDLE_SHARE: Final = 0.1
"""Share of a core that an idle server may burn; one that spins burns all that others leave it."""
PAUSE_S: Final = 1.0
_SAMPLES: Final = 2000
_ROUNDS: Final = 4
_MANY: Final = 64
_WARM: Final = 50
_REPEATS: Final = 25
_MOST_ROUNDS: Final = 10
_BUSY: Final = 3.0
"""How far a measurement on a machine with more work than cores may be off without a word on the peer."""
_ECHO_DEADLINE_S: Final = 5.0

_ECHO: Final = """
import socket
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
s.bind(("127.0.0.1", 0))
s.settimeout(30)
print(s.getsockname()[1], flush=True)
while True:
    data, peer = s.recvfrom(256)
    s.sendto(data, peer)
"""
"""A process that sends every datagram back, and ends half a minute after the last one."""


@contextmanager
def _udp_echo() -> Iterator[Callable[[], None]]:
    """One round trip by loopback UDP to another process, of a command row and back; ends the process at the end."""
    command = [sys.executable, "-I", "-S", "-c", _ECHO]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line,
    ):
        try:
            assert process.stdout is not None
            line.connect(("127.0.0.1", int(process.stdout.readline())))
            line.settimeout(_ECHO_DEADLINE_S)

            def exchange() -> None:
                line.send(bytes(64))
                line.recv(256)

            yield exchange
        finally:
            process.kill()


def _times(exchange: Callable[[], object], count: int) -> list[float]:
    """How long each of `count` exchanges takes (us)."""
    times = []
    for _ in range(count):
        began = time.perf_counter_ns()
        exchange()
        times.append((time.perf_counter_ns() - began) / 1e3)
    return times


def _opened(rig: Rig, lanes: int = 1) -> RawAgent:
    """Open a session whose steps take one inner step, and warm it up."""
    agent = rig.open(lanes=lanes, dt=0.01, inner_steps=1)
    done(agent.reset(resets(agent)), "a reset")
    agent.put_commands(commands(agent))
    _times(_stepping(agent), _WARM)
    return agent


def _stepping(agent: RawAgent) -> Callable[[], None]:
    """Return what takes one step, with the commands that stand."""

    def step() -> None:
        agent.request(Op.STEP)
        agent.await_bell()
        agent.steps += 1

    return step


def _in_turn(exchanges: list[Callable[[], None]], samples: int) -> list[list[float]]:
    """Measure several exchanges in turn, so that all of them meet the same machine."""
    times: list[list[float]] = [[] for _ in exchanges]
    for _ in range(_ROUNDS):
        for found, exchange in zip(times, exchanges, strict=True):
            found += _times(exchange, samples // _ROUNDS)
    return times


def _at_best(times: list[float]) -> float:
    """The longest of the fastest tenth: what others do on the machine at the time has little part in it."""
    return sorted(times)[len(times) // 10]


def _in_words(times: list[float]) -> str:
    """Write p50, p99 and p99.9."""
    ordered = sorted(times)
    quantiles = (ordered[min(len(ordered) - 1, int(share * len(ordered)))] for share in (0.5, 0.99, 0.999))
    return " / ".join(f"{quantile:.1f}" for quantile in quantiles)


@server_rule(
    "latency", Level.PERFORMANCE, "10", "how long a step of one lane and one inner step takes", required=False
)
def latency(rig: Rig) -> str:
    """Information, beside loopback UDP in the same run."""
    with _udp_echo() as echo:
        ours, udp = _in_turn([_stepping(_opened(rig)), echo], _SAMPLES)
    ratio = statistics.median(ours) / statistics.median(udp)
    return (
        f"p50 / p99 / p99.9 {_in_words(ours)} us, loopback UDP {_in_words(udp)} us in the same run; "
        f"ratio of the medians {ratio:.2f}"
    )


@server_rule(
    "no-sleep-in-step",
    Level.PERFORMANCE,
    "10",
    f"no sleep in the step path: a step takes less than {SLEEPLESS:g} times loopback UDP",
)
def no_sleep_in_step(rig: Rig) -> str:
    """One lane, one inner step, in the same run."""
    with _udp_echo() as echo:
        ours, udp = map(_at_best, _in_turn([_stepping(_opened(rig)), echo], _SAMPLES // 4))
    demand(ours < SLEEPLESS * udp, "a step at best", f"below {SLEEPLESS * udp:.0f} us", f"{ours:.0f} us")
    return f"{ours / udp:.2f} times UDP"


@server_rule(
    "idle-cpu", Level.PERFORMANCE, "10", f"an idle server burns less than {IDLE_SHARE:.0%} of a core"
)
def idle_cpu(rig: Rig) -> str:
    """While the agent pauses for a second; and it takes the next step."""
    agent = rig.open()
    done(agent.reset(resets(agent)), "a reset")
    fly(agent, commands(agent), 1)
    pid, _ = handshake.owner(agent.pose)
    if not Path(f"/proc/{pid}/stat").exists():
        raise Skip("this system has no /proc that tells a process's time")
    time.sleep(0.1)  # it may look closely for a while
    began, burnt = time.perf_counter(), _cpu_seconds(pid)
    time.sleep(PAUSE_S)
    share = (_cpu_seconds(pid) - burnt) / (time.perf_counter() - began)
    demand(share < IDLE_SHARE, "share of a core while idle", f"below {IDLE_SHARE:.0%}", f"{share:.0%}")
    fly(agent, commands(agent), 1)
    return f"{share:.0%}"


def _cpu_seconds(pid: int) -> float:
    """User and system time of a process so far (s)."""
    with suppress(OSError):
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / float(os.sysconf("SC_CLK_TCK"))
    raise Failure("the server", "alive while the agent pauses", "it ended")


@server_rule("long-pause", Level.PERFORMANCE, "10", f"a pause of the agent of {2 * PAUSE_S:g} s ends nothing")
def long_pause(rig: Rig) -> None:
    """Before the first request, and between two steps."""
    agent = rig.open()
    time.sleep(PAUSE_S)
    done(agent.reset(resets(agent)), "a reset after a pause")
    time.sleep(PAUSE_S)
    fly(agent, commands(agent), 2)


@server_rule(
    "lanes-cost",
    Level.PERFORMANCE,
    "5",
    f"but for the engine's own time a step of {_MANY} lanes costs less than {_MANY} steps of one",
)
def lanes_cost(rig: Rig) -> str:
    """By the fastest round trip less `engine_ns`, in turn, for as many rounds as a busy machine needs to show it."""
    single, crowd = _opened(rig), _opened(rig, _MANY)
    one, many = [_fastest_beside_engine(single)], [_fastest_beside_engine(crowd)]
    while min(many) >= _MANY * statistics.median(one) and len(one) < _MOST_ROUNDS:
        one.append(_fastest_beside_engine(single))
        many.append(_fastest_beside_engine(crowd))
    bound, found = _MANY * statistics.median(one), min(many)
    if bound <= found < _BUSY * bound and os.getloadavg()[0] > (os.cpu_count() or 1):
        raise Skip(
            f"the machine is too busy to tell: {found:.0f} us, where less than {bound:.0f} us is demanded"
        )
    what = f"a step of {_MANY} lanes less engine_ns, at best"
    demand(found < bound, what, f"below {bound:.0f} us", f"{found:.0f} us")
    return f"{_MANY * found / bound:.1f} times a step of one lane"


def _fastest_beside_engine(agent: RawAgent) -> float:
    """The fastest of some steps, without the engine's own time (us)."""
    step = _stepping(agent)
    return min(_times(step, 1)[0] - agent.get("engine_ns") / 1e3 for _ in range(_REPEATS))
