"""The batched rigid body: N free spheres without an engine, all lanes and inner steps in one compiled call.

It has **no walls**: nothing is ever touched, and a tube is refused. Whoever flies in a tube judges contact from the
clearance, with lanes that are reset into NO_TUBE, as training does; a contact that slows the drone down or throws
it back is seen with the Bullet engine alone.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from physics_server.errors import EngineError
from physics_server.parameters import description
from physics_server.reference_kernels import advance
from protocol.errors import Refusal
from protocol.plant import (
    NO_TUBE,
    PARAMETERS,
    CommandBatch,
    Plant,
    PlantDescription,
    PoseBatch,
    ResetBatch,
    TubeReference,
)

ENGINE: Final = "reference 1"
"""Name and version; the version changes when the same commands would give other trajectories."""


class ReferencePlant(Plant):
    """Rigid bodies in free space by the equations of `protocol/README.md`, annex A, integrated as Bullet does.

    Velocities first, from the forces at the beginning of the inner step, then the pose from the new velocities;
    the gyroscopic torque of unequal moments is taken at the beginning of the step too. Recorded commands give
    Bullet's positions within 1e-13 m after 10 s. A quaternion may have the other sign, which is the same attitude,
    and Bullet lets a body turn by at most pi/4 in an inner step (188 rad/s at 1/240 s), this model by any angle.

    Of the parameters, those of a contact (body_radius, restitution, friction) have no part here. Lanes are
    independent of each other and of their number, bit for bit.
    """

    def __init__(self) -> None:
        self._dt = self._physics_dt = 0.0
        self._inner_steps = 0
        self._prepare(0)

    def describe(self) -> PlantDescription:
        """Name the engine and publish the default parameters."""
        return description(ENGINE, walls=False)

    def open(self, lanes: int, dt: float, physics_dt: float, inner_steps: int) -> None:
        """Prepare `lanes` bodies, and compile or load the machine code: the first step does not wait for it."""
        self._dt, self._physics_dt, self._inner_steps = dt, physics_dt, inner_steps
        self._prepare(0)
        self._advance(CommandBatch.zeros(0))
        self._prepare(lanes)

    def register_tube(self, index: int, tube: TubeReference) -> None:
        """Refuse any tube: a wall that is accepted and then not felt would be believed.

        Raises:
            Refusal: always.
        """
        raise _no_walls(tube.path)

    def release_tube(self, index: int) -> None:
        """Forget nothing; the session knows that no tube is registered."""

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Put the selected lanes into their initial states.

        Raises:
            Refusal: a lane is to fly in a tube. No lane has moved.
        """
        selected = np.flatnonzero(resets.selected)
        for lane in selected[resets.tube[selected] != NO_TUBE][:1]:
            raise _no_walls(f"index {resets.tube[lane]}", int(lane))
        state = self._state
        state.raw[selected] = 0.0
        state.raw[selected, :13] = resets.raw[selected, :13]
        self._parameters[selected] = resets.parameters[selected, : len(PARAMETERS)]
        self._seeds[selected] = resets.seed.view(np.uint64)[selected]
        poses.raw[selected] = state.raw[selected]

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Take one control step in every lane.

        Raises:
            EngineError: a state is no longer finite.
        """
        failed = self._advance(commands)
        state = self._state
        if failed >= 0:
            raise EngineError(
                f"lane {failed}, control step {state.step[failed]}: expected a finite state, found "
                f"{state.raw[failed, :13].tolist()}; the gains of its reset may be too stiff for inner steps "
                f"of {self._physics_dt:g} s"
            )
        poses.raw[:] = state.raw

    def close(self) -> None:
        """Give up the bodies."""
        self._prepare(0)

    def _prepare(self, lanes: int) -> None:
        """Make the arrays of so many bodies."""
        self._state = PoseBatch.zeros(lanes)
        self._parameters = np.zeros((lanes, len(PARAMETERS)))
        self._seeds = np.zeros(lanes, np.uint64)

    def _advance(self, commands: CommandBatch) -> int:
        """Integrate over one control step; the first lane that is not finite, or -1."""
        raw = self._state.raw
        return advance(
            raw,
            raw.view(np.int64),
            self._parameters,
            self._seeds,
            commands.raw,
            self._dt,
            self._physics_dt,
            self._inner_steps,
        )


def _no_walls(found: str, lane: int = -1) -> Refusal:
    """The refusal of a tube."""
    return Refusal(
        "tube",
        f"none, since {ENGINE} has no walls (fly with NO_TUBE, {NO_TUBE}, and judge contact from the clearance, "
        "or use --engine bullet)",
        found,
        lane,
    )
