"""The inference loop: the paper's Algorithm 1 for N lanes of one session."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from agent_client.actuation import CommandPath
from agent_client.controllers import CONTINUOUS, Controller
from agent_client.episodes import Records
from agent_client.settings import Settings
from agent_client.start import build_resets
from agent_client.task import OnContact, Outcome, TaskStep, TubeTask
from meshes.geometry import Geometry
from protocol.agent import AgentSession
from protocol.plant import NO_TUBE, CommandBatch

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

PHASES: Final = ("wait", "physics", "rays", "features", "policy")
"""Where the time of a step goes. wait: the exchange without the engine's own time; physics: that time; rays: LiDAR
and lines of sight; features: all other perception, judgement and reward; policy: the controller."""


@dataclass
class FlightStep:
    """One control step of all lanes, as `on_step` sees it: the same object and arrays at every call.

    `on_step` sees step k while physics already works on step k + 1, so that what it does costs no time of the
    loop as long as it takes less than physics does.
    """

    index: int
    """0: the reset; k: control step k."""
    command: Floats  # (N, 8)
    """Command block of step k (`protocol.plant.CommandBatch.raw`); zero at the reset."""
    pose: Floats  # (N, 16)
    """Pose block that answered it (`protocol.plant.PoseBatch.raw`)."""
    actions: Ints  # (N,)
    """Actions that made the command, or `agent_client.controllers.CONTINUOUS`."""
    task: TaskStep
    """What came of the pose: observation, reward, outcome, sensors."""
    phases: Ints  # (5,)
    """Time of the step by PHASES (ns); the policy's is that of the action that made the command."""


@dataclass(frozen=True)
class FlightResult:
    """How a flight of N lanes went."""

    outcome: tuple[Outcome, ...]  # (N,)
    """RUNNING where the flight was stopped by `on_step`."""
    steps: Ints  # (N,)
    """Control steps until the outcome."""
    progress: Floats  # (N,)
    """Progress along the tube at the outcome, 0 to 1."""
    quality: Floats  # (N,)
    """Quality index Q."""
    min_clearance: Floats  # (N,)
    """Smallest distance of the centre to the wall (m)."""
    contacts: Ints  # (N,)
    """Control steps with contact."""
    sim_time: Floats  # (N,)
    """Simulated time until the outcome (s)."""
    control_steps: int
    """Steps of the session: those of the longest lane."""
    wall_time: float
    """From the first command to the end (s), `on_step` included."""
    phases: Ints  # (5,)
    """Sums over the control steps, by PHASES (ns)."""


def fly(
    session: AgentSession,
    geometry: Geometry,
    controller: Controller,
    settings: Settings,
    *,
    seeds: Sequence[int],
    tube: int | Sequence[int] = NO_TUBE,
    parameters: Mapping[str, float] | None = None,
    drawn: Records | None = None,
    clearance_contact: bool = False,
    on_contact: OnContact = "end",
    step_limit: int | None = None,
    on_step: Callable[[FlightStep], bool | None] | None = None,
) -> FlightResult:
    """Fly every lane from its start until each episode is over.

    Lanes whose episode is over are commanded to stand still until the last one ends.

    Args:
        session: an open session of as many lanes as the geometry has.
        geometry: the tubes.
        controller: who flies.
        settings: constants of the task.
        seeds: (N,) one a lane, of its start and of the plant's disturbance.
        tube: index of the registered tube that physics resets the lanes into, one for all or one a lane.
        parameters: plant parameters by name that differ from the plant's defaults.
        drawn: (N,) conditions of the episodes (`agent_client.conditions.draw_conditions`), None for those of the
            settings and the parameters.
        clearance_contact: whether contact is known from the clearance rather than from physics.
        on_contact: "end" or "continue", see `TubeTask`.
        step_limit: control steps until a time-out, None for the limit of each tube.
        on_step: called after the reset and for each control step; returning True ends the flight after the
            step that is under way, which is the last that it sees.

    Raises:
        SettingsError: seeds or parameters do not fit.
        protocol.errors.ProtocolError: the session failed, or physics refused a reset or command.
    """
    task = TubeTask(
        geometry,
        settings,
        session.dt,
        clearance_contact=clearance_contact,
        on_contact=on_contact,
        step_limit=step_limit,
    )
    resets = build_resets(
        session.description, geometry, settings, seeds, tube=tube, parameters=parameters, drawn=drawn
    )
    commands = CommandBatch.zeros(geometry.lanes)
    actions: Ints = np.full(geometry.lanes, CONTINUOUS, dtype=np.int64)
    phases, totals = np.zeros((2, len(PHASES)), dtype=np.int64)
    poses = session.reset(resets)
    lanes = np.arange(geometry.lanes)
    state = task.begin(lanes, poses, drawn)
    task.measure_clearance()  # loads compiled code, too, before the first step and not in it
    step = FlightStep(0, np.zeros_like(commands.raw), poses.raw, actions.copy(), state, phases)
    stopped = False

    def report() -> None:
        nonlocal stopped
        task.measure_clearance()
        stopped = on_step is not None and bool(on_step(step))

    commands.compensation[:] = settings.drone.compensation
    path = CommandPath(geometry.lanes, session.description.speed_max)
    if drawn is not None:
        path.begin(lanes, drawn, state, commands)
    clock = time.perf_counter_ns
    started = clock()
    while not stopped and (over := np.count_nonzero(state.outcome)) < geometry.lanes:
        begun = clock()
        controller.act(state, commands, actions)
        if over:
            commands.speed[state.outcome != int(Outcome.RUNNING)] = 0.0
        sent = path.send(commands, state)
        decided = clock()
        poses = session.step(sent, report)
        answered = clock()
        task.observe(poses)
        seen = clock()
        physics = int(1e9 * session.engine_seconds)
        rays = task.ray_nanoseconds
        phases[:] = (answered - decided - physics, physics, rays, seen - answered - rays, decided - begun)
        totals += phases
        step.index += 1
        step.pose = poses.raw
        step.command[:] = sent.raw
        step.actions[:] = actions
    report()
    return FlightResult(
        outcome=tuple(Outcome(value) for value in state.outcome.tolist()),
        steps=state.step.copy(),
        progress=state.progress.copy(),
        quality=state.quality.copy(),
        min_clearance=state.min_clearance.copy(),
        contacts=state.contacts.copy(),
        sim_time=np.multiply(state.step, session.dt, dtype=np.float64),
        control_steps=step.index,
        wall_time=1e-9 * (clock() - started),
        phases=totals,
    )
