"""What can be wrong with a tube.

MeshError
├── MeshReadError      the file is missing, unreadable, empty, or of a form that is not read
├── CentrelineError    the centreline branches, is a loop, has gaps, or lies outside the tube
└── CurveError         a generated curve is too tight or comes too near to itself
"""

from __future__ import annotations


class MeshError(Exception):
    """Root of everything that this package raises on purpose; the message names the file and what to do."""


class MeshReadError(MeshError):
    """A file that cannot be read as a mesh or centreline."""


class CentrelineError(MeshError):
    """A centreline that cannot be flown along."""


class CurveError(MeshError):
    """A generated curve that cannot be swept into a tube."""
