"""Walls that are registered as lanes need them, before a session that refuses every mistake."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from agent_client.kinematic import KinematicPlant
from agent_client.tubes import TubeRecipe, draw_tube
from cosim.errors import CosimError
from cosim.walls import WallRegistry, wall_slots, write_wall
from meshes.swept import SweptTube
from meshes.swept_geometry import SweptGeometry
from meshes.wall import read_wall
from protocol.agent import AgentSession, SessionSettings
from protocol.plant import ResetBatch, TubeReference
from protocol.twin import open_twin

LANES = 3
TUBES = [draw_tube(level, (seed,), "train", TubeRecipe((4.0,))) for level in range(3) for seed in range(8)]


class Reading(KinematicPlant):
    """A plant that reads the walls it is given, as an engine would."""

    def __init__(self) -> None:
        super().__init__()
        self.walls: dict[int, np.ndarray] = {}
        self.read = 0

    def register_tube(self, index: int, tube: TubeReference) -> None:
        """Read it."""
        wall = read_wall(tube.path, scale=tube.scale)
        assert wall.sha256 == tube.sha256
        self.walls[index] = wall.vertices
        self.read += 1

    def release_tube(self, index: int) -> None:
        """Forget it."""
        del self.walls[index]


@pytest.fixture
def plant() -> Reading:
    """A plant that reads walls."""
    return Reading()


@pytest.fixture
def session(plant: Reading) -> Iterator[AgentSession]:
    """A session of three lanes with that plant and room for six walls."""
    with open_twin(plant, SessionSettings(LANES, 0.1, 0.1, tube_slots=6)) as session:
        yield session


def fly_in(session: AgentSession, lanes: list[int], indices: list[int]) -> None:
    """Reset some lanes into registered tubes; the session refuses those that are not."""
    resets = ResetBatch.zeros(LANES)
    resets.parameters[:, : len(session.description.defaults)] = session.description.defaults
    resets.parameters[:, :5] = [1.0, 1.0, 1.0, 1.0, 0.15]
    resets.selected[lanes] = 1
    resets.tube[:] = indices
    session.reset(resets)


def is_wall_of(vertices: np.ndarray, tube: SweptTube) -> bool:
    """Whether a wall that was read starts and ends around the ends of a tube's axis."""
    ends = [vertices[:48].mean(axis=0), vertices[-48:].mean(axis=0)]
    return bool(np.allclose(ends, tube.points[[0, -1]], atol=1e-3))


def test_lanes_are_always_reset_into_their_own_tubes(session: AgentSession, plant: Reading) -> None:
    """Over many resets of some lanes, more tubes than slots, one flown on and on: each index is of its tube."""
    registry, rng = WallRegistry(6), np.random.default_rng(0)
    flown = [TUBES[0]] * LANES
    for round_ in range(60):
        lanes = sorted(
            set(rng.integers(0 if round_ == 0 else 1, LANES, 2).tolist())
        )  # lane 0 begins but once
        for lane in lanes if round_ else range(LANES):
            flown[lane] = TUBES[rng.integers(len(TUBES))]
        indices = registry(session, flown)
        assert all(is_wall_of(plant.walls[index], tube) for index, tube in zip(indices, flown, strict=True))
        assert len(plant.walls) <= 6
        fly_in(session, lanes if round_ else list(range(LANES)), indices)


def test_a_wall_that_is_registered_is_not_read_again(session: AgentSession, plant: Reading) -> None:
    """The same tubes in any order and any lanes cost nothing; one new tube costs one."""
    registry = WallRegistry(6)
    first = registry(session, TUBES[:3])
    assert plant.read == 3
    assert registry(session, TUBES[2::-1]) == first[::-1]
    assert registry(session, [TUBES[1]] * 3) == [first[1]] * 3
    assert plant.read == 3
    registry(session, [TUBES[3], *TUBES[:2]])
    assert plant.read == 4


def test_another_session_knows_no_walls_yet(session: AgentSession, plant: Reading) -> None:
    """The registry begins anew with it."""
    registry = WallRegistry(6)
    registry(session, TUBES[:3])
    other = Reading()
    with open_twin(other, SessionSettings(LANES, 0.1, 0.1, tube_slots=6)) as second:
        registry(second, TUBES[:3])
        assert sorted(other.walls) == sorted(plant.walls)


def test_too_few_slots_are_refused(session: AgentSession) -> None:
    """Each lane needs one for the tube it leaves and one for the tube it enters."""
    with pytest.raises(CosimError, match="two for each of 3 lanes, found 5"):
        WallRegistry(5)(session, TUBES[:3])
    assert wall_slots(1000) == 2000
    assert wall_slots(1) >= 2


def test_no_file_is_left(session: AgentSession, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The mesh files are gone when the walls are registered."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    WallRegistry(6)(session, TUBES[:3])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("recipe", "level"),
    [
        (TubeRecipe((6.0,)), 2),
        (TubeRecipe((6.0,), ellipse=(0.2, 0.2)), 1),
        (TubeRecipe((6.0,), lobes=(0.1, 0.1)), 1),
    ],
)
def test_the_file_is_the_wall_that_perception_sees(tmp_path: Path, recipe: TubeRecipe, level: int) -> None:
    """Rays from the axis meet the triangles of the file where they meet the swept wall, within 2 mm on average."""
    swept = draw_tube(level, (3,), "train", recipe)
    reference = write_wall(tmp_path / "wall.obj", swept)
    wall = read_wall(reference.path, scale=reference.scale)
    assert wall.sha256 == reference.sha256
    rng = np.random.default_rng(0)
    origins = swept.points[rng.integers(3, len(swept.points) - 3, (1, 500))]
    directions = rng.normal(size=origins.shape)
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    by_axis = SweptGeometry([swept]).rays(origins, directions, 1.6)
    by_triangles = wall.scene.distances(origins[0], directions[0], 1.6)
    np.testing.assert_allclose(by_triangles, by_axis[0], atol=0.02)
    assert np.abs(by_triangles - by_axis[0]).mean() < 0.002
