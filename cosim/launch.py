"""`cosim launch`: one flight, from the user's options to a run folder and a summary."""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import click

from agent_client.conditions import NAMES
from agent_client.episodes import Records, episode_dtype
from agent_client.flight import FlightResult, FlightStep, FlownBefore, fly
from agent_client.settings import max_steps
from agent_client.start import build_resets
from agent_client.task import Outcome
from cosim import __version__, interrupts
from cosim.conduits import Conduit, find_mesh, generate_conduit, read_conduit
from cosim.errors import RunError, Terminated
from cosim.folders import check_folder, new_folder
from cosim.inputs import (
    FlightConditions,
    check_options,
    draw_flight_conditions,
    parse_parameters,
    setting_notes,
)
from cosim.live import LiveLine, working
from cosim.live_view import LiveView, ViewChoice
from cosim.options import SHIPPED_MESH, SHIPPED_POLICY, FlightOptions
from cosim.pilots import SHIPPED_CHECKPOINT, Pilot, PilotChoice, Terms, choose_pilot, read_pilot
from cosim.recording import MANIFEST, Recorder
from cosim.sessions import TUBE, attached_session, offered_session, rendezvous_of
from cosim.supervise import PhysicsProcess, physics_command
from cosim.versions import versions
from meshes.tube import INDUSTRIAL
from protocol.agent import AgentSession, SessionSettings
from protocol.plant import PARAMETERS, ResetBatch


@dataclass(frozen=True)
class Flight:
    """All that one flight is made of."""

    options: FlightOptions
    conduit: Conduit
    pilot: Pilot
    conditions: FlightConditions
    session: AgentSession
    rendezvous: str
    folder: Path


@dataclass(frozen=True)
class Continuation:
    """The beginning of a recorded run, from which another flight goes on."""

    run: Path
    before: FlownBefore
    trajectory_hash: str
    """Of the run up to and with the last of these steps, which must be reached again."""

    def check(self, step: int, trajectory_hash: str) -> None:
        """Compare the hash once the last of the steps is flown again.

        Raises:
            RunError: physics made other poses of the same commands.
        """
        if step == len(self.before.commands) and trajectory_hash != self.trajectory_hash:
            raise RunError(
                f"{self.run}: expected trajectory {self.trajectory_hash[:16]}… at step {step}, found "
                f"{trajectory_hash[:16]}…: physics did not make the same poses of the same commands; "
                f"`cosim verify {self.run}` names the first that differs"
            )


def launch(
    options: FlightOptions,
    *,
    as_json: bool = False,
    after: Continuation | None = None,
    view: ViewChoice | None = None,
) -> dict[str, Any]:
    """Fly once, say what happened, and return the report; --json prints it with what is said of the mesh.

    The physics process starts up while the tube is read; bad input ends it and leaves nothing behind. With
    `as_json` stdout holds one JSON object and everything else goes to stderr. With `after` the
    flight goes on from a recorded one. With `view` a window shows it live, at wall-clock pace unless told otherwise.

    Raises:
        CosimError, MeshError, AgentError, SessionError: bad input.
        ProtocolError: the physics process or the protocol failed.
    """

    def say(text: str) -> None:
        click.echo(text, err=as_json)

    if view is not None and options.realtime is None:
        options = replace(options, realtime=1.0)
    check_folder(options.out)
    check_options(options)
    command = None if options.connect is not None else physics_command(options.server)
    rendezvous = rendezvous_of(options.connect, options.session, options.transport)
    ranges, recipe = options.settings.resolve()
    conditions = draw_flight_conditions(options, ranges, parse_parameters(options.parameters))
    mesh, choice = find_mesh(options), choose_pilot(options.policy, options.lookahead, options.speed)
    for note in (*_chosen_for_the_user(mesh, choice), *setting_notes(options, ranges, recipe)):
        say(note)
    with ExitStack() as stack:
        folder = stack.enter_context(new_folder(options.out, _label(options, mesh, choice)))
        window = stack.enter_context(LiveView(view, say))
        pilot = read_pilot(choice, Terms(options.dt, options.allow_mismatch, conditions.drone))
        # On offer before the physics process starts: a second launch of the same name never starts one, which
        # might serve this session.
        offer = stack.enter_context(
            offered_session(rendezvous, SessionSettings(1, pilot.dt, options.physics_dt))
        )
        process = None
        if command is None:
            say(f"waiting for a physics peer at {rendezvous} (at most {options.attach_timeout:g} s)")
        else:
            process = stack.enter_context(PhysicsProcess(command, rendezvous, folder))
        with working("reading the tube" if mesh is not None else "making the tube"):
            if mesh is None:
                conduit = generate_conduit(options, recipe, folder)
            else:
                conduit = read_conduit(options, mesh, folder, float(conditions.drawn["body_radius"][0]))
        stack.callback(_forget_unflown, folder, conduit.written)
        for note in (*conduit.notes, *pilot.notes, *conditions.notes):
            say(note)
        session = stack.enter_context(
            attached_session(offer, process=process, attach_timeout=options.attach_timeout)
        )
        if process is not None:
            say(f"session: {rendezvous} (cosim watch shows its live state)")
        interrupts.check()
        plant = session.description
        say(f"physics: {plant.name} {plant.version}, engine {plant.engine}")
        if not plant.walls:
            say(
                "the physics side has no walls: contact is judged from the clearance, and nothing stops the drone"
            )
        seen = float(conditions.drawn["field_of_view"][0])
        window.start(rendezvous, conduit.description["mesh"], options.start_end, pilot.settings, seen)
        report = _fly_recorded(
            Flight(options, conduit, pilot, conditions, session, rendezvous, folder), after
        )
    if as_json:
        click.echo(json.dumps(report | {"mesh": conduit.description["mesh"]}))
    else:
        _summarise(report, pilot, conduit, say)
    return report


def _chosen_for_the_user(mesh: Path | None, choice: PilotChoice) -> Iterator[str]:
    """Which of the shipped files are flown."""
    if mesh == INDUSTRIAL:
        yield f"mesh: {SHIPPED_MESH} is the shipped one"
    if choice.path == SHIPPED_CHECKPOINT:
        yield f"policy: {SHIPPED_POLICY} is the shipped one"


def _label(options: FlightOptions, mesh: Path | None, choice: PilotChoice) -> str:
    """Names of tube and pilot for a folder."""
    tube = options.tube
    flown = mesh.stem[:60] if mesh is not None else f"level{tube.level}-{tube.seed}" if tube else ""
    return f"{flown}-{choice.label[:60]}-seed{options.start_seed}"


def _forget_unflown(folder: Path, written: tuple[Path, ...]) -> None:
    """Remove the files of a tube where no flight began."""
    if not (folder / MANIFEST).exists():
        for path in written:
            path.unlink(missing_ok=True)


def _fly_recorded(flight: Flight, after: Continuation | None) -> dict[str, Any]:
    """Fly with a recording that is closed whatever happens, and return the report."""
    options, pilot, session, folder = flight.options, flight.pilot, flight.session, flight.folder
    names = [parameter.name for parameter in PARAMETERS]
    defaults = dict(zip(names, session.description.defaults, strict=True))
    geometry, parameters = flight.conduit.geometry, flight.conditions.parameters
    drawn = flight.conditions.over(defaults)
    # Refuses a tube without room for the drone before anything is recorded.
    resets = build_resets(
        session.description,
        geometry,
        pilot.settings,
        [options.start_seed],
        parameters=parameters,
        drawn=drawn,
    )
    chosen = dict(zip(names, resets.parameters[0, : len(names)].tolist(), strict=True))
    manifest = _manifest(flight, drawn, defaults, chosen) | {"reset": _reset_described(resets)}
    manifest["continues"] = None if after is None else _continuation_described(after)
    recorder = Recorder(folder, manifest, episode_dtype(pilot.settings.lidar.rays))
    status, report = "failed", dict[str, Any]()
    try:
        with LiveLine() as live:
            session.register_tube(TUBE, flight.conduit.reference)
            observer = _Observer(recorder, live, options.realtime, pilot, after)
            result = fly(
                session,
                geometry,
                pilot.make_controller(geometry),
                pilot.settings,
                seeds=[options.start_seed],
                tube=TUBE,
                parameters=parameters,
                drawn=drawn,
                clearance_contact=not session.description.walls,
                on_contact="end" if options.on_contact == "end" else "continue",
                step_limit=options.max_steps,
                before=None if after is None else after.before,
                on_step=observer,
            )
        status, report = "completed", _report(result, recorder, pilot, observer)
    except (KeyboardInterrupt, Terminated):
        status = "interrupted"
        click.echo(f"interrupted after {recorder.records} records, which are saved in {folder}", err=True)
        raise
    except Exception as error:
        if recorder.records:
            error.add_note(f"{recorder.records} records are saved in {folder}")
        raise
    finally:
        recorder.close(status, report)
    return report


class _Observer:
    """Sees every step of the flight: records it, draws the live line, keeps the pace."""

    def __init__(
        self,
        recorder: Recorder,
        live: LiveLine,
        realtime: float | None,
        pilot: Pilot,
        after: Continuation | None,
    ) -> None:
        self._recorder, self._live, self._realtime, self._after = recorder, live, realtime, after
        self._body_radius = pilot.settings.drone.body_radius
        self._dt = pilot.dt
        self.started = 0.0
        self.startup_s: float | None = None
        """From the start of this process to the first control step."""

    def __call__(self, step: FlightStep) -> None:
        interrupts.check()
        self._recorder.write(step)
        if self._after is not None:
            self._after.check(step.index, self._recorder.trajectory_hash)
        if step.index == 0:
            self.started = time.monotonic()
            self.startup_s = process_age()
        task = step.task
        self._live.update(step.index, float(task.progress[0]), float(task.clearance[0]) - self._body_radius)
        if self._realtime is not None:
            due = self.started + step.index * self._dt / self._realtime
            if (ahead := due - time.monotonic()) > 0.0:
                time.sleep(ahead)


def process_age() -> float | None:
    """Seconds since this process was started, to 0.01 s; None where /proc does not tell."""
    try:
        after_boot = int(Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()[19])
        uptime = float(Path("/proc/uptime").read_text().split()[0])
    except OSError:
        return None
    return round(uptime - after_boot / os.sysconf("SC_CLK_TCK"), 2)


def _word(outcome: Outcome) -> str:
    return outcome.name.lower()


def _report(result: FlightResult, recorder: Recorder, pilot: Pilot, observer: _Observer) -> dict[str, Any]:
    steps = int(result.steps[0])
    return {
        "outcome": _word(result.outcome[0]),
        "steps": steps,
        "sim_time_s": float(result.sim_time[0]),
        "wall_time_s": result.wall_time,
        "steps_per_second": steps / result.wall_time,
        "progress": float(result.progress[0]),
        "quality": float(result.quality[0]),
        "min_clearance_m": float(result.min_clearance[0]) - pilot.settings.drone.body_radius,
        "contacts": int(result.contacts[0]),
        "trajectory_hash": recorder.trajectory_hash,
        "run_dir": str(recorder.folder),
        "startup_s": observer.startup_s,
    }


def _summarise(report: dict[str, Any], pilot: Pilot, conduit: Conduit, say: Callable[[str], None]) -> None:
    """A short summary for people."""
    outcome = click.style(
        report["outcome"], fg="green" if report["outcome"] == "success" else "red", bold=True
    )
    say(
        f"{outcome} after {report['steps']} control steps, {report['sim_time_s']:.1f} s simulated in "
        f"{report['wall_time_s']:.2f} s ({report['steps_per_second']:.0f} steps/s)"
    )
    say(
        f"  flown by {pilot.description['name']} ({pilot.description['sees']}), "
        f"{100.0 * report['progress']:.1f} % of {conduit.length:.1f} m, quality Q {report['quality']:.3f}"
    )
    say(
        f"  smallest gap between body and wall {report['min_clearance_m']:.3f} m, "
        f"{report['contacts']} steps with contact"
    )
    say(f"  trajectory {report['trajectory_hash'][:16]}…, recorded in {report['run_dir']}")


def _reset_described(resets: ResetBatch) -> dict[str, Any]:
    """What a lane was reset to, beside the parameters: whoever flies it again asks for the same bits."""
    state = ("position", "quaternion", "linear_velocity", "angular_velocity")
    return {name: getattr(resets, name)[0].tolist() for name in state} | {"seed": int(resets.seed[0])}


def _continuation_described(after: Continuation) -> dict[str, Any]:
    return {
        "run": str(after.run.resolve()),
        "from_step": len(after.before.commands),
        "trajectory_hash": after.trajectory_hash,
    }


def _manifest(
    flight: Flight, drawn: Records, defaults: dict[str, float], chosen: dict[str, float]
) -> dict[str, Any]:
    """What is known before the first step: enough to fly the same again.

    Args:
        flight: what is flown.
        drawn: (1,) conditions of the flight.
        defaults: the plant's own parameters.
        chosen: the parameters that are flown with.
    """
    options, pilot, session = flight.options, flight.pilot, flight.session
    conditions, length = flight.conditions, flight.conduit.length
    return {
        "cosim": __version__,
        "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "options": {name: str(v) if isinstance(v, Path) else v for name, v in asdict(options).items()}
        | {"seed": options.start_seed},
        **flight.conduit.description,
        "policy": pilot.description,
        "settings": asdict(pilot.settings),
        "conditions": {
            "chosen": conditions.chosen,
            "drawn": {name: float(drawn[name][0]) for name in NAMES},
            "noise_seed": int(drawn["seed"][0]),
        },
        "session": {
            "rendezvous": flight.rendezvous,
            "dt": session.dt,
            "physics_dt": session.physics_dt,
            "inner_steps": session.inner_steps,
            "step_limit": options.max_steps or max_steps(pilot.settings, length, session.dt),
        },
        "plant": asdict(session.description) | {"defaults": defaults},
        "parameters": chosen,
        "physics_pid": session.peer_pid,
        "versions": versions(),
        "platform": platform.platform(),
    }
