"""The constants of the task and what is refused of them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from agent_client.errors import SettingsError
from agent_client.settings import (
    ActionSettings,
    CameraSettings,
    LidarSettings,
    Settings,
    StartSettings,
    TaskSettings,
    max_steps,
)


def test_step_limit_is_one_and_a_half_times_the_slowest_passage() -> None:
    """20 m at 0.5 m/s in steps of 0.1 s are 400 steps, the limit is 600, without a step for rounding."""
    assert max_steps(Settings(), 20.0, 0.1) == 600
    assert max_steps(Settings(), 20.01, 0.1) == 601
    assert max_steps(Settings(), 20.0, 0.05) == 1200


def test_speed_max_is_the_fastest_level() -> None:
    """Speeds are normalised by the last level."""
    assert Settings(actions=ActionSettings(speeds=(0.5, 3.0))).speed_max == 3.0


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"lidar": LidarSettings(rays=32)}, "lidar.rays"),
        ({"lidar": LidarSettings(offset=4.0)}, "lidar.offset"),
        ({"camera": CameraSettings(half_width=math.pi / 2)}, "camera.half_width"),
        ({"camera": CameraSettings(half_height=math.nan)}, "camera.half_height"),
        ({"actions": ActionSettings(speeds=(1.0, 0.5))}, "actions.speeds"),
        ({"actions": ActionSettings(speeds=())}, "actions.speeds"),
        ({"start": StartSettings(offset=1.0)}, "start.offset"),
        ({"task": TaskSettings(time_factor=0.0)}, "task.time_factor"),
    ],
)
def test_a_setting_out_of_range_is_refused_by_name(changes: dict[str, Any], name: str) -> None:
    """The message names the setting, what was expected and what was found."""
    with pytest.raises(SettingsError, match=rf"{name}: expected .*, found "):
        replace(Settings(), **changes)
