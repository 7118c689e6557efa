"""The named conditions of a flight beyond the tube: body, sensors, delays, dynamics. One table, drawn per episode.

Each condition is a range that every episode draws from evenly and for itself; a range of no width is a fixed
value. The defaults are the task as it is trained and flown by default, and `HARD` is the one preset that the
hard evaluation uses. None of this is the paper's: it flies one drone under one set of conditions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from agent_client.errors import SettingsError
from agent_client.noise import spread_seeds
from protocol.plant import PARAMETER_INDEX, ResetBatch

Range = tuple[float, float]
Records = NDArray[Any]
Floats = NDArray[np.float64]

DELAY_MAX: Final = 10
"""Longest delay (control steps)."""


@dataclass(frozen=True)
class Condition:
    """One named setting: what it means, and the values that it may take."""

    name: str
    unit: str
    meaning: str
    lowest: float
    highest: float
    whole: bool = False
    """Whether only whole numbers are drawn."""
    needs_inertia: bool = False
    """Whether it has a meaning under rigid-body dynamics alone."""

    def check(self, low: float, high: float) -> None:
        """Refuse a range that this setting may not have; one value is a range of no width.

        Raises:
            SettingsError: it is out of bounds or upside down.
        """
        fits = self.lowest <= low <= high <= self.highest
        if not fits or (self.whole and not (float(low).is_integer() and float(high).is_integer())):
            kind = "whole numbers" if self.whole else "numbers"
            found = f"{low:g}" if low == high else f"{low:g} to {high:g}"
            raise SettingsError(
                f"{self.name}: expected {kind} low <= high within {self.lowest:g} to {self.highest:g} "
                f"{self.unit}, found {found}"
            )


CONDITIONS: Final = (
    Condition("body_radius", "m", "radius of the drone's body", 0.01, 1.0),
    Condition("field_of_view", "1", "field of view as a fraction of the camera's half-angles", 0.05, 1.0),
    Condition("lidar_noise", "m", "standard deviation of every LiDAR ray", 0.0, 1.0),
    Condition("lidar_dropout", "1", "probability that a LiDAR ray reads its full range", 0.0, 1.0),
    Condition("camera_dropout", "1", "probability that the camera sees nothing in a step", 0.0, 1.0),
    Condition("action_delay", "steps", "control steps from decision to plant", 0, DELAY_MAX, whole=True),
    Condition("observation_delay", "steps", "age of what the policy sees", 0, DELAY_MAX, whole=True),
    Condition("gain", "1/s", "k_v of the force law", 0.1, 100.0, needs_inertia=True),
    Condition("compensation", "weight", "gravity compensation c; 1 hovers", 0.0, 2.0, needs_inertia=True),
    Condition("mass", "kg", "mass of the drone; idle without drag and gust: the force scales with it",
              0.01, 100.0, needs_inertia=True),
    Condition("drag", "N s/m", "linear drag", 0.0, 100.0, needs_inertia=True),
    Condition("gust", "N", "amplitude of a random force, new every control step", 0.0, 100.0, needs_inertia=True),
    Condition("near_wall", "m/s", "amplitude of the air's random motion at the wall", 0.0, 10.0),
    Condition("along_body", "1", "1: thrust along the body's axis, 0: along the command", 0, 1, whole=True,
              needs_inertia=True),
)  # fmt: skip
"""All conditions, in the order of the fields of `Conditions`."""

NAMES: Final = tuple(condition.name for condition in CONDITIONS)

INERTIA_ALONE: Final = tuple(condition.name for condition in CONDITIONS if condition.needs_inertia)
"""Conditions that have no meaning in a world without inertia."""

_BY_NAME: Final = {condition.name: condition for condition in CONDITIONS}

DRAWN: Final = np.dtype([*((name, "f8") for name in NAMES), ("seed", "u8")])
"""What one episode drew: a value a condition, and the seed of its sensors' noise."""

NEAR_WALL_REACH: Final = 0.5
"""Gap between body and wall (m) from which on the air is still, as far as `near_wall` goes."""

PARAMETERS_OF: Final = {
    "body_radius": "body_radius",
    "gain": "force_gain",
    "mass": "mass",
    "drag": "linear_drag",
    "gust": "gust",
    "along_body": "force_along_body",
}
"""Conditions that are plant parameters (`protocol.plant.PARAMETERS`), and their names there."""

_COLUMNS: Final = np.array([NAMES.index(name) for name in PARAMETERS_OF])
_SLOTS: Final = np.array([PARAMETER_INDEX[name] for name in PARAMETERS_OF.values()])


@dataclass(frozen=True)
class Conditions:
    """A range for every condition; `CONDITIONS` says what each means.

    Raises:
        SettingsError: a range that is out of bounds or upside down; says which.
    """

    body_radius: Range = (0.15, 0.15)
    field_of_view: Range = (1.0, 1.0)
    lidar_noise: Range = (0.0, 0.0)
    lidar_dropout: Range = (0.0, 0.0)
    camera_dropout: Range = (0.0, 0.0)
    action_delay: Range = (0, 0)
    observation_delay: Range = (0, 0)
    gain: Range = (8.0, 8.0)
    compensation: Range = (0.9, 0.9)
    mass: Range = (1.0, 1.0)
    drag: Range = (0.0, 0.0)
    gust: Range = (0.0, 0.0)
    near_wall: Range = (0.0, 0.0)
    along_body: Range = (0, 0)

    def __post_init__(self) -> None:
        for name, (low, high) in self.ranges().items():
            _BY_NAME[name].check(low, high)

    def ranges(self) -> dict[str, Range]:
        """The range of each condition, by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def bounds(self) -> Floats:
        """The lower and the upper ends of the ranges, (2, C), in the order of the table."""
        return np.array(list(self.ranges().values()), dtype=np.float64).T.copy()

    def changed(self) -> dict[str, Range]:
        """The ranges that differ from the defaults, by name."""
        usual = Conditions().ranges()
        return {name: span for name, span in self.ranges().items() if span != usual[name]}

    def without_inertia(self) -> Conditions:
        """These conditions for a world without inertia: what only inertia gives a meaning to is as usual."""
        usual = Conditions().ranges()
        return self.with_ranges({name: usual[name] for name in INERTIA_ALONE})

    def with_ranges(self, ranges: Mapping[str, Range]) -> Conditions:
        """These conditions with some ranges replaced.

        Raises:
            SettingsError: an unknown name, or a range out of bounds.
        """
        unknown = sorted(set(ranges) - set(NAMES))
        if unknown:
            raise SettingsError(f"conditions: expected names out of {', '.join(NAMES)}, found {unknown}")
        return replace(self, **dict(ranges))


HARD: Final = Conditions(
    body_radius=(0.25, 0.25),
    field_of_view=(0.65, 0.65),  # half-angles of 29 and 23 degrees in place of 45 and 35
    lidar_noise=(0.02, 0.02),
    lidar_dropout=(0.02, 0.02),
    camera_dropout=(0.1, 0.1),
    gain=(1.5, 6.0),
    compensation=(0.8, 1.05),
)
"""The hard conditions; their tubes are `agent_client.tubes.HARD_TUBES`."""


_TAG: Final = 0xC04D  # enters the seed, so that conditions do not follow the draws of tubes and starts

_WHOLE: Final = np.array([condition.whole for condition in CONDITIONS])


def draw_conditions(conditions: Conditions, seeds: ArrayLike) -> Records:
    """Draw the conditions of episodes, (K,) records of DRAWN; an episode's depend on its seed alone.

    Args:
        conditions: the ranges.
        seeds: (K, S), one a episode, each a few whole numbers from 0 to 2^64 - 1.
    """
    words = np.asarray(seeds, dtype=np.uint64)
    drawn = np.zeros(len(words), DRAWN)
    values = _values(drawn)
    # One draw for each condition, in the order of the table: narrowing one range moves no other's draw.
    spread_seeds(words, _TAG, values, drawn["seed"])
    _place(values, conditions.bounds, _WHOLE)
    return drawn


@njit(cache=True)
def _place(values: Floats, bounds: Floats, whole: NDArray[np.bool_]) -> None:
    """Turn numbers in (0, 1), (K, C), into numbers within the bounds (2, C), whole ones where asked for."""
    for k in range(values.shape[0]):
        for c in range(values.shape[1]):
            low, high = bounds[0, c], bounds[1, c]
            if whole[c]:
                values[k, c] = min(math.floor(low + values[k, c] * (high - low + 1.0)), high)
            else:
                values[k, c] = low + values[k, c] * (high - low)


def _values(drawn: Records) -> Floats:
    """The conditions in records of DRAWN as a view (K, C), in the order of the table."""
    return drawn.view(np.float64).reshape(len(drawn), len(NAMES) + 1)[:, : len(NAMES)]


def apply_parameters(resets: ResetBatch, lanes: NDArray[np.int64], drawn: Records) -> None:
    """Write the conditions that are plant parameters, and the seed of the gusts, into the rows of resets.

    Args:
        resets: to be filled in.
        lanes: (K,) lane indices.
        drawn: (K,) conditions of their episodes.
    """
    resets.parameters[lanes[:, None], _SLOTS] = _values(np.ascontiguousarray(drawn))[:, _COLUMNS]
    resets.seed[lanes] = drawn["seed"].astype(np.int64)
