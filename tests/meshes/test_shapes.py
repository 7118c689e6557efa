"""Named shapes of curves, against what geometry says of helices, arcs and alternating bends."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from meshes.curves import SHAPES, Curve, check_curve, generate_curve
from meshes.errors import CurveError
from meshes.shapes import CREST, ELBOW_ANGLE, LEVEL_CAPS, NAMED_SHAPES, PITCH, S_ANGLE, S_TWIST

Floats = NDArray[np.float64]

COUNT = 30
"""Curves of a shape, level and cap that are looked at."""


def unit(vectors: Floats) -> Floats:
    """Vectors (K, 3) made 1 long."""
    scaled: Floats = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return scaled


def signed_turns(curve: Curve) -> tuple[Floats, Floats]:
    """Turns (M - 2,) at inner points, with a sign that flips where the bend does, and twists (M - 3,) of their axes.

    Axes of opposite bends are opposite but for the twist, which is taken to be less than a quarter turn.
    """
    chords = unit(np.diff(curve.points, axis=0))
    cross = np.cross(chords[:-1], chords[1:])
    turns = np.arctan2(np.linalg.norm(cross, axis=1), np.sum(chords[:-1] * chords[1:], axis=1))
    axes = unit(cross)
    flips = np.sign(np.sum(axes[:-1] * axes[1:], axis=1))
    signs = np.concatenate([[1.0], np.cumprod(flips)])
    axes = axes * signs[:, None]
    twists = np.arctan2(
        np.sum(np.cross(axes[:-1], axes[1:]) * chords[1:-1], axis=1), np.sum(axes[:-1] * axes[1:], axis=1)
    )
    return signs * turns, twists


@pytest.mark.parametrize("shape", NAMED_SHAPES)
@pytest.mark.parametrize("cap", [0.05, 0.65, 0.9])
@pytest.mark.parametrize("level", [0, 1, 2])
def test_every_curve_can_be_swept(shape: str, cap: float, level: int) -> None:
    """Named shapes have equal steps, keep clear of themselves, and bend within the cap of their level."""
    for i in range(COUNT):
        curve = generate_curve(level, [8, i], shape=shape, curvature_cap=cap)
        assert curve.points.shape == (101, 3)
        np.testing.assert_array_equal(curve.points[0], 0.0)
        np.testing.assert_allclose(np.linalg.norm(np.diff(curve.points, axis=0), axis=1), 0.2, rtol=1e-9)
        check_curve(curve, min(LEVEL_CAPS[level], cap))


@pytest.mark.parametrize("shape", NAMED_SHAPES)
@pytest.mark.parametrize("length", [1.0, 7.3, 333.3, 2000.0])
def test_any_length(shape: str, length: float) -> None:
    """Named shapes of any length are just that long and keep clear of themselves."""
    curve = generate_curve(2, [4], length, shape=shape, curvature_cap=0.9)
    assert curve.length == pytest.approx(length, rel=1e-12)
    assert curve.step == pytest.approx(0.2, rel=0.03)
    check_curve(curve, 0.9)


@pytest.mark.parametrize("shape", SHAPES)
def test_wide_walls_keep_clear_of_each_other(shape: str) -> None:
    """Curves for walls up to 1.8 R from the axis leave more than 3.6 R between their parts."""
    for i in range(COUNT):
        curve = generate_curve(1, [6, i], 40.0, shape=shape, curvature_cap=0.5, widest=1.8)
        s = curve.step * np.arange(len(curve.points))
        apart = np.abs(s[:, None] - s) > 4.5 * 1.8 / 1.15 + 1e-9
        assert cdist(curve.points, curve.points)[apart].min() >= 3.6


def test_bends_tighten_with_the_level() -> None:
    """The tightest bends of every named shape are tighter at each level, and reach the cap at level 2."""
    for shape in NAMED_SHAPES:
        tightest = [
            max(
                generate_curve(level, [2, i], shape=shape, curvature_cap=0.9).curvature.max()
                for i in range(COUNT)
            )
            for level in range(3)
        ]
        np.testing.assert_allclose(tightest, [0.3, 0.5, 0.9], rtol=0.05)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_a_helix_has_constant_curvature_and_torsion(level: int) -> None:
    """Every turn is the same, and so is every twist; a turn advances by the pitch of that helix."""
    pitches, hands = [], set()
    for i in range(COUNT):
        curve = generate_curve(level, [i], 60.0, shape="helix", curvature_cap=0.9)
        turns, twists = signed_turns(curve)
        np.testing.assert_allclose(turns, turns[0], rtol=1e-6)
        np.testing.assert_allclose(twists, twists[0], rtol=1e-6)
        curvature, torsion = abs(turns[0]) / curve.step, twists[0] / curve.step
        assert CREST[0] - 1e-9 <= curvature / min(LEVEL_CAPS[level], 0.9) <= CREST[1] + 1e-9
        hands.add(np.sign(torsion))
        # Points one turn apart differ by the pitch along the axis, which the Darboux vector gives.
        rate = np.hypot(curvature, torsion)
        pitch = 2.0 * np.pi * abs(torsion) / rate**2
        pitches.append(pitch)
        s = curve.step * np.arange(len(curve.points))
        later = [np.interp(s + 2.0 * np.pi / rate, s, curve.points[:, k]) for k in range(3)]
        whole = s + 2.0 * np.pi / rate < s[-1]
        advance = np.linalg.norm(np.stack(later, axis=1) - curve.points, axis=1)[whole]
        np.testing.assert_allclose(advance, pitch, rtol=0.01)
    assert hands == {-1.0, 1.0}
    assert min(pitches) > PITCH[0] * 0.999
    assert max(pitches) < PITCH[1]


@pytest.mark.parametrize("level", [0, 1, 2])
def test_an_s_bend_alternates(level: int) -> None:
    """Bends go to one side and to the other by turns, by the same angle each, in a plane that twists steadily."""
    for i in range(COUNT):
        curve = generate_curve(level, [i], 100.0, shape="s-bend")
        turns, twists = signed_turns(curve)
        starts = np.flatnonzero(np.diff(np.sign(turns)) != 0) + 1
        bends = np.split(turns, starts)[1:-1]  # the first and the last may be cut
        angles = np.array([bend.sum() for bend in bends])
        assert len(bends) >= 5
        np.testing.assert_array_equal(np.sign(angles[1:]), -np.sign(angles[:-1]))
        assert np.ptp(np.abs(angles)) < 0.02
        assert S_ANGLE[0] - 0.01 < np.abs(angles).mean() < S_ANGLE[1] + 0.01
        np.testing.assert_allclose(twists, twists[0], rtol=1e-3)
        bend_steps = np.diff(starts).mean()
        assert S_TWIST[0] * 0.97 < abs(twists[0]) * bend_steps < S_TWIST[1] * 1.03


@pytest.mark.parametrize(("level", "bend"), [(0, 1 / 0.3), (1, 2.0), (2, 1 / 0.9)])
def test_elbows_are_straights_and_arcs(level: int, bend: float) -> None:
    """Points are on straights or on arcs of the tightest radius; each arc turns by 60 to 90 degrees in a plane."""
    planes = []
    for i in range(COUNT):
        curve = generate_curve(level, [i], 40.0, shape="elbow", curvature_cap=0.9)
        chords = unit(np.diff(curve.points, axis=0))
        cross = np.cross(chords[:-1], chords[1:])
        turns = np.arcsin(np.linalg.norm(cross, axis=1))
        turning = turns > 1e-6
        edges = np.flatnonzero(np.diff(turning)) + 1
        arcs = [arc for arc in np.split(np.arange(len(turns)), edges)[:-1] if turning[arc[0]]]
        assert len(arcs) >= 3
        assert not turning[:5].any()
        axes = []
        for arc in arcs:
            np.testing.assert_allclose(turns[arc[:-1]], curve.step / bend, rtol=1e-6)
            assert turns[arc[-1]] <= curve.step / bend + 1e-9
            assert ELBOW_ANGLE[0] - 1e-6 < turns[arc].sum() < ELBOW_ANGLE[1] + 1e-6
            axis = unit(cross[arc[:-1]])
            np.testing.assert_allclose(axis, np.broadcast_to(axis[0], axis.shape), atol=1e-6)
            axes.append(axis[0])
        straights = [part for part in np.split(np.arange(len(turns)), edges)[1:-1] if not turning[part[0]]]
        assert all(1.3 < curve.step * len(part) < 4.2 for part in straights)
        planes += [float(a @ b) for a, b in pairwise(axes)]
    assert min(planes) < -0.5
    assert max(planes) > 0.5


def test_shapes_are_drawn_from_their_seeds() -> None:
    """The same arguments give the same curve; another seed, domain or shape gives another."""
    ends = []
    for shape in SHAPES:
        first = generate_curve(2, [3], shape=shape).points
        np.testing.assert_array_equal(first, generate_curve(2, (3,), shape=shape).points)
        others = [generate_curve(2, [4], shape=shape), generate_curve(2, [3], shape=shape, domain="tune")]
        ends += [first[-1], *(curve.points[-1] for curve in others)]
    assert (cdist(ends, ends) + np.eye(len(ends))).min() > 1e-3


def test_unknown_shapes_are_refused() -> None:
    """A shape that does not exist is refused, with the names of those that do."""
    with pytest.raises(
        CurveError, match="shape: expected one of curriculum, helix, s-bend, elbow but found 'u'"
    ):
        generate_curve(0, [1], shape="u")
