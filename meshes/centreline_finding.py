"""The centreline of a wall that comes without one.

Three steps: balls of free space in the wall and the ways between them (`meshes.lumen`), the shortest way between
the two ends, and its points moved into the centres of their sections by rings of exact rays (`centre_path`).

Libraries that were considered: vmtk does the same with Voronoi balls of the vertices, weighs 1 GB with VTK and is
not on PyPI; skeletor contracts or slices the graph of the *vertices*, which a tube of 60 vertices or a double wall
defeats; scikit-image's minimal paths and scipy's distance transform need a grid of voxels, whose memory grows with
the volume of the bounding box and whose step limits the accuracy. Taken from a library are the k-d tree, the
shortest path, the connected components and the smoothing filter, all of scipy, and the rays, of Embree.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.signal import savgol_filter  # type: ignore[import-untyped]
from scipy.sparse.csgraph import connected_components, dijkstra  # type: ignore[import-untyped]
from scipy.spatial import cKDTree  # type: ignore[import-untyped]

from meshes.embree import RayScene
from meshes.errors import CentrelineError
from meshes.geometry import Floats
from meshes.lumen import Balls, find_balls, leave
from meshes.sections import (
    close_sideways,
    measure_rings,
    offsets_of_centres,
    resample_evenly,
    ring_directions,
)
from meshes.swept import unit_tangents
from meshes.wall import Wall

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Opening:
    """Where the space inside of a wall meets the space outside."""

    centre: Floats  # (3,)
    """Metres, world frame."""
    outward: Floats  # (3,)
    """Unit vector."""
    radius: float
    """Of the tube behind it (m), estimated."""


@dataclass(frozen=True)
class FoundCentreline:
    """A centreline that was found, and between what."""

    points: Floats  # (P, 3)
    """From the start to the end (m), world frame, evenly spaced."""
    radius: float
    """Median distance of the wall from the centreline (m)."""
    openings: tuple[Opening, ...]
    """All that were found, used or not."""
    used: tuple[int | None, int | None]
    """The openings at which it starts and ends; None where it ends at a cap, or inside."""
    capped: tuple[bool, bool]
    """Whether a wall stands before its start and behind its end."""
    notes: tuple[str, ...]
    """What a user should know."""

    def scaled(self, factor: float) -> FoundCentreline:
        """The same in a wall that is `factor` times as large, about the origin."""
        openings = tuple(Opening(o.centre * factor, o.outward, o.radius * factor) for o in self.openings)
        return replace(self, points=self.points * factor, radius=self.radius * factor, openings=openings)


def find_centreline(
    wall: Wall, entry: ArrayLike | None = None, exit: ArrayLike | None = None
) -> FoundCentreline:
    """Find the centreline of a wall.

    Args:
        wall: the wall of a tube.
        entry: (3,) where the centreline starts (m), world frame: a point in the tube or before an opening.
        exit: (3,) where it ends.

    Raises:
        CentrelineError: there is nothing that can be flown, or it is not clear what; says why and where.
    """
    balls = find_balls(wall.scene, wall.vertices, wall.faces)
    if not len(balls.radii):
        raise CentrelineError(f"{wall.path}: expected a tube, found no space that is enclosed by walls")
    _, labels = connected_components(balls.ways, directed=False)
    component = np.flatnonzero(labels == np.argmax(np.bincount(labels)))
    radius = float(np.median(balls.radii[component]))
    openings = find_openings(wall.scene, balls, component)
    if entry is None and exit is None and len(openings) == 2:
        start, end = (_nearest(balls, component, o.centre - 0.5 * radius * o.outward) for o in openings)
    elif entry is not None and exit is not None:
        start, end = (_nearest(balls, component, np.asarray(p, dtype=float)) for p in (entry, exit))
    else:
        start, end = farthest_pair(balls, component)
    path = shortest_way(balls, start, end)
    points = centre_path(wall.scene, balls.centres[path], balls.radii[path])
    head, start_capped = extend(wall.scene, points[::-1])
    points, end_capped = extend(wall.scene, head[::-1])
    return FoundCentreline(points, radius, tuple(openings), (None, None), (start_capped, end_capped), ())


def find_openings(scene: RayScene, balls: Balls, component: Ints) -> list[Opening]:
    """The openings of the space that some balls fill, the widest first."""
    few = component[:: max(len(component) // 300, 1)]
    points, ways, seen_from = leave(scene, balls.centres[few], balls.radii[few])
    if not len(points):
        return []
    radius = float(np.median(balls.radii[component]))
    near = cKDTree(points).sparse_distance_matrix(cKDTree(points), 0.5 * radius)
    _count, labels = connected_components(near, directed=False)
    sizes = np.bincount(labels)
    openings = []
    for k in np.argsort(-sizes):
        at = labels == k
        if sizes[k] < 0.05 * sizes.max():
            continue
        outward = ways[at].mean(axis=0)
        outward /= np.linalg.norm(outward)
        centre = points[at].mean(axis=0)
        openings.append(Opening(centre, outward, float(np.median(balls.radii[few][seen_from[at]]))))
    return openings


def farthest_pair(balls: Balls, component: Ints) -> tuple[int, int]:
    """The two balls with the longest way between them, of two sweeps."""
    first = int(component[0])
    for _ in range(2):
        reached = dijkstra(balls.lengths, directed=False, indices=first)
        reached[~np.isfinite(reached)] = -1.0
        first, last = int(np.argmax(reached)), first
    return last, first


def _nearest(balls: Balls, component: Ints, point: Floats) -> int:
    distance = np.linalg.norm(balls.centres[component] - point, axis=1)
    return int(component[np.argmin(distance)])


def shortest_way(balls: Balls, start: int, end: int) -> Ints:
    """Balls along the way from one to another that is short and keeps clear of the wall."""
    _reached, before = dijkstra(balls.ways, directed=False, indices=start, return_predecessors=True)
    way = [end]
    while way[-1] != start:
        way.append(int(before[way[-1]]))
    return np.array(way[::-1])


def centre_path(scene: RayScene, path: Floats, radii: Floats) -> Floats:
    """A path (P, 3) moved into the centres of its sections, (M, 3), even steps."""
    radius = float(np.median(radii))
    step = 0.2 * float(np.quantile(radii, 0.2))
    points = resample_evenly(path, step)
    points = _keep_free(scene, points, _smooth(points, 2.0 * radius / step))
    for _ in range(8):
        points = resample_evenly(points, step)
        tangents = unit_tangents(points)
        rings = measure_rings(scene, points, tangents)
        closed = close_sideways(rings.distances, step, radius)
        points = _keep_free(scene, points, points + 0.8 * offsets_of_centres(rings, closed))
        points = _keep_free(scene, points, _smooth(points, 0.75 * radius / step))
    return points


def _smooth(points: Floats, half: float) -> Floats:
    """A cubic through each point's neighbours, `half` of them to either side."""
    window = min(2 * max(round(half), 2) + 1, (len(points) - 1) // 2 * 2 + 1)
    return savgol_filter(points, window, 3, axis=0) if window > 3 else points


def _keep_free(scene: RayScene, points: Floats, moved: Floats) -> Floats:
    """The moved points, but where a wall lies on the way the points themselves."""
    blocked = scene.blocked(points, moved)
    return np.where(blocked[:, None], points, moved)


def extend(scene: RayScene, points: Floats) -> tuple[Floats, bool]:
    """Go on from the last of some points (M, 3) to the mouth of the tube, or up to its cap.

    Returns:
        All points, and whether there is a cap.
    """
    step = float(np.linalg.norm(points[-1] - points[-2]))
    tangents = unit_tangents(points)
    rings = measure_rings(scene, points, tangents)
    whole = np.flatnonzero(np.isfinite(rings.distances).all(axis=1))
    last = int(whole[-1])
    points = points[: last + 1]
    typical = rings.distances[last]
    normal, binormal, tangent = rings.normals[last], rings.binormals[last], tangents[last]
    radius = float(typical.mean())
    step = 0.05 * radius
    added = [points[-1]]
    for _ in range(80):
        ahead = float(scene.distances(added[-1][None], tangent[None], np.inf)[0])
        if ahead < 0.5 * radius:
            return np.concatenate([points[:-1], added]), True
        there = added[-1] + step * tangent
        directions = ring_directions(normal[None], binormal[None])[0]
        distances = scene.distances(np.repeat(there[None], len(directions), axis=0), directions, np.inf)
        met = distances < 1.5 * typical
        if met.mean() < 0.67:
            break
        if met.all():
            there = there + (distances[:, None] * directions).mean(axis=0)
            typical = distances
        added.append(there)
    return np.concatenate([points[:-1], added]), False
