"""Local polynomials: what they keep, against closed forms and numpy's own fit."""

from __future__ import annotations

import numpy as np
import pytest

from meshes.smoothing import fit_locally


@pytest.mark.parametrize("window", [5, 9, 21])
def test_a_polynomial_is_kept_with_its_derivatives(window: int) -> None:
    """A quartic through 21 points is given back everywhere, the ends included, and so are its derivatives."""
    t = 0.25 * np.arange(21)
    polynomials = [np.polynomial.Polynomial(c) for c in ([1, -2, 0.5, 0.3, -0.1], [0, 1, 0, 0, 0.02])]
    points = np.stack([p(t) for p in polynomials], axis=1)
    for order in range(4):
        expected = np.stack([p.deriv(order)(t) for p in polynomials], axis=1) if order else points
        np.testing.assert_allclose(fit_locally(points, window, 4, order, 0.25), expected, atol=1e-8)


def test_noise_is_fitted_as_numpy_fits_it() -> None:
    """Inside, and in the half window before each end, the value is that of numpy's least squares fit."""
    points = np.random.default_rng(1).normal(size=(30, 1))
    smooth = fit_locally(points, 11, 3)
    for place, first in ((0, 0), (3, 0), (5, 0), (12, 7), (24, 19), (28, 19), (29, 19)):
        fit = np.polynomial.Polynomial.fit(np.arange(first, first + 11), points[first : first + 11, 0], 3)
        assert smooth[place, 0] == pytest.approx(fit(place), abs=1e-12)
