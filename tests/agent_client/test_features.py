"""The 37 features against a plain, one-lane, textbook formulation of their definitions."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from agent_client.errors import SettingsError
from agent_client.features import FEATURE_NAMES, FEATURES
from agent_client.settings import Settings
from agent_client.task import TubeTask
from protocol.plant import PoseBatch

Maker = Callable[..., Any]


class Oracle:
    """One drone in a straight open cylinder along x; every quantity spelled out with no regard for speed."""

    def __init__(self, radius: float, length: float, limit: int) -> None:
        self.R, self.length, self.limit = radius, length, limit
        self.t = -1
        self.v_before: float | None = None
        self.memory: np.ndarray | None = None
        self.age = 21

    def distance(self, o: np.ndarray, d: np.ndarray) -> float:
        """Range to the wall by bisection on the way, not by the formula."""
        outside = lambda t: math.hypot(*(o + t * d)[1:]) > self.R  # noqa: E731
        if not outside(3.0):
            return 3.0  # the way is straight and the section convex: inside at its end is inside all along
        low, high = 0.0, 3.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if outside(middle) else (middle, high)
        return low if 0.0 <= (o + low * d)[0] <= self.length else 3.0

    def ring(self, p: np.ndarray, f: np.ndarray, u: np.ndarray, r: np.ndarray, side: float) -> np.ndarray:
        """Ranges of a ring over 3 m."""
        if self.distance(p, side * f) < 0.2:
            return np.zeros(36)
        angles = [math.radians(10 * j) for j in range(36)]
        origin = p + side * 0.2 * f
        return np.array([self.distance(origin, math.cos(a) * r + math.sin(a) * u) for a in angles]) / 3.0

    def observe(self, p: np.ndarray, q: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """The observation after one more step."""
        self.t += 1
        m = Rotation.from_quat(q).as_matrix()
        f, u, r = m[:, 0], m[:, 2], -m[:, 1]
        out: list[float] = []
        scores, means, all_ranges = [], [], []
        for side in (1.0, -1.0):
            ranges = self.ring(p, f, u, r, side)
            degrees = 10 * np.arange(36)
            right = ranges[(degrees <= 40) | (degrees >= 320)].mean()
            top = ranges[(degrees >= 50) & (degrees <= 130)].mean()
            left = ranges[(degrees >= 140) & (degrees <= 220)].mean()
            bottom = ranges[(degrees >= 230) & (degrees <= 310)].mean()
            out += [right - left, top - bottom]
            scores.append(1 - (abs(right - left) + abs(top - bottom)) / 2)
            means.append(ranges.mean())
            all_ranges.append(ranges)
        nearest = np.min(all_ranges)
        out += [2 * x - 1 for x in (*scores, *means, nearest)]
        out += [*f, *u, *r]
        v = float(velocity @ f)
        before = v if self.v_before is None else self.v_before
        self.v_before = v
        out += [np.clip(2 * v / 2.0 - 1, -1, 1), np.clip((v - before) / 2.0, -1, 1)]
        s = min(max(p[0], 0.0), self.length)
        axis = np.array([s, 0.0, 0.0])
        out.append(2 * s / self.length - 1)
        out += [np.clip((p - axis) @ e / self.R, -1, 1) for e in (f, u, r)]
        d = np.array([min(s + 3.0, self.length), 0.0, 0.0]) - p
        depth = float(np.linalg.norm(d))
        d = d / depth
        seen = (
            abs(math.degrees(math.atan2(d @ r, d @ f))) <= 45
            and abs(math.degrees(math.atan2(d @ u, d @ f))) <= 35
        )
        if seen:
            out += [d @ f, d @ u, d @ r, min(2 * depth / 4.0 - 1, 1), 1.0]
            self.memory, self.age = d, 0
        else:
            out += [0.0, 0.0, 0.0, 1.0, -1.0]
            self.age = min(self.age + 1, 21)
        kept = self.memory if self.memory is not None and self.age <= 20 else None
        out.append(min(2 * self.age / 20 - 1, 1))
        out += [0.0, 0.0, 0.0, -1.0] if kept is None else [kept @ f, kept @ u, kept @ r, 1.0]
        out.append(np.clip((3.0 * nearest - 0.15) / 0.3, -1, 1))
        out.append(1.0 if math.hypot(p[1], p[2]) < self.R and 0 <= p[0] <= self.length else -1.0)
        out.append(2 * self.t / self.limit - 1)
        return np.array(out)


def test_the_table_numbers_37_features_in_the_papers_groups() -> None:
    """9 LiDAR, 15 kinematic, 5 camera, 5 memory, 3 context; names are unique; all lie in [-1, 1]."""
    assert [f.index for f in FEATURES] == list(range(37))
    assert len(set(FEATURE_NAMES)) == 37
    sections = [f.section for f in FEATURES]
    sizes = [sections.count(name) for name in dict.fromkeys(sections)]
    assert sizes == [9, 15, 5, 5, 3]
    assert {(f.low, f.high) for f in FEATURES} == {(-1.0, 1.0)}
    assert FEATURE_NAMES[9:24] == (
        "f_x", "f_y", "f_z", "u_x", "u_y", "u_z", "r_x", "r_y", "r_z", "v", "dv", "progress",
        "position_f", "position_u", "position_r",
    )  # fmt: skip


@pytest.mark.parametrize("lanes", [1, 5])
def test_features_agree_with_the_plain_formulation(cylinder: Maker, lanes: int) -> None:
    """Random poses, any attitude, over a whole episode of 40 steps: equal to float32 rounding."""
    rng = np.random.default_rng(11)
    tube = cylinder(lanes=lanes, radius=1.1)
    task = TubeTask(tube, Settings(), 0.1, clearance_contact=False, on_contact="continue", step_limit=500)
    oracles = [Oracle(1.1, 20.0, 500) for _ in range(lanes)]
    attitude = Rotation.random(lanes, random_state=5)
    for t in range(41):
        poses = PoseBatch.zeros(lanes)
        radial, angle = 1.05 * np.sqrt(rng.random(lanes)), 2 * np.pi * rng.random(lanes)
        poses.position[:, 0] = rng.uniform(0.5, 19.0, lanes)
        poses.position[:, 1], poses.position[:, 2] = radial * np.cos(angle), radial * np.sin(angle)
        if t % 15 == 0:  # often the same attitude for a while, so that memory is renewed, aged and lost
            attitude = Rotation.from_rotvec(rng.normal(0.0, 1.0, (lanes, 3)))
        poses.quaternion[:] = attitude.as_quat()
        poses.linear_velocity[:] = rng.normal(0.0, 1.5, (lanes, 3))
        step = task.begin(np.arange(lanes), poses) if t == 0 else task.observe(poses)
        for i, oracle in enumerate(oracles):
            expected = oracle.observe(poses.position[i], poses.quaternion[i], poses.linear_velocity[i])
            for name, got, want in zip(FEATURE_NAMES, step.observation[i], expected, strict=True):
                assert got == pytest.approx(want, abs=2e-7), f"{name} of lane {i} at step {t}"
    assert step.observation.dtype == np.float32


def test_features_outside_of_the_tube_stay_in_range(cylinder: Maker, poses_at: Maker) -> None:
    """Far outside, every feature is finite and in [-1, 1], and `inside` is -1."""
    poses = poses_at([25.0, 3.0, -4.0], (0.3, 1.0, 0.2), speed=30.0)
    task = TubeTask(cylinder(), Settings(), 0.1, clearance_contact=False)
    step = task.begin(np.array([0]), poses)
    assert np.isfinite(step.observation).all()
    assert np.abs(step.observation).max() <= 1.0
    assert step.observation[0, FEATURE_NAMES.index("inside")] == -1.0


def test_masked_features_stay_in_place_and_read_zero(cylinder: Maker, poses_at: Maker) -> None:
    """Masking changes the named features alone."""
    poses = poses_at([5.0, 0.2, 0.1], (1.0, 0.1, 0.0), speed=1.0)
    masked = ("progress", "position_f", "position_u", "position_r")
    seen = TubeTask(cylinder(), Settings(), 0.1, clearance_contact=False).begin(np.array([0]), poses)
    blind = TubeTask(cylinder(), Settings(masked_features=masked), 0.1, clearance_contact=False).begin(
        np.array([0]), poses
    )
    for i, name in enumerate(FEATURE_NAMES):
        assert blind.observation[0, i] == (0.0 if name in masked else seen.observation[0, i])


def test_an_unknown_masked_feature_is_refused(cylinder: Maker) -> None:
    """A misspelt name does not silently mask nothing."""
    with pytest.raises(SettingsError, match=r"masked_features: expected .* found \['progres'\]"):
        TubeTask(cylinder(), Settings(masked_features=("progres",)), 0.1, clearance_contact=True)
