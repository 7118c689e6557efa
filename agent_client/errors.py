"""What can go wrong on the agent's side.

AgentError
├── SettingsError          a setting is out of range, or two settings contradict each other
├── TrainingError          a training that cannot be gone on with, or whose log cannot be read
└── PolicyError            a checkpoint that is missing, empty, foreign, or of other spaces
    └── ContractMismatch   a checkpoint that was made for other sensors, actions or time step than run now
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


class AgentError(Exception):
    """Root of everything that this package raises on purpose."""


class SettingsError(AgentError):
    """A setting that cannot be used; the message names it, what was expected and what was found."""


class TrainingError(AgentError):
    """A training's files that do not fit; the message names the file and what to do."""


class TrainingOver(TrainingError):  # noqa: N818 - it is named after what it finds
    """A training to be resumed whose steps are all done."""


class PolicyError(AgentError):
    """A checkpoint that cannot be flown; the message names the file and what to do."""


@dataclass(frozen=True)
class Difference:
    """One disagreement between a checkpoint's contract and what runs."""

    name: str
    expected: str
    """What the checkpoint was made for."""
    found: str
    """What runs now."""


LISTED = 5
"""Differences that a message lists; another action table alone can make a hundred."""


class ContractMismatch(PolicyError):  # noqa: N818 - it is named after what it finds
    """A checkpoint whose contract differs from what runs; `differences` has every disagreement, the message the
    first `LISTED`."""

    def __init__(self, differences: Sequence[Difference], name: str) -> None:
        self.differences = tuple(differences)
        listed = "; ".join(
            f"{d.name}: expected {d.expected}, found {d.found}" for d in self.differences[:LISTED]
        )
        more = len(self.differences) - LISTED
        if more > 0:
            listed += f"; and {more} more"
        super().__init__(f"the contract of {name} does not fit what runs: {listed}")
