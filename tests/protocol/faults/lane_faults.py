"""Faults of lanes."""

from __future__ import annotations

from fault import fault

from protocol.plant import CommandBatch, PoseBatch, ResetBatch
from protocol.toy import ToyPlant


@fault("rows-of-1", "rows-of-2", "rows-of-7", "rows-of-64")
class ForgetsTheLast(ToyPlant):
    """The command of the last lane is not read."""

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Stop the last lane."""
        commands.speed[-1] = 0.0
        super().step(commands, poses)


@fault("many-lanes")
class CountsInAByte(ToyPlant):
    """Lanes are counted in eight bits: those beyond are never stepped."""

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Put back the rows behind the first 256."""
        before = poses.raw[256:].copy()
        super().step(commands, poses)
        poses.raw[256:] = before


@fault("alone-as-among-2", "alone-as-among-7", "alone-as-among-64")
class Crowded(ToyPlant):
    """What others do is felt, in the last digits."""

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Add a trace of all lanes."""
        super().step(commands, poses)
        poses.position[:] += 1e-15 * (len(poses.raw) - 1)


@fault("reset-of-one-lane")
class ResetsStopOthers(ToyPlant):
    """A reset stops the lanes that are not reset."""

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Stop them."""
        poses.linear_velocity[:] = 0.0
        super().reset(resets, poses)


@fault("count-of-each-lane")
class OneClock(ToyPlant):
    """All lanes have the clock of the first."""

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Copy it."""
        super().step(commands, poses)
        poses.step[:], poses.sim_time[:] = poses.step[0], poses.sim_time[0]


@fault("rows-never-reset")
class UnitRows(ToyPlant):
    """Lanes that were never reset have a quaternion."""

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Give them one."""
        poses.quaternion[:, 3] = 1.0
        super().reset(resets, poses)


@fault("lanes-do-not-touch")
class OneWorld(ToyPlant):
    """Bodies in the same place push each other away."""

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Push the last one."""
        super().step(commands, poses)
        if len(poses.raw) > 1 and abs(poses.position[0] - poses.position[-1]).max() < 0.1:
            poses.position[-1, 0] += 0.01
