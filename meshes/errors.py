"""What can be wrong with a tube.

MeshError
├── MeshReadError      the file is missing, unreadable, empty, or of a form that is not read
├── CentrelineError    the centreline branches, is a loop, has gaps, lies outside the tube, or cannot be found
│   └── EndsError      the tube has several openings, and it is not said which are meant
└── CurveError         a generated curve is too tight or comes too near to itself
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from meshes.openings import Opening


class MeshError(Exception):
    """Root of everything that this package raises on purpose; the message names the file and what to do."""


class MeshReadError(MeshError):
    """A file that cannot be read as a mesh or centreline."""


class CentrelineError(MeshError):
    """A centreline that cannot be flown along."""


class EndsError(CentrelineError):
    """Several openings without a choice; carries them."""

    def __init__(self, text: str, openings: tuple[Opening, ...]) -> None:
        super().__init__(text)
        self.openings = openings


class CurveError(MeshError):
    """A generated curve that cannot be swept into a tube."""
