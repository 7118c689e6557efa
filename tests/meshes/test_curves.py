"""Generated curves: their difficulty, their seeds, what is rejected, and the B-splines that smooth them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.spatial.distance import cdist

import meshes.curves as curves_module
from meshes.curves import (
    CURVATURE_CAP,
    HARD_CURVATURE_CAP,
    Curve,
    arc_lengths,
    bspline_basis,
    check_curve,
    generate_curve,
)
from meshes.errors import CurveError

Floats = NDArray[np.float64]

COUNT = 600
"""Curves a level, of which the medians are taken."""


def circumradius_curvature(points: Floats) -> Floats:
    """Curvature of the circles through three successive points: another formula than the one under test."""
    a, b = np.diff(points[:-1], axis=0), np.diff(points[1:], axis=0)
    area = np.linalg.norm(np.cross(a, b), axis=1)
    sides = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1) * np.linalg.norm(a + b, axis=1)
    curvature: Floats = 2.0 * area / sides
    return curvature


def nearest_approach(curve: Curve, apart: float = 4.5) -> float:
    """Least distance between points that are farther apart than that along the curve."""
    s = curve.step * np.arange(len(curve.points))
    distances = cdist(curve.points, curve.points)
    return float(distances[np.abs(s[:, None] - s) > apart + 1e-9].min())


@pytest.mark.parametrize(("level", "curvature", "turning"), [(0, 0.13, 72), (1, 0.37, 211), (2, 0.58, 365)])
def test_medians_of_each_level(level: int, curvature: float, turning: float) -> None:
    """Maximum curvature and total turning have a level's medians within 10 %.

    Measured over 2,000 curves a level: 0.130, 0.381, 0.554 per R and 73, 214, 367 degrees.
    """
    curves = [generate_curve(level, [31, i]) for i in range(COUNT)]
    assert np.median([curve.curvature.max() for curve in curves]) == pytest.approx(curvature, rel=0.1)
    assert np.degrees(np.median([curve.turning for curve in curves])) == pytest.approx(turning, rel=0.1)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_every_curve_can_be_swept(level: int) -> None:
    """Each curve starts at the origin, has uniform steps, bends within the cap and keeps clear of itself."""
    for i in range(100):
        curve = generate_curve(level, [5, i])
        assert curve.points.shape == (101, 3)
        assert curve.step == pytest.approx(0.2)
        assert curve.length == pytest.approx(20.0)
        np.testing.assert_array_equal(curve.points[0], 0.0)
        steps = np.linalg.norm(np.diff(curve.points, axis=0), axis=1)
        assert (steps <= 0.2 + 1e-9).all()
        assert (steps > 0.199).all()
        assert circumradius_curvature(curve.points).max() < CURVATURE_CAP * 1.002
        assert nearest_approach(curve) >= 2.3
        check_curve(curve)


def test_curves_point_everywhere() -> None:
    """Overall directions are spread over the sphere: tubes that rise, fall and cross the horizon all happen."""
    ends = np.array([generate_curve(0, [9, i]).points[-1] for i in range(COUNT)])
    directions = ends / np.linalg.norm(ends, axis=1, keepdims=True)
    np.testing.assert_allclose(directions.mean(axis=0), 0.0, atol=0.15)
    np.testing.assert_allclose(directions.T @ directions / COUNT, np.eye(3) / 3.0, atol=0.1)


def test_hard_curves_bend_more() -> None:
    """With the hard cap, curves bend more tightly than the usual cap allows, up to a bend radius of 1.1 R."""
    curves = [generate_curve(2, [6, i], curvature_cap=HARD_CURVATURE_CAP) for i in range(100)]
    tightest = np.array([curve.curvature.max() for curve in curves])
    assert np.median(tightest) > CURVATURE_CAP
    assert 0.85 < tightest.max() <= HARD_CURVATURE_CAP
    for curve in curves:
        check_curve(curve, HARD_CURVATURE_CAP)


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("length", [1.0, 7.3, 20.1, 333.3, 2000.0])
def test_any_length(level: int, length: float) -> None:
    """Curves of any length have just that length, about the usual step, and keep clear of themselves."""
    curve = generate_curve(level, [4], length=length)
    assert curve.length == pytest.approx(length, rel=1e-12)
    assert curve.step == pytest.approx(0.2, rel=0.03)
    check_curve(curve)
    if length < 1000.0 and length > 5.0:
        assert nearest_approach(curve) >= 2.3


def test_a_longer_curve_is_as_hard_all_along() -> None:
    """A level means the same at every length: turning grows with it, and each 20 m are like a short curve."""
    curve = generate_curve(1, [12], length=1000.0)
    assert np.degrees(curve.turning) / 50.0 == pytest.approx(211.0, rel=0.15)
    start = generate_curve(1, [12])
    np.testing.assert_allclose(curve.points[:101], start.points, atol=1e-9)


def test_the_same_seed_gives_the_same_curve() -> None:
    """Arguments decide the curve, whatever was drawn before."""
    first = generate_curve(2, [1, 2, 3]).points
    generate_curve(2, [4])
    np.testing.assert_array_equal(generate_curve(2, (1, 2, 3)).points, first)


def test_domains_and_seeds_are_disjoint() -> None:
    """Another domain, level or seed gives another curve, also where seeds differ by zeros or by large parts."""
    seeds: list[list[int]] = [
        [],
        [0],
        [0, 0],
        [1],
        [1, 0],
        [0, 1],
        [2**32],
        [1, 2**32],
        [2**32 + 1, 0],
        [7, 7],
    ]
    curves = [
        generate_curve(level, seed, length=2.0, domain=domain).points
        for domain in ("train", "tune", "evaluate")
        for level in (0, 1, 2)
        for seed in seeds
    ]
    ends = np.array([points[-1] for points in curves])
    distances = cdist(ends, ends) + np.eye(len(ends))
    assert len(ends) == 90
    assert distances.min() > 1e-6


def test_arguments_out_of_range() -> None:
    """Unknown levels and domains, negative seeds, and impossible lengths and caps are refused."""
    with pytest.raises(CurveError, match="level: expected 0, 1 or 2 but found 3"):
        generate_curve(3, [1])
    with pytest.raises(CurveError, match="domain: expected one of train, tune, evaluate but found 'test'"):
        generate_curve(0, [1], domain="test")
    with pytest.raises(CurveError, match="seed: expected whole numbers"):
        generate_curve(0, [-1])
    for length in (0.5, np.nan, np.inf):
        with pytest.raises(CurveError, match="length: expected at least 1 m"):
            generate_curve(0, [1], length=length)
    for cap in (0.0, 0.95):
        with pytest.raises(CurveError, match=r"curvature_cap: expected 0 to 0\.9"):
            generate_curve(0, [1], curvature_cap=cap)


def circle(bend: float, angle: float, pitch: float = 0.0) -> Curve:
    """A circle, or a helix that rises by `pitch` a turn."""
    per_radian = np.hypot(bend, pitch / (2.0 * np.pi))
    count = round(angle * per_radian / 0.2) + 1
    turn = np.linspace(0.0, angle, count)
    points = np.stack([bend * np.cos(turn), bend * np.sin(turn), pitch * turn / (2.0 * np.pi)], axis=1)
    return Curve(points, angle * per_radian / (count - 1))


def test_tight_bends_are_rejected() -> None:
    """A bend above the cap is refused, one just below it passes; the radius of the tube scales the cap."""
    check_curve(circle(1.0 / 0.64, 3.0))
    with pytest.raises(CurveError, match=r"expected curvature up to 0\.65 / R but found 0\.66"):
        check_curve(circle(1.0 / 0.66, 3.0))
    with pytest.raises(CurveError, match=r"expected curvature up to 0\.65"):
        check_curve(circle(1.0 / 0.64, 3.0), radius=1.1)


def test_curves_that_touch_themselves_are_rejected() -> None:
    """A curve that comes nearer to itself than 2.3 R is refused, one that stays just beyond it passes."""
    check_curve(circle(3.0, 12.0, pitch=2.6))
    with pytest.raises(CurveError, match="the tube would touch itself"):
        check_curve(circle(3.0, 12.0, pitch=2.2))


def test_a_curve_that_cannot_keep_clear_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where every draw comes too near to itself, the search ends with an error instead of going on."""
    monkeypatch.setattr(curves_module, "SELF_DISTANCE", 50.0)
    monkeypatch.setattr(curves_module, "MAX_DRAWS", 5)
    monkeypatch.setattr(curves_module, "MAX_RETREATS", 5)
    with pytest.raises(CurveError, match=r"level 1, seed \(3,\), length 60 m: .* use another seed"):
        generate_curve(1, [3], length=60.0)


def test_curvature_and_turning_of_a_circle() -> None:
    """Three quarters of a circle of 5 m turn by 270 degrees, at 0.2 per m all along."""
    curve = circle(5.0, 1.5 * np.pi)
    np.testing.assert_allclose(curve.curvature, 0.2, rtol=1e-9)
    assert curve.turning == pytest.approx(1.5 * np.pi, rel=0.01)
    assert curve.length == pytest.approx(7.5 * np.pi)


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 5), st.integers(7, 40), st.integers(0, 2**31))
def test_spline_basis(degree: int, controls: int, seed: int) -> None:
    """The basis gives the same curve as scipy's B-spline with clamped uniform knots, ends included."""
    coefficients = np.random.default_rng(seed).normal(size=(controls, 3))
    knots = np.concatenate([[0.0] * degree, np.linspace(0.0, 1.0, controls - degree + 1), [1.0] * degree])
    basis = bspline_basis(controls, degree, 101)
    np.testing.assert_allclose(basis.sum(axis=1), 1.0, atol=1e-12)
    expected = BSpline(knots, coefficients, degree)(np.linspace(0.0, 1.0, 101))
    np.testing.assert_allclose(basis @ coefficients, expected, atol=1e-12)


def test_arc_lengths_of_a_polyline() -> None:
    """Arc length adds up the chords."""
    points = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0], [3.0, 4.0, 2.0]])
    np.testing.assert_array_equal(arc_lengths(points), [0.0, 5.0, 7.0])
