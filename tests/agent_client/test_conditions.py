"""The named conditions: what is drawn, and what it acts on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields

import numpy as np
import pytest
from scipy import stats

from agent_client.conditions import (
    CONDITIONS,
    DELAY_MAX,
    HARD,
    NAMES,
    PARAMETERS_OF,
    Conditions,
    apply_parameters,
    draw_conditions,
)
from agent_client.errors import SettingsError
from agent_client.features import FEATURE_NAMES
from agent_client.settings import Settings
from agent_client.task import TubeTask
from meshes.geometry import Geometry
from protocol.plant import PARAMETERS, PoseBatch, ResetBatch

COUNT = 3000
WIDE = Conditions(
    body_radius=(0.1, 0.3), field_of_view=(0.5, 1.0), lidar_noise=(0.0, 0.05), lidar_dropout=(0.0, 0.1),
    camera_dropout=(0.0, 0.5), action_delay=(1, 4), observation_delay=(0, 2), gain=(1.5, 6.0),
    compensation=(0.8, 1.05), mass=(0.5, 2.0), drag=(0.0, 0.3), gust=(0.0, 1.0), near_wall=(0.0, 0.5),
    along_body=(0, 1),
)  # fmt: skip


def seeds(count: int = COUNT) -> np.ndarray:
    """Seeds of two parts, (count, 2)."""
    return np.stack([np.full(count, 9), np.arange(count)], axis=1)


def test_the_table_has_a_row_for_every_field_in_order() -> None:
    """Names of the table and fields of the ranges are the same, and every default lies within its bounds."""
    assert tuple(field.name for field in fields(Conditions)) == NAMES
    for row, (low, high) in zip(CONDITIONS, Conditions().ranges().values(), strict=True):
        assert row.lowest <= low == high <= row.highest


@pytest.mark.parametrize("row", CONDITIONS, ids=NAMES)
def test_a_condition_is_drawn_evenly_from_its_range(row: object) -> None:
    """Numbers are even over the range, whole numbers evenly many of each, both ends included."""
    low, high = getattr(WIDE, row.name)
    values = draw_conditions(WIDE, seeds())[row.name]
    assert low <= values.min() <= values.max() <= high
    if row.whole:
        counts = np.bincount(values.astype(int) - int(low), minlength=int(high - low) + 1)
        np.testing.assert_array_equal(values, np.floor(values))
        assert stats.chisquare(counts).pvalue > 0.001
    else:
        assert stats.kstest((values - low) / (high - low), "uniform").pvalue > 0.001


def test_the_conditions_of_an_episode_depend_on_its_seed_alone() -> None:
    """Whatever else is drawn beside it, an episode draws the same; another seed draws others."""
    together = draw_conditions(WIDE, seeds(20))
    for number in (0, 7, 19):
        assert draw_conditions(WIDE, [(9, number)])[0] == together[number]
    assert len(set(together["gain"].tolist())) == len(set(together["seed"].tolist())) == 20
    assert draw_conditions(WIDE, [(2**64 - 1,)])["seed"] != draw_conditions(WIDE, [(0,)])["seed"]


def test_conditions_are_drawn_independently_of_each_other() -> None:
    """No two conditions are correlated, nor is any with the same of the next seed."""
    drawn = draw_conditions(WIDE, seeds())
    values = np.stack([drawn[name] for name in NAMES])
    assert np.abs(np.corrcoef(values) - np.eye(len(NAMES))).max() < 0.08
    for row in values:
        assert abs(np.corrcoef(row[1:], row[:-1])[0, 1]) < 0.08


def test_fixing_one_condition_moves_no_other() -> None:
    """A range of no width gives its value, and leaves the other draws and the noise's seed as they were."""
    before, after = (draw_conditions(c, seeds(50)) for c in (WIDE, WIDE.with_ranges({"gain": (3.0, 3.0)})))
    assert (after["gain"] == 3.0).all()
    for name in (*NAMES, "seed"):
        assert name == "gain" or (before[name] == after[name]).all()


def test_ranges_that_make_no_sense_are_refused_by_name() -> None:
    """Out of bounds, upside down, NaN, a broken delay, an unknown name: each refusal says what was found."""
    for name, span in (
        ("body_radius", (0.0, 0.1)),
        ("gain", (6.0, 1.5)),
        ("camera_dropout", (0.0, 1.1)),
        ("mass", (math.nan, 1.0)),
        ("action_delay", (0, 1.5)),
        ("observation_delay", (0, DELAY_MAX + 1)),
    ):
        with pytest.raises(SettingsError, match=name):
            Conditions().with_ranges({name: span})
    with pytest.raises(SettingsError, match="gian"):
        Conditions().with_ranges({"gian": (1.0, 2.0)})


def test_changed_names_what_differs_from_the_defaults() -> None:
    """The hard conditions name their seven; the defaults none."""
    assert Conditions().changed() == {}
    assert set(HARD.changed()) == {
        "body_radius", "field_of_view", "lidar_noise", "lidar_dropout", "camera_dropout", "gain", "compensation",
    }  # fmt: skip


def test_parameters_are_written_where_the_plant_reads_them() -> None:
    """Each plant parameter's word, of the chosen lanes, holds its condition; all other words are left alone."""
    names = [parameter.name for parameter in PARAMETERS]
    resets = ResetBatch.zeros(4)
    resets.raw[:] = 7.0
    drawn = draw_conditions(WIDE, seeds(2))
    apply_parameters(resets, np.array([3, 1]), drawn)
    for row, lane in ((0, 3), (1, 1)):
        words = dict(zip(names, resets.parameters[lane], strict=False))
        assert words.pop("force_gain") == drawn["gain"][row]
        assert words.pop("mass") == drawn["mass"][row]
        assert words.pop("linear_drag") == drawn["drag"][row]
        assert words.pop("gust") == drawn["gust"][row]
        assert words.pop("body_radius") == drawn["body_radius"][row]
        assert words.pop("force_along_body") == drawn["along_body"][row]
        assert set(words.values()) == {7.0}
        assert resets.seed[lane] == drawn["seed"][row] >= 0
    np.testing.assert_array_equal(resets.raw[[0, 2]], 7.0)


def test_every_plant_takes_the_extremes_of_every_condition() -> None:
    """The bounds of conditions that are plant parameters lie within what a reset may carry."""
    parameters = {parameter.name: parameter for parameter in PARAMETERS}
    for name, parameter in PARAMETERS_OF.items():
        row = CONDITIONS[NAMES.index(name)]
        assert row.lowest >= parameters[parameter].lowest
        assert row.highest <= parameters[parameter].highest
        assert not parameters[parameter].above_lowest or row.lowest > parameters[parameter].lowest


@pytest.fixture
def begin(
    cylinder: Callable[..., Geometry], poses_at: Callable[..., PoseBatch]
) -> Callable[..., tuple[TubeTask, PoseBatch]]:
    """Starts one lane a value of one condition in a tube of R = 1 m, all at the same pose."""

    def start(
        name: str, values: list[float], position: object, direction: object
    ) -> tuple[TubeTask, PoseBatch]:
        drawn = np.concatenate(
            [draw_conditions(Conditions().with_ranges({name: (v, v)}), [(0,)]) for v in values]
        )
        lanes = len(values)
        task = TubeTask(cylinder(lanes), Settings(), 0.1, clearance_contact=True)
        poses = poses_at(np.tile(position, (lanes, 1)), direction)
        task.begin(np.arange(lanes), poses, drawn)
        return task, poses

    return start


def test_the_body_touches_where_its_own_radius_reaches(
    begin: Callable[..., tuple[TubeTask, PoseBatch]],
) -> None:
    """0.2 m from the wall, bodies of less than 0.2 m fly on and larger ones collide."""
    task, poses = begin("body_radius", [0.1, 0.19, 0.21, 0.3], [5.0, 0.8, 0.0], [1.0, 0.0, 0.0])
    state = task.observe(poses)
    np.testing.assert_array_equal(state.contact, [False, False, True, True])
    np.testing.assert_array_equal(state.outcome, [0, 0, 3, 3])


def test_the_safety_feature_is_measured_from_the_own_body(
    begin: Callable[..., tuple[TubeTask, PoseBatch]],
) -> None:
    """0.4 m from the wall it is the gap to the body over 0.3 m, at most 1."""
    radii = [0.05, 0.15, 0.25, 0.35]
    task, poses = begin("body_radius", radii, [5.0, 0.0, -0.6], [1.0, 0.0, 0.0])
    safety = task.observe(poses).observation[:, FEATURE_NAMES.index("safety")]
    np.testing.assert_allclose(safety, [min((0.4 - radius) / 0.3, 1.0) for radius in radii], atol=1e-6)


@pytest.mark.parametrize(("half", "plane"), [(45.0, (0.0, 1.0, 0.0)), (35.0, (0.0, 0.0, 1.0))])
def test_the_field_of_view_is_that_share_of_the_half_angles(
    begin: Callable[..., tuple[TubeTask, PoseBatch]], half: float, plane: tuple[float, float, float]
) -> None:
    """Looking past the target by 0.99 of a narrowed half-angle it is seen, by 1.01 of it not."""
    for share in (0.3, 0.65, 1.0):
        for past, seen in ((0.99, True), (1.01, False)):
            angle = math.radians(past * share * half)
            direction = math.cos(angle) * np.array([1.0, 0.0, 0.0]) + math.sin(angle) * np.array(plane)
            task, poses = begin("field_of_view", [share], [5.0, 0.0, 0.0], direction)
            assert bool(task.observe(poses).target_visible[0]) is seen
