"""How a flight went wrong, for the page of `cosim report`: the moment, where the wall was, what was known of it."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from agent_client.task import Outcome
from cosim.runs import Run, column
from cosim.scene import Scene, Surface
from cosim.senses import local_frames
from meshes.closest import build_tree, wall_distance

Floats = NDArray[np.float64]

ASIDE: Final = np.sin(np.pi / 8)
"""Least share of a direction along one axis of the body for which that side is named."""
PROBE: Final = 1e-4
"""Over which the distance to the wall is differentiated, over the distance."""
STANDSTILL: Final = 1.0
"""Seconds without progress after which a flight does not come on."""
SIDES: Final = (("ahead", "behind"), ("above", "below"), ("to the right", "to the left"))
"""Of the drone, along its axes f, u and r and against them."""


def describe_ending(run: Run, scene: Scene, curvature: Floats) -> dict[str, Any] | None:
    """The first contact of a flight, else the end of one that failed; None where nothing went wrong.

    Args:
        run: with at least one record.
        scene: of the run.
        curvature: (T,) of the axis at every record (1/m), NaN where it is not known.

    Returns:
        As JSON: `time` of the moment and of the record `before` it, by which its step was decided (s); the place
        `wall` of the wall that was nearest (m, world frame), None where no wall was met; a `title` and `facts`,
        pairs of a name and a text. LiDAR and camera are told as they were before.
    """
    records = run.records
    touched = np.flatnonzero(column(run, "contact"))
    ended = Outcome(int(records[-1]["outcome"]))
    if not len(touched) and ended in (Outcome.RUNNING, Outcome.SUCCESS):
        return None
    at = int(touched[0]) if len(touched) else len(records) - 1
    now, before = records[at], records[max(at - 1, 0)]
    facts = {"where": _place(run, at, float(curvature[at]))}
    nearest = None
    if len(touched) or ended is Outcome.COLLISION:
        # A tube that was rebuilt from the log is too coarse, and ends where the flight did.
        nearest = nearest_on_wall(scene.tube, now["position"]) if not scene.note else _beyond_axis(now)
        facts |= {
            "the wall": _wall(run, now, nearest),
            "the gap": _gap(run, at),
            "flown": _flight(before, nearest),
            "commanded": _command(before, now, nearest),
            "LiDAR before": _lidar(run, before, nearest),
        }
    facts["camera before"] = _camera(run, at)
    return {
        "time": as_shown(now["sim_time"]),
        "before": as_shown(before["sim_time"]),
        "wall": None if nearest is None else nearest.tolist(),
        "title": _title(run, at, ended, bool(len(touched))),
        "facts": [[name, text] for name, text in facts.items() if text],
    }


def as_shown(time: Any) -> float:
    """A time (s) as the page's single precision has it, so that it finds its own record and not the one before."""
    return float(np.float32(time))


def nearest_on_wall(wall: Surface, point: Floats) -> Floats:
    """The place (3,) of a wall that is nearest to a point (3,), both in metres."""
    tree = build_tree(wall.vertices, wall.faces)

    def distances(points: Floats) -> Floats:
        found = np.empty(len(points))
        wall_distance(
            np.ascontiguousarray(points), tree.boxes, tree.triangles, np.full(len(points), -1), found
        )
        return found

    away = float(distances(point[None])[0])
    # The distance grows fastest straight away from the nearest place.
    probe = PROBE * max(away, 1e-3) * np.eye(3)
    slope = distances(point + probe) - distances(point - probe)
    steepest = float(np.linalg.norm(slope))
    return point - away * slope / steepest if steepest > 0.0 else np.array(point)


def _beyond_axis(record: np.void) -> Floats:
    """Straight away from the axis, as far off as the recorded clearance (3,), in metres: the wall of a round tube."""
    away = record["position"] - record["axis_position"]
    place: Floats = record["position"] + record["clearance"] * away / max(float(np.linalg.norm(away)), 1e-12)
    return place


def sides(direction: Floats) -> str:
    """Where a direction (3,) of the local frame f, u, r points: "ahead, to the left"."""
    direction = direction / max(float(np.linalg.norm(direction)), 1e-12)
    named = [SIDES[i][int(direction[i] < 0.0)] for i in range(3) if abs(direction[i]) > ASIDE]
    return ", ".join(named)


def _title(run: Run, at: int, ended: Outcome, contact: bool) -> str:
    record = run.records[at]
    when = f"in step {int(record['step'])}, {record['sim_time']:.1f} s after the start"
    if contact:
        inner, of = int(record["contact_steps"]), int(run.manifest["session"]["inner_steps"])
        return f"It touched the wall {when}" + (f", in {inner} of {of} inner steps" if inner else "")
    if ended is Outcome.EXIT:
        return f"It left the tube {when}"
    if ended is Outcome.COLLISION:
        return f"It was too near to the wall {when}"
    return f"Its time was over {when}: {_stalled(run)}"


def _stalled(run: Run) -> str:
    """How far a flight came at last, and whether it still came on."""
    along = np.maximum.accumulate(column(run, "arc_length"))
    step = 0.1 * float(run.records[-1]["radius"])
    times = run.records["sim_time"]
    since = float(times[int(np.argmax(along > along[-1] - step))])
    if times[-1] - since < STANDSTILL:
        return f"it was still coming on, at {along[-1]:.2f} m"
    return f"it came to {along[-1]:.2f} m in {since:.1f} s and no further"


def _place(run: Run, at: int, curvature: float) -> str:
    record = run.records[at]
    along, radius = float(record["arc_length"]), float(record["radius"])
    text = f"{along:.2f} m along the axis of {run.manifest['mesh']['length_m']:.1f} m, R {radius:.2f} m"
    if not np.isfinite(curvature):
        return text
    if curvature * radius < 0.05:
        return f"{text}, where the axis is straight"
    return f"{text}, in a bend of radius {1.0 / curvature:.2f} m ({1.0 / (curvature * radius):.1f} R)"


def _wall(run: Run, now: np.void, nearest: Floats) -> str:
    """Where the wall is of the body."""
    offset = nearest - now["position"]
    body = float(run.manifest["parameters"]["body_radius"])
    seen = _local(offset, now)
    off_nose = np.degrees(np.arctan2(np.hypot(seen[1], seen[2]), seen[0]))
    return (
        f"{sides(seen)}; {off_nose:.0f}° off the drone's nose, {np.linalg.norm(offset):.3f} m from its centre "
        f"(body: {body:.3f} m)"
    )


def _flight(before: np.void, nearest: Floats) -> str:
    """How fast it came, and how fast towards the wall."""
    towards = nearest - before["position"]
    towards /= max(float(np.linalg.norm(towards)), 1e-12)
    velocity = before["linear_velocity"]
    speed, closing = np.linalg.norm(velocity), velocity @ towards
    return f"{speed:.2f} m/s one step before, {closing:.2f} m/s of it towards that place"


def _command(before: np.void, now: np.void, nearest: Floats) -> str:
    """What was asked for in the step, beside how the drone flew and where the wall was."""
    towards = nearest - before["position"]
    off = _angle(now["direction"], towards)
    told = f"{now['commanded_speed']:.2f} m/s, {off:.0f}° off the direction of that place"
    if np.linalg.norm(before["linear_velocity"]) < 1e-3:
        return told
    return f"{told}, {_angle(now['direction'], before['linear_velocity']):.0f}° off the direction of flight"


def _lidar(run: Run, before: np.void, nearest: Floats) -> str:
    """What the rings read before, and whether a ring's plane came near to the place."""
    settings = run.manifest["settings"]["lidar"]
    rays, offset = int(settings["rays"]), float(settings["offset"])
    readings = before["lidar"].reshape(2, rays)
    parts = []
    for name, ring in zip(("front", "rear"), readings, strict=True):
        least = int(ring.argmin())
        angle = 2.0 * np.pi * least / rays
        where = sides(np.array([0.0, np.sin(angle), np.cos(angle)]))
        which = f"least {where}" if ring.any() else "all round: it had gone through the wall"
        parts.append(f"{name} ring {ring[least]:.2f} m or more, {which}")
    ahead = float(_local(nearest - before["position"], before)[0])
    text = "; ".join(parts)
    if ahead > 2.0 * offset:
        text += f"; the place lay {ahead - offset:.2f} m ahead of the front ring, where no ray looks"
    return text


def _camera(run: Run, at: int) -> str:
    """Whether the target was in sight when the step was decided, or since when it was not."""
    if at == 0:
        return ""
    seen = run.records["target_visible"][:at]
    before = run.records[at - 1]
    if seen[-1]:
        return "the target was in sight"
    if not seen.any():
        return "the target was never in sight"
    last = int(np.flatnonzero(seen)[-1])
    ago = float(before["sim_time"] - run.records["sim_time"][last])
    held = "remembered" if before["memory_available"] else "forgotten"
    return f"the target was lost {ago:.1f} s before, and {held}"


def _gap(run: Run, at: int) -> str:
    """Since when the gap to the wall shrank without a pause."""
    gap = column(run, "clearance")[: at + 1] - run.manifest["parameters"]["body_radius"]
    # A drone that bounced off within the step is further away again at its end.
    at -= int(at > 0 and gap[at - 1] < gap[at])
    start = at
    while start > 0 and gap[start - 1] > gap[start]:
        start -= 1
    times = run.records["sim_time"]
    if start == at:
        return f"{gap[at]:.3f} m"
    return (
        f"shrank from {gap[start]:.3f} m to {gap[at]:.3f} m in the {times[at] - times[start]:.1f} s before, "
        "without a pause"
    )


def _local(vector: Floats, record: np.void) -> Floats:
    """A vector (3,) of the world frame in the drone's frame f, u, r."""
    frame = local_frames(record["position"][None], record["quaternion"][None])[0]
    seen: Floats = frame @ vector
    return seen


def _angle(a: Floats, b: Floats) -> float:
    """Between two vectors (3,), in degrees."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
