"""Local frames and quaternions."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from agent_client.frames import frames_along, quaternions


def test_quaternions_of_frames_are_those_of_their_rotations() -> None:
    """Body x is f, body y is -r, body z is u; the scalar part is not negative; half turns are exact too."""
    rotation = Rotation.concatenate(
        [Rotation.random(200, random_state=1), Rotation.from_rotvec(np.pi * np.eye(3)), Rotation.identity(1)]
    )
    m = rotation.as_matrix()
    q = quaternions(np.stack([m[:, :, 0], m[:, :, 2], -m[:, :, 1]], axis=1))
    assert (q[:, 3] >= 0.0).all()
    assert (rotation.inv() * Rotation.from_quat(q)).magnitude().max() < 1e-14


def test_frames_along_are_right_handed_level_and_defined_everywhere() -> None:
    """F x u = r; r is level unless the direction is steep; vertical directions have a frame as well."""
    d = np.array([[1.0, 0, 0], [0, -2.0, 0], [0.6, 0, 0.8], [0, 0, 1.0], [0, 0, -1.0], [0.1, 0, 0.995]])
    frame = frames_along(d)
    np.testing.assert_allclose(frame @ frame.transpose(0, 2, 1), np.tile(np.eye(3), (6, 1, 1)), atol=1e-15)
    np.testing.assert_allclose(np.cross(frame[:, 0], frame[:, 1]), frame[:, 2], atol=1e-15)
    np.testing.assert_allclose(frame[:, 0], d / np.linalg.norm(d, axis=1, keepdims=True), atol=1e-15)
    np.testing.assert_allclose(frame[:3, 2, 2], 0.0, atol=1e-15)
    assert (frame[:3, 1, 2] > 0.0).all()
