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
from protocol.plant import NO_TUBE, CommandBatch, ResetBatch

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
    entropy: Floats  # (N,)
    """Entropy of the distribution that they were chosen from (nat), NaN where there is none."""
    task: TaskStep
    """What came of the pose: observation, reward, outcome, sensors."""
    phases: Ints  # (5,)
    """Time of the step by PHASES (ns); the policy's is that of the action that made the command."""


@dataclass(frozen=True)
class FlownBefore:
    """The first K control steps of a flight that was flown before, which are sent again as they were."""

    commands: Floats  # (K, N, 8)
    """Command blocks as they crossed the protocol."""
    actions: Ints  # (K, N)


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
    before: FlownBefore | None = None,
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
        before: control steps to send again before the controller flies; it looks on meanwhile, so that it knows
            what it would know, and what it would have done is dropped.
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
    loop = _Loop(session, task, controller, before, on_step)
    loop.begin(resets, drawn)
    started = time.perf_counter_ns()
    while loop.goes_on():
        loop.advance()
    loop.report()
    return loop.result(time.perf_counter_ns() - started)


class _Loop:
    """The lanes of one flight, from control step to control step.

    Args:
        session: an open session.
        task: of the flight.
        controller: who flies.
        before: as for `fly`.
        on_step: as for `fly`.
    """

    def __init__(
        self,
        session: AgentSession,
        task: TubeTask,
        controller: Controller,
        before: FlownBefore | None,
        on_step: Callable[[FlightStep], bool | None] | None,
    ) -> None:
        self._session, self._task, self._controller, self._on_step = session, task, controller, on_step
        self._commands = CommandBatch.zeros(task.lanes)
        self._commands.compensation[:] = task.settings.drone.compensation
        self._path = CommandPath(task.lanes, session.description.speed_max)
        self._actions: Ints = np.full(task.lanes, CONTINUOUS, dtype=np.int64)
        self._totals: Ints = np.zeros(len(PHASES), dtype=np.int64)
        self._entropy: Floats | float = np.nan
        self._before, self._known = before, 0 if before is None else len(before.commands)
        self._stopped = False
        self._over = 0
        self._step: FlightStep

    def begin(self, resets: ResetBatch, drawn: Records | None) -> None:
        """Reset every lane and take the first look."""
        lanes = np.arange(self._task.lanes)
        poses = self._session.reset(resets)
        state = self._task.begin(lanes, poses, drawn)
        self._task.measure_clearance()  # loads compiled code, too, before the first step and not in it
        if drawn is not None:
            self._path.begin(lanes, drawn, state, self._commands)
        phases: Ints = np.zeros_like(self._totals)
        unknown = np.full(self._task.lanes, np.nan)
        command = np.zeros_like(self._commands.raw)
        self._step = FlightStep(0, command, poses.raw, self._actions.copy(), unknown, state, phases)

    def goes_on(self) -> bool:
        """Whether nobody stopped the flight and a lane still flies."""
        self._over = int(np.count_nonzero(self._step.task.outcome))
        return not self._stopped and self._over < self._task.lanes

    def advance(self) -> None:
        """Take a control step; the one before it is reported while physics works."""
        step, task, clock = self._step, self._task, time.perf_counter_ns
        begun = clock()
        self._controller.act(step.task, self._commands, self._actions)
        sent = self._path.send(self._commands, step.task)
        if self._over:  # whatever is still on its way to them, or blows there
            sent.speed[step.task.outcome != int(Outcome.RUNNING)] = 0.0
        self._entropy = self._controller.entropy
        if step.index < self._known:
            self._send_again(sent, step.index)
        decided = clock()
        poses = self._session.step(sent, self.report)
        answered = clock()
        task.observe(poses)
        seen = clock()
        physics, rays = int(1e9 * self._session.engine_seconds), task.ray_nanoseconds
        step.phases[:] = (
            answered - decided - physics,
            physics,
            rays,
            seen - answered - rays,
            decided - begun,
        )
        self._totals += step.phases
        step.index += 1
        step.pose = poses.raw
        step.command[:] = sent.raw
        step.actions[:] = self._actions
        step.entropy[:] = self._entropy

    def _send_again(self, sent: CommandBatch, index: int) -> None:
        """Put what was flown before in place of what the controller would do now."""
        assert self._before is not None
        sent.raw[:] = self._before.commands[index]
        self._actions[:] = self._before.actions[index]
        self._entropy = np.nan

    def report(self) -> None:
        """Show the last step to `on_step`."""
        self._task.measure_clearance()
        self._stopped = self._on_step is not None and bool(self._on_step(self._step))

    def result(self, wall_nanoseconds: int) -> FlightResult:
        """How the flight went, and that it took so long."""
        state = self._step.task
        return FlightResult(
            outcome=tuple(Outcome(value) for value in state.outcome.tolist()),
            steps=state.step.copy(),
            progress=state.progress.copy(),
            quality=state.quality.copy(),
            min_clearance=state.min_clearance.copy(),
            contacts=state.contacts.copy(),
            sim_time=np.multiply(state.step, self._session.dt, dtype=np.float64),
            control_steps=self._step.index,
            wall_time=1e-9 * wall_nanoseconds,
            phases=self._totals,
        )
