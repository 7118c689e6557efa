"""Tubes to train and to be judged in: drawn from seeds, one domain of seeds for each purpose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import numpy as np

from meshes.curves import DOMAINS, Curve, generate_curve
from meshes.swept import SweptTube, circular

LEVELS: Final = 3
"""Levels of the curriculum."""

POOL_SIZE: Final = 1000
"""Tubes of a level that training draws its episodes from."""

Domain: TypeAlias = Literal["train", "tune", "evaluate"]

_SHAPE: Final = 0x5AFE  # enters the seed of radius and turn, so that they do not follow the curve's draws


@dataclass(frozen=True)
class TubeRecipe:
    """How the tubes of a level are drawn; the defaults are the tubes of the paper as we take them."""

    lengths: tuple[float, ...] = (20.0,)
    """Lengths of the axis over R, drawn evenly."""
    radius: tuple[float, float] = (1.0, 1.0)
    """Range of the mean radius R (m). The whole tube is scaled by it: bends keep their radius over R."""
    swing: float = 0.0
    """Largest relative change of the radius along the tube, a gentle wave."""


PAPER_TUBES: Final = TubeRecipe()
"""Round tubes of 20 m and R = 1 m."""

VARIED_TUBES: Final = TubeRecipe((20.0, 20.0, 40.0, 70.0), (0.8, 1.2), 0.15)
"""What the shipped policy was trained in: longer tubes too, wider and narrower ones."""


def draw_tube(level: int, seed: Sequence[int], domain: Domain, recipe: TubeRecipe = PAPER_TUBES) -> SweptTube:
    """Draw the tube that belongs to a level, a seed and a domain; the same arguments give the same tube.

    Args:
        level: 0, 1 or 2.
        seed: whole numbers from 0 on.
        domain: "train", "tune" or "evaluate": tubes of one are never seen in another.
        recipe: lengths and radii.

    Raises:
        meshes.errors.CurveError: no such tube was found, or it would fold.
    """
    rng = np.random.Generator(np.random.PCG64([_SHAPE, DOMAINS[domain], level, *seed]))
    length = float(rng.choice(np.array(recipe.lengths)))
    radius = rng.uniform(*recipe.radius)
    curve = generate_curve(level, seed, length, domain=domain)
    wavelength = rng.uniform(8.0, 20.0)
    phase = 2.0 * np.pi * (curve.step * np.arange(len(curve.points)) / wavelength + rng.uniform())
    swing = rng.uniform(0.0, recipe.swing) * np.sin(phase)
    return circular(Curve(curve.points * radius, curve.step * radius), radius * (1.0 + swing))


def draw_pool(
    level: int, seed: int, count: int = POOL_SIZE, recipe: TubeRecipe = PAPER_TUBES
) -> list[SweptTube]:
    """Draw `count` tubes of a level from training's domain."""
    return [draw_tube(level, (seed, index), "train", recipe) for index in range(count)]
