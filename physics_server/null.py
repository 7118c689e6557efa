"""An engine that does nothing but answer: what a round trip costs when no physics is in it."""

from __future__ import annotations

import numpy as np

from physics_server.parameters import description
from protocol.plant import (
    POSE_WORDS,
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
        self._rows = PoseBatch.zeros(0)
        self._words = memoryview(b"").cast("q")
        self._floats = memoryview(b"").cast("d")

    def describe(self) -> PlantDescription:
        """Say that nothing integrates here."""
        return description("null", walls=False)

    def open(self, lanes: int, dt: float, physics_dt: float, inner_steps: int) -> None:
        """Prepare the poses."""
        self._dt, self._rows = dt, PoseBatch.zeros(lanes)
        # Memoryviews write one number in a tenth of numpy's time, and this is there to measure other things.
        octets = memoryview(self._rows.raw.view(np.uint8).reshape(-1).data)
        self._words, self._floats = octets.cast("q"), octets.cast("d")

    def register_tube(self, index: int, tube: TubeReference) -> None:
        """Accept any tube."""

    def release_tube(self, index: int) -> None:
        """Accept any index."""

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Echo the initial states of the selected lanes."""
        selected = np.flatnonzero(resets.selected)
        self._rows.raw[selected, :13] = resets.raw[selected, :13]
        self._rows.raw[selected, 13:] = 0.0
        poses.raw[selected] = self._rows.raw[selected]

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Count the step; the bodies stand still."""
        for row in range(0, len(self._words), POSE_WORDS):
            self._words[row + _STEP] = steps = self._words[row + _STEP] + 1
            self._floats[row + _SIM_TIME] = steps * self._dt
        poses.raw[:] = self._rows.raw

    def close(self) -> None:
        """Nothing to give up."""
