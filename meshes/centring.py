"""A rough path inside of a tube made its centreline, and prolonged to the tube's ends."""

from __future__ import annotations

from typing import Final

import numpy as np

from meshes.embree import RayScene
from meshes.geometry import Floats
from meshes.sections import (
    RING,
    SIDEWAYS,
    close_sideways,
    measure_rings,
    offsets_of_centres,
    ring_directions,
)
from meshes.smoothing import fit_locally
from meshes.swept import unit_tangents

STEP: Final = 0.2
"""Distance between points, over the local radius."""
GAIN: Final = 0.8
"""Share of the way to the centre that a point is moved at a time."""
ROUNDS: Final = 40
"""Times that points are moved at most: 4 for a round section, and the more the flatter it is."""
CALM_AFTER: Final = 10
CALM: Final = 0.92
"""After so many rounds the gain goes down by this factor in each: sections in a chamber or a junction may turn with
the path and never come to rest by themselves."""
ENDS: Final = 5
"""Points at either end that are not waited for, and stay where they are from then on."""
HELD: Final = 2
"""Points at either end whose sections stand as the next one does."""
MOUTH_POINTS: Final = 5
"""Points over which the direction of a mouth gives way to that of the path."""
SETTLED: Final = 0.003
"""Largest move of the last round, over the radius."""
SMOOTHING: Final = 0.75
"""A cubic is laid through the points within so many radii ahead and behind."""
TANGENT: Final = 1.2
"""The same for tangents: a section that turned with every move of its point would never come to rest."""
FLARE: Final = 0.4
"""Where the radius changes by more than this, by the way, points are moved less: in a cone the centre of a section
moves with its tilt, and would take the path with it."""
FIRST_SMOOTHING: Final = 2.0
"""The same for the rough path."""
BLIND: Final = 1.0
"""A rough path ends so many radii before a cap, which would be in the way of sections that are not yet square."""
TAIL: Final = 16
"""Points at the end of a path that follow its growth."""
TAIL_ROUNDS: Final = 2
LOOK_AHEAD: Final = 0.3
"""A mouth so many radii ahead is gone to straight on."""
STRAIGHT: Final = 1.2
"""So many radii before a cap a path goes straight on."""
FARTHEST: Final = 5.0
"""An end further away than so many radii is not looked for."""
FREE_BEFORE_CAP: Final = 0.5
"""A centreline ends so many radii before a cap."""
CONE: Final = np.radians(35.0)
"""Half of the angle of the cone in which a cap is looked for."""
CONE_RAYS: Final = 8
LEAST_WALL: Final = 0.6
"""Fraction of a ring that meets the wall where a mouth begins: half at the middle of an oblique one."""


Mouths = tuple[Floats | None, Floats | None]
"""Unit vectors (3,) of the tube at its start and end, in the sense of the path; None where none is known to open."""


def centre_path(scene: RayScene, path: Floats, radii: Floats, mouths: Mouths) -> Floats:
    """A path (P, 3), with the radii (P,) of the tube along it, moved into the centres of the sections, (M, 3).

    Points stand `STEP` radii apart. An end that is not known to be open is cut off where a cap may be in the way of
    whole sections. Sections that side branches open are closed first, see `close_sideways`.
    """
    points, radii = _respace(path, radii)
    points = _keep_free(scene, points, _smooth(points, FIRST_SMOOTHING))
    # The balls of a flat tube are smaller than its sections: once more, by these.
    radii = close_sideways(measure_rings(scene, points, _tangents(points)).distances, STEP).mean(axis=1)
    points, radii = _respace(points, radii)
    points = _keep_free(scene, points, _smooth(points, FIRST_SMOOTHING))
    kept = _before_caps(scene, points, radii, mouths)
    points, radii = points[kept], radii[kept]
    for number in range(ROUNDS):
        gain = GAIN * min(CALM ** (number - CALM_AFTER), 1.0)
        points, radii = _respace(points, radii)
        rings = measure_rings(scene, points, _held_tangents(points, mouths))
        closed = close_sideways(rings.distances, STEP)
        radii = closed.mean(axis=1)
        calm = np.minimum((FLARE / np.maximum(_slopes(points, radii), 1e-9)) ** 2, 1.0)[:, None]
        moved = _keep_free(scene, points, points + gain * calm * offsets_of_centres(rings, closed))
        moved = _keep_free(scene, moved, _smooth(moved, SMOOTHING))
        if number >= CALM_AFTER:
            moved[:ENDS], moved[-ENDS:] = points[:ENDS], points[-ENDS:]
        moves = np.linalg.norm(moved - points, axis=1) / radii
        points = moved
        # The ends have no neighbours that hold them in place: while one waited for them the path would shrink.
        if moves[ENDS:-ENDS].max(initial=0.0) < SETTLED:
            break
    return points


def _before_caps(scene: RayScene, points: Floats, radii: Floats, mouths: Mouths) -> slice:
    """The part of a path (M, 3) from whose ends no wall is near ahead."""
    tangents, third = _tangents(points), max(len(points) // 3, 1)
    ahead = wall_ahead(scene, points[-third:], tangents[-third:])[::-1] > BLIND * radii[-third:][::-1]
    behind = wall_ahead(scene, points[:third], -tangents[:third]) > BLIND * radii[:third]
    start = 0 if mouths[0] is not None else int(np.argmax(behind))
    stop = 0 if mouths[1] is not None else int(np.argmax(ahead))
    return slice(start, len(points) - stop)


def wall_ahead(scene: RayScene, points: Floats, tangents: Floats) -> Floats:
    """How far along the tangents (M, 3) from points (M, 3) a wall stands across the whole way (m), (M,).

    The furthest along any of a narrow cone of rays: in a bend one of them looks around the corner.
    """
    side = np.cross(tangents, np.eye(3)[np.argmin(np.abs(tangents), axis=1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    around = ring_directions(side, np.cross(tangents, side))[:, :: RING // CONE_RAYS]
    directions = np.cos(CONE) * tangents[:, None] + np.sin(CONE) * around
    origins = np.repeat(points, directions.shape[1], axis=0)
    distances = scene.distances(origins, directions.reshape(-1, 3), np.inf).reshape(len(points), -1)
    ahead: Floats = np.cos(CONE) * distances.max(axis=1)
    return ahead


def _respace(points: Floats, radii: Floats) -> tuple[Floats, Floats]:
    """Points (M, 3) a fixed share of the local radius apart, M >= 5, and the radii there."""
    chords = np.linalg.norm(np.diff(points, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(2.0 * chords / (radii[1:] + radii[:-1]))])
    wanted = np.linspace(0.0, along[-1], max(int(np.ceil(along[-1] / STEP)), 4) + 1)
    spaced = np.stack([np.interp(wanted, along, points[:, k]) for k in range(3)], axis=1)
    return spaced, np.interp(wanted, along, radii)


def to_the_end(scene: RayScene, points: Floats, mouth: Floats | None) -> tuple[Floats, bool]:
    """Prolong some points (M, 3), `STEP` radii apart, to the mouth of the tube, or up to its cap.

    It grows by one step at a time, and its last part is centred anew after each, so that it follows a bend.

    Args:
        points: centred, the last one near the end.
        mouth: unit vector (3,) out of the tube there; None where none is known to open. A wall ahead of a mouth is
            that of a bend.

    Returns:
        All points, and whether there is a cap.
    """
    begun, forward = points, _tangents(points[-TAIL:])[-1]
    for _ in range(round(FARTHEST / STEP)):
        tail = points[-TAIL:]
        tangents = _tangents(tail)
        if tangents[-1] @ forward < 0.0:  # lost: it turned round
            return begun, False
        rings = measure_rings(scene, tail, tangents)
        typical = close_sideways(rings.distances, STEP)[-1]
        radius = float(typical.mean())
        free = float(wall_ahead(scene, tail[-1:], tangents[-1:])[0])
        if mouth is None and free < FREE_BEFORE_CAP * radius:
            return points, True
        # Straight ahead as far as a bend does not matter: there may be the mouth.
        ahead = np.linspace(0.0, LOOK_AHEAD * radius, 21)[1:, None] * tangents[-1] + tail[-1]
        looks = scene.distances(
            np.repeat(ahead, RING, axis=0), np.tile(rings.directions[-1], (len(ahead), 1)), np.inf
        )
        inside = (looks.reshape(-1, RING) < SIDEWAYS * typical).mean(axis=1) >= LEAST_WALL
        if not inside.all() and not scene.blocked(tail[-1:], ahead[[int(np.argmin(inside))]])[0]:
            return np.concatenate([points, ahead[: int(np.argmin(inside))][-1:]]), False
        points = np.concatenate([points, tail[-1:] + STEP * radius * tangents[-1:]])
        if mouth is not None or free > STRAIGHT * radius:
            points = np.concatenate([points[:-TAIL], _settle(scene, points[-TAIL:], mouth)])
    return points, False


def _settle(scene: RayScene, tail: Floats, mouth: Floats | None) -> Floats:
    """The last points (T, 3) of a path, the second half of them centred; `mouth` as in `to_the_end`."""
    fixed = len(tail) // 2
    for _ in range(TAIL_ROUNDS):
        rings = measure_rings(scene, tail, _held_tangents(tail, (None, mouth)))
        offsets = offsets_of_centres(rings, close_sideways(rings.distances, STEP))
        offsets[:fixed] = 0.0
        tail = _keep_free(scene, tail, tail + GAIN * offsets)
        tail = np.concatenate([tail[:fixed], _smooth(tail, SMOOTHING)[fixed:]])
    return tail


def _smooth(points: Floats, radii: float) -> Floats:
    """A cubic through each point's neighbours within so many radii to either side."""
    window = _window(points, radii)
    return fit_locally(points, window, 3) if window > 3 else points


def _tangents(points: Floats) -> Floats:
    """Unit tangents (M, 3) of points (M, 3), smoothed."""
    window = _window(points, TANGENT)
    if window <= 3:
        return unit_tangents(points)
    along = fit_locally(points, window, 3, derivative=1)
    tangents: Floats = along / np.linalg.norm(along, axis=1, keepdims=True)
    return tangents


def _slopes(points: Floats, radii: Floats) -> Floats:
    """How fast the radius (M,) changes by the way along points (M, 3), (M,)."""
    slopes: Floats = np.abs(np.gradient(radii)) / np.linalg.norm(np.gradient(points, axis=0), axis=1)
    return slopes


def _held_tangents(points: Floats, mouths: Mouths) -> Floats:
    """Unit tangents (M, 3), at the ends those of their mouths.

    A free end that turned with its own moves would turn ever further. Where no mouth is known, it stands as the
    points before it do.
    """
    tangents = _tangents(points)
    share = np.linspace(1.0, 0.0, min(MOUTH_POINTS, len(points) // 2), endpoint=False)[:, None]
    for mouth, view in zip(mouths, (tangents, tangents[::-1]), strict=True):
        if mouth is None:
            view[:HELD] = view[HELD]
        else:
            view[: len(share)] = share * mouth + (1.0 - share) * view[: len(share)]
    unit: Floats = tangents / np.linalg.norm(tangents, axis=1, keepdims=True)
    return unit


def _window(points: Floats, radii: float) -> int:
    return min(2 * max(round(radii / STEP), 2) + 1, (len(points) - 1) // 2 * 2 + 1)


def _keep_free(scene: RayScene, points: Floats, moved: Floats) -> Floats:
    """The moved points (M, 3); where a wall lies on the way, the points themselves."""
    blocked = scene.blocked(points, moved)
    return np.where(blocked[:, None], points, moved)
