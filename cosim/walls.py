"""The walls of swept tubes for a physics process: written as mesh files, registered when lanes first fly in them."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Final

from cosim.errors import CosimError
from cosim.sessions import server_session
from meshes.sweep import sweep_wall, write_obj
from meshes.swept import SweptTube
from protocol.agent import AgentSession, SessionSettings
from protocol.plant import TubeReference

KEPT: Final = 256
"""Walls that stay registered; our server takes 3 MB for each."""

SIDES_PER_LOBE: Final = 16
"""Sides of a section for each order of its harmonics: 48 of a round one."""


def wall_slots(lanes: int) -> int:
    """How many walls to keep for so many lanes: what to open a session with, as its `tube_slots`."""
    return max(KEPT, 2 * lanes)


def walled_session(settings: SessionSettings) -> AbstractContextManager[AgentSession]:
    """A session with a Bullet server of its own that has slots for the walls of `WallRegistry(wall_slots(lanes))`."""
    return server_session(replace(settings, tube_slots=wall_slots(settings.lanes)), "bullet")


class WallRegistry:
    """Registers the walls of tubes that lanes are about to fly in, and lets go those not flown in for the longest.

    An `agent_client.start.RegisterWalls`. Registering a wall takes some 0.1 s, so that a whole pool at once would
    keep a training waiting for minutes, and take gigabytes.

    Args:
        slots: walls that are registered at the same time, at most the session's `tube_slots`; at least two for
            each lane, one that it leaves and one that it enters.
    """

    def __init__(self, slots: int = KEPT) -> None:
        self._slots = slots
        self._session: AgentSession | None = None
        self._free: list[int] = []
        self._indices: dict[SweptTube, int] = {}
        """Index of each registered tube; the tubes that were asked for last are at the end."""

    def __call__(self, session: AgentSession, tubes: Sequence[SweptTube]) -> list[int]:
        """Have walls registered.

        Args:
            session: with a plant that knows walls. One that was not seen before knows none yet.
            tubes: those that all lanes of the session fly in from now on.

        Returns:
            The index under which each is registered.

        Raises:
            CosimError: there are not two slots for each lane.
            Refusal: the plant takes no walls, or has fewer slots.
            ProtocolError: the session is over.
        """
        if self._slots < 2 * len(tubes):
            raise CosimError(
                f"slots of walls: expected two for each of {len(tubes)} lanes, found {self._slots}"
            )
        if session is not self._session:
            self._session, self._indices = session, {}
            self._free = list(range(self._slots))
        for tube in tubes:
            index = self._indices.pop(tube, None)
            self._indices[tube] = self._register(session, tube) if index is None else index
        return [self._indices[tube] for tube in tubes]

    def _register(self, session: AgentSession, tube: SweptTube) -> int:
        """Register a new wall, in place of the one not asked for for the longest time where all slots are taken."""
        if not self._free:
            # At least as many others were asked for since as there are lanes: nobody flies in it any more.
            oldest = next(iter(self._indices))
            session.release_tube(self._indices[oldest])
            self._free.append(self._indices.pop(oldest))
        register_wall(session, self._free[-1], tube)
        return self._free.pop()


def register_wall(session: AgentSession, index: int, tube: SweptTube) -> None:
    """Register the wall of one swept tube, by way of a mesh file that is gone again afterwards.

    Raises:
        Refusal: the slot is taken, or the plant takes no walls.
        ProtocolError: the session is over.
    """
    with tempfile.TemporaryDirectory(prefix="cosim-wall-") as folder:
        session.register_tube(index, write_wall(Path(folder) / "tube.obj", tube))


def write_wall(path: Path, tube: SweptTube) -> TubeReference:
    """Write the wall of a swept tube as an .obj file; returns how to name it to a physics process.

    Between the file's triangles and the wall that perception sees lie 1 mm on average and 7 mm at most, inside of
    the tightest bends (R = 1 m): the body's radius is 150 mm. Sections with many lobes get as many more sides.
    """
    write_obj(path, *sweep_wall(tube, SIDES_PER_LOBE * max(tube.harmonics.shape[1] + 1, 3)))
    return TubeReference(str(path.resolve()), "zup", 1.0, hashlib.sha256(path.read_bytes()).hexdigest())
