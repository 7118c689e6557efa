"""From where a tube and its drone are looked at: positions of a camera, and no drawing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

VIEW_ANGLE: Final = 30.0
"""Height of what is seen from outside (degrees)."""
INSIDE_ANGLE: Final = 75.0
"""Of what is seen inside of a tube."""
UP: Final = np.array([0.0, 0.0, 1.0])
SIDE_MARGIN: Final = 0.12
TOP_MARGIN: Final = 0.17
BOTTOM_MARGIN: Final = 0.1
"""Shares of the picture that an overview keeps free; texts stand at the top, a scale at the right."""
POINTS: Final = 1500
"""Of a tube, by which it is framed."""

FOLLOW_BACK: Final = 4.0
FOLLOW_SIDE: Final = 6.0
FOLLOW_ABOVE: Final = 4.5
"""Of the camera that goes along outside: behind the drone, beside it and above it, over R."""
FOLLOW_CLEAR: Final = 2.5
"""What is nearer to that camera than the drone by more than this many R is left out."""
INSIDE_BACK: Final = 1.7
"""Of the camera that flies along inside: behind the drone on the axis, over R."""


@dataclass(frozen=True)
class Camera:
    """A place to look from."""

    position: Floats  # (3,)
    focus: Floats  # (3,)
    """What stands in the middle of the picture."""
    up: Floats  # (3,)
    angle: float = VIEW_ANGLE
    """Height of the picture (degrees)."""
    nearest: float = 0.0
    """What is nearer than this is left out (m)."""


def overview(points: Floats, aspect: float) -> Camera:
    """The whole of some points (V, 3), from the side from which they spread widest over the picture.

    Args:
        points: of the tube (m).
        aspect: width over height of the picture.
    """
    points = points[:: max(1, len(points) // POINTS)]
    apart = points - points.mean(axis=0)
    whole = max(float(np.linalg.norm(apart, axis=1).mean()), 1e-9)
    best, found = -1.0, None
    for elevation in np.radians([15.0, 25.0, 40.0, 60.0]):
        for azimuth in np.radians(np.arange(0.0, 360.0, 15.0)):
            level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
            towards = -np.cos(elevation) * level - np.sin(elevation) * UP
            distance, camera = _frame(points, towards, aspect)
            seen = np.linalg.norm(apart - np.outer(apart @ towards, towards), axis=1).mean()
            # Large, not shortened, and not from steeply above, where a tube looks flat.
            score = float(seen / max(distance, 1e-9) * (seen / whole) * (1.0 - 0.4 * np.sin(elevation)))
            if score > best * (1.0 + 1e-9):
                best, found = score, camera
    assert found is not None
    return found


def follow(position: Floats, tangent: Floats, radius: float) -> Camera:
    """Along with a drone, from outside of the tube, beside, behind and above it.

    Args:
        position: (3,) of the drone (m).
        tangent: (3,) of the axis there.
        radius: of the tube there (m).
    """
    ahead = _level(tangent)
    side = np.cross(ahead, UP)
    away = radius * (-FOLLOW_BACK * ahead + FOLLOW_SIDE * side + FOLLOW_ABOVE * UP)
    focus = position + 0.8 * radius * tangent
    nearest = float(np.linalg.norm(away)) - FOLLOW_CLEAR * radius
    return Camera(focus + away, focus, UP, nearest=nearest)


def inside(position: Floats, axis_position: Floats, tangent: Floats, up: Floats, radius: float) -> Camera:
    """Behind a drone, inside of the tube.

    Args:
        position: (3,) of the drone (m).
        axis_position: (3,) a point of the axis that is `INSIDE_BACK` R behind it (m).
        tangent: (3,) of the axis there.
        up: (3,) of the drone.
        radius: of the tube there (m).
    """
    upward = up - (up @ tangent) * tangent
    length = np.linalg.norm(upward)
    upward = upward / length if length > 0.1 else UP
    place = axis_position + 0.45 * radius * upward
    return Camera(place, position + 0.8 * radius * tangent, upward, angle=INSIDE_ANGLE)


def _frame(points: Floats, towards: Floats, aspect: float) -> tuple[float, Camera]:
    """The nearest camera that looks `towards` and sees all points, and how far it is from their middle."""
    right = np.cross(towards, UP)
    right /= np.linalg.norm(right)
    up = np.cross(right, towards)
    x, y, z = points @ right, points @ up, points @ towards
    half = float(np.tan(np.radians(VIEW_ANGLE / 2)))
    wide, tall, deep = (half * (1.0 - 2.0 * margin) for margin in (SIDE_MARGIN, TOP_MARGIN, BOTTOM_MARGIN))
    wide *= aspect
    # At depth z a camera at (a, b, c) sees |x - a| <= wide (z - c): each edge of the picture is a plane that
    # leans on the outermost point, and c is where two planes that face each other meet.
    left, right_most = (x + wide * z).min(), (x - wide * z).max()
    low, high = (y + deep * z).min(), (y - tall * z).max()
    c = min((left - right_most) / (2.0 * wide), (low - high) / (tall + deep))
    a, b = (left + right_most) / 2.0, (high + tall * c + low - deep * c) / 2.0
    middle = (z.min() + z.max()) / 2
    position = a * right + b * up + c * towards
    return float(middle - c), Camera(position, position + (middle - c) * towards, up)


def _level(tangent: Floats) -> Floats:
    """The direction of a tangent in the plane, or along x where it is upright."""
    flat = tangent - (tangent @ UP) * UP
    length = float(np.linalg.norm(flat))
    return flat / length if length > 0.2 else np.array([1.0, 0.0, 0.0])
