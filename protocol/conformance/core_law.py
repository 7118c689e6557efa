"""Core rules of frames and of the law: what a body does, against closed forms and an evaluation of Annex A.

Velocities after an inner step do not depend on how an engine integrates, since force and torque are those of the
step's beginning: they are compared closely. Poses do, and may lie anywhere between those that follow the old and
the new velocities.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from protocol.conformance import annex_a
from protocol.conformance.annex_a import Body, Order, body
from protocol.conformance.raw_agent import RawAgent
from protocol.conformance.rig import Rig
from protocol.conformance.rule import Failure, Level, demand, server_rule
from protocol.conformance.sound import (
    AT_REST,
    close_to,
    commands,
    done,
    done_or_skip,
    fly,
    parameter_names,
    resets,
    speed_max,
)
from protocol.layout import Farewell, Op
from protocol.plant import Floats, PoseBatch, ResetBatch

EXACT: Final = 2e-5
"""What single precision costs in a few steps, relative to the numbers at hand."""
_TILTED: Final = (0.1, -0.3, 0.5, math.sqrt(0.65))
"""An attitude like no other, of unit length."""
_G: Final = 9.81
_BODY: Final = {**AT_REST, "mass": 2.0, "inertia_x": 0.02, "inertia_y": 0.02, "inertia_z": 0.02}
"""A body on which nothing acts."""
_FORWARD: Final = Order(np.array([1.0, 0.0, 0.0]), 0.0, 0.0)


def _placed(agent: RawAgent, state: Body, **parameters: float) -> ResetBatch:
    """Resets into a state with the parameters of `_BODY` and others by name."""
    batch = resets(agent, **{**_BODY, **parameters})
    batch.position[:], batch.quaternion[:] = state.position, state.quaternion
    batch.linear_velocity[:], batch.angular_velocity[:] = state.velocity, state.omega
    return batch


def _fly(agent: RawAgent, state: Body, order: Order, steps: int, **parameters: float) -> list[PoseBatch]:
    """Reset into a state and give the same order for some steps."""
    done(agent.reset(_placed(agent, state, **parameters)), "a reset")
    batch = commands(agent, tuple(order.direction), order.speed, order.compensation)
    return fly(agent, batch, steps)


def _obeys(agent: RawAgent, state: Body, order: Order, steps: int, **parameters: float) -> None:
    """Fly, and compare every step with Annex A from the server's own state before it."""
    values = dict(
        zip(parameter_names(), resets(agent, **{**_BODY, **parameters}).parameters[0], strict=False)
    )
    n, h = agent.settings.inner_steps, agent.settings.dt / agent.settings.inner_steps
    for step, pose in enumerate(_fly(agent, state, order, steps, **parameters), start=1):
        new, old = (annex_a.control_step(state, order, values, h, n, late) for late in (True, False))
        found = _state(pose)
        # Attitudes in between turn the forces of later inner steps: what that may change is allowed too.
        for name, what in (("velocity", "linear_velocity"), ("omega", "angular_velocity")):
            expected, other = getattr(new, name), getattr(old, name)
            allowed = EXACT * (1.0 + float(np.abs(expected).max())) + 1.5 * float(
                np.abs(expected - other).max()
            )
            close_to(f"{what} after step {step}", getattr(found, name), expected, allowed)
        allowed = EXACT + 1.5 * float(np.abs(new.position - old.position).max())
        close_to(f"position after step {step}", found.position, new.position, allowed)
        allowed = 1e-4 + 1.5 * _apart(new.quaternion, old.quaternion)
        _same_attitude(f"attitude after step {step}", found.quaternion, new.quaternion, allowed)
        state = found


def _state(pose: PoseBatch) -> Body:
    return Body(pose.position[0], pose.quaternion[0], pose.linear_velocity[0], pose.angular_velocity[0])


def _apart(one: Floats, other: Floats) -> float:
    """Angle between two attitudes (rad); either sign of a quaternion is the same attitude."""
    return 2.0 * float(min(np.linalg.norm(one - other), np.linalg.norm(one + other)))


def _same_attitude(what: str, found: Floats, expected: Floats, tolerance: float) -> None:
    apart = _apart(found, expected)
    if not apart <= tolerance:
        raise Failure(
            what, f"{expected.tolist()} within {tolerance:.3g} rad", f"{found.tolist()}, {apart:.3g} rad off"
        )


# --- frames ---


@server_rule(
    "free-fall", Level.CORE, "A", "a body without command falls: -g t, and -g t (t + h) / 2 within g t h"
)
def free_fall(rig: Rig) -> None:
    """The closed form of semi-implicit steps; another engine may lag or lead by less than one inner step."""
    agent = rig.open()
    h = agent.settings.physics_dt
    start = body((0.0, 0.0, 10.0), _TILTED, (1.0, 0.0, 2.0))
    for step, pose in enumerate(_fly(agent, start, _FORWARD, 8, gravity=_G), start=1):
        t = step * agent.settings.dt
        close_to(
            f"linear_velocity after {t:.1f} s", pose.linear_velocity[0], (1.0, 0.0, 2.0 - _G * t), EXACT * 10
        )
        fallen = (t, 0.0, 10.0 + 2.0 * t - _G * t * (t + h) / 2.0)
        close_to(f"position after {t:.1f} s", pose.position[0], fallen, 1.01 * _G * t * h + EXACT)


@server_rule(
    "gravity", Level.CORE, "1", "gravity acts along world -Z, whatever the attitude, and as the reset says"
)
def gravity(rig: Rig) -> None:
    """Downwards, upwards for a negative g, and not at all for zero."""
    agent = rig.open()
    for g in (3.0, -5.0, 0.0):
        (pose,) = _fly(agent, body(quaternion=_TILTED), _FORWARD, 1, gravity=g)
        close_to(
            f"linear_velocity after 0.1 s with g = {g}", pose.linear_velocity[0], (0, 0, -0.1 * g), EXACT
        )


@server_rule("inner-steps", Level.CORE, "6", "a step is exactly n inner steps, the force evaluated at each")
def inner_steps(rig: Rig) -> None:
    """With k_v h = 1/2 each inner step halves what is left to the commanded speed: 1/2^n after the step."""
    for n in (1, 4, 7):
        agent = rig.open(inner_steps=n)
        speed = min(1.0, speed_max(agent))
        (pose,) = _fly(
            agent, body(), replace(_FORWARD, speed=speed), 1, force_gain=0.5 / agent.settings.physics_dt
        )
        expected = speed * (1.0 - 0.5**n)
        close_to(f"speed after one step of {n} inner steps", pose.linear_velocity[0], (expected, 0, 0), EXACT)


@server_rule(
    "quaternion-order",
    Level.CORE,
    "1",
    "quaternions are x y z w and turn the body's forward axis into the world",
)
def quaternion_order(rig: Rig) -> None:
    """A force along the body's x axis: a quarter turn about z takes it to world y, and so on."""
    agent = rig.open()
    speed, half = min(1.0, speed_max(agent)), math.sqrt(0.5)
    for quaternion, forward in (
        ((0.0, 0.0, half, half), (0.0, 1.0, 0.0)),
        ((0.0, half, 0.0, half), (0.0, 0.0, -1.0)),
        ((0.5, 0.5, 0.5, 0.5), (0.0, 1.0, 0.0)),
        ((1.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
        (_TILTED, tuple(annex_a.rotation(np.array(_TILTED))[:, 0])),
    ):
        order = replace(_FORWARD, speed=speed)
        (pose,) = _fly(agent, body(quaternion=quaternion), order, 1, force_along_body=1.0, force_gain=5.0)
        velocity = pose.linear_velocity[0]
        direction = velocity / max(float(np.linalg.norm(velocity)), 1e-12)
        close_to(f"direction of flight with quaternion {quaternion}", direction, forward, 1e-4)


@server_rule(
    "spin", Level.CORE, "1", "a spinning body's quaternion turns by its angular velocity, in the world frame"
)
def spin(rig: Rig) -> None:
    """From a tilted attitude: after t the attitude is the turn by omega t, put before the first one."""
    agent = rig.open()
    for omega in ((0.6, -0.8, 1.2), (2.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, -2.0)):
        start = body(quaternion=_TILTED, omega=omega)
        for step, pose in enumerate(_fly(agent, start, _FORWARD, 4), start=1):
            close_to(
                f"angular_velocity of a free body, step {step}", pose.angular_velocity[0], omega, EXACT * 10
            )
            expected = annex_a.turned(start.quaternion, start.omega * 0.1 * step)
            _same_attitude(
                f"attitude after {0.1 * step:.1f} s of {omega} rad/s", pose.quaternion[0], expected, 2e-3
            )


@server_rule("angular-momentum", Level.CORE, "A", "a free body of unequal moments keeps its angular momentum")
def angular_momentum(rig: Rig) -> None:
    """Within 2 % over half a second in inner steps of 1 ms; without the gyroscopic torque it would turn away."""
    agent = rig.open(inner_steps=100)
    moments = {"inertia_x": 0.01, "inertia_y": 0.02, "inertia_z": 0.03}
    start = body(quaternion=_TILTED, omega=(1.0, 2.0, -1.5))
    momentum = annex_a.inertia(start.quaternion, moments) @ start.omega
    for step, pose in enumerate(_fly(agent, start, _FORWARD, 5, **moments), start=1):
        found = annex_a.inertia(pose.quaternion[0], moments) @ pose.angular_velocity[0]
        close_to(
            f"angular momentum after step {step}", found, momentum, 0.02 * float(np.linalg.norm(momentum))
        )


@server_rule("no-damping", Level.CORE, "A", "the engine adds no damping, and no body falls asleep")
def no_damping(rig: Rig) -> None:
    """A body that creeps and turns slowly does so for five seconds."""
    agent = rig.open(dt=0.5, inner_steps=20)
    start = body(velocity=(0.01, 0.0, 0.0), omega=(0.0, 0.02, 0.0))
    pose = _fly(agent, start, _FORWARD, 10)[-1]
    close_to("linear_velocity after 5 s", pose.linear_velocity[0], start.velocity, 1e-5)
    close_to("angular_velocity after 5 s", pose.angular_velocity[0], start.omega, 1e-5)
    close_to("position after 5 s", pose.position[0], (0.05, 0.0, 0.0), 1e-4)


@server_rule("quaternion-length", Level.CORE, "6", "quaternions in poses have length 1")
def quaternion_length(rig: Rig) -> None:
    """Within 1e-6 of squared length 1, so that the agent may send one back in a reset; also in a fast tumble."""
    agent = rig.open()
    start = body(quaternion=_TILTED, omega=(4.0, -3.0, 5.0))
    moments = {"inertia_x": 0.01, "inertia_y": 0.012, "inertia_z": 0.014}
    for step, pose in enumerate(_fly(agent, start, _FORWARD, 20, **moments), start=1):
        squared = float(pose.quaternion[0] @ pose.quaternion[0])
        demand(
            abs(squared - 1.0) <= 1e-6,
            f"squared length of the quaternion of step {step}",
            "1 within 1e-6",
            squared,
        )


# --- the law ---


@server_rule(
    "force-law", Level.CORE, "A", "force: m k_v (v_cmd d - V), drag, disturbance and compensation together"
)
def force_law(rig: Rig) -> None:
    """Against an evaluation of its own, along a direction like no other."""
    agent = rig.open()
    order = Order(np.array([0.48, -0.6, 0.64]), min(3.0, speed_max(agent)), 0.7)
    acting = {
        "disturbance_x": 0.7,
        "disturbance_y": -0.4,
        "disturbance_z": 0.2,
        "linear_drag": 0.5,
        "gravity": _G,
    }
    _obeys(agent, body(velocity=(1.0, 2.0, -3.0)), order, 4, force_gain=6.0, **acting)


@server_rule(
    "compensation",
    Level.CORE,
    "A",
    "c lifts by c times the weight: 1 hovers; it tilts neither force nor body",
)
def compensation(rig: Rig) -> None:
    """The acceleration is (c - 1) g upwards, and a body that points along d does not turn."""
    agent = rig.open()
    for c in (0.0, 1.0, 1.5, 2.0):
        order = replace(_FORWARD, compensation=c)
        pose = _fly(agent, body(), order, 2, gravity=_G, torque_kp=50.0, torque_kd=10.0)[-1]
        close_to(
            f"velocity after 0.2 s with c = {c}",
            pose.linear_velocity[0],
            (0, 0, 0.2 * (c - 1.0) * _G),
            EXACT * 2,
        )
        close_to(f"angular_velocity with c = {c}", pose.angular_velocity[0], (0.0, 0.0, 0.0), EXACT)


@server_rule("linear-drag", Level.CORE, "A", "linear_drag is a force -drag V")
def linear_drag(rig: Rig) -> None:
    """The speed falls by the factor (1 - drag h / m) an inner step."""
    agent = rig.open()
    (pose,) = _fly(agent, body(velocity=(2.0, -1.0, 0.5)), _FORWARD, 1, linear_drag=8.0)
    left = (1.0 - 8.0 * agent.settings.physics_dt / 2.0) ** 4
    close_to(
        "linear_velocity after a step", pose.linear_velocity[0], (2.0 * left, -left, 0.5 * left), EXACT * 2
    )


@server_rule("disturbance", Level.CORE, "A", "the disturbance is a constant force in the world frame")
def disturbance(rig: Rig) -> None:
    """F / m t, whatever the attitude; with another mass in the next episode, another velocity."""
    agent = rig.open()
    force = {"disturbance_x": 0.4, "disturbance_y": -0.8, "disturbance_z": 1.2}
    for mass in (2.0, 0.5):
        (pose,) = _fly(agent, body(quaternion=_TILTED), _FORWARD, 1, **{**force, "mass": mass})
        expected = [0.1 * value / mass for value in force.values()]
        close_to(f"linear_velocity after 0.1 s, mass {mass}", pose.linear_velocity[0], expected, EXACT)


@server_rule(
    "force-along-body",
    Level.CORE,
    "A",
    "with force_along_body = 1 the force follows the body's x axis, not d",
)
def force_along_body(rig: Rig) -> None:
    """The body turns towards d meanwhile, and the force with it."""
    agent = rig.open()
    order = Order(np.array([0.0, 0.6, 0.8]), min(2.0, speed_max(agent)), 1.0)
    law = {"force_along_body": 1.0, "force_gain": 6.0, "torque_kp": 60.0, "torque_kd": 12.0, "gravity": _G}
    _obeys(agent, body(quaternion=_TILTED), order, 4, **law)


@server_rule("torque-law", Level.CORE, "A", "torque: I (k_p (f x d) - k_d omega) turns the forward axis to d")
def torque_law(rig: Rig) -> None:
    """Against an evaluation of its own, with equal and with unequal moments; after a second f points along d."""
    agent = rig.open(inner_steps=20)
    order = Order(np.array([0.48, -0.6, 0.64]), 0.0, 0.0)
    start = body(quaternion=_TILTED, omega=(0.5, -1.0, 2.0))
    law = {"torque_kp": 100.0, "torque_kd": 20.0}
    _obeys(agent, start, order, 3, **law)
    unequal = {"inertia_x": 0.01, "inertia_y": 0.02, "inertia_z": 0.03}
    _obeys(agent, start, order, 3, **law, **unequal)
    pose = _fly(agent, start, order, 15, **law, **unequal)[-1]
    forward = annex_a.rotation(pose.quaternion[0])[:, 0]
    close_to("the forward axis after 1.5 s", forward, order.direction, 0.02)


@server_rule("torque-inertia", Level.CORE, "A", "the gains of the torque are per unit of inertia")
def torque_inertia(rig: Rig) -> None:
    """From rest one inner step gives omega = h k_p (f x d), whatever the moments."""
    agent = rig.open(dt=0.01, inner_steps=1)
    unequal = {"inertia_x": 0.01, "inertia_y": 0.05, "inertia_z": 0.2}
    order = Order(np.array([0.0, 0.6, 0.8]), 0.0, 0.0)
    (pose,) = _fly(agent, body(), order, 1, torque_kp=100.0, **unequal)
    close_to("angular_velocity after one inner step", pose.angular_velocity[0], (0.0, -0.8, 0.6), EXACT)


@server_rule(
    "angular-drag", Level.CORE, "A", "angular_drag is a torque -drag omega on the body's own moments"
)
def angular_drag(rig: Rig) -> None:
    """About each principal axis, which is turned away from the world's, the factor is (1 - drag h / I)."""
    agent = rig.open()
    moments = {"inertia_x": 0.01, "inertia_y": 0.02, "inertia_z": 0.05}
    for axis, moment in enumerate(moments.values()):
        omega = annex_a.rotation(np.array(_TILTED))[:, axis]
        start = body(quaternion=_TILTED, omega=tuple(omega))
        (pose,) = _fly(agent, start, _FORWARD, 1, angular_drag=0.04, **moments)
        expected = omega * (1.0 - 0.04 * agent.settings.physics_dt / moment) ** 4
        close_to(f"angular_velocity about body {'xyz'[axis]}", pose.angular_velocity[0], expected, 2e-3)


@server_rule(
    "gusts", Level.CORE, "A", "gusts are those of splitmix64, from the row's seed and the lane's step"
)
def gusts(rig: Rig) -> None:
    """A constant force over each control step; the seed is taken as unsigned."""
    agent = rig.open()
    for seed in (0, 12345, -1, 2**63 - 2):
        batch = _placed(agent, body(), gust=3.0)
        batch.seed[:] = seed
        done_or_skip(agent.reset(batch), "gusts")
        velocity = np.zeros(3)
        for step, pose in enumerate(fly(agent, commands(agent), 3), start=1):
            velocity = velocity + 0.1 * annex_a.gust(3.0, seed, step) / 2.0
            close_to(
                f"linear_velocity after step {step}, seed {seed}", pose.linear_velocity[0], velocity, EXACT
            )


@server_rule(
    "not-finite-state",
    Level.CORE,
    "6",
    "a state that is no longer finite is a farewell of kind 2, not a reply",
)
def not_finite_state(rig: Rig) -> None:
    """Gains that no inner step can bear: the server says so and leaves, or refuses such a reset (PLANT)."""
    agent = rig.open()
    batch = _placed(agent, body(velocity=(1.0, 0.0, 0.0)), force_gain=1e200)
    done_or_skip(agent.reset(batch), "a gain of 1e200")
    agent.put_commands(commands(agent, speed=speed_max(agent)))
    try:
        agent.ask(Op.STEP)
    except Failure:  # it left
        reason, text = agent.await_farewell()
    else:
        raise Failure("a step to a state that is not finite", "farewell 2", agent.poses().raw[0].tolist())
    demand(reason == Farewell.FAILED and bool(text), "farewell", "2 and a text", f"{reason}, {text!r}")
