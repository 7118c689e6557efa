"""Rays against a wall of triangles by Embree: the one importer of embreex.

embreex is called directly: 72 rays take about 9 us, through a general wrapper 500 us.
"""

from __future__ import annotations

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from meshes.geometry import Bools, Floats


class RayScene:
    """A wall that rays can be cast against.

    Embree computes in float32. The wall is moved to its own centre first, so that a tube far from the origin
    loses nothing: the error is about 1e-7 of the tube's extent, wherever it lies. The scene is built in
    Embree's robust mode, in which no ray slips through an edge that two triangles share.
    """

    def __init__(self, vertices: Floats, faces: NDArray[np.int32]) -> None:
        """Build the scene: vertices (V, 3) in metres, faces (F, 3)."""
        self.centre: Floats = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        self._scene = EmbreeScene(robust=True)
        # The scene does not own its geometry.
        self._mesh = TriangleMesh(
            scene=self._scene,
            vertices=(vertices - self.centre).astype(np.float32),
            indices=np.ascontiguousarray(faces, dtype=np.int32),
        )

    def distances(self, origins: Floats, directions: Floats, reach: float) -> Floats:
        """Distance to the first wall along each ray, (M,), `reach` where there is none nearer.

        Both sides of a triangle count. A ray from outside of the tube reads the next wall that it meets.

        Args:
            origins: (M, 3), metres.
            directions: (M, 3), unit vectors.
            reach: metres; infinity for no limit, which then also stands for a miss.
        """
        hits = self._scene.run(
            (origins - self.centre).astype(np.float32),
            directions.astype(np.float32),
            dists=reach * (1 + 1e-6),
            query="DISTANCE",
        )
        # The limit went through float32: it was a little more, and is cut here, so that a miss reads the reach.
        distances: Floats = hits.astype(np.float64)
        return np.minimum(distances, reach, out=distances)

    def faces_hit(self, origins: Floats, directions: Floats) -> NDArray[np.int64]:
        """Index of the face that each ray (M, 3), (M, 3) meets first, (M,), -1 where there is none."""
        hits = self._scene.run(
            (origins - self.centre).astype(np.float32), directions.astype(np.float32), query="INTERSECT"
        )
        return hits.astype(np.int64)  # type: ignore[no-any-return]

    def blocked(self, origins: Floats, targets: Floats) -> Bools:
        """Whether a wall lies between each origin (M, 3) and its target (M, 3), metres, (M,)."""
        # Directions as long as the way, and cast to 1: no square root, and a way of length 0 is free.
        hits = self._scene.run(
            (origins - self.centre).astype(np.float32),
            (targets - origins).astype(np.float32),
            dists=1.0,
            query="OCCLUDED",
        )
        return hits >= 0  # type: ignore[no-any-return]
