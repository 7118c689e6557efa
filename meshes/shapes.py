"""Named shapes of curves: helices, S-bends and elbows, to be flown beyond the paper's own families.

Each is drawn by its bends: the turn at every point, and the twist of the plane in which it turns. Bends tighten
with the level, up to the cap that is asked for at level 2. Lengths are those at R = 1 m.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Final, TypeAlias

import numpy as np

from meshes.compiled import compiled
from meshes.geometry import Floats

LEVEL_CAPS: Final = (0.3, 0.5, math.inf)
"""Greatest curvature of the named shapes at each level (1/R), if the cap that is asked for is not lower."""
CREST: Final = (0.7, 1.0)
"""Curvature of a helix, and of an S-bend at its crests, over the level's greatest."""
PITCH: Final = (2.7, 8.0)
"""Advance of a helix in one turn (m), at most what slopes by 45 degrees. 2.7 R keep two turns clear of each
other, with a gap of 0.7 R between the walls."""
S_ANGLE: Final = (math.radians(60.0), math.radians(120.0))
"""Angle by which an S-bend turns to one side before it turns to the other (rad)."""
S_TWIST: Final = (math.radians(20.0), math.radians(60.0))
"""Angle by which the plane of an S-bend turns in one bend, towards either side (rad)."""
ELBOW_ANGLE: Final = (math.radians(60.0), math.radians(90.0))
"""Angle of an elbow (rad)."""
ELBOW_STRAIGHT: Final = (1.5, 4.0)
"""Length of the straight before each elbow (m)."""

DrawPiece: TypeAlias = Callable[[np.random.Generator, int, int, float, float], "Floats | None"]
"""Draws a piece of a curve from a level, the segments that are still wanted, the step (m) and the cap (1/m).

It returns at most that many segments and one more: points (segments + 2, 3) whose first chord is the heading
that the piece starts from; None if the draw is of no use.
"""


def draw_helix(rng: np.random.Generator, level: int, segments: int, step: float, cap: float) -> Floats:
    """A helix of constant curvature and torsion, all that is wanted at once."""
    curvature = rng.uniform(*CREST) * min(LEVEL_CAPS[level], cap)
    # A helix that slopes by an angle b has the pitch pi sin(2 b) / curvature and the torsion curvature tan(b).
    pitch = rng.uniform(PITCH[0], min(PITCH[1], math.pi / curvature))
    slope = 0.5 * math.asin(pitch * curvature / math.pi)
    torsion = rng.choice([-1.0, 1.0]) * curvature * math.tan(slope)
    return _bend(np.full(segments, step * curvature), np.full(segments, step * torsion), step)


def draw_s_bend(rng: np.random.Generator, level: int, segments: int, step: float, cap: float) -> Floats:
    """Equal bends to the left and to the right by turns, in a plane that twists steadily; all at once.

    The curvature is a sine of the arc length. As each two bends are the same movement, the curve winds around
    a straight line and does not come back to itself, however long it is.
    """
    crest = rng.uniform(*CREST) * min(LEVEL_CAPS[level], cap)
    bend = 0.5 * math.pi * rng.uniform(*S_ANGLE) / crest  # arc length of one bend
    along = step * np.arange(segments) / bend + rng.uniform(0.0, 2.0)
    twist = rng.choice([-1.0, 1.0]) * rng.uniform(*S_TWIST) * step / bend
    return _bend(step * crest * np.sin(math.pi * along), np.full(segments, twist), step)


def draw_elbow(rng: np.random.Generator, level: int, segments: int, step: float, cap: float) -> Floats:
    """One straight and the arc behind it, as tight as is allowed. The next one bends in another plane."""
    straight = round(rng.uniform(*ELBOW_STRAIGHT) / step)
    turn = step * min(LEVEL_CAPS[level], cap)
    whole, rest = divmod(rng.uniform(*ELBOW_ANGLE), turn)
    turns = np.concatenate([np.zeros(straight), np.full(int(whole), turn), [rest]])[:segments]
    return _bend(turns, np.zeros(len(turns)), step)


NAMED_SHAPES: Final[Mapping[str, DrawPiece]] = {
    "helix": draw_helix,
    "s-bend": draw_s_bend,
    "elbow": draw_elbow,
}
"""The shapes by their names."""


@compiled
def _bend(turns: Floats, twists: Floats, step: float) -> Floats:
    """A polyline (K + 2, 3) from the turns (rad) at its K inner points and the twists (rad) before them.

    A twist rolls the axis of the next turn about the chord; both are the discrete curvature and torsion.
    """
    points = np.zeros((len(turns) + 2, 3))
    chord, binormal, normal = np.zeros(3), np.zeros(3), np.zeros(3)
    chord[0], binormal[2], normal[1] = 1.0, 1.0, 1.0
    points[1] = step * chord
    for i in range(len(turns)):
        c, s = np.cos(twists[i]), np.sin(twists[i])
        for k in range(3):
            binormal[k], normal[k] = c * binormal[k] - s * normal[k], c * normal[k] + s * binormal[k]
        c, s = np.cos(turns[i]), np.sin(turns[i])
        for k in range(3):
            chord[k], normal[k] = c * chord[k] + s * normal[k], c * normal[k] - s * chord[k]
            points[i + 2, k] = points[i + 1, k] + step * chord[k]
    return points
