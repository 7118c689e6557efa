"""What can be wrong on this side other than a refused request.

    PhysicsServerError
    └── EngineError        the physics engine is not installed here, or cannot be loaded

A request that cannot be carried out is a `protocol.errors.Refusal`.
"""

from __future__ import annotations


class PhysicsServerError(Exception):
    """Root of everything that this package raises on purpose; the message says what to do."""


class EngineError(PhysicsServerError):
    """The engine that was asked for cannot be loaded on this machine."""
