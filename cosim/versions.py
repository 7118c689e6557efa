"""Whose versions a result depends on."""

from __future__ import annotations

import platform
from importlib import metadata
from typing import Final

from cosim import __version__
from protocol.layout import VERSION_MAJOR, VERSION_MINOR

PACKAGES: Final = ("numpy", "numba", "pybullet", "embreex")
"""Libraries whose versions are recorded: a run may differ where they do."""


def versions() -> dict[str, str]:
    """Versions of cosim, the protocol, Python and the libraries, by name."""
    return {
        "cosim": __version__,
        "protocol": f"{VERSION_MAJOR}.{VERSION_MINOR}",
        **{name: metadata.version(name) for name in PACKAGES},
        "python": platform.python_version(),
    }
