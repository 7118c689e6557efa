"""Faults of resets, of the poses' numbers, and of tubes and contact."""

from __future__ import annotations

import numpy as np
from fault import Walled, fault, promising_walls

from protocol import validation
from protocol.errors import Refusal, RefusalCode
from protocol.plant import CommandBatch, Plant, PlantDescription, PoseBatch, ResetBatch, TubeReference
from protocol.toy import ToyPlant


class Toy(ToyPlant):
    """The toy, which remembers its poses and in which tube each lane is."""

    def __init__(self) -> None:
        self.poses = PoseBatch.zeros(0)
        self.tubes: dict[int, int] = {}
        self.resets = 0

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Remember, and reset."""
        self.resets += 1
        self.poses = poses
        self.tubes |= {int(lane): int(resets.tube[lane]) for lane in np.flatnonzero(resets.selected == 1)}
        super().reset(resets, poses)


@fault("reset-state")
class Wxyz(Toy):
    """Takes quaternions for w x y z, and shows them so."""

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Roll the quaternion."""
        super().reset(resets, poses)
        poses.quaternion[:] = np.roll(poses.quaternion, 1, axis=1)


@fault("reset-again")
class KeepsCount(Toy):
    """A second reset leaves count and time as they were."""

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Keep them."""
        before = poses.raw[:, 13:].copy()
        super().reset(resets, poses)
        poses.raw[:, 13:] = before


@fault("reset-forgets")
class LastParameters(Toy):
    """The parameters of a reset count from the next reset on."""

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Take those of the reset before."""
        before = self._parameters
        super().reset(resets, poses)
        self._pending, parameters = self._parameters, getattr(self, "_pending", self._parameters)
        self._parameters = list(parameters) if before[0] else self._parameters


@fault("reset-nothing")
class ResetsAll(Toy):
    """No lane selected means all lanes."""

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Select all."""
        if not resets.selected.any():
            resets.selected[:] = 1
        super().reset(resets, poses)


@fault("reset-unselected")
def looks_at_all_rows() -> Plant:
    """Rows that are not selected are checked as well."""
    usual = validation.reset_refusal

    def refusal(resets: ResetBatch, tubes: object) -> Refusal | None:
        for lane in range(len(resets.raw)):
            if np.isnan(resets.position[lane]).any():
                return Refusal("position", "finite numbers", "NaN", lane, RefusalCode.NOT_FINITE)
        return usual(resets, tubes)  # type: ignore[arg-type]

    validation.reset_refusal = refusal  # type: ignore[assignment]
    return ToyPlant()


@fault("pose-step")
class CountsOn(Toy):
    """The row's count goes on over resets."""

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Count from the session's beginning."""
        self._count = getattr(self, "_count", 0) + 1
        super().step(commands, poses)
        poses.step[:] = self._count


@fault("pose-time")
class SumOfTimes(Toy):
    """The time is a sum."""

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Add dt."""
        before = poses.sim_time.copy()
        super().step(commands, poses)
        poses.sim_time[:] = before + self._dt


@fault("tube-last-index")
class ShortIndex(Toy):
    """A tube's index is kept in sixteen bits with a sign."""

    def register_tube(self, index: int, tube: TubeReference) -> None:
        """Refuse what does not fit."""
        if index >= 1 << 15:
            raise Refusal("tube_index", "at most 32767", str(index), code=RefusalCode.TUBE_SLOT)


@fault("tube-release-again")
class RemembersTubes(Toy):
    """An index that was released cannot be registered again."""

    def register_tube(self, index: int, tube: TubeReference) -> None:
        """Refuse an index that was ever used."""
        self._used = getattr(self, "_used", set[int]())
        if index in self._used:
            raise Refusal("tube_index", "one never used", str(index))
        self._used.add(index)


@fault("tube-unnoticed")
class Stumbles(Toy):
    """A registration disturbs the lanes."""

    def register_tube(self, index: int, tube: TubeReference) -> None:
        """Stop all bodies."""
        self.poses.linear_velocity[:] = 0.0


@fault("contact-free-space")
class AlwaysInTouch(Toy):
    """Reports contact in free space."""

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Touch."""
        super().step(commands, poses)
        poses.contact_steps[:] = 1


class Touches(Toy):
    """Reports contact in any tube."""

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Touch where there is a tube."""
        super().step(commands, poses)
        poses.contact_steps[:] = [self.tubes[lane] >= 0 for lane in range(len(poses.raw))]


fault("contact-none-promised")(Touches)


@fault("contact-hollow")
class Solid(Touches):
    """Promises walls, and fills a tube."""

    def describe(self) -> PlantDescription:
        """Promise walls."""
        return promising_walls(super().describe())


@fault("tube-left")
class Sticky(Toy):
    """Promises walls, and stays in touch after the tube was left."""

    def describe(self) -> PlantDescription:
        """Promise walls."""
        return promising_walls(super().describe())

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Touch from the first tube on."""
        super().step(commands, poses)
        poses.contact_steps[:] = 1


fault("contact-wall", "tube-scale", "tube-axes", "tube-of-each-lane")(Walled)
