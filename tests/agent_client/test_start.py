"""Where episodes start."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from agent_client.conditions import Conditions, draw_conditions
from agent_client.errors import SettingsError
from agent_client.kinematic import KinematicPlant
from agent_client.settings import DroneSettings, Settings
from agent_client.start import build_resets, draw_starts
from protocol.plant import NO_TUBE, PARAMETER_INDEX, ResetBatch

Maker = Callable[..., Any]

DESCRIPTION = KinematicPlant().describe()


def test_starts_lie_in_the_disc_and_cone_and_fill_them(cylinder: Maker) -> None:
    """At 0.6 m, up to 0.24 R off the axis, up to 8 degrees off its direction, at rest, without roll."""
    n = 2000
    resets = build_resets(DESCRIPTION, cylinder(lanes=n, radius=1.5), Settings(), range(n))
    np.testing.assert_allclose(resets.position[:, 0], 0.6)
    offset = np.linalg.norm(resets.position[:, 1:], axis=1) / 1.5
    assert offset.max() <= 0.24
    assert np.mean(offset < 0.12) == pytest.approx(0.25, abs=0.03)  # evenly over the disc
    m = Rotation.from_quat(resets.quaternion).as_matrix()
    angle = np.degrees(np.arccos(m[:, 0, 0]))
    assert angle.max() <= 8.0 + 1e-9
    assert np.mean(angle < 4.0) == pytest.approx(0.5, abs=0.04)
    np.testing.assert_allclose(m[:, 2, 1], 0.0, atol=1e-12)
    assert np.abs(resets.position[:, 1:].mean(axis=0)).max() < 0.02
    assert (resets.raw[:, 7:13] == 0.0).all()


def test_a_lane_starts_by_its_own_seed(cylinder: Maker) -> None:
    """The same seed gives the same start, bit for bit, in whatever company."""
    together = build_resets(DESCRIPTION, cylinder(lanes=3), Settings(), [5, 6, 7])
    for lane, seed in enumerate([5, 6, 7]):
        alone = build_resets(DESCRIPTION, cylinder(), Settings(), [seed])
        np.testing.assert_array_equal(together.raw[lane], alone.raw[0])
    assert len(np.unique(together.position[:, 1])) == 3


def test_resets_carry_defaults_overrides_and_the_body_radius(cylinder: Maker) -> None:
    """Plant's defaults, then the settings' body radius, then what is asked for; tube and seed as given."""
    settings = Settings(drone=DroneSettings(body_radius=0.2))
    resets = build_resets(
        DESCRIPTION, cylinder(), settings, [42], tube=3, parameters={"force_gain": 4.0, "gust": 0.5}
    )
    values = resets.parameters[0]
    assert values[PARAMETER_INDEX["mass"]] == DESCRIPTION.defaults[PARAMETER_INDEX["mass"]]
    assert values[PARAMETER_INDEX["body_radius"]] == 0.2
    assert values[PARAMETER_INDEX["force_gain"]] == 4.0
    assert values[PARAMETER_INDEX["gust"]] == 0.5
    assert (values[len(PARAMETER_INDEX) :] == 0.0).all()
    assert (resets.tube[0], resets.seed[0], resets.selected[0]) == (3, 42, 1)


def test_drawn_conditions_take_the_place_of_parameters_and_leave_the_start_alone(cylinder: Maker) -> None:
    """Each lane has its own gain, mass, body and seed of the gusts; what is no condition stays as asked for."""
    drawn = draw_conditions(
        Conditions(gain=(1.5, 6.0), mass=(0.5, 2.0), body_radius=(0.1, 0.2), along_body=(0, 1)),
        [(1,), (2,), (3,)],
    )
    plain = build_resets(
        DESCRIPTION, cylinder(lanes=3), Settings(), [5, 6, 7], parameters={"torque_kp": 100.0}
    )
    resets = build_resets(
        DESCRIPTION,
        cylinder(lanes=3),
        Settings(),
        [5, 6, 7],
        parameters={"force_gain": 4.0, "torque_kp": 100.0},
        drawn=drawn,
    )
    for parameter, name in (
        ("force_gain", "gain"), ("mass", "mass"), ("body_radius", "body_radius"), ("force_along_body", "along_body"),
    ):  # fmt: skip
        np.testing.assert_array_equal(resets.parameters[:, PARAMETER_INDEX[parameter]], drawn[name])
    assert (resets.parameters[:, PARAMETER_INDEX["torque_kp"]] == 100.0).all()
    np.testing.assert_array_equal(resets.seed, drawn["seed"].astype(np.int64))
    np.testing.assert_array_equal(resets.raw[:, :13], plain.raw[:, :13])


def test_drawing_selects_exactly_the_lanes_that_were_asked_for(cylinder: Maker) -> None:
    """Other rows keep their poses and are not selected."""
    resets = ResetBatch.zeros(4)
    resets.selected[:] = 1
    draw_starts(resets, np.array([1, 3]), cylinder(lanes=4), Settings().start, np.random.default_rng(0))
    np.testing.assert_array_equal(resets.selected, [0, 1, 0, 1])
    assert (resets.position[[0, 2]] == 0.0).all()
    assert (resets.position[[1, 3], 0] > 0.0).all()
    assert (resets.tube == NO_TUBE).all()


def test_a_start_in_a_vertical_tube_looks_up(bend: Maker) -> None:
    """The frame of a start is defined for any direction of the axis."""
    tube = bend()
    tube.axis = lambda s: (np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))
    resets = build_resets(DESCRIPTION, tube, Settings(), [1])
    forward = Rotation.from_quat(resets.quaternion[0]).as_matrix()[:, 0]
    assert forward[2] > math.cos(math.radians(8.1))


def test_a_tube_that_is_flown_before_it_begins_is_refused(cylinder: Maker) -> None:
    """At R 1 m the start at 0.6 m and the success radius of 0.5 R leave no way to fly in 1.1 m."""
    tubes = cylinder(lanes=2)
    tubes._length[1] = 1.09
    with pytest.raises(SettingsError, match=r"lane 1: expected a length above 1\.1 m .* found 1\.09 m"):
        build_resets(DESCRIPTION, tubes, Settings(), [0, 1])
    tubes._length[1] = 1.11
    build_resets(DESCRIPTION, tubes, Settings(), [0, 1])


def test_a_tube_that_the_body_does_not_fit_into_is_refused(cylinder: Maker) -> None:
    """The local radius at the start must be above the radius of the body that flies."""
    with pytest.raises(SettingsError, match=r"R 0\.01 m at the start is not above the body's radius 0\.15 m"):
        build_resets(DESCRIPTION, cylinder(radius=0.01), Settings(), [0])
    with pytest.raises(SettingsError, match=r"not above the body's radius 1\.2 m"):
        build_resets(DESCRIPTION, cylinder(), Settings(), [0], parameters={"body_radius": 1.2})
    drawn = draw_conditions(Conditions(), [(1,), (2,)])
    drawn["body_radius"][1] = 1.0
    with pytest.raises(SettingsError, match=r"lane 1: R 1 m at the start is not above the body's radius 1 m"):
        build_resets(DESCRIPTION, cylinder(lanes=2), Settings(), [0, 1], drawn=drawn)


def test_wrong_names_and_counts_are_refused(cylinder: Maker) -> None:
    """A misspelt parameter does not fly with its default."""
    with pytest.raises(SettingsError, match=r"plant parameters: expected .* found \['mas'\]"):
        build_resets(DESCRIPTION, cylinder(), Settings(), [0], parameters={"mas": 1.0})
    with pytest.raises(SettingsError, match="seeds: expected one for each of 2 lanes, found 1"):
        build_resets(DESCRIPTION, cylinder(lanes=2), Settings(), [0])
