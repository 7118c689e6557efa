"""Noise and drop-outs of the sensors, against their distributions and a plain SplitMix64."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

from agent_client.conditions import Conditions, draw_conditions
from agent_client.noise import spread_seeds, uniform
from agent_client.settings import Settings
from agent_client.task import TaskStep, TubeTask
from meshes.geometry import Geometry
from protocol.plant import PoseBatch

LANES = 60
WORD = 2**64


def splitmix64(z: int) -> int:
    """The mixing of SplitMix64 in whole numbers of any size."""
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9 % WORD
    z = (z ^ (z >> 27)) * 0x94D049BB133111EB % WORD
    return z ^ (z >> 31)


@pytest.fixture
def look(
    cylinder: Callable[..., Geometry], poses_at: Callable[..., PoseBatch]
) -> Callable[..., list[TaskStep]]:
    """Makes drones hover on the axis of a tube of R = 1 m, 5 m in, and returns what they see in each step."""

    def hover(conditions: Conditions, seeds: list[int], steps: int = 1) -> list[dict[str, np.ndarray]]:
        task = TubeTask(cylinder(len(seeds)), Settings(), 0.1, clearance_contact=True)
        poses = poses_at(np.tile([5.0, 0.0, 0.0], (len(seeds), 1)))
        drawn = draw_conditions(conditions, [(seed,) for seed in seeds])
        seen = [task.begin(np.arange(len(seeds)), poses, drawn).episodes.copy()]
        seen += [task.observe(poses).episodes.copy() for _ in range(steps)]
        return seen

    return hover


def test_a_number_is_splitmix64_of_seed_step_and_index() -> None:
    """The compiled mixing is the published one, to the last bit, for seeds of 64 bits too."""
    for seed, step, index in ((0, 0, 0), (7, 3, 71), (2**63 + 5, 999, 0x20002), (WORD - 1, 1, 0x10000)):
        word = splitmix64((seed + step * 0xD1342543DE82EF95 + (index + 1) * 0x9E3779B97F4A7C15) % WORD)
        assert uniform(np.uint64(seed), step, index) == ((word >> 12) + 0.5) / 2**52


def test_numbers_are_even_over_indices_and_over_steps() -> None:
    """Kolmogorov-Smirnov finds nothing uneven, along either counter; neighbours are not correlated."""
    for numbers in (
        np.array([uniform(np.uint64(5), 0, index) for index in range(4000)]),
        np.array([uniform(np.uint64(5), step, 0) for step in range(4000)]),
        np.array([uniform(np.uint64(seed), 0, 0) for seed in range(4000)]),
    ):
        assert 0.0 < numbers.min() < numbers.max() < 1.0
        assert stats.kstest(numbers, "uniform").pvalue > 0.001
        assert abs(np.corrcoef(numbers[1:], numbers[:-1])[0, 1]) < 0.06


def spread(seeds: np.ndarray, tag: int = 1, columns: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """Shares and new seeds of `spread_seeds`."""
    words = np.asarray(seeds, dtype=np.uint64)
    shares, fresh = np.empty((len(words), columns)), np.empty(len(words), np.uint64)
    spread_seeds(words, tag, shares, fresh)
    return shares, fresh


def test_a_row_of_shares_depends_on_its_own_seed_and_the_tag() -> None:
    """A seed gives the same row beside any others; another part, order, length or tag gives another."""
    seeds = np.array([[1, 2], [2, 1], [1, 3], [0, 0]])
    shares, fresh = spread(seeds)
    for row in range(4):
        alone, seed = spread(seeds[row : row + 1])
        np.testing.assert_array_equal(alone[0], shares[row])
        assert seed[0] == fresh[row] < 2**63
    others = [
        *shares,
        *spread(seeds, tag=2)[0],
        spread(np.array([[1, 2, 0]]))[0][0],
        spread(np.array([[0]]))[0][0],
    ]
    assert len({tuple(row) for row in others}) == len(others)


def test_shares_are_even_and_columns_have_nothing_to_do_with_each_other() -> None:
    """Successive seeds give even shares without correlation between columns, rows, or the new seed."""
    shares, fresh = spread(np.stack([np.full(4000, 3), np.arange(4000)], axis=1))
    columns = np.column_stack([shares, fresh / 2.0**63])
    for column in columns.T:
        assert stats.kstest(column, "uniform").pvalue > 0.001
        assert abs(np.corrcoef(column[1:], column[:-1])[0, 1]) < 0.06
    assert np.abs(np.corrcoef(columns.T) - np.eye(9)).max() < 0.06


def test_lidar_noise_is_normal_with_the_deviation_asked_for(look: Callable[..., list]) -> None:
    """On the axis of a tube of R = 1 m, readings are 1 m plus a normal number, independent between rays."""
    seen = look(Conditions(lidar_noise=(0.05, 0.05)), list(range(LANES)))[0]
    noise = (seen["lidar"] - 1.0) / 0.05
    assert stats.kstest(noise.ravel(), "norm").pvalue > 0.001
    assert noise.std() == pytest.approx(1.0, abs=0.04)
    pairs = noise.reshape(-1, 2)  # two rays share their two uniform numbers
    assert abs(np.corrcoef(pairs.T)[0, 1]) < 0.1


def test_noise_keeps_readings_within_the_range(look: Callable[..., list]) -> None:
    """With noise as large as the range, readings lie in 0 to 3 m, and some at either end."""
    lidar = look(Conditions(lidar_noise=(1.0, 1.0)), list(range(LANES)))[0]["lidar"]
    assert lidar.min() == 0.0
    assert lidar.max() == 3.0


def test_noise_depends_on_seed_and_step_alone(look: Callable[..., list]) -> None:
    """The same episodes in other lanes, beside others, or again, see the same noise; every step is new."""
    conditions = Conditions(lidar_noise=(0.05, 0.05), lidar_dropout=(0.1, 0.1), camera_dropout=(0.5, 0.5))
    seeds = [11, 12, 13, 14]
    for together, turned in zip(look(conditions, seeds, 5), look(conditions, seeds[::-1], 5), strict=True):
        np.testing.assert_array_equal(together["lidar"], turned["lidar"][::-1])
        np.testing.assert_array_equal(together["target_visible"], turned["target_visible"][::-1])
    steps = look(conditions, seeds, 5)
    for seen, alone in zip(steps, look(conditions, seeds[2:3], 5), strict=True):
        np.testing.assert_array_equal(seen["lidar"][2], alone["lidar"][0])
    assert len({seen["lidar"][0].tobytes() for seen in steps}) == 6


def test_lidar_drops_the_share_of_rays_asked_for(look: Callable[..., list]) -> None:
    """A dropped ray reads the full range; their number is binomial; the others read the wall."""
    for share in (0.02, 0.3):
        lidar = np.stack(
            [seen["lidar"] for seen in look(Conditions(lidar_dropout=(share, share)), [*range(LANES)], 4)]
        )
        dropped = lidar == 3.0
        np.testing.assert_allclose(lidar[~dropped], 1.0, atol=1e-12)
        assert abs(dropped.mean() - share) < 4.0 * np.sqrt(share * (1.0 - share) / dropped.size)


def test_the_camera_drops_out_as_often_as_asked_and_is_remembered(look: Callable[..., list]) -> None:
    """A target that would be seen is missed in that share of the steps, and then remembered from before."""
    seen = look(Conditions(camera_dropout=(0.4, 0.4)), list(range(LANES)), 30)
    visible = np.stack([step["target_visible"] for step in seen])
    assert abs(visible.mean() - 0.6) < 4.0 * np.sqrt(0.24 / visible.size)
    age = np.where(visible[0], 0, 21)
    for step, sees in zip(seen[1:], visible[1:], strict=True):
        age = np.where(sees, 0, np.minimum(age + 1, 21))
        np.testing.assert_array_equal(step["memory_age"], age)


def test_nothing_is_disturbed_by_default(look: Callable[..., list]) -> None:
    """Without noise and drop-outs the seed has no effect."""
    first, other = (look(Conditions(), [seed] * 2, 2) for seed in (1, 2))
    for a, b in zip(first, other, strict=True):
        np.testing.assert_array_equal(a["lidar"], b["lidar"])
        np.testing.assert_allclose(a["lidar"], 1.0, atol=1e-12)
        assert a["target_visible"].all()
