"""Smoothing and derivatives of evenly spaced points by polynomials fitted around each (Savitzky and Golay).

As `scipy.signal.savgol_filter` does it, whose import takes longer than finding a centreline.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from meshes.geometry import Floats


def fit_locally(points: Floats, window: int, degree: int, derivative: int = 0, step: float = 1.0) -> Floats:
    """A derivative, at each of the points (M, K), of the polynomial through its neighbours in the least squares.

    Nearer to an end than half of the window it is the polynomial of the window at this end.

    Args:
        points: evenly spaced, at least `window` of them.
        window: an odd number of points, more than `degree`.
        degree: of the polynomials.
        derivative: which; 0 smooths.
        step: distance between neighbours, in whose unit the derivative is.
    """
    half = window // 2
    at = np.arange(-half, half + 1) / half  # in half windows, for a well-conditioned fit
    coefficients = np.linalg.pinv(np.vander(at, degree + 1, increasing=True))  # (degree + 1, window)
    powers = np.arange(derivative, degree + 1)
    factors = np.array([math.perm(power, derivative) for power in powers]) / (half * step) ** derivative
    weights = (at[:, None] ** (powers - derivative) * factors) @ coefficients[powers]  # (window, window)
    fitted = np.empty_like(points)
    fitted[:half] = weights[:half] @ points[:window]
    fitted[half:-half] = sliding_window_view(points, window, axis=0) @ weights[half]
    fitted[-half:] = weights[half + 1 :] @ points[-window:]
    return fitted
