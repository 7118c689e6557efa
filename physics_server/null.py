"""An engine that does nothing but answer: what a round trip costs when no physics is in it."""

from __future__ import annotations

import numpy as np

from physics_server.parameters import description
from protocol.plant import (
    CommandBatch,
    Plant,
    PlantDescription,
    PoseBatch,
    ResetBatch,
    TubeReference,
)

_SIM_TIME, _STEP = 13, 15
"""Words of a pose row, as PoseBatch has them."""


class NullPlant(Plant):
    """Bodies that stay where their reset put them; tubes are accepted unread, and nothing is ever touched.

    Steps and simulated times are counted, so that a session over it is a whole one.
    """

    def __init__(self) -> None:
        self._dt = 0.0
        self._poses: PoseBatch | None = None

    def describe(self) -> PlantDescription:
        """Say that nothing integrates here."""
        return description("null", walls=False)

    def open(self, lanes: int, dt: float, physics_dt: float, inner_steps: int) -> None:
        """Note the control step."""
        self._dt, self._poses = dt, None

    def register_tube(self, index: int, tube: TubeReference) -> None:
        """Accept any tube."""

    def release_tube(self, index: int) -> None:
        """Accept any index."""

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Echo the initial states of the selected lanes."""
        selected = np.flatnonzero(resets.selected)
        poses.raw[selected, :13] = resets.raw[selected, :13]
        poses.raw[selected, 13:] = 0.0

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Count the step; the bodies stand still."""
        if len(poses.raw) > 1:
            np.add(poses.step, 1, out=poses.step)
            np.multiply(poses.step, self._dt, out=poses.sim_time)
            return
        if poses is not self._poses:
            # Memoryviews write one number in a tenth of numpy's time, and this is there to measure other things.
            octets = poses.raw.data.cast("B")
            self._poses, self._words, self._floats = poses, octets.cast("q"), octets.cast("d")
        self._words[_STEP] = steps = self._words[_STEP] + 1
        self._floats[_SIM_TIME] = steps * self._dt

    def close(self) -> None:
        """Nothing to give up."""
