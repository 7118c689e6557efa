"""Rules for servers about what stands at the rendezvous: stale segments, other servers, sessions that were served."""

from __future__ import annotations

from typing import Final

from protocol.conformance.rig import PeerProcess, Rig, await_end, await_no_segments
from protocol.conformance.rule import Level, demand, expect, server_rule
from protocol.conformance.scenes import hand_over
from protocol.conformance.sound import commands, resets
from protocol.conformance.stand_in import dead_process
from protocol.handshake import write_farewell
from protocol.layout import POSE, Farewell, write_i64

ROBUSTNESS: Final = Level.ROBUSTNESS


@server_rule(
    "stale-segments-removed",
    ROBUSTNESS,
    "4",
    "a starting server removes the segments of a dead agent and waits on",
)
def _stale_segments_removed(rig: Rig) -> None:
    agent = rig.agent()
    stand_in = hand_over(agent)
    agent.offer(pid=stand_in.pid, start_time=stand_in.started)
    stand_in.close()
    server = rig.start()
    await_no_segments(rig.rendezvous, rig.timeout)
    agent.close()
    _serves_next(rig, rig.rendezvous, server)


@server_rule(
    "abandoned-header-removed",
    ROBUSTNESS,
    "4",
    "a header left without magic for half a second, its lock free, is removed by a starting server",
)
def _abandoned_header_removed(rig: Rig) -> None:
    agent = rig.agent()
    hand_over(agent).close()
    server = rig.start()
    await_no_segments(rig.rendezvous, rig.timeout)
    agent.close()
    _serves_next(rig, rig.rendezvous, server)


@server_rule(
    "second-server", ROBUSTNESS, "2", "a second server leaves without writing a byte, and the first serves on"
)
def _second_server(rig: Rig) -> None:
    agent = rig.open()
    agent.reset(resets(agent))
    before = bytes(agent.pose)
    second = rig.start()
    await_end(second, "as a second client", rig.timeout)
    demand(
        bytes(agent.pose) == before, "the pose segment", "not a byte written by a second server", "it changed"
    )
    expect("status of a step by the first server", agent.step(commands(agent)).status, 0)


@server_rule(
    "served-session-left",
    ROBUSTNESS,
    "2",
    "a session that another server has served or refused is left untouched",
)
def _served_session_left(rig: Rig) -> None:
    for traces in ("magic", "farewell"):
        agent = rig.agent(rendezvous=rig.new_rendezvous())
        agent.offer()
        if traces == "magic":
            agent.pose[:8] = b"TUBE.POS"
        else:
            write_farewell(agent.pose, Farewell.FAILED, "its engine did not start")
        before = bytes(agent.pose)
        server = rig.start(agent.rendezvous)
        await_end(server, f"since a {traces} stands in the pose segment", rig.timeout)
        demand(
            bytes(agent.pose) == before, f"a pose segment with a {traces}", "not a byte written", "it changed"
        )
        agent.close()


@server_rule(
    "died-before-magic-replaced",
    ROBUSTNESS,
    "2",
    "a server that died before its magic stood is replaced by another",
)
def _died_before_magic_replaced(rig: Rig) -> None:
    agent = rig.agent()
    pid, started = dead_process()
    for field, value in ((POSE["pid"], pid), (POSE["start_time"], started)):
        write_i64(agent.pose, field, value)
    agent.offer()
    agent.attend(rig.start())
    agent.await_header()
    demand(agent.get("pid") != pid, "pid of the header", "the new server's", pid)


def _serves_next(rig: Rig, rendezvous: str, server: PeerProcess) -> None:
    """Demand that a waiting server takes the next session at its rendezvous."""
    agent = rig.agent(rendezvous=rendezvous)
    agent.offer()
    agent.attend(server)
    agent.await_header()
    agent.goodbye()
    await_end(server, "after a goodbye")
