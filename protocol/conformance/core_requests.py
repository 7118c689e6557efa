"""Core rules of requests: what a reset puts in place and forgets, numbers of the poses, tubes and contact."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from protocol.conformance.raw_agent import RawAgent
from protocol.conformance.rig import Rig
from protocol.conformance.rule import Level, Skip, demand, expect, server_rule
from protocol.conformance.sound import (
    AT_REST,
    close_to,
    commands,
    done,
    fly,
    has_walls,
    register,
    release,
    resets,
    same_bits,
    speed_max,
    take_box,
    write_box,
)
from protocol.layout import TUBE_SLOTS_MAX, Axes
from protocol.plant import NO_TUBE, PARAMETER_INDEX, CommandBatch, PoseBatch, ResetBatch

ROUNDED: Final = 1e-5
"""How much an engine may round a state that it is given: single precision at a few metres."""
_DT: Final = 0.1
_RADIUS: Final = 0.1
"""Of the body in the rules of contact (m)."""


def _somewhere(agent: RawAgent) -> ResetBatch:
    """Resets into a moving and turning state, another one in each lane."""
    batch = resets(agent)
    for lane in range(agent.settings.lanes):
        batch.position[lane] = (1.5 + lane, -2.25, 0.75)
        batch.quaternion[lane] = (0.1, -0.3, 0.5, 0.806225774829855)
        batch.linear_velocity[lane] = (0.25, -0.5, 1.125 + lane)
        batch.angular_velocity[lane] = (0.5, -0.25, 1.5)
    return batch


@server_rule(
    "reset-state",
    Level.CORE,
    "6",
    "a reset's pose is the state asked for, its count and times zero",
)
def reset_state(rig: Rig) -> None:
    """The engine may round it; nothing is integrated."""
    agent = rig.open()
    batch = _somewhere(agent)
    poses = done(agent.reset(batch), "a reset into a moving state")
    for name in ("position", "quaternion", "linear_velocity", "angular_velocity"):
        close_to(f"{name} after a reset", getattr(poses, name)[0], getattr(batch, name)[0], ROUNDED)
    _count_is(poses, 0)


def _count_is(poses: PoseBatch, step: int, dt: float = _DT) -> None:
    expect("step of the pose row", poses.step.tolist(), [step] * len(poses.raw))
    expect("sim_time of the pose row", poses.sim_time.tolist(), [step * dt] * len(poses.raw))
    if step == 0:
        expect("contact_steps after a reset", poses.contact_steps.tolist(), [0] * len(poses.raw))


@server_rule("reset-again", Level.CORE, "6", "a reset in flight puts the body back, with count and time zero")
def reset_again(rig: Rig) -> None:
    """The second reset of a lane does as the first did, bit for bit."""
    agent = rig.open()
    batch = _somewhere(agent)
    first = done(agent.reset(batch), "a reset")
    fly(agent, commands(agent), 3)
    second = done(agent.reset(batch), "a second reset")
    _count_is(second, 0)
    same_bits("the pose of the second reset", second, first)


@server_rule("reset-forgets", Level.CORE, "6", "an episode after others is bit for bit that episode alone")
def reset_forgets(rig: Rig) -> None:
    """Another episode lies between, with other parameters and a wild state."""
    agent = rig.open()
    moving = commands(agent, direction=(0.6, 0.0, 0.8), speed=0.5 * speed_max(agent), compensation=0.9)
    alone = _episode(agent, _somewhere(agent), moving)
    between = _somewhere(agent)
    between.parameters[:, PARAMETER_INDEX["mass"]] *= 3.0
    between.parameters[:, PARAMETER_INDEX["gravity"]] = 1.5
    between.angular_velocity[:] = (5.0, 4.0, -3.0)
    _episode(agent, between, commands(agent, direction=(0.0, -1.0, 0.0), speed=speed_max(agent)))
    after = _episode(agent, _somewhere(agent), moving)
    for number, (one, other) in enumerate(zip(after, alone, strict=True)):
        same_bits(f"step {number} of the episode after another", one, other)


def _episode(agent: RawAgent, batch: ResetBatch, flown: CommandBatch) -> list[PoseBatch]:
    return [done(agent.reset(batch), "a reset"), *fly(agent, flown, 6)]


@server_rule("reset-nothing", Level.CORE, "6", "a reset that selects no lane is done and changes nothing")
def reset_nothing(rig: Rig) -> None:
    """Before the first reset and in flight."""
    agent = rig.open()
    done(agent.reset(resets(agent, [])), "a reset of no lane")
    expect("pose rows of lanes that were never reset", agent.poses().raw.any(), False)
    done(agent.reset(_somewhere(agent)), "a reset")
    (before,) = fly(agent, commands(agent), 1)
    same_bits("poses", done(agent.reset(resets(agent, [])), "a reset of no lane"), before)


@server_rule("reset-unselected", Level.CORE, "7", "words of a row that is not selected are not looked at")
def reset_unselected(rig: Rig) -> None:
    """Nonsense in the row of lane 0 does not hinder the reset of lane 1."""
    agent = rig.open(lanes=2)
    done(agent.reset(resets(agent)), "a reset")
    batch = resets(agent)
    batch.raw[0] = np.nan
    batch.selected[0] = 0
    done(agent.reset(batch), "a reset with nonsense in a row that is not selected")
    fly(agent, commands(agent), 1)


@server_rule(
    "pose-step", Level.CORE, "6", "the pose row's step counts the control steps since the lane's reset"
)
def pose_step(rig: Rig) -> None:
    """It goes on by one a step, and begins again with a reset, while the session's count goes on."""
    agent = rig.open()
    for episode in range(2):
        poses = done(agent.reset(resets(agent)), "a reset")
        expect("step after a reset", poses.step.tolist(), [0])
        counted = [int(poses.step[0]) for poses in fly(agent, commands(agent), 4)]
        expect(f"step of the pose rows of episode {episode}", counted, [1, 2, 3, 4])
    expect("step of the session", agent.steps, 8)


@server_rule("pose-time", Level.CORE, "6", "sim_time is the product of the row's step and dt, not a sum")
def pose_time(rig: Rig) -> None:
    """With dt = 0.1 the third step shows 0.30000000000000004, and a sum differs from the sixth on."""
    agent = rig.open()
    done(agent.reset(resets(agent)), "a reset")
    for step, poses in enumerate(fly(agent, commands(agent), 12), start=1):
        expect(f"sim_time of step {step}", float(poses.sim_time[0]), step * agent.settings.dt)


@server_rule("tube-last-index", Level.CORE, "6", f"of {TUBE_SLOTS_MAX} tube slots the last one takes a tube")
def tube_last_index(rig: Rig) -> None:
    """A lane is reset into it and flies there, and it is released."""
    agent = rig.open(tube_slots=TUBE_SLOTS_MAX)
    index = TUBE_SLOTS_MAX - 1
    take_box(agent, rig.folder, index)
    batch = resets(agent)
    batch.tube[:] = index
    done(agent.reset(batch), f"a reset into tube {index}")
    fly(agent, commands(agent), 1)
    done(agent.reset(resets(agent)), "a reset out of it")
    done(release(agent, index), f"the release of tube {index}")


@server_rule("tube-release-again", Level.CORE, "6", "a released index can be registered again")
def tube_release_again(rig: Rig) -> None:
    """With another file; and the same file may stand under several indices."""
    agent = rig.open()
    box = take_box(agent, rig.folder)
    done(register(agent, 1, box), "the same file under another index")
    done(release(agent, 0), "release of index 0")
    larger = write_box(rig.folder / "larger.obj", (2.0, 2.0, 2.0))
    done(register(agent, 0, larger), "another file under the released index")
    for index in (0, 1):
        batch = resets(agent)
        batch.tube[:] = index
        done(agent.reset(batch), f"a reset into tube {index}")


@server_rule("tube-unnoticed", Level.CORE, "6", "lanes do not notice registrations and releases")
def tube_unnoticed(rig: Rig) -> None:
    """A flight in free space with registrations and releases between its steps is the flight without."""
    agent, undisturbed = rig.open(), rig.open()
    box = take_box(agent, rig.folder)
    flown = []
    for each in (agent, undisturbed):
        done(each.reset(_somewhere(each)), "a reset")
    for _ in range(2):
        flown += fly(agent, commands(agent), 1)
        before = agent.poses()
        done(register(agent, 1, box), "a registration in flight")
        same_bits("poses after a registration", agent.poses(), before)
        flown += fly(agent, commands(agent), 1)
        done(release(agent, 1), "a release in flight")
    for one, other in zip(flown, fly(undisturbed, commands(undisturbed), 4), strict=True):
        same_bits("a step among registrations", one, other)


@server_rule("contact-free-space", Level.CORE, "6", "in free space contact_steps is 0")
def contact_free_space(rig: Rig) -> None:
    """A body in no tube touches nothing, wherever it flies."""
    agent = rig.open()
    done(agent.reset(resets(agent)), "a reset")
    for poses in fly(agent, commands(agent, speed=speed_max(agent)), 20):
        expect("contact_steps in free space", int(poses.contact_steps[0]), 0)


# --- contact ---


def _drive(agent: RawAgent, direction: tuple[float, float, float], tube: int = 0) -> list[PoseBatch]:
    """Reset into the middle of a tube and push the body along `direction`, for a way of 2 m at least."""
    parameters = {**AT_REST, "body_radius": _RADIUS, "force_gain": 4.0, "restitution": 0.0}
    batch = resets(agent, **parameters)
    batch.tube[:] = tube
    done(agent.reset(batch), f"a reset into tube {tube}")
    speed = min(1.0, speed_max(agent))  # within an inner step it gets 25 mm far, and no wall is missed
    steps = math.ceil((2.0 / speed + 0.6) / agent.settings.dt)
    return fly(agent, commands(agent, direction=direction, speed=speed), steps)


def _with_walls(rig: Rig) -> RawAgent:
    agent = rig.open()
    if not has_walls(agent):
        raise Skip("the plant has no walls")
    return agent


def _stopped_at(poses: list[PoseBatch], axis: int, wall: float, what: str) -> None:
    """Demand that the body was stopped where its sphere touches the wall, and that contact was reported."""
    touched = [int(pose.contact_steps[0]) for pose in poses]
    demand(max(touched) > 0, f"contact_steps at {what}", "more than 0", touched)
    demand(min(touched) >= 0 and max(touched) <= 4, f"contact_steps at {what}", "0 to n = 4", touched)
    reached = float(poses[-1].position[0, axis])
    expected = wall - _RADIUS if wall > 0 else wall + _RADIUS
    close_to(f"where {what} stops the body", [reached], [expected], 0.05)


@server_rule("contact-none-promised", Level.CORE, "6", "a plant without walls always reports 0 contact_steps")
def contact_none_promised(rig: Rig) -> None:
    """Driven through the wall of a tube that it accepted."""
    agent = rig.open()
    if has_walls(agent):
        raise Skip("the plant has walls")
    take_box(agent, rig.folder)
    touched = [int(poses.contact_steps[0]) for poses in _drive(agent, (1.0, 0.0, 0.0))]
    expect("contact_steps of a plant with walls = 0", max(touched), 0)


@server_rule("contact-wall", Level.CORE, "6", "a registered wall stops the body, and contact_steps says so")
def contact_wall(rig: Rig) -> None:
    """In a box of 2 m, along each axis and both ways; contact_steps stays within 0 to n."""
    agent = _with_walls(rig)
    take_box(agent, rig.folder)
    for axis in range(3):
        for sign in (1.0, -1.0):
            direction = [0.0, 0.0, 0.0]
            direction[axis] = sign
            poses = _drive(agent, (direction[0], direction[1], direction[2]))
            _stopped_at(poses, axis, sign, f"the wall at {'xyz'[axis]} = {sign:g}")


@server_rule("contact-hollow", Level.CORE, "6", "a tube is hollow: inside of it a body touches nothing")
def contact_hollow(rig: Rig) -> None:
    """A body that hovers in the middle of a box reports no contact and is not pushed out."""
    agent = _with_walls(rig)
    take_box(agent, rig.folder)
    batch = resets(agent, **{**AT_REST, "body_radius": _RADIUS})
    batch.tube[:] = 0
    batch.position[:] = (0.25, -0.125, 0.0625)
    done(agent.reset(batch), "a reset into the box")
    for pose in fly(agent, commands(agent), 5):
        expect("contact_steps within the box", int(pose.contact_steps[0]), 0)
        close_to("where the body hovers", pose.position[0], batch.position[0], ROUNDED)


@server_rule("tube-scale", Level.CORE, "6", "tube_scale is metres per unit of the file")
def tube_scale(rig: Rig) -> None:
    """A box of 2000 units with scale 0.001 has its walls at 1 m."""
    agent = _with_walls(rig)
    box = write_box(rig.folder / "millimetres.obj", (1000.0, 1000.0, 1000.0))
    done(register(agent, 0, box, scale=0.001), "registration of a box in millimetres")
    _stopped_at(_drive(agent, (1.0, 0.0, 0.0)), 0, 1.0, "the wall at 1000 mm")


@server_rule("tube-axes", Level.CORE, "6", "a file with Y up is turned: (x, y, z) becomes (x, -z, y)")
def tube_axes(rig: Rig) -> None:
    """A box around (0, 0.5, 0.2) of the file is around (0, -0.2, 0.5) of the world."""
    agent = _with_walls(rig)
    box = write_box(rig.folder / "yup.obj", (1.5, 1.0, 0.8), (0.0, 0.5, 0.2))
    done(register(agent, 0, box, Axes.yup), "registration of a box with Y up")
    for axis, direction, wall in (
        (2, (0.0, 0.0, 1.0), 1.5),
        (2, (0.0, 0.0, -1.0), -0.5),
        (1, (0.0, 1.0, 0.0), 0.6),
        (1, (0.0, -1.0, 0.0), -1.0),
    ):
        _stopped_at(_drive(agent, direction), axis, wall, f"the wall at {'xyz'[axis]} = {wall:g}")


@server_rule("tube-left", Level.CORE, "6", "a lane that is reset into free space has left its tube")
def tube_left(rig: Rig) -> None:
    """Nothing stops it where the wall was."""
    agent = _with_walls(rig)
    take_box(agent, rig.folder)
    _drive(agent, (1.0, 0.0, 0.0))
    poses = _drive(agent, (1.0, 0.0, 0.0), NO_TUBE)
    expect("contact_steps in free space", max(int(pose.contact_steps[0]) for pose in poses), 0)
    reached = float(poses[-1].position[0, 0])
    demand(reached > 1.5, "x of the body", "beyond the wall at 1 m, more than 1.5 m", reached)
