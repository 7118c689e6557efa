"""Every constant of the task, once, with its unit and its source.

"Paper" names a section of the article that the project reproduces; "our choice" marks what it leaves open.
The learning scale is a tube of R = 1 m. What is on the drone is in metres and does not scale with the tube.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import Final

from agent_client.errors import SettingsError

DEFAULT_DT: Final = 0.1
"""Control step (s) of the kinematic world and of the shipped policy. Our choice."""


@dataclass(frozen=True)
class DroneSettings:
    """The drone's body and what its command carries."""

    body_radius: float = 0.15
    """Radius of the collision sphere (m). Our choice: 0.15 R."""
    compensation: float = 0.9
    """Gravity compensation c of every command (fraction of the weight; 1 hovers). The paper's "small
    stabilizing vertical term" (Data Exchange) has no value; 0.9 is our choice."""


@dataclass(frozen=True)
class LidarSettings:
    """Two rings of rays perpendicular to the body, one ahead of its centre and one behind (paper, LiDAR
    Features and Turn Detection). Numbers and sizes are our choice."""

    rays: int = 36
    """Rays of one ring: four times an odd number, so that no ray lies on the border of two sectors."""
    offset: float = 0.2
    """Distance of each ring's plane from the centre, along the body (m)."""
    reach: float = 3.0
    """Range (m); distances are normalised by it."""


@dataclass(frozen=True)
class CameraSettings:
    """The forward camera (paper, Visual Perception of the Target). Numbers are our choice."""

    half_width: float = math.radians(45.0)
    """Horizontal half-angle of the field of view (rad), theta_max^(a) of the paper's Action Space."""
    half_height: float = math.radians(35.0)
    """Vertical half-angle of the field of view (rad), theta_max^(b)."""
    target_distance: float = 3.0
    """How far ahead of the drone on the axis the target lies (m, arc length), at most the tube's end."""
    depth_scale: float = 4.0
    """Distance (m) at which the depth feature reaches 1; a target that is not seen reads 1 too."""


@dataclass(frozen=True)
class MemorySettings:
    """The directional memory (paper, Memory Mechanism)."""

    steps: int = 20
    """Control steps for which a direction that is no longer seen is remembered; 0 for no memory. Our choice."""


@dataclass(frozen=True)
class ActionSettings:
    """The 36 actions (paper, Action Space)."""

    spread: float = 0.75
    """k of the paper: the actions' angles as a fraction of the camera's half-angles."""
    speeds: tuple[float, ...] = (0.5, 1.0, 1.5, 2.0)
    """Speed levels (m/s), ascending. Their number is the paper's, their values are our choice."""


@dataclass(frozen=True)
class MotionSettings:
    """The kinematic world of training; the paper says nothing of it, these are our choice."""

    heading_blend: float = 0.35
    """Share of the way to the commanded direction that the heading goes in one control step."""
    speed_blend: float = 0.5
    """Share of the way to the commanded speed that the speed goes in one control step."""


@dataclass(frozen=True)
class StartSettings:
    """Where an episode starts. Our choice."""

    arc_length: float = 0.6
    """Arc length of the start on the axis (m)."""
    offset: float = 0.24
    """Largest random offset from the axis, as a fraction of the local radius R."""
    heading_error: float = math.radians(8.0)
    """Largest random angle between heading and axis (rad)."""


@dataclass(frozen=True)
class TaskSettings:
    """When an episode ends, and what its context features are scaled by."""

    success_radius: float = 0.5
    """An episode succeeds this close to the tube's end, as a fraction of R (along the axis)."""
    time_factor: float = 1.5
    """Step limit over the steps that the axis takes at the slowest speed. Our choice."""
    safety_scale: float = 0.3
    """Free distance (m) between body and nearest LiDAR return at which the second safety metric reaches 1.
    The paper does not define the metric; ours resolves the last 0.3 m before a touch, l_min being coarse."""


@dataclass(frozen=True)
class RewardSettings:
    """What the paper leaves open in its reward, and its terminal rewards (paper, Reward Shaping)."""

    per_metre: bool = True
    """Multiply the per-step terms by the step's progress over v_max dt. A departure from the paper, whose
    literal reward (False) pays for time in the tube and so teaches loitering."""
    regimes: bool = True
    """Pay the terms of the paper's three cases by what is seen. False, for comparison: those of its case 3, blind
    navigation, always, so that nothing is paid for alignment."""
    warmup_steps: int = 10
    """t_warmup: control steps with the warm-up bonus. Our choice: the first second."""
    centring: float = 0.0
    """Weight of S_center in the per-step terms. Our addition: the paper judges by S_traj = (S_center + S_align) / 2
    but rewards S_align alone, so that a policy that cuts corners loses 2 % of its reward."""
    success: float = 10.0
    failure: float = -10.0
    """For leaving the tube and for collision alike."""
    timeout: float = -1.0


@dataclass(frozen=True)
class Settings:
    """All constants of the task; `Settings()` is the task as it is trained and flown by default.

    Raises:
        SettingsError: a value is out of range; says which, what was expected and what was found.
    """

    drone: DroneSettings = field(default_factory=DroneSettings)
    lidar: LidarSettings = field(default_factory=LidarSettings)
    camera: CameraSettings = field(default_factory=CameraSettings)
    memory: MemorySettings = field(default_factory=MemorySettings)
    actions: ActionSettings = field(default_factory=ActionSettings)
    motion: MotionSettings = field(default_factory=MotionSettings)
    start: StartSettings = field(default_factory=StartSettings)
    task: TaskSettings = field(default_factory=TaskSettings)
    reward: RewardSettings = field(default_factory=RewardSettings)
    masked_features: tuple[str, ...] = ()
    """Names of features that stay in place and read 0, for a policy that is not to see them."""

    def __post_init__(self) -> None:
        for name, value, expected, holds in _rules(self):
            if not holds:
                raise SettingsError(f"{name}: expected {expected}, found {value}")

    @property
    def speed_max(self) -> float:
        """The fastest speed level (m/s); speeds are normalised by it."""
        return self.actions.speeds[-1]


def max_steps(settings: Settings, length: float, dt: float) -> int:
    """Step limit of a tube: `time_factor` times the control steps that its axis takes at the slowest speed.

    Args:
        settings: the task's constants.
        length: length of the axis (m).
        dt: control step (s).
    """
    # The tiny allowance keeps 20 / (0.5 * 0.1) at 400 where rounding makes it 400.00000000000006.
    return math.ceil(settings.task.time_factor * length / (settings.actions.speeds[0] * dt) - 1e-9)


def _rules(s: Settings) -> tuple[tuple[str, object, str, bool], ...]:
    """Name, value, what is expected, and whether it holds, of every rule."""
    quarter = math.pi / 2.0
    speeds = s.actions.speeds
    return (
        ("drone.body_radius", s.drone.body_radius, "a length above 0 m", s.drone.body_radius > 0.0),
        ("drone.compensation", s.drone.compensation, "0 to 2", 0.0 <= s.drone.compensation <= 2.0),
        ("lidar.rays", s.lidar.rays, "four times an odd number", s.lidar.rays > 0 and s.lidar.rays % 8 == 4),
        ("lidar.offset", s.lidar.offset, "0 m to the range", 0.0 <= s.lidar.offset < s.lidar.reach),
        (
            "camera.half_width",
            s.camera.half_width,
            "an angle in (0, pi/2)",
            0 < s.camera.half_width < quarter,
        ),
        (
            "camera.half_height",
            s.camera.half_height,
            "an angle in (0, pi/2)",
            0 < s.camera.half_height < quarter,
        ),
        ("camera.target_distance", s.camera.target_distance, "above 0 m", s.camera.target_distance > 0.0),
        ("camera.depth_scale", s.camera.depth_scale, "above 0 m", s.camera.depth_scale > 0.0),
        ("memory.steps", s.memory.steps, "at least 0 steps", s.memory.steps >= 0),
        ("actions.spread", s.actions.spread, "in (0, 1]", 0.0 < s.actions.spread <= 1.0),
        ("actions.speeds", speeds, "ascending speeds above 0 m/s", _ascending(speeds)),
        ("motion.heading_blend", s.motion.heading_blend, "in (0, 1]", 0.0 < s.motion.heading_blend <= 1.0),
        ("motion.speed_blend", s.motion.speed_blend, "in (0, 1]", 0.0 < s.motion.speed_blend <= 1.0),
        ("start.arc_length", s.start.arc_length, "at least 0 m", s.start.arc_length >= 0.0),
        ("start.offset", s.start.offset, "in [0, 1)", 0.0 <= s.start.offset < 1.0),
        ("start.heading_error", s.start.heading_error, "in [0, pi/2)", 0 <= s.start.heading_error < quarter),
        ("task.success_radius", s.task.success_radius, "above 0", s.task.success_radius > 0.0),
        ("task.time_factor", s.task.time_factor, "above 0", s.task.time_factor > 0.0),
        ("task.safety_scale", s.task.safety_scale, "above 0 m", s.task.safety_scale > 0.0),
        ("reward.centring", s.reward.centring, "at least 0", s.reward.centring >= 0.0),
        ("reward.warmup_steps", s.reward.warmup_steps, "at least 0", s.reward.warmup_steps >= 0),
    )


def _ascending(speeds: tuple[float, ...]) -> bool:
    return bool(speeds) and speeds[0] > 0.0 and all(a < b for a, b in itertools.pairwise(speeds))
