"""Random kills of either side: every one must end in a typed error, in time, with nothing left behind."""

from __future__ import annotations

import os
import random
import signal
import time
from dataclasses import asdict, dataclass
from typing import Any, Final

from pair import SIDES, Pair, Report, Roles, exchanges, meeting, queued_seconds

from protocol.agent import AgentSession, SessionSettings
from protocol.plant import CommandBatch, PoseBatch, ResetBatch
from protocol.toy import DEFAULTS, ToyPlant

BOUND_S: Final = 0.1
"""The specification's: a dead peer is noticed within this time."""
MOMENTS: Final = ("start", "flight", "idle", "goodbye")
"""Where a kill falls: while the session comes to be, between and in quick steps, while the other side has waited
long enough to sleep, around the orderly end."""
START_S: Final = 0.02
FLIGHT_S: Final = 0.08
PAUSE_S: Final = 0.2
"""How long the victim of an idle kill does nothing, again and again."""
_GOODBYE_AT_S: Final = 0.03


@dataclass(frozen=True)
class Kill:
    """One kill and what came of it."""

    transport: str
    exchange: str
    victim: str
    moment: str
    after_s: float
    """From the start of the pair to the kill."""
    error: str
    """Error of the survivor; empty where the session had ended in order by then."""
    noticed_s: float
    """From the kill to the survivor's error."""
    queued_s: float
    """Of that, the time that the processes waited for a core: the victim to die, the survivor to look."""
    step: int
    """Control step that the survivor's error names."""
    fault: str
    """What was wrong: a hang, an error that is not typed, something left; empty where all is well."""

    @property
    def counts(self) -> bool:
        """Whether the survivor noticed a death, where the other kills came after the orderly end."""
        return bool(self.error)


class _PausingPlant(ToyPlant):
    """The toy, which does nothing for a while in every step."""

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Pause, then step."""
        time.sleep(PAUSE_S)
        super().step(commands, poses)


def _fly(session: AgentSession, pause: float, leave_at: float) -> int:
    resets, commands = ResetBatch.zeros(1), CommandBatch.zeros(1)
    resets.selected[:], resets.parameters[:, : len(DEFAULTS)], resets.quaternion[:, 3] = 1, DEFAULTS, 1.0
    commands.direction[:, 0], commands.speed[:] = 1.0, 1.0
    session.reset(resets)
    while time.monotonic() < leave_at:
        session.step(commands)
        if pause:
            time.sleep(pause)
    return session.steps


def kill_once(chance: random.Random, ways: tuple[str, ...]) -> Kill:
    """Start a pair, kill one of the two at a random moment, and see how the other ends."""
    transport, victim = chance.choice(("shm", "file")), chance.choice(SIDES)
    moment, exchange = chance.choice(MOMENTS), chance.choice(ways)
    survivor = "physics" if victim == "agent" else "agent"
    leave_at = time.monotonic() + (_GOODBYE_AT_S if moment == "goodbye" else 3600.0)
    idle = moment == "idle"
    roles = Roles(
        SessionSettings(1, 0.1, 0.1),
        _PausingPlant if idle and victim == "physics" else ToyPlant,
        lambda session: _fly(session, PAUSE_S if idle and victim == "agent" else 0.0, leave_at),
        exchange=dict.fromkeys(SIDES, exchange),
    )
    after = {
        "start": chance.uniform(0.0, START_S),
        "flight": chance.uniform(START_S, FLIGHT_S),
        "idle": chance.uniform(START_S, START_S + 2 * PAUSE_S),
        "goodbye": _GOODBYE_AT_S + chance.uniform(-0.001, 0.002),
    }[moment]
    fault, end, noticed, queued = "", None, 0.0, 0.0
    try:
        with meeting(transport) as rendezvous:
            began = time.monotonic()
            pair = Pair(rendezvous, roles)
            time.sleep(max(0.0, began + after - time.monotonic()))
            before = {side: queued_seconds(pid) for side, pid in pair.pids.items()}
            our_own = queued_seconds(os.getpid())
            killed = time.monotonic()
            pair.signal(victim, signal.SIGKILL)
            queued = queued_seconds(os.getpid()) - our_own
            while not pair.ended(victim):
                time.sleep(0.0005)
            queued += queued_seconds(pair.pids[victim]) - before[victim]
            end = pair.finish()[survivor]
            if end is not None:
                noticed, queued = end.at - killed, queued + end.queued - before[survivor]
    except (AssertionError, TimeoutError) as error:
        fault = str(error)
    fault = fault or _judge(end)
    step = int(end.text.split("at step ")[1].split(",")[0]) if end and "at step " in end.text else 0
    error = end.error if end else ""
    return Kill(transport, exchange, victim, moment, after, error, noticed, queued, step, fault)


def _judge(end: Report | None) -> str:
    """What is wrong with a survivor's end."""
    if end is None:
        return "the survivor died without a word"
    if end.error and (not end.typed or end.error != "PeerLost"):
        return f"expected PeerLost, found {end.error}: {end.text}"
    return ""


def run_kills(count: int, seed: int) -> dict[str, Any]:
    """Kill until `count` deaths were there to be noticed; kills after an orderly end come on top."""
    chance, ways = random.Random(seed), exchanges()
    kills: list[Kill] = []
    while sum(kill.counts or bool(kill.fault) for kill in kills) < count:
        kills.append(kill_once(chance, ways))
    noticed = sorted(kill.noticed_s for kill in kills if kill.counts)
    net = sorted(max(0.0, kill.noticed_s - kill.queued_s) for kill in kills if kill.counts)
    return {
        "seed": seed,
        "kills": len(kills),
        "noticed": len(noticed),
        "after_the_end": sum(not kill.counts and not kill.fault for kill in kills),
        "faults": [asdict(kill) for kill in kills if kill.fault],
        "noticed_ms": _distribution(noticed),
        "noticed_ms_on_a_core": _distribution(net),
        "by_moment": {
            f"{moment} of {victim}": sum(k.counts and (k.moment, k.victim) == (moment, victim) for k in kills)
            for moment in MOMENTS
            for victim in SIDES
        },
        "by_exchange": {way: sum(k.counts and k.exchange == way for k in kills) for way in ways},
        "steps": sorted(kill.step for kill in kills if kill.counts),
        "cores": len(os.sched_getaffinity(0)),
    }


def _distribution(seconds: list[float]) -> dict[str, float]:
    """Median, 99 % and largest of sorted times, in ms."""
    if not seconds:
        return {}
    places = {"p50": 0.5, "p99": 0.99, "max": 1.0}
    return {
        name: round(1000 * seconds[min(int(q * len(seconds)), len(seconds) - 1)], 1)
        for name, q in places.items()
    }
