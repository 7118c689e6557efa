"""The two rings in a straight cylinder, against closed forms."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from agent_client.lidar import ring_sectors
from agent_client.settings import LidarSettings, Settings
from agent_client.task import TaskStep, TubeTask

Maker = Callable[..., Any]


def look(geometry: Any, poses: Any, settings: Settings | None = None) -> TaskStep:
    """The first look at a pose."""
    task = TubeTask(geometry, settings or Settings(), 0.1, clearance_contact=True)
    return task.begin(np.arange(geometry.lanes), poses)


def test_sectors_are_ninety_degrees_around_right_top_left_and_bottom() -> None:
    """Nine rays of ten degrees each: right is -40 to 40 degrees, top 50 to 130, and so on."""
    expected = [0] * 5 + [1] * 9 + [2] * 9 + [3] * 9 + [0] * 4
    np.testing.assert_array_equal(ring_sectors(36), expected)


def test_centred_in_a_cylinder_everything_is_symmetric(cylinder: Maker, poses_at: Maker) -> None:
    """All rays read R; no asymmetry; both scores 1; no turn; whatever the roll."""
    for roll in (0.0, 0.7):
        step = look(cylinder(radius=1.2), poses_at([5.0, 0.0, 0.0], roll=roll))
        np.testing.assert_allclose(step.lidar, 1.2, atol=1e-12)
        e = step.episodes[0]
        for name in ("h_f", "v_f", "h_r", "v_r", "C_turn"):
            assert e[name] == pytest.approx(0.0, abs=1e-12)
        assert (e["S_F"], e["S_R"]) == (pytest.approx(1.0), pytest.approx(1.0))
        assert (e["mu_F"], e["mu_R"], e["l_min"]) == (pytest.approx(0.4),) * 3


def test_off_centre_rays_have_the_chords_of_the_circle(cylinder: Maker, poses_at: Maker) -> None:
    """A ray at angle phi from right, d to the right of the axis, reads -d cos phi + sqrt(R^2 - d^2 sin^2 phi)."""
    d = 0.3
    step = look(cylinder(), poses_at([5.0, -d, 0.0]))  # looking along x, right is -y
    phi = np.radians(10.0 * np.arange(36))
    chord = -d * np.cos(phi) + np.sqrt(1.0 - (d * np.sin(phi)) ** 2)
    np.testing.assert_allclose(step.lidar[0], np.tile(chord, 2), atol=1e-12)
    sectors = [chord[ring_sectors(36) == k].mean() / 3.0 for k in range(4)]
    e = step.episodes[0]
    assert e["h_f"] == pytest.approx(sectors[0] - sectors[2])
    assert e["h_f"] < 0.0
    assert e["v_f"] == pytest.approx(0.0, abs=1e-12)
    assert e["S_F"] == pytest.approx(1.0 - 0.5 * abs(sectors[0] - sectors[2]))
    assert e["mu_R"] == pytest.approx(chord.mean() / 3.0)
    assert e["l_min"] == pytest.approx(0.7 / 3.0)


def test_signs_are_right_minus_left_and_top_minus_bottom(cylinder: Maker, poses_at: Maker) -> None:
    """Close to the left wall there is more room on the right; close to the floor more at the top."""
    step = look(cylinder(lanes=2), poses_at([[5.0, 0.4, 0.0], [5.0, 0.0, -0.4]]))
    assert step.episodes["h_f"][0] > 0.1
    assert step.episodes["v_f"][1] > 0.1


def test_a_pitched_drone_has_its_rings_at_different_heights(cylinder: Maker, poses_at: Maker) -> None:
    """Nose up, the front ring stands 0.2 sin(pitch) above the rear one; straight up reads (R - z) / cos(pitch)."""
    pitch = 0.3
    direction = (math.cos(pitch), 0.0, math.sin(pitch))
    step = look(cylinder(), poses_at([5.0, 0.0, 0.0], direction))
    height = 0.2 * math.sin(pitch)
    assert step.lidar[0, 9] == pytest.approx((1.0 - height) / math.cos(pitch))
    assert step.lidar[0, 36 + 9] == pytest.approx((1.0 + height) / math.cos(pitch))


def test_readings_end_at_the_range(cylinder: Maker, poses_at: Maker) -> None:
    """In a tube wider than the range every ray reads the range."""
    step = look(cylinder(radius=5.0), poses_at([10.0, 0.0, 0.0]))
    assert (step.lidar == 3.0).all()
    assert step.episodes["l_min"][0] == 1.0


def test_a_ring_whose_way_is_blocked_reads_zero(cylinder: Maker, poses_at: Maker) -> None:
    """The nose pokes through the wall: the front ring reads zero, the rear one does not."""
    step = look(cylinder(), poses_at([5.0, -0.84, 0.0], (0.0, -1.0, 0.0)))
    assert (step.lidar[0, :36] == 0.0).all()
    assert (step.lidar[0, 36:] > 0.0).all()
    assert step.episodes["l_min"][0] == 0.0


def test_rings_have_as_many_rays_as_set(cylinder: Maker, poses_at: Maker) -> None:
    """The number of rays is a setting, and the summary does not depend on it in a centred pose."""
    step = look(cylinder(), poses_at([5.0, 0.0, 0.0]), Settings(lidar=LidarSettings(rays=12)))
    assert step.lidar.shape == (1, 24)
    assert step.episodes["mu_F"][0] == pytest.approx(1.0 / 3.0)
