"""Command line, process supervision, recording and export around the two sides of the co-simulation."""

from __future__ import annotations

__version__ = "0.1.0"
