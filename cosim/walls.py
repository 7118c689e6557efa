"""The walls of a pool of tubes for a physics process: written as mesh files, registered when they are needed."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from agent_client.world import Ints
from meshes.sweep import sweep_wall, write_obj
from meshes.swept import SweptTube
from protocol.agent import AgentSession
from protocol.plant import TubeReference

KEPT: Final = 256
"""Walls that stay registered: our server takes 3 MB for each. Tubes that are flown in come on top."""


class PoolWalls:
    """Registers the walls of a pool's tubes, tube i under index i, when lanes are about to fly in them.

    A whole pool at once would take minutes and gigabytes; a wall takes 0.1 s when it is first needed. It goes to
    `agent_client.world.TubeWorld` as `walls`, with `WorldOptions.registered`.

    Args:
        session: with a plant that knows walls, opened with at least as many `tube_slots` as there are tubes.
        tubes: of all pools together, in the order of the world's pools.
        folder: for mesh files, each of which is gone again once the plant has read it.
        kept: walls that stay registered though no lane flies in them, those that were needed last.
    """

    def __init__(
        self, session: AgentSession, tubes: Sequence[SweptTube], folder: Path, kept: int = KEPT
    ) -> None:
        self._session, self._tubes, self._folder, self._kept = session, tubes, folder, kept
        self._registered: dict[int, None] = {}
        """Indices of the registered tubes, the one that was needed last at the end."""

    def __call__(self, needed: Sequence[int], flown: Ints) -> None:
        """Have the walls of `needed` registered; release those that were not needed for the longest time.

        Args:
            needed: indices of tubes that lanes are about to be reset into.
            flown: indices of tubes that lanes fly in until then; any other number is of no tube.

        Raises:
            Refusal: the plant takes no walls, or has fewer slots than there are tubes.
            ProtocolError: the session is over.
        """
        for index in dict.fromkeys(needed):
            if index in self._registered:
                del self._registered[index]
            else:
                register_wall(self._session, index, self._tubes[index], self._folder)
            self._registered[index] = None
        if len(self._registered) > self._kept:
            busy = {*needed, *flown.tolist()}
            idle = [index for index in self._registered if index not in busy]
            for index in idle[: len(self._registered) - self._kept]:
                self._session.release_tube(index)
                del self._registered[index]


def register_wall(session: AgentSession, index: int, tube: SweptTube, folder: Path) -> None:
    """Register the wall of one swept tube, by way of a mesh file in `folder` that is removed again.

    Raises:
        Refusal: the slot is taken, or the plant takes no walls.
        ProtocolError: the session is over.
    """
    path = folder.absolute() / f"tube-{index}.obj"
    write_obj(path, *sweep_wall(tube))
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        session.register_tube(index, TubeReference(str(path), "zup", 1.0, digest))
    finally:
        path.unlink()
