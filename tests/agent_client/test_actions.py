"""The 36 actions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from agent_client.actions import action_table, decode
from agent_client.settings import Settings

K = 0.75
WIDE, HIGH = K * math.radians(45.0), K * math.radians(35.0)


def test_there_are_nine_directions_times_four_speeds() -> None:
    """Index = direction * 4 + speed; 9 distinct directions, each with all speeds in ascending order."""
    table = action_table(Settings())
    assert len(table) == 36
    assert len(np.unique(np.round(table.local, 12), axis=0)) == 9
    np.testing.assert_array_equal(table.speed.reshape(9, 4), np.tile([0.5, 1.0, 1.5, 2.0], (9, 1)))
    by_direction = table.local.reshape(9, 4, 3)
    np.testing.assert_array_equal(by_direction, np.repeat(by_direction[:, :1], 4, axis=1))


def test_directions_are_the_papers_angle_pairs() -> None:
    """(0, 0), +-k theta_a, +-k theta_b and their four combinations, as angles seen in the image plane."""
    table = action_table(Settings())
    pairs = {(round(a, 9), round(b, 9)) for a, b in zip(table.alpha, table.beta, strict=True)}
    assert pairs == {(round(a, 9), round(b, 9)) for a in (-WIDE, 0, WIDE) for b in (-HIGH, 0, HIGH)}
    f, u, r = table.local.T
    np.testing.assert_allclose(np.arctan2(r, f), table.alpha, atol=1e-15)
    np.testing.assert_allclose(np.arctan2(u, f), table.beta, atol=1e-15)


def test_directions_are_unit_forward_and_inside_the_field_of_view() -> None:
    """No action faces backward or leaves the camera's cone."""
    table = action_table(Settings())
    np.testing.assert_allclose(np.linalg.norm(table.local, axis=1), 1.0, atol=1e-15)
    assert (table.local[:, 0] > 0.5).all()
    assert (np.abs(table.alpha) < math.radians(45.0)).all()
    assert (np.abs(table.beta) < math.radians(35.0)).all()


def test_the_first_actions_go_straight_and_the_next_to_the_right() -> None:
    """The order of directions is part of every checkpoint: straight, right, left, up, down, corners."""
    local = action_table(Settings()).local[::4]
    signs = np.sign(np.round(local[:, 1:], 12))  # components along u and r
    expected = [(0, 0), (0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, 1), (1, -1), (-1, -1)]
    np.testing.assert_array_equal(signs, expected)


@pytest.mark.parametrize("lanes", [1, 7])
def test_decode_turns_actions_into_world_commands(lanes: int) -> None:
    """Direction = f + tan(alpha) r + tan(beta) u, normalised, by the lane's own axes; the rest is untouched."""
    rng = np.random.default_rng(3)
    table = action_table(Settings())
    m = Rotation.random(lanes, random_state=4).as_matrix()
    frame = np.stack([m[:, :, 0], m[:, :, 2], -m[:, :, 1]], axis=1)
    actions = rng.integers(0, 36, lanes)
    commands = np.full((lanes, 8), 7.0)
    decode(actions, frame, table.local, table.speed, commands)
    for i, a in enumerate(actions):
        f, u, r = frame[i]
        d = f + math.tan(table.alpha[a]) * r + math.tan(table.beta[a]) * u
        np.testing.assert_allclose(commands[i, :3], d / np.linalg.norm(d), atol=1e-14)
        assert commands[i, 3] == table.speed[a]
    assert (commands[:, 4:] == 7.0).all()
