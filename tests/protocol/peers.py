"""Programs for the tests to start, kill and stop: `python peers.py serve|fly RENDEZVOUS TRACE`.

`serve` is a physics process over a RecordingPlant; `fly` is an agent that resets and steps until it is killed.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

from protocol.agent import AgentSession, SessionSettings
from protocol.errors import ProtocolError, Refusal
from protocol.physics import serve
from protocol.plant import CommandBatch, Plant, PlantDescription, PoseBatch, ResetBatch, TubeReference
from protocol.toy import DEFAULTS, ToyPlant

REFUSE, FAIL, DIE, LINGER, INTERRUPT, EXIT = 9.1, 9.2, 9.3, 9.4, 9.5, 9.6
"""Commanded speeds on which a RecordingPlant misbehaves while it steps."""
LINGER_S = 0.4


class RecordingPlant(ToyPlant):
    """The toy plant, which writes every call into a trace file and misbehaves on some speeds."""

    def __init__(self, trace: Path) -> None:
        self._trace = trace

    def _note(self, line: str) -> None:
        with self._trace.open("a", encoding="utf-8") as file:
            file.write(line + "\n")

    def describe(self) -> PlantDescription:
        """Say what the toy says."""
        return super().describe()

    def open(self, lanes: int, dt: float, physics_dt: float, inner_steps: int) -> None:
        """Note the sizes."""
        self._note(f"open {lanes} {dt:.9g} {inner_steps}")
        super().open(lanes, dt, physics_dt, inner_steps)

    def register_tube(self, index: int, tube: TubeReference) -> None:
        """Note the tube; refuse a path that ends in `missing.obj`."""
        self._note(f"register {index} {tube.path} {tube.axes} {tube.scale:g} {tube.sha256[:4]}")
        if tube.path.endswith("missing.obj"):
            raise Refusal("tube_path", "a file", tube.path)

    def release_tube(self, index: int) -> None:
        """Note the release."""
        self._note(f"release {index}")

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Note the lanes."""
        self._note(f"reset {[i for i, chosen in enumerate(resets.selected) if chosen]}")
        super().reset(resets, poses)

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Note the step, or misbehave."""
        speed = float(commands.speed[0])
        self._note(f"step {int(poses.step[0]) + 1}")
        if speed == REFUSE:
            poses.raw[:] = 77.0
            raise Refusal("engine", "a mood to step", "none", 0)
        if speed == FAIL:
            raise ZeroDivisionError("the engine exploded")
        if speed == DIE:
            os.kill(os.getpid(), signal.SIGKILL)
        if speed == LINGER:
            time.sleep(LINGER_S)
        if speed == INTERRUPT:
            raise KeyboardInterrupt
        if speed == EXIT:
            os._exit(3)
        super().step(commands, poses)

    def close(self) -> None:
        """Note the end."""
        self._note("close")


def run_server(rendezvous: str, plant: Plant, timeout: float) -> int:
    """Serve one session; 3 and one line on stderr where the protocol failed."""
    try:
        serve(rendezvous, plant, timeout)
    except ProtocolError as error:
        sys.stderr.write(f"{type(error).__name__}: {error}\n")
        return 3
    return 0


def run_agent(rendezvous: str, trace: Path, speed: float) -> int:
    """Reset one lane and step it until something ends this process."""
    with AgentSession.open(rendezvous, SessionSettings(1, 0.1, 0.1 / 4)) as session:
        resets, commands = ResetBatch.zeros(1), CommandBatch.zeros(1)
        resets.selected[:], resets.parameters[:, : len(DEFAULTS)] = 1, DEFAULTS
        commands.direction[:, 0], commands.speed[:] = 1.0, speed
        trace.write_text("open")
        session.reset(resets)
        while True:
            session.step(commands)
            trace.write_text(f"step {session.steps}")
            time.sleep(0.002)


def _raise_exit(number: int, frame: object) -> None:
    raise SystemExit(128 + number)


def main() -> int:
    """Play the part that the command line names."""
    part, rendezvous, trace, *rest = sys.argv[1:]
    signal.signal(signal.SIGTERM, _raise_exit)
    if part == "serve":
        return run_server(rendezvous, RecordingPlant(Path(trace)), float(rest[0]) if rest else 20.0)
    return run_agent(rendezvous, Path(trace), float(rest[0]) if rest else 1.0)


if __name__ == "__main__":
    sys.exit(main())
