"""Tubes to train and to be judged in: drawn from seeds, one domain of seeds for each purpose.

The paper has round tubes of one radius at three levels. The settings of `TubeRecipe` go beyond it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import numpy as np

from agent_client.conditions import Condition, Range
from agent_client.errors import SettingsError
from meshes.curves import (
    CURRICULUM,
    CURVATURE_CAP,
    DOMAINS,
    HARD_CURVATURE_CAP,
    SHAPES,
    Curve,
    generate_curve,
)
from meshes.geometry import Floats
from meshes.swept import SweptTube, sweep_section

LEVELS: Final = 3
"""Levels of the curriculum."""

POOL_SIZE: Final = 1000
"""Tubes of a level that training draws its episodes from."""

Domain: TypeAlias = Literal["train", "tune", "evaluate"]

TUBE_SETTINGS: Final = (
    Condition("lengths", "R", "lengths of the axis, one of which is drawn", 1.0, 2000.0),
    Condition("radius", "m", "mean radius R; the whole tube is scaled by it", 0.5, 2.0),
    Condition("swing", "R", "greatest change of the radius along the tube, a gentle wave", 0.0, 0.3),
    Condition(
        "curvature_cap",
        "1/R",
        "greatest curvature of level 2 and of named shapes; 0.9 bends to 1.1 R",
        0.05,
        0.9,
    ),
    Condition("ellipse", "R", "amplitude of an elliptic section", 0.0, 0.3),
    Condition("lobes", "R", "amplitude of a lobed section", 0.0, 0.2),
    Condition(
        "lobe_count", "lobes", "number of lobes of a lobed section; idle without lobes", 3, 8, whole=True
    ),
)
"""The settings of a recipe that are numbers, in the order of the fields of `TubeRecipe`, which has their
defaults."""

MIXED: Final = "mixed"
"""Instead of a shape: each tube has one of them, as likely as any other."""

TUBE_SHAPES: Final = (*SHAPES, MIXED)
"""The values of the setting `shape`."""

WIDEST_FOLD: Final = 0.95
"""Greatest product of curvature and wall distance; at 1 the wall folds inside of the bend."""

_SHAPE: Final = 0x5AFE  # enters the seed of radius and turn, so that they do not follow the curve's draws


@dataclass(frozen=True)
class TubeRecipe:
    """How the tubes of a level are drawn; the defaults are the tubes of the paper as we take them.

    A range is drawn from evenly, and for itself, by every tube.

    Raises:
        SettingsError: a value out of the bounds of `TUBE_SETTINGS`, or a range upside down; says which.
    """

    lengths: tuple[float, ...] = (20.0,)
    """Lengths of the axis over R, drawn evenly."""
    radius: Range = (1.0, 1.0)
    """Mean radius R (m). The whole tube is scaled by it: bends keep their radius over R."""
    swing: Range = (0.0, 0.0)
    """Largest relative change of the radius along the tube, a gentle wave."""
    curvature_cap: float = CURVATURE_CAP
    """Greatest curvature (1/R) at level 2, and of the named shapes. The curriculum's levels 0 and 1 keep the
    paper's own curves. A tube whose widest wall would fold in its bends is drawn with wider bends, as wide as
    `WIDEST_FOLD` asks for."""
    ellipse: Range = (0.0, 0.0)
    """Amplitude over R of the section's second harmonic, at an angle of its own, the same all along."""
    lobes: Range = (0.0, 0.0)
    """Amplitude over R of one higher harmonic, at an angle of its own, the same all along."""
    lobe_count: tuple[int, int] = (3, 5)
    """Order of that harmonic: the number of lobes."""
    shape: str = CURRICULUM
    """Shape of the axis, one of `TUBE_SHAPES`: the paper's families, a named shape, or any of them."""

    def __post_init__(self) -> None:
        if not self.lengths:
            raise SettingsError("lengths: expected at least one length over R, found none")
        for row in TUBE_SETTINGS:
            value = getattr(self, row.name)
            # `lengths` are choices and the cap is one number; the rest are ranges.
            choices = value if row.name == "lengths" else (value,)
            for choice in choices:
                row.check(*(choice if isinstance(choice, tuple) else (choice, choice)))
        if self.shape not in TUBE_SHAPES:
            raise SettingsError(f"shape: expected one of {', '.join(TUBE_SHAPES)}, found {self.shape!r}")


PAPER_TUBES: Final = TubeRecipe()
"""Round tubes of 20 m and R = 1 m."""

VARIED_TUBES: Final = TubeRecipe((20.0, 20.0, 40.0, 70.0), (0.8, 1.2), (0.0, 0.15))
"""What the shipped policy was trained in: longer tubes too, wider and narrower ones."""

HARD_TUBES: Final = TubeRecipe(curvature_cap=HARD_CURVATURE_CAP)
"""Bends down to a radius of 1.1 R at level 2."""


def draw_tube(level: int, seed: Sequence[int], domain: Domain, recipe: TubeRecipe = PAPER_TUBES) -> SweptTube:
    """Draw the tube that belongs to a level, a seed and a domain; the same arguments give the same tube.

    Args:
        level: 0, 1 or 2.
        seed: whole numbers from 0 on.
        domain: "train", "tune" or "evaluate": tubes of one are never seen in another.
        recipe: lengths, bends, radii and sections.

    Raises:
        meshes.errors.CurveError: no such tube was found.
    """
    rng = np.random.Generator(np.random.PCG64([_SHAPE, DOMAINS[domain], level, *seed]))
    length = float(rng.choice(np.array(recipe.lengths)))
    radius = rng.uniform(*recipe.radius)
    wavelength, turn = rng.uniform(8.0, 20.0), rng.uniform()
    swing = rng.uniform(*recipe.swing)
    harmonics = _draw_section(rng, recipe)
    shape = SHAPES[math.floor(rng.random() * len(SHAPES))] if recipe.shape == MIXED else recipe.shape
    widest = (1.0 + swing) * (1.0 + float(np.hypot(*harmonics.T).sum()))

    def draw_curve(cap: float) -> Curve:
        return generate_curve(
            level, seed, length, domain=domain, curvature_cap=cap, shape=shape, widest=widest
        )

    curve = draw_curve(recipe.curvature_cap if changed_by_cap(shape, level) else CURVATURE_CAP)
    if curve.curvature.max(initial=0.0) * widest > WIDEST_FOLD:
        curve = draw_curve(WIDEST_FOLD / widest)
    phase = 2.0 * np.pi * (curve.step * np.arange(len(curve.points)) / wavelength + turn)
    radii = radius * (1.0 + swing * np.sin(phase))
    return sweep_section(Curve(curve.points * radius, curve.step * radius), radii, harmonics)


def changed_by_cap(shape: str, level: int) -> bool:
    """Whether a recipe's `curvature_cap` bounds the tubes of a level: the curriculum's easy ones keep the paper's."""
    return shape != CURRICULUM or level == LEVELS - 1


def _draw_section(rng: np.random.Generator, recipe: TubeRecipe) -> Floats:
    """Amplitudes (H, 2) of the section's harmonics over R, as few as the recipe needs."""
    # One draw for each setting, whatever its range: narrowing one moves no other's draw.
    ellipse, ellipse_turn, lobes, lobes_turn, count = rng.random(5).tolist()
    low, high = recipe.lobe_count
    order = math.floor(low + count * (high - low + 1))
    highest = order if recipe.lobes[1] > 0.0 else 2 if recipe.ellipse[1] > 0.0 else 1
    harmonics = np.zeros((highest - 1, 2))
    if recipe.ellipse[1] > 0.0:
        harmonics[0] = _harmonic(recipe.ellipse, ellipse, ellipse_turn)
    if recipe.lobes[1] > 0.0:
        harmonics[order - 2] = _harmonic(recipe.lobes, lobes, lobes_turn)
    return harmonics


def _harmonic(span: Range, share: float, turn: float) -> tuple[float, float]:
    """An amplitude from its range, split into cosine and sine by a turn in [0, 1)."""
    amplitude = span[0] + share * (span[1] - span[0])
    return amplitude * math.cos(2.0 * math.pi * turn), amplitude * math.sin(2.0 * math.pi * turn)


def draw_pool(
    level: int, seed: int, count: int = POOL_SIZE, recipes: Sequence[TubeRecipe] = (PAPER_TUBES,)
) -> list[SweptTube]:
    """Draw `count` tubes of a level from training's domain, from the recipes in turn."""
    return [draw_tube(level, (seed, i), "train", recipes[i % len(recipes)]) for i in range(count)]
