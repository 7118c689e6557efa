"""By which colours the values of a quantity are shown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

Quantity = Literal["clearance", "reward", "speed"]

# The colours of the centreline and of the camera's field are in neither of the first two maps.
_SCALES: Final[dict[Quantity, tuple[str, str]]] = {
    "clearance": ("gap to wall\n(m)", "RdBu"),
    "reward": ("reward, 96 %\nof steps", "RdBu"),
    "speed": ("speed\n(m/s)", "viridis"),
}
"""Title and map of matplotlib's. The gap is that between body and wall; rewards beyond the ends look like them."""


@dataclass(frozen=True)
class Scale:
    """Colours of values."""

    title: str
    colours: str
    """Name of a map of matplotlib's."""
    limits: tuple[float, float]
    """Values of its first and its last colour; others have one of these two."""


def scale_of(quantity: Quantity, low: float, high: float) -> Scale:
    """The scale of a quantity between two values, the second at least the first."""
    title, colours = _SCALES[quantity]
    return Scale(title, colours, (low, max(high, low + 1e-9)))
