"""Two plants that need no engine: one that only echoes, and a free body in Euler steps.

They serve tests, measurements of the transport alone, and implementers who want something to compare with.
"""

from __future__ import annotations

from protocol.plant import (
    CommandBatch,
    Plant,
    PlantDescription,
    PoseBatch,
    ResetBatch,
    TubeReference,
)

DEFAULTS = (
    *(1.0, 0.01, 0.01, 0.02, 0.15),  # mass, inertia, body radius
    *(8.0, 0.0, 120.0, 18.0),  # gains of force and torque
    *(0.0, 0.0, 9.81),  # drag, gravity
    *(0.2, 0.5),  # restitution, friction
    *(0.0, 0.0, 0.0, 0.0),  # disturbance, gust
)


class NullPlant(Plant):
    """Does nothing: a reset's state stays as it is, and only the counters move."""

    def __init__(self) -> None:
        self._dt = 0.0
        self.open_calls = 0

    def describe(self) -> PlantDescription:
        """Say what this plant is."""
        return PlantDescription("protocol.toy", "1", "null", 10.0, DEFAULTS)

    def open(self, lanes: int, dt: float, physics_dt: float, inner_steps: int) -> None:
        """Remember the control step."""
        self._dt = dt

    def register_tube(self, index: int, tube: TubeReference) -> None:
        """Take note of nothing: there are no walls."""

    def release_tube(self, index: int) -> None:
        """Take note of nothing."""

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Echo the initial states of the selected lanes."""
        lanes = resets.selected == 1
        poses.raw[lanes] = 0.0
        poses.raw[lanes, :13] = resets.raw[lanes, :13]

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Count the step."""

    def close(self) -> None:
        """Nothing to give up."""
