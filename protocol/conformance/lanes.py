"""Rules of several lanes in one session: rows, resets and refusals go where they belong, and lanes never touch."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from protocol.conformance.raw_agent import RawAgent
from protocol.conformance.rig import Rig
from protocol.conformance.rule import Level, Silence, Skip, demand, expect, server_rule
from protocol.conformance.sound import (
    AT_REST,
    close_to,
    commands,
    done,
    fly,
    has_walls,
    refused,
    resets,
    same_bits,
    speed_max,
    take_box,
)
from protocol.errors import RefusalCode
from protocol.plant import PARAMETER_INDEX, CommandBatch, PoseBatch, ResetBatch

COUNTS: Final = (1, 2, 7, 64)
"""Numbers of lanes that the rules open."""
CROWD: Final = 1000
"""Lanes of the rule that there may be many."""
_TOLERANCE: Final = 1e-4


def _own_resets(agent: RawAgent, numbers: list[int]) -> ResetBatch:
    """A reset of every lane into a state of its own, that of the lane's number."""
    batch = resets(agent, **AT_REST)
    for row, number in enumerate(numbers):
        batch.position[row] = (0.5 * number, -0.25 * number, 1.0 + number)
        batch.parameters[row, PARAMETER_INDEX["force_gain"]] = 0.5 / agent.settings.physics_dt
        batch.parameters[row, PARAMETER_INDEX["gravity"]] = 0.1 * number
    return batch


def _own_commands(agent: RawAgent, numbers: list[int]) -> CommandBatch:
    """A command for every lane in a direction and at a speed of its own."""
    batch = commands(agent, compensation=0.0)
    for row, number in enumerate(numbers):
        batch.direction[row] = (math.cos(0.1 * number), math.sin(0.1 * number), 0.0)
        batch.speed[row] = min(2.0, speed_max(agent)) * (1 + number) / 64
    return batch


def _rows(lanes: int) -> None:
    """Register the rule that N lanes have their own rows."""

    @server_rule(
        f"rows-of-{lanes}",
        Level.LANES,
        "3",
        f"with N = {lanes} every lane has rows of its own",
    )
    def rows(rig: Rig) -> None:
        agent = rig.open(lanes=lanes)
        numbers = list(range(lanes))
        placed, flown = _own_resets(agent, numbers), _own_commands(agent, numbers)
        poses = done(agent.reset(placed), "a reset of all lanes")
        close_to("positions after a reset", poses.position.ravel(), placed.position.ravel(), _TOLERANCE)
        poses = done(agent.step(flown), "a step")
        # With k_v h = 1/2 what is left to the final velocity halves in each of the four inner steps.
        final = flown.speed[:, None] * flown.direction
        final[:, 2] -= 0.1 * np.arange(lanes) / (0.5 / agent.settings.physics_dt)
        expected = final * (1.0 - 0.5**4)
        for lane in numbers:
            close_to(f"velocity of lane {lane}", poses.linear_velocity[lane], expected[lane], _TOLERANCE)

    rows.__doc__ = "Every lane has another state, another gravity and another command, and goes its own way."


def _alone(lanes: int) -> None:
    """Register the rule that a lane among N flies as it would alone."""

    @server_rule(
        f"alone-as-among-{lanes}",
        Level.LANES,
        "1",
        f"a lane among {lanes} flies bit for bit as the same lane alone",
    )
    def alone(rig: Rig) -> None:
        agent, single = rig.open(lanes=lanes), rig.open(lanes=1)
        number = lanes - 1
        one, other = _tumble(agent, list(range(lanes))), _tumble(single, [number])
        for step, (poses, expected) in enumerate(zip(one, other, strict=True)):
            row = PoseBatch(poses.raw[number:].copy())
            same_bits(f"pose of lane {number} after step {step}", row, expected)

    alone.__doc__ = "The last lane's poses, under the whole law, do not depend on the others or their number."


def _tumble(agent: RawAgent, numbers: list[int]) -> list[PoseBatch]:
    """Fly every lane from a state of its own under the server's default law."""
    batch = resets(agent)
    for row, number in enumerate(numbers):
        batch.position[row] = (0.3 * number, 0.1, -0.7 * number)
        batch.quaternion[row] = (0.0, math.sin(0.3 * number), 0.0, math.cos(0.3 * number))
        batch.linear_velocity[row] = (0.1 * number, 0.0, 0.3)
        batch.angular_velocity[row] = (0.3, -0.01 * number, 0.7)
    flown = _own_commands(agent, numbers)
    return [done(agent.reset(batch), "a reset of all lanes"), *fly(agent, flown, 5)]


for _lanes in COUNTS:
    _rows(_lanes)
    if _lanes > 1:
        _alone(_lanes)


@server_rule(
    "many-lanes", Level.LANES, "3", f"{CROWD} lanes attach, are reset and step once, each with its own row"
)
def many_lanes(rig: Rig) -> None:
    """Nothing acts on the bodies; each flies on at a velocity of its own, the first and the last as all between."""
    try:
        agent = rig.open(lanes=CROWD, inner_steps=1)
    except Silence as silence:  # an engine may need seconds for so many worlds: no rule says how long
        raise Skip(f"with {CROWD} lanes {silence}; give it longer by --timeout") from silence
    batch = resets(agent, **AT_REST)
    batch.position[:, 1] = np.arange(CROWD)
    batch.linear_velocity[:, 0] = np.arange(CROWD) / CROWD
    placed = done(agent.reset(batch), f"a reset of {CROWD} lanes")
    close_to("positions after a reset", placed.position.ravel(), batch.position.ravel(), _TOLERANCE)
    poses = done(agent.step(commands(agent)), f"a step of {CROWD} lanes")
    expected = batch.position + agent.settings.dt * batch.linear_velocity
    off = np.abs(poses.position - expected).max(axis=1)
    lane = int(np.argmax(np.where(np.isnan(off), np.inf, off)))
    close_to(f"position of lane {lane} after a step", poses.position[lane], expected[lane], _TOLERANCE)
    expect("lanes whose step is 1", int((poses.step == 1).sum()), CROWD)


@server_rule(
    "reset-of-one-lane",
    Level.LANES,
    "6",
    "a reset of one lane leaves the others on their way",
)
def reset_of_one_lane(rig: Rig) -> None:
    """The rows of the other lanes stay, and their flight is that without the reset, bit for bit."""
    agent, undisturbed = rig.open(lanes=7), rig.open(lanes=7)
    numbers = list(range(7))
    for each in (agent, undisturbed):
        done(each.reset(_own_resets(each, numbers)), "a reset of all lanes")
    flown = _own_commands(agent, numbers)
    before = fly(agent, flown, 3)[-1]
    batch = resets(agent, [3])
    batch.position[3] = (9.0, 9.0, 9.0)
    poses = done(agent.reset(batch), "a reset of lane 3")
    others = [0, 1, 2, 4, 5, 6]
    same_bits("poses of the other lanes after a reset", poses, before, others)
    close_to("position of the lane that was reset", poses.position[3], batch.position[3], _TOLERANCE)
    for one, other in zip(fly(agent, flown, 2), fly(undisturbed, flown, 5)[3:], strict=True):
        same_bits("poses of the other lanes, a step later", one, other, others)


@server_rule(
    "count-of-each-lane", Level.LANES, "6", "each lane counts the steps and the time since its own reset"
)
def count_of_each_lane(rig: Rig) -> None:
    """A lane that is reset begins again at 0, the others go on."""
    agent = rig.open(lanes=2)
    done(agent.reset(resets(agent)), "a reset of both lanes")
    fly(agent, commands(agent), 3)
    poses = done(agent.reset(resets(agent, [1])), "a reset of lane 1")
    expect("step of each lane", poses.step.tolist(), [3, 0])
    (poses,) = fly(agent, commands(agent), 1)
    expect("step of each lane", poses.step.tolist(), [4, 1])
    expect("sim_time of each lane", poses.sim_time.tolist(), [4 * agent.settings.dt, agent.settings.dt])


@server_rule("rows-never-reset", Level.LANES, "6", "rows of lanes that were never reset are zero")
def rows_never_reset(rig: Rig) -> None:
    """Until each lane's first reset."""
    agent = rig.open(lanes=3)
    batch = resets(agent, [1])
    batch.position[:] = 4.0
    poses = done(agent.reset(batch), "a reset of lane 1")
    demand(
        not poses.raw[[0, 2]].any(), "rows of lanes that were never reset", "zero", poses.raw[[0, 2]].tolist()
    )


@server_rule("refusal-names-first-lane", Level.LANES, "7", "of several lanes at fault the first is named")
def refusal_names_first_lane(rig: Rig) -> None:
    """For commands and for resets, whatever the later faults are."""
    agent = rig.open(lanes=7)
    done(agent.reset(resets(agent)), "a reset of all lanes")
    batch = commands(agent)
    batch.compensation[2], batch.speed[5], batch.direction[6] = 3.0, math.nan, 0.0
    refused(agent.step(batch), "faults in lanes 2, 5 and 6 of a step", RefusalCode.OUT_OF_RANGE, 2)
    again = resets(agent)
    again.quaternion[4], again.position[5], again.tube[6] = 0.0, math.nan, 3
    refused(agent.reset(again), "faults in lanes 4, 5 and 6 of a reset", RefusalCode.NOT_UNIT, 4)
    again.selected[4] = 0
    refused(agent.reset(again), "the same with lane 4 not selected", RefusalCode.NOT_FINITE, 5)


@server_rule("lanes-do-not-touch", Level.LANES, "1", "bodies of different lanes pass through each other")
def lanes_do_not_touch(rig: Rig) -> None:
    """Two bodies in the same place stay there, and report no contact."""
    agent = rig.open(lanes=2)
    done(agent.reset(resets(agent, **AT_REST)), "a reset of both lanes to the same place")
    for poses in fly(agent, commands(agent), 5):
        expect("contact_steps of bodies in free space", poses.contact_steps.tolist(), [0, 0])
        close_to("positions of bodies at rest", poses.position.ravel(), [0.0] * 6, _TOLERANCE)


@server_rule("tube-of-each-lane", Level.LANES, "6", "each lane flies in the tube of its own reset")
def tube_of_each_lane(rig: Rig) -> None:
    """Lane 0 is stopped by a wall that lane 1, in free space, flies through."""
    agent = rig.open(lanes=2)
    if not has_walls(agent):
        raise Skip("the plant has no walls")
    take_box(agent, rig.folder)
    batch = resets(agent, **{**AT_REST, "force_gain": 4.0, "body_radius": 0.1, "restitution": 0.0})
    batch.tube[0] = 0
    done(agent.reset(batch), "a reset of lane 0 into the box and of lane 1 into free space")
    speed = min(1.0, speed_max(agent))
    poses = fly(agent, commands(agent, speed=speed), math.ceil((2.0 / speed + 0.6) / agent.settings.dt))
    touched = [max(int(pose.contact_steps[lane]) for pose in poses) for lane in (0, 1)]
    demand(touched[0] > 0 and touched[1] == 0, "contact_steps of lanes 0 and 1", "some, and none", touched)
    x = poses[-1].position[:, 0].tolist()
    demand(x[0] < 1.0 < x[1], "x of lanes 0 and 1", "within and beyond the wall at 1 m", x)
