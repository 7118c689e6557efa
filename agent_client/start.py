"""Where episodes start: near the axis, looking roughly along it, at rest."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from agent_client.conditions import Records, apply_parameters
from agent_client.errors import SettingsError
from agent_client.frames import frames_along, quaternions
from agent_client.settings import Settings, StartSettings
from meshes.geometry import Geometry
from meshes.swept import SweptTube
from protocol.agent import AgentSession
from protocol.plant import NO_TUBE, PARAMETER_INDEX, PlantDescription, ResetBatch

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

RegisterWalls = Callable[[AgentSession, Sequence[SweptTube]], Sequence[int]]
"""Makes the walls of tubes, those that the lanes of a session fly in from now on, known to its plant; returns the
index of each."""


def draw_starts(
    resets: ResetBatch, lanes: Ints, geometry: Geometry, start: StartSettings, rng: np.random.Generator
) -> None:
    """Draw starting poses of some lanes, and select exactly those lanes for the next reset.

    The centre is drawn evenly over a disc around the axis, the heading's angle to the axis and its azimuth
    evenly over their ranges; velocities are zero. Tubes, seeds and parameters are left alone.

    Args:
        resets: to be filled in.
        lanes: (K,) lane indices.
        geometry: the tubes that the lanes start in.
        start: the ranges.
        rng: four numbers are drawn from it for each lane, in the order of `lanes`.
    """
    draws = rng.random((len(lanes), 4))
    points, tangents = geometry.axis(np.full(geometry.lanes, start.arc_length))
    radius = geometry.project(points, np.full(geometry.lanes, start.arc_length)).radius[lanes]
    axes = frames_along(tangents[lanes])
    offset = start.offset * radius * np.sqrt(draws[:, 0])
    tilt = start.heading_error * draws[:, 2]
    side = _circle(axes, draws[:, 1])
    heading = np.cos(tilt)[:, None] * axes[:, 0] + np.sin(tilt)[:, None] * _circle(axes, draws[:, 3])
    resets.selected[:] = 0
    resets.selected[lanes] = 1
    resets.position[lanes] = points[lanes] + offset[:, None] * side
    resets.quaternion[lanes] = quaternions(frames_along(heading))
    resets.linear_velocity[lanes] = 0.0
    resets.angular_velocity[lanes] = 0.0


def build_resets(
    description: PlantDescription,
    geometry: Geometry,
    settings: Settings,
    seeds: Sequence[int],
    *,
    tube: int | Sequence[int] = NO_TUBE,
    parameters: Mapping[str, float] | None = None,
    drawn: Records | None = None,
) -> ResetBatch:
    """Resets of all lanes of a flight: lane i starts as `seeds[i]` says, whatever the other lanes do.

    Args:
        description: of the plant; its defaults are taken where nothing else is said.
        geometry: the tubes that the lanes start in.
        settings: constants of the task; the body's radius comes from here.
        seeds: (N,) one a lane: of its start, and of the plant's disturbance.
        tube: index of the registered tube that lanes fly in, one for all or one a lane.
        parameters: plant parameters by name that differ from the defaults.
        drawn: (N,) conditions of the episodes, whose plant parameters are taken in place of all others.

    Raises:
        SettingsError: there are not as many seeds as lanes, a parameter's name does not exist, or a tube is too
            short or too narrow to start in.
    """
    if len(seeds) != geometry.lanes:
        raise SettingsError(f"seeds: expected one for each of {geometry.lanes} lanes, found {len(seeds)}")
    chosen = {"body_radius": settings.drone.body_radius, **(parameters or {})}
    unknown = sorted(set(chosen) - set(PARAMETER_INDEX))
    if unknown:
        raise SettingsError(
            f"plant parameters: expected names out of {list(PARAMETER_INDEX)}, found {unknown}"
        )
    body_radius = np.full(geometry.lanes, chosen["body_radius"]) if drawn is None else drawn["body_radius"]
    _check_room(geometry, settings, body_radius)
    resets = ResetBatch.zeros(geometry.lanes)
    for lane, seed in enumerate(seeds):
        draw_starts(resets, np.array([lane]), geometry, settings.start, np.random.default_rng(seed))
    resets.selected[:] = 1
    resets.tube[:] = tube
    resets.seed[:] = seeds
    resets.parameters[:, : len(description.defaults)] = description.defaults
    for name, value in chosen.items():
        resets.parameters[:, PARAMETER_INDEX[name]] = value
    if drawn is not None:
        apply_parameters(resets, np.arange(geometry.lanes), drawn)
    return resets


def _check_room(geometry: Geometry, settings: Settings, body_radius: Floats) -> None:
    """Refuse tubes whose start is already their end, and those that the body does not fit into there.

    Raises:
        SettingsError: names the first lane whose tube is so.
    """
    start = np.full(geometry.lanes, settings.start.arc_length)
    radius = geometry.project(geometry.axis(start)[0], start).radius.copy()
    length = geometry.length
    end_radius = geometry.project(geometry.axis(length)[0], length).radius
    least = start + settings.task.success_radius * end_radius
    for lane in range(geometry.lanes):
        if not length[lane] > least[lane]:
            raise SettingsError(
                f"tube of lane {lane}: expected a length above {least[lane]:.4g} m (start.arc_length + "
                f"task.success_radius x R at the end), found {length[lane]:.4g} m, which would be flown before "
                f"the first step; check the scale"
            )
        if not radius[lane] > body_radius[lane]:
            raise SettingsError(
                f"tube of lane {lane}: R {radius[lane]:.4g} m at the start is not above the body's radius "
                f"{body_radius[lane]:.4g} m; check the scale"
            )


def _circle(axes: Floats, turns: Floats) -> Floats:
    """Unit vectors (K, 3) across the forward axes of frames (K, 3, 3), at turns (K,) in [0, 1)."""
    phi = 2.0 * np.pi * turns[:, None]
    circle: Floats = np.cos(phi) * axes[:, 2] + np.sin(phi) * axes[:, 1]
    return circle
