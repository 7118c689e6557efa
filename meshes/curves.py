"""Generated curves in space, that tubes are swept along: the paper's families, smoothed and fused.

The paper (Environment, curriculum learning) names four families (a) to (d) from nearly straight to highly
curved, two for each level, reparameterised by B-splines of random degree and tension and fused by a factor
alpha in [0.1, 0.9]. It gives no formulas. Those below are our choice: each family advances along x and swings
in y and z, its swing set by the curvature at its crests and its wavelength, in ranges that give the medians
0.13, 0.37, 0.58 per R of the maximum curvature and 72, 211, 365 degrees of total turning at the levels 0, 1
and 2, within 10 %. `meshes.shapes` has other shapes than the paper's.

Curves are made at R = 1 m in pieces, the paper's of 20 m. A longer one is a chain of pieces, so that a level
means the same at every length; a piece that comes too near to an earlier one is drawn anew.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from meshes.compiled import compiled
from meshes.errors import CurveError
from meshes.geometry import Floats
from meshes.shapes import NAMED_SHAPES

STEP = 0.2
"""Arc length between two points of a curve (m)."""
PIECE_LENGTH = 20.0
"""Arc length of a piece (m): the length of the paper's tubes as we take it, 20 R."""
CURVATURE_CAP = 0.65
"""Greatest curvature of a curve (1/R)."""
HARD_CURVATURE_CAP = 0.9
"""Greatest cap that may be asked for (1/R): a bend radius of 1.1 R."""
SELF_DISTANCE = 2.3
"""Least distance between parts of one curve (R): two walls and a gap of 0.3 R."""
SELF_ARC = 4.5
"""Arc length between points (R) from which on SELF_DISTANCE holds."""
WIDEST = SELF_DISTANCE / 2.0
"""Greatest wall distance (R) that SELF_DISTANCE has room for; walls beyond it need more in proportion."""

FUSION = (0.1, 0.9)
"""Range of alpha, the weight of a level's first family."""
DEGREES = (2, 3, 4, 5)
"""Degrees of the smoothing B-spline. 1 would leave corners."""
TENSION = (0.0, 0.5)
"""Range of the tension: how far each control point is pulled to the middle of its neighbours."""
CONTROL_SPACING = 1.25
"""Advance between two control points (m)."""
SPAN = 30.0
"""Advance of a raw curve (m): more than a piece, whose place in it is random."""
SAMPLES = 1200
"""Points on a raw curve's spline; what is read between them is off by less than 0.0001 m."""

# Curvature at the crests (1/m) and wavelength (m) of the families, at R = 1 m.
BOW_CURVATURE = (0.01, 0.05)
WAVE_CURVATURE = (0.17, 0.35)
WAVE_LENGTH = (13.0, 22.0)
SNAKE_CURVATURE = (0.4, 0.75)
SNAKE_LENGTH = (8.0, 13.0)
HELIX_CURVATURE = (1.7, 2.4)
HELIX_LENGTH = (6.5, 8.5)
HELIX_DRIFT = 0.3
"""Change of the helix's wavenumber along a raw curve, over its mean."""
HELIX_FLATNESS = (0.5, 1.0)
"""Ratio of the helix's two amplitudes."""

CURRICULUM = "curriculum"
"""The shape that a curve has by default: the paper's families at their levels."""
SHAPES = (CURRICULUM, *NAMED_SHAPES)
"""Shapes that a curve may have."""

DOMAINS = {"train": 1, "tune": 2, "evaluate": 3}
"""Tags of the seed domains: tubes of one domain are never drawn in another."""
MAX_DRAWS = 200
"""Draws of one piece before the last pieces of a chain are taken back."""
MAX_RETREATS = 50
"""Retreats before a curve is given up."""
RETREAT = 3
"""Pieces that a retreat takes back."""


@dataclass(frozen=True, eq=False)
class Curve:
    """A smooth curve, sampled at a uniform step of arc length."""

    points: Floats  # (M, 3)
    """Points (m), world frame, from the start to the end."""
    step: float
    """Arc length between two successive points (m)."""

    @property
    def length(self) -> float:
        """Arc length from the first to the last point (m)."""
        return self.step * (len(self.points) - 1)

    @property
    def curvature(self) -> Floats:
        """Curvature (1/m) at each inner point, (M - 2,): the angle between its two chords over the step."""
        return _turns(self.points) / self.step

    @property
    def turning(self) -> float:
        """Total turning (rad): the sum of the angles between successive chords."""
        return float(_turns(self.points).sum())


Family = Callable[[np.random.Generator, Floats], Floats]
"""Draws a raw curve: from the advance x (C,) to the swing (y, z), (C, 2), in metres."""


def family_a(rng: np.random.Generator, x: Floats) -> Floats:
    """Nearly straight: a shallow bow of one curvature."""
    curvature = rng.uniform(*BOW_CURVATURE)
    swing = np.zeros((len(x), 2))
    swing[:, 0] = 0.5 * curvature * (x - x[-1] * rng.uniform()) ** 2
    return swing


def family_b(rng: np.random.Generator, x: Floats) -> Floats:
    """Gently curved: a wave in one plane."""
    swing = np.zeros((len(x), 2))
    swing[:, 0] = _wave(rng, x, WAVE_CURVATURE, WAVE_LENGTH)
    return swing


def family_c(rng: np.random.Generator, x: Floats) -> Floats:
    """Curved: waves of different lengths in two planes, hence bends that follow each other out of plane."""
    return np.stack(
        [_wave(rng, x, SNAKE_CURVATURE, SNAKE_LENGTH), _wave(rng, x, SNAKE_CURVATURE, SNAKE_LENGTH)], axis=1
    )


def family_d(rng: np.random.Generator, x: Floats) -> Floats:
    """Highly curved: a flattened helix whose pitch drifts along it."""
    number = 2.0 * np.pi / rng.uniform(*HELIX_LENGTH)
    amplitude = rng.uniform(*HELIX_CURVATURE) / number**2
    drift = rng.uniform(-HELIX_DRIFT, HELIX_DRIFT)
    phase = number * x * (1.0 + drift * (x / x[-1] - 0.5)) + rng.uniform(0.0, 2.0 * np.pi)
    flatness = rng.uniform(*HELIX_FLATNESS) * rng.choice([-1.0, 1.0])
    return amplitude * np.stack([np.cos(phase), flatness * np.sin(phase)], axis=1)


def _wave(
    rng: np.random.Generator, x: Floats, curvature: tuple[float, float], length: tuple[float, float]
) -> Floats:
    """A sine with a crest curvature (1/m) and a wavelength (m) from these ranges."""
    number = 2.0 * np.pi / rng.uniform(*length)
    amplitude = rng.uniform(*curvature) / number**2
    wave: Floats = amplitude * np.sin(number * x + rng.uniform(0.0, 2.0 * np.pi))
    return wave


LEVELS: tuple[tuple[Family, Family], ...] = ((family_a, family_b), (family_b, family_c), (family_c, family_d))
"""The two families of each level (paper, curriculum-controlled selection)."""


def generate_curve(
    level: int,
    seed: Sequence[int],
    length: float = PIECE_LENGTH,
    *,
    domain: str = "train",
    curvature_cap: float = CURVATURE_CAP,
    shape: str = CURRICULUM,
    widest: float = 1.0,
) -> Curve:
    """Draws the curve that belongs to a level and a seed; the same arguments give the same curve.

    Args:
        level: 0, 1 or 2.
        seed: whole numbers from 0 to 2**64 - 1.
        length: arc length (m), at least 1; the step is the nearest to 0.2 m that divides it.
        domain: "train", "tune" or "evaluate"; tubes of different domains have nothing in common.
        curvature_cap: greatest curvature (1/m), up to 0.9 for hard tubes: the same curves, made smaller by
            the cap over 0.65, so that they bend more tightly and more often. Named shapes reach it at level 2.
        shape: "curriculum", or the name of one of `meshes.shapes`.
        widest: greatest distance of the wall from the axis over R. Beyond 1.15, parts of the curve keep 2
            `widest` R apart in place of 2.3 R.

    Raises:
        CurveError: an argument out of range, or no curve that keeps clear of itself was found.
    """
    _check_arguments(length, curvature_cap, shape)
    draw_piece = NAMED_SHAPES.get(shape, _draw_fused)
    rng = np.random.Generator(np.random.PCG64(_seed_sequence(level, seed, domain)))
    segments = round(length / STEP)
    step = length / segments
    room = max(widest / WIDEST, 1.0)
    points = np.zeros((segments + 1, 3))
    ends = [1]  # how many points stand after each piece
    draws = retreats = 0
    while ends[-1] <= segments:
        if draws == MAX_DRAWS:
            draws, retreats = 0, retreats + 1
            del ends[max(len(ends) - RETREAT, 1) :]
        if retreats > MAX_RETREATS:
            raise CurveError(
                f"shape {shape}, level {level}, seed {tuple(seed)}, length {length:g} m: expected a curve with "
                f"curvature up to {curvature_cap:g} per m that keeps clear of itself but found none; use "
                "another seed"
            )
        draws += 1
        start = ends[-1]
        piece = draw_piece(rng, level, segments + 1 - start, step, curvature_cap)
        if piece is None:
            continue
        stop = start + len(piece) - 2
        points[start:stop] = _continue(rng, points[:start], piece)
        if _self_approach(points[:stop], start, int(SELF_ARC * room / step), SELF_DISTANCE * room, step) < 0:
            ends.append(stop)
            draws = 0
    return Curve(points, step)


def check_curve(curve: Curve, curvature_cap: float = CURVATURE_CAP, radius: float = 1.0) -> None:
    """Checks that a tube of a radius R (m) can be swept along a curve.

    Raises:
        CurveError: the curvature exceeds `curvature_cap` / R, or parts of the curve more than 4.5 R apart
            along it are closer to each other than 2.3 R.
    """
    curvature = curve.curvature * radius
    if curvature.max(initial=0.0) > curvature_cap + 1e-9:
        place = curve.step * (int(curvature.argmax()) + 1)
        raise CurveError(
            f"curve: expected curvature up to {curvature_cap:g} / R but found {curvature.max():.3f} / R at "
            f"{place:.2f} m; widen the bend"
        )
    apart = int(SELF_ARC * radius / curve.step)
    index = _self_approach(curve.points, 1, apart, SELF_DISTANCE * radius, curve.step)
    if index >= 0:
        raise CurveError(
            f"curve: expected {SELF_DISTANCE:g} R between parts more than {SELF_ARC:g} R apart along it but "
            f"found less at {curve.step * index:.2f} m; the tube would touch itself"
        )


def _check_arguments(length: float, curvature_cap: float, shape: str) -> None:
    if not (np.isfinite(length) and length >= 1.0):
        raise CurveError(f"length: expected at least 1 m but found {length}")
    if not 0.0 < curvature_cap <= HARD_CURVATURE_CAP:
        raise CurveError(f"curvature_cap: expected 0 to {HARD_CURVATURE_CAP} per m but found {curvature_cap}")
    if shape not in SHAPES:
        raise CurveError(f"shape: expected one of {', '.join(SHAPES)} but found {shape!r}")


def _seed_sequence(level: int, seed: Sequence[int], domain: str) -> np.random.SeedSequence:
    if level not in range(len(LEVELS)):
        raise CurveError(f"level: expected 0, 1 or 2 but found {level}")
    if domain not in DOMAINS:
        raise CurveError(f"domain: expected one of {', '.join(DOMAINS)} but found {domain!r}")
    if not all(0 <= part < 2**64 for part in seed):
        raise CurveError(f"seed: expected whole numbers from 0 to 2**64 - 1 but found {tuple(seed)}")
    # SeedSequence pads with zeros and takes large numbers apart: their count, and two words for each, keep
    # different seeds different.
    words = [word for part in seed for word in (part & 0xFFFFFFFF, part >> 32)]
    return np.random.SeedSequence([DOMAINS[domain], level, len(seed), *words])


def _draw_fused(
    rng: np.random.Generator, level: int, segments: int, step: float, curvature_cap: float
) -> Floats | None:
    """A piece of a level's two families, fused, as a `meshes.shapes.DrawPiece`; None if it is too tight."""
    segments = min(segments, round(PIECE_LENGTH / step))
    scale = CURVATURE_CAP / curvature_cap
    raw = [_smooth(rng, family) for family in LEVELS[level]]
    alpha = rng.uniform(*FUSION)
    fused = scale * (alpha * raw[0] + (1.0 - alpha) * raw[1])
    reached = arc_lengths(fused)
    spare = reached[-1] - (segments + 1) * step
    offset = rng.uniform() * spare
    if spare < 0.0:
        return None
    piece = _interpolate(fused, reached, offset + step * np.arange(segments + 2))
    if _turns(piece).max(initial=0.0) > curvature_cap * step:
        return None
    return piece


def _smooth(rng: np.random.Generator, family: Family) -> Floats:
    """A raw curve as a B-spline of random degree and tension, (SAMPLES, 3), uniform in arc length."""
    x = np.arange(0.0, SPAN + CONTROL_SPACING, CONTROL_SPACING)
    controls = np.column_stack([x, _roll(rng, family(rng, x))])
    degree = int(rng.choice(DEGREES))
    tension = rng.uniform(*TENSION)
    controls[1:-1] += tension * (0.5 * (controls[:-2] + controls[2:]) - controls[1:-1])
    spline = bspline_basis(len(controls), degree, SAMPLES) @ controls
    reached = arc_lengths(spline)
    return _interpolate(spline, reached, np.linspace(0.0, reached[-1], SAMPLES))


def _roll(rng: np.random.Generator, swing: Floats) -> Floats:
    """Turns a swing (C, 2) about the x axis by a random angle."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    c, s = np.cos(angle), np.sin(angle)
    rolled: Floats = swing @ np.array([[c, s], [-s, c]])
    return rolled


@lru_cache(maxsize=16)
def bspline_basis(controls: int, degree: int, samples: int) -> Floats:
    """Values (samples, controls) of the B-spline basis with clamped uniform knots, over its whole range.

    Source: the recursion of Cox and de Boor.
    """
    inner = np.linspace(0.0, 1.0, controls - degree + 1)
    knots = np.concatenate([np.zeros(degree), inner, np.ones(degree)])
    t = np.linspace(0.0, 1.0, samples)[:, None]
    span = np.clip(np.searchsorted(knots, t, side="right") - 1, degree, controls - 1)
    basis: Floats = (span == np.arange(len(knots) - 1)).astype(np.float64)
    for k in range(1, degree + 1):
        width = knots[k:] - knots[:-k]  # of the functions of degree k - 1
        weight = np.divide(t - knots[:-k], width, out=np.zeros((samples, len(width))), where=width > 0.0)
        basis = weight[:, :-1] * basis[:, :-1] + (1.0 - weight[:, 1:]) * basis[:, 1:]
    basis.setflags(write=False)
    return basis


def arc_lengths(points: Floats) -> Floats:
    """Length (m) of the polyline up to each of its points, (M,)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def _interpolate(points: Floats, reached: Floats, wanted: Floats) -> Floats:
    return np.column_stack([np.interp(wanted, reached, points[:, i]) for i in range(3)])


def _continue(rng: np.random.Generator, points: Floats, piece: Floats) -> Floats:
    """Moves a piece to the end of a chain, rolled at random, so that its first chord continues the last one.

    Returns:
        The piece behind its first chord, (len(piece) - 2, 3). A chain of one point heads anywhere.
    """
    heading = points[-1] - points[-2] if len(points) > 1 else rng.normal(size=3)
    source = _frame(piece[1] - piece[0], np.array([0.0, 0.0, 1.0]))
    target = _frame(heading, rng.normal(size=3))
    moved: Floats = points[-1] + (piece[2:] - piece[1]) @ source.T @ target
    return moved


def _frame(forward: Floats, side: Floats) -> Floats:
    """Orthonormal rows, the first along `forward`, the second towards `side`, (3, 3)."""
    first = forward / np.linalg.norm(forward)
    second = side - (side @ first) * first
    second /= np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)])


def _turns(points: Floats) -> Floats:
    """Angles (rad) between successive chords of a polyline (M, 3), (M - 2,)."""
    return _angles(np.diff(points, axis=0))


@compiled
def _angles(chords: Floats) -> Floats:
    """Angles (rad) between successive vectors (C, 3), (C - 1,)."""
    angles = np.empty(max(len(chords) - 1, 0))
    for i in range(len(angles)):
        ax, ay, az = chords[i, 0], chords[i, 1], chords[i, 2]
        bx, by, bz = chords[i + 1, 0], chords[i + 1, 1], chords[i + 1, 2]
        cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        angles[i] = np.arctan2(np.sqrt(cx * cx + cy * cy + cz * cz), ax * bx + ay * by + az * bz)
    return angles


@compiled
def _self_approach(points: Floats, start: int, apart: int, distance: float, step: float) -> int:
    """First point from `start` on that has one more than `apart` before it within `distance` (m), or -1."""
    for i in range(start, len(points)):
        j = 0
        while j < i - apart:
            x, y, z = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
            far = np.sqrt(x * x + y * y + z * z) - distance
            if far < 0.0:
                return i
            # No point nearer along the curve than that can be near enough.
            j += max(int(far / step), 1)
    return -1
