"""Small tubes written by the tests themselves, and a plant that is driven without any transport."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pybullet
import pytest
from numpy.typing import NDArray

from physics_server.bullet import BulletPlant
from physics_server.parameters import BodyParameters
from protocol.plant import NO_TUBE, CommandBatch, Plant, PoseBatch, ResetBatch, TubeReference

Floats = NDArray[np.float64]
INNER = 1 / 240


def wall_arrays(
    radius: float = 1.0, length: float = 20.0, sides: int = 32, rings: int = 21
) -> tuple[Floats, NDArray[np.int32]]:
    """An open prism along x from 0 to `length` with a flat side at z = -radius: vertices (V, 3), faces (F, 3)."""
    angle = (np.arange(sides) + 0.5) * (2 * np.pi / sides) - np.pi / 2
    corner = radius / np.cos(np.pi / sides)
    x = np.linspace(0, length, rings)
    vertices = np.stack(
        [np.repeat(x, sides), np.tile(corner * np.cos(angle), rings), np.tile(corner * np.sin(angle), rings)],
        1,
    )
    ring, side = (index.ravel() for index in np.indices((rings - 1, sides)))
    a, b = ring * sides + side, ring * sides + (side + 1) % sides
    faces = np.concatenate([np.stack([a, b, a + sides], 1), np.stack([b, b + sides, a + sides], 1)])
    return vertices, faces.astype(np.int32)


@pytest.fixture
def tube_file(tmp_path: Path) -> Callable[..., TubeReference]:
    """Write a tube as .obj and refer to it; arguments as of `wall_arrays`, and `inverted` for the winding."""

    def write(inverted: bool = False, **section: float) -> TubeReference:
        vertices, faces = wall_arrays(**section)  # type: ignore[arg-type]
        rows = faces[:, ::-1] if inverted else faces
        text = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in vertices.tolist())
        text += "".join(f"f {a} {b} {c}\n" for a, b, c in (rows + 1).tolist())
        path = tmp_path / f"tube{len(list(tmp_path.iterdir()))}.obj"
        path.write_text(text)
        return TubeReference(str(path), "zup", 1.0, hashlib.sha256(path.read_bytes()).hexdigest())

    return write


class Rig:
    """A plant with the batches that a session would hold, one method a request."""

    def __init__(self, plant: Plant, lanes: int, inner_steps: int, physics_dt: float) -> None:
        self.plant = plant
        self.plant.open(lanes, inner_steps * physics_dt, physics_dt, inner_steps)
        self.commands = CommandBatch.zeros(lanes)
        self.commands.direction[:, 0] = 1.0
        self.poses = PoseBatch.zeros(lanes)
        self.resets = ResetBatch.zeros(lanes)

    def set(
        self,
        lane: int = 0,
        tube: int = NO_TUBE,
        position: tuple[float, ...] = (0, 0, 0),
        quaternion: tuple[float, ...] = (0, 0, 0, 1),
        velocity: tuple[float, ...] = (0, 0, 0),
        omega: tuple[float, ...] = (0, 0, 0),
        seed: int = 0,
        **parameters: float,
    ) -> None:
        """Fill in one lane's row of the next reset; parameters that are not named have their defaults."""
        self.resets.selected[lane] = 1
        self.resets.tube[lane] = tube
        self.resets.seed[lane] = seed
        self.resets.position[lane] = position
        self.resets.quaternion[lane] = quaternion
        self.resets.linear_velocity[lane] = velocity
        self.resets.angular_velocity[lane] = omega
        row = BodyParameters(**parameters).row()
        self.resets.parameters[lane, : len(row)] = row

    def reset(self, lane: int = 0, **state: object) -> None:
        """Reset one lane."""
        self.resets.selected[:] = 0
        self.set(lane, **state)  # type: ignore[arg-type]
        self.plant.reset(self.resets, self.poses)

    def command(
        self,
        direction: tuple[float, ...] = (1, 0, 0),
        speed: float = 0.0,
        compensation: float = 0.0,
        lane: int | slice = slice(None),
    ) -> None:
        """Fill in the next command of one lane or all."""
        self.commands.direction[lane] = direction
        self.commands.speed[lane] = speed
        self.commands.compensation[lane] = compensation

    def step(self, steps: int = 1) -> Floats:
        """Take control steps; the pose rows after each of them, (steps, N, 16), as a copy."""
        rows = []
        for _ in range(steps):
            self.plant.step(self.commands, self.poses)
            rows.append(self.poses.raw.copy())
        return np.array(rows)


@pytest.fixture
def fill_tubes(monkeypatch: pytest.MonkeyPatch) -> Callable[[], AbstractContextManager[None]]:
    """A context in which the engine takes a tube's convex hull, as it does with a mesh without indices."""

    @contextmanager
    def filled() -> Iterator[None]:
        create = pybullet.createCollisionShape

        def create_hull(*shape: Any, **options: Any) -> Any:
            options.pop("indices", None)
            return create(*shape, **options)

        with monkeypatch.context() as patch:
            patch.setattr(pybullet, "createCollisionShape", create_hull)
            yield

    return filled


@pytest.fixture
def rig() -> Iterator[Callable[..., Rig]]:
    """Open a plant of `lanes` lanes and `inner_steps` inner steps of `physics_dt`; it is closed afterwards.

    It is Bullet's, or that of the class `plant`.
    """
    opened: list[Rig] = []

    def make(
        lanes: int = 1, inner_steps: int = 24, physics_dt: float = INNER, plant: type[Plant] = BulletPlant
    ) -> Rig:
        opened.append(Rig(plant(), lanes, inner_steps, physics_dt))
        return opened[-1]

    yield make
    for one in opened:
        one.plant.close()
