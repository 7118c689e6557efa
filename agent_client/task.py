"""The task: N episodes of flight through tubes, from poses to observations, rewards, ends and quality.

One implementation serves training and flying. A pose that comes back from physics goes round once: local
frame, nearest axis point, rays, camera, memory, verdict, reward, features; each quantity is computed once.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent_client.episodes import SENSED, OnContact, Records, constants, episode_dtype
from agent_client.errors import SettingsError
from agent_client.features import FEATURES, feature_mask
from agent_client.judge import Outcome, note_clearance
from agent_client.lidar import LINES, SPOKES, ring_circle, ring_sectors
from agent_client.perception import aim, assess
from agent_client.reward import Regime
from agent_client.settings import Settings, max_steps
from meshes.geometry import AxisPoints, Geometry
from protocol.plant import PoseBatch

__all__ = ["OnContact", "Outcome", "Regime", "TaskStep", "TubeTask"]

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Bytes = NDArray[np.int8]


@dataclass(frozen=True)
class TaskStep:
    """Everything about N episodes after a control step. Positions and directions are in the world frame.

    The arrays are the task's own and change with its next call; copy what you keep.
    """

    episodes: Records  # (N,)
    """The records (`agent_client.episodes`) that all fields below but the observation are views of."""
    observation: Singles  # (N, 37)
    """Features in the order of `agent_client.features.FEATURES`."""
    reward: Floats  # (N,)
    """Reward of the step; 0 after `begin` and once an episode is over."""
    reward_terms: Floats  # (N, T)
    """The reward's terms, columns `agent_client.reward.TERMS`; they sum to `reward`."""
    regime: Bytes  # (N,)
    """Values of Regime."""
    outcome: Bytes  # (N,)
    """Values of Outcome. Once an episode is over its row stays as it is until `begin`, reward apart."""
    step: Ints  # (N,)
    """Control steps of the episode."""
    max_steps: Ints  # (N,)
    """Control steps after which it times out."""
    position: Floats  # (N, 3)
    """Centre of the drone (m)."""
    speed: Floats  # (N,)
    """Velocity along f (m/s)."""
    frame: Floats  # (N, 3, 3)
    """Local frame: rows f, u, r."""
    axis: AxisPoints
    """Nearest points of the axis."""
    progress: Floats  # (N,)
    """Arc length of the nearest axis point over the tube's length, 0 to 1."""
    inside: Bools  # (N,)
    """Whether the centre is inside the tube."""
    clearance: Floats  # (N,)
    """Distance of the centre to the wall (m), negative outside; see `TubeTask.measure_clearance`."""
    contact: Bools  # (N,)
    """Whether the body touched the wall in this step."""
    lidar: Floats  # (N, 2 rays)
    """Readings (m): front ring, then rear ring."""
    target_position: Floats  # (N, 3)
    """The camera's target: a point of the axis (m)."""
    target_direction: Floats  # (N, 3)
    """Unit vector to it, seen or not."""
    target_distance: Floats  # (N,)
    """Distance to it (m)."""
    target_visible: Bools  # (N,)
    memory_direction: Floats  # (N, 3)
    """Direction in which the target was seen last; zero without memory."""
    memory_age: Ints  # (N,)
    """Control steps since then; one more than the memory's length without memory."""
    memory_available: Bools  # (N,)
    centring: Floats  # (N,)
    """S_center = clip(1 - d / R, 0, 1)."""
    alignment: Floats  # (N,)
    """S_align in [-1, 1]."""
    quality: Floats  # (N,)
    """Q of the episode so far: mean of centring and of (alignment + 1) / 2, half each, over its control steps
    inside the tube; 0 before the first."""
    contacts: Ints  # (N,)
    """Control steps of the episode with contact."""
    min_clearance: Floats  # (N,)
    """Smallest clearance of the episode so far, the start included (m); see `TubeTask.measure_clearance`."""

    @classmethod
    def over(cls, episodes: Records) -> TaskStep:
        """The step whose fields are views of `episodes`."""
        axis = AxisPoints(
            arc_length=episodes["arc_length"],
            position=episodes["axis_position"],
            tangent=episodes["tangent"],
            radial_distance=episodes["radial_distance"],
            radius=episodes["radius"],
        )
        observation = np.zeros((len(episodes), len(FEATURES)), dtype=np.float32)
        shared = set(cls.__dataclass_fields__) & set(episodes.dtype.names or ())
        views: dict[str, Any] = {name: episodes[name] for name in shared}
        return cls(episodes=episodes, observation=observation, axis=axis, **views)


class TubeTask:
    """N episodes, lane i in the tube that the geometry assigns to it.

    Args:
        geometry: the tubes; its lanes are the task's.
        settings: constants of the task.
        dt: control step (s).
        clearance_contact: how contact is known: True, the clearance falls below the body's radius (for plants
            without walls); False, the poses report it.
        on_contact: "end" ends an episode with COLLISION, "continue" counts contacts and lets the rest decide.
        step_limit: control steps after which an episode times out, None for `max_steps` of each tube.

    Raises:
        SettingsError: dt or the step limit is not above 0, or a masked feature does not exist.
    """

    def __init__(
        self,
        geometry: Geometry,
        settings: Settings,
        dt: float,
        *,
        clearance_contact: bool,
        on_contact: OnContact = "end",
        step_limit: int | None = None,
    ) -> None:
        if not (math.isfinite(dt) and dt > 0.0):
            raise SettingsError(f"dt: expected a time above 0 s, found {dt}")
        if step_limit is not None and step_limit < 1:
            raise SettingsError(f"step_limit: expected at least 1 step, found {step_limit}")
        n, rays = geometry.lanes, settings.lidar.rays
        self.geometry, self.settings, self.dt = geometry, settings, dt
        self.ray_nanoseconds = 0
        """How long rays and lines of sight took in the last call."""
        self._step_limit = step_limit
        self._clearance_contact = clearance_contact
        self._target_distance = settings.camera.target_distance
        # One reach for all rays. The target lies no further away than its arc length and the offset from the
        # axis together: twice the arc length reaches it in any tube of R up to that length.
        self._reach = max(settings.lidar.reach, 2.0 * self._target_distance)
        self._constants = constants(settings, dt, clearance_contact=clearance_contact, on_contact=on_contact)
        self._mask = feature_mask(settings.masked_features)
        self._episodes: Records = np.zeros(n, dtype=episode_dtype(rays))
        self._episodes["max_steps"] = 1
        self._step = TaskStep.over(self._episodes)
        self._all: Ints = np.arange(n)
        self._unmeasured = self._all[:0]
        self._axis: AxisPoints
        self._position = np.zeros((n, 3))
        self._ahead = np.zeros(n)
        self._near: Floats = np.full(n, np.nan)
        self._origins = np.zeros((n, SPOKES + 2 * rays + LINES, 3))
        self._directions = np.zeros_like(self._origins)
        self._circle, self._sectors = ring_circle(rays), ring_sectors(rays)

    @property
    def lanes(self) -> int:
        """Number of episodes N."""
        return self.geometry.lanes

    def begin(self, lanes: Ints, poses: PoseBatch, drawn: Records | None = None) -> TaskStep:
        """Start new episodes in some lanes, in the geometry's present tubes, and take their first look.

        Args:
            lanes: (K,) distinct lane indices.
            poses: (N,) poses; those of other lanes have no effect.
            drawn: (K,) conditions of the episodes (`agent_client.conditions.draw_conditions`), None for the
                settings' body and sensors without noise.

        Returns:
            The step of all lanes; other lanes' rows are as they were.
        """
        lanes = np.ascontiguousarray(lanes, dtype=np.int64)
        episodes, length = self._episodes, self.geometry.length[lanes]
        limits = [self._step_limit or max_steps(self.settings, float(metres), self.dt) for metres in length]
        fresh = np.zeros(len(lanes), dtype=episodes.dtype)
        fresh["length"] = length
        fresh["max_steps"] = limits
        fresh["memory_age"] = self.settings.memory.steps + 1
        fresh["min_clearance"] = np.inf
        if drawn is None:
            fresh["body_radius"] = self.settings.drone.body_radius
            fresh["field_of_view"] = 1.0
        else:
            for name in (*SENSED, "observation_delay"):
                fresh[name] = drawn[name]
            fresh["noise_seed"] = drawn["seed"]
        episodes[lanes] = fresh
        self._near[lanes] = np.nan
        active = None
        if len(lanes) < self.lanes:
            active = np.zeros(self.lanes, dtype=np.bool_)
            active[lanes] = True
        self._perceive(lanes, poses, active, fresh=True)
        return self._step

    def observe(self, poses: PoseBatch) -> TaskStep:
        """Take in the poses that answer a control step: perception, ends, rewards and observations.

        Lanes whose episode is over stay as they were at its end, but earn nothing more.
        """
        lanes, active = self._all, None
        if np.count_nonzero(self._step.outcome):
            active = self._step.outcome == int(Outcome.RUNNING)
            lanes = np.flatnonzero(active)
            self._step.reward[~active] = 0.0
            self._step.reward_terms[~active] = 0.0
        self._perceive(lanes, poses, active, fresh=False)
        return self._step

    def _perceive(self, lanes: Ints, poses: PoseBatch, active: Bools | None, *, fresh: bool) -> None:
        """Bring the records and observations of `lanes` up to their poses; judge them unless they are fresh."""
        geometry, episodes, constant, raw = self.geometry, self._episodes, self._constants, poses.raw
        position, origins, directions = self._position, self._origins, self._directions
        np.copyto(position, poses.position)
        axis = self._axis = geometry.project(position, self._near)
        np.add(axis.arc_length, self._target_distance, out=self._ahead)
        targets, _ = geometry.axis(self._ahead)
        aim(lanes, episodes, constant, raw, self._circle, targets, axis.position, origins, directions)
        started = time.perf_counter_ns()
        distances = geometry.rays(origins, directions, self._reach, active)
        self.ray_nanoseconds = time.perf_counter_ns() - started
        self._unmeasured = lanes
        if self._clearance_contact:
            self.measure_clearance()
        assess(
            lanes, episodes, constant, raw.view(np.int64), axis.arc_length, axis.position, axis.tangent,
            axis.radial_distance, axis.radius, distances, targets,
            self._sectors, self._mask, fresh, self._near, self._step.observation,
        )  # fmt: skip

    def measure_clearance(self) -> None:
        """Measure `clearance` and `min_clearance` of the lanes that `begin` or `observe` looked at last.

        Where physics reports contact no decision depends on them, and they take as long as the rest of
        perception: `begin` and `observe` then leave them as they were, and whoever wants them calls this after
        each, best while physics works. Where contact is judged by them they are always up to date.
        """
        if len(self._unmeasured):
            clearance = self.geometry.clearance(self._position, self._axis)
            note_clearance(self._unmeasured, self._episodes, clearance)
            self._unmeasured = self._all[:0]
