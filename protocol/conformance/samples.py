"""Sound payloads for sessions by hand: what a rule sends where it is about something else."""

from __future__ import annotations

from protocol.conformance.raw_agent import RawAgent
from protocol.layout import POSE, read_f64
from protocol.plant import PARAMETER_INDEX, CommandBatch, ResetBatch


def resting_resets(agent: RawAgent, **parameters: float) -> ResetBatch:
    """Resets of all lanes, at rest at the origin, free of tubes, with the server's defaults or others by name."""
    batch = ResetBatch.zeros(agent.settings.lanes)
    batch.selected[:] = 1
    batch.parameters[:] = read_f64(agent.pose, POSE["defaults"])
    for name, value in parameters.items():
        batch.parameters[:, PARAMETER_INDEX[name]] = value
    return batch


def level_commands(lanes: int = 1, speed: float = 0.5, compensation: float = 1.0) -> CommandBatch:
    """The same command for all lanes: along x, hovering."""
    batch = CommandBatch.zeros(lanes)
    batch.direction[:, 0] = 1.0
    batch.speed[:], batch.compensation[:] = speed, compensation
    return batch
