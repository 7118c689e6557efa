"""A teacher that sees what no drone does: the exact axis, its velocity, and the dynamics that were drawn.

It wants the velocity v* towards the point of the axis `lookahead` ahead, and commands

    w = v* + (lead / k_v) (v* - V) + (1 - c) g / k_v z

which under F = m k_v (w - V) + c m g - m g makes V go to v* with the gain (1 + lead / k_v) k_v, and not sink. The
drone turns its nose, and with it its sensors, along w: where w would point further than `cone` from v* it is made
longer along v*, since who learns from noses that point backwards turns back. An action's merit is how near its
velocity comes to w. Pure Pursuit is w = v*.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from agent_client.actions import action_table
from agent_client.episodes import Records
from agent_client.settings import Settings
from agent_client.task import TaskStep
from meshes.geometry import Geometry
from protocol.plant import PoseBatch

Floats = NDArray[np.float64]

SLOWEST: Final = 0.2
"""Least component of w along v* (m/s)."""

GRAVITY: Final = 9.81
"""The plant's default (m/s^2)."""


@dataclass(frozen=True)
class TeacherOptions:
    """How the teacher flies under hard conditions: look-ahead and lead found on tubes of the tuning domain, the rest
    by how policies that imitate it flew other tubes than the README's tables are of."""

    lookahead: float = 0.7
    """Arc length ahead (m)."""
    speed: float = 0.9
    """Size of v* as a share of the top speed: what is left over serves corrections."""
    lead: float = 2.0
    """How much faster than the plant the velocity is corrected (1/s)."""
    cone: float = math.radians(60.0)
    """Greatest angle between w and v* (rad)."""
    gravity: float = GRAVITY
    """What pulls at the drones (m/s^2): the plant's default; 0 in the kinematic world."""
    sharpness: float = 16.0
    """How sharply its choice among actions falls off with the square of what they miss w by (s^2/m^2)."""


class Teacher:
    """Rates the actions of N lanes.

    Args:
        geometry: the tubes.
        settings: constants of the task.
        options: how it flies.
    """

    def __init__(self, geometry: Geometry, settings: Settings, options: TeacherOptions) -> None:
        self._geometry, self._options = geometry, options
        self._speed_max = settings.speed_max
        table = action_table(settings)
        self.velocities: Final[Floats] = table.local * table.speed[:, None]
        """Velocity that each action commands (m/s), local frame, (A, 3)."""

    def command(self, step: TaskStep, poses: PoseBatch, drawn: Records) -> Floats:
        """The velocity w that it would command (m/s), local frame, (N, 3), at most the top speed.

        Args:
            step: what is known of the episodes.
            poses: (N,) that it came from.
            drawn: (N,) conditions of the episodes (`agent_client.conditions.draw_conditions`).
        """
        lookahead, lead = self._options.lookahead, self._options.lead
        ahead = step.axis.arc_length + lookahead
        targets, tangents = self._geometry.axis(ahead)
        beyond = np.maximum(ahead - self._geometry.length, 0.0)[:, None]
        way = targets + beyond * tangents - step.position
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        wanted = self._options.speed * self._speed_max * way
        gain = drawn["gain"][:, None]
        command = wanted + lead / gain * (wanted - poses.linear_velocity)
        command[:, 2] += (1.0 - drawn["compensation"]) * self._options.gravity / drawn["gain"]
        along = (command * way).sum(axis=1, keepdims=True)
        across = command - along * way
        least = np.linalg.norm(across, axis=1, keepdims=True) / math.tan(self._options.cone) + SLOWEST
        command = across + np.maximum(along, least) * way
        local: Floats = np.einsum("nij,nj->ni", step.frame, command)
        local *= np.minimum(1.0, self._speed_max / np.linalg.norm(local, axis=1, keepdims=True))
        return local
