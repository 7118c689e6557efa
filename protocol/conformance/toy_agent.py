"""The program `python -m protocol.conformance.toy_agent [--lanes N] [--tube MESH] RENDEZVOUS`: a small agent.

Registers the tube, if there is one, resets all lanes into it, steps 50 times, resets the lanes into free space,
releases the tube and says goodbye. Exit status 0 then, 3 where the session failed.
"""

from __future__ import annotations

import argparse
import hashlib
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import Final, NoReturn

from protocol.agent import AgentSession, SessionSettings
from protocol.errors import ProtocolError
from protocol.plant import NO_TUBE, CommandBatch, ResetBatch, TubeReference

STEPS: Final = 50
DT: Final = 0.02
PHYSICS_DT: Final = 0.005
_TUBE: Final = 0


def fly(session: AgentSession, mesh: Path | None) -> None:
    """Ask for a little of everything that a session offers.

    Raises:
        Refusal, PeerLost, PeerViolation, SessionError: as the session does.
    """
    resets, commands = ResetBatch.zeros(session.lanes), CommandBatch.zeros(session.lanes)
    resets.selected[:] = 1
    resets.parameters[:, : len(session.description.defaults)] = session.description.defaults
    commands.direction[:, 0], commands.speed[:], commands.compensation[:] = 1.0, 0.5, 1.0
    if mesh is not None:
        digest = hashlib.sha256(mesh.read_bytes()).hexdigest()
        session.register_tube(_TUBE, TubeReference(str(mesh.absolute()), "zup", 1.0, digest))
        resets.tube[:] = _TUBE
    session.reset(resets)
    for _ in range(STEPS):
        session.step(commands)
    if mesh is not None:
        resets.tube[:] = NO_TUBE
        session.reset(resets)
        session.release_tube(_TUBE)


def main() -> int:
    """Fly one session and return the exit status."""
    parser = argparse.ArgumentParser(prog="toy_agent", description="A small agent, for the conformance kit.")
    parser.add_argument("--lanes", type=int, default=1)
    parser.add_argument("--tube", type=Path)
    parser.add_argument("rendezvous")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, _stop)
    try:
        with AgentSession.open(options.rendezvous, SessionSettings(options.lanes, DT, PHYSICS_DT)) as session:
            fly(session, options.tube)
    except ProtocolError as error:
        sys.stderr.write(f"toy_agent: {type(error).__name__}: {error}\n")
        return 3
    return 0


def _stop(number: int, frame: FrameType | None) -> NoReturn:
    """Leave through the session, which says farewell and removes the segments."""
    raise SystemExit(128 + number)


if __name__ == "__main__":
    sys.exit(main())
