"""`cosim launch`: one flight, from the user's options to a run folder and a summary."""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any, Final

import click

from agent_client.episodes import episode_dtype
from agent_client.flight import FlightResult, FlightStep, fly
from agent_client.settings import max_steps
from agent_client.start import build_resets
from agent_client.task import Outcome
from cosim import __version__
from cosim.errors import CosimError, Terminated
from cosim.folders import check_folder, new_folder
from cosim.inputs import Pilot, name_inputs, parse_parameters, read_pilot, read_tube_input
from cosim.live import LiveLine
from cosim.options import FlightOptions
from cosim.recording import Recorder
from cosim.sessions import physics_session, rendezvous_of
from cosim.supervise import PhysicsProcess, physics_command
from meshes.mesh_geometry import MeshGeometry
from meshes.tube import Tube
from protocol.agent import AgentSession, SessionSettings
from protocol.plant import PARAMETERS, TubeReference

TUBE: Final = 0
"""Index under which the flight's tube is registered."""

PACKAGES: Final = ("numpy", "numba", "pybullet", "embreex")
"""Whose versions are recorded: a run may differ where they do."""


def launch(options: FlightOptions, *, as_json: bool = False) -> bool:
    """Fly once, say what happened, and return whether the outcome is success.

    The physics process starts up while the tube is read; bad input ends it and leaves nothing behind. With
    `as_json` stdout holds one JSON object and everything else goes to stderr.

    Raises:
        CosimError, MeshError, AgentError, SessionError: bad input.
        ProtocolError: the physics process or the protocol failed.
    """

    def say(text: str) -> None:
        click.echo(text, err=as_json)

    check_folder(options.out)
    if options.connect is not None and (options.server or options.session):
        raise CosimError(
            "--connect: a peer that you start has its own command and name; drop --server or --session"
        )
    command = None if options.connect is not None else physics_command(options.server)
    parameters = parse_parameters(options.parameters)
    rendezvous = rendezvous_of(options.connect, options.session, options.transport)
    named = name_inputs(options)
    for note in named.notes:
        say(note)
    with ExitStack() as stack:
        folder = stack.enter_context(new_folder(options.out, f"{named.label}-seed{options.seed}"))
        process = None
        if command is None:
            say(f"waiting for a physics peer at {rendezvous} (at most {options.attach_timeout:g} s)")
        else:
            process = stack.enter_context(PhysicsProcess(command, rendezvous, folder))
        tube = read_tube_input(options, named)
        geometry = MeshGeometry([tube])
        pilot = read_pilot(options, named, geometry, parameters)
        for note in pilot.notes:
            say(note)
        settings = SessionSettings(1, pilot.dt, options.physics_dt)
        session = stack.enter_context(
            physics_session(rendezvous, settings, process=process, attach_timeout=options.attach_timeout)
        )
        plant = session.description
        say(f"physics: {plant.name} {plant.version}, engine {plant.engine}")
        manifest = _manifest(options, tube, pilot, session, parameters, rendezvous)
        report = _fly_recorded(options, tube, geometry, pilot, session, parameters, folder, manifest)
    if as_json:
        click.echo(json.dumps(report))
    else:
        _summarise(report, pilot, tube, say)
    return bool(report["outcome"] == _word(Outcome.SUCCESS))


def _fly_recorded(
    options: FlightOptions,
    tube: Tube,
    geometry: MeshGeometry,
    pilot: Pilot,
    session: AgentSession,
    parameters: dict[str, float],
    folder: Path,
    manifest: dict[str, Any],
) -> dict[str, Any]:
    """Fly with a recording that is closed whatever happens, and return the report."""
    # Refuses a tube without room for the drone before anything is recorded.
    build_resets(session.description, geometry, pilot.settings, [options.seed], parameters=parameters)
    recorder = Recorder(folder, manifest, episode_dtype(pilot.settings.lidar.rays))
    status, report = "failed", dict[str, Any]()
    try:
        with LiveLine() as live:
            session.register_tube(TUBE, _reference(tube))
            observer = _Observer(recorder, live, options.realtime, pilot)
            result = fly(
                session,
                geometry,
                pilot.controller,
                pilot.settings,
                seeds=[options.seed],
                tube=TUBE,
                parameters=parameters,
                on_contact="end" if options.on_contact == "end" else "continue",
                step_limit=options.max_steps,
                on_step=observer,
            )
        status, report = "completed", _report(result, recorder, pilot, observer)
    except (KeyboardInterrupt, Terminated):
        status = "interrupted"
        click.echo(f"interrupted after {recorder.records} records, which are saved in {folder}", err=True)
        raise
    finally:
        recorder.close(status, report)
    return report


class _Observer:
    """Sees every step of the flight: records it, draws the live line, keeps the pace."""

    def __init__(self, recorder: Recorder, live: LiveLine, realtime: float | None, pilot: Pilot) -> None:
        self._recorder, self._live, self._realtime = recorder, live, realtime
        self._body_radius = pilot.settings.drone.body_radius
        self._dt = pilot.dt
        self.started = 0.0
        self.startup_s: float | None = None
        """From the start of this process to the first control step."""

    def __call__(self, step: FlightStep) -> None:
        self._recorder.write(step)
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


def _summarise(report: dict[str, Any], pilot: Pilot, tube: Tube, say: Callable[[str], None]) -> None:
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
        f"{100.0 * report['progress']:.1f} % of {tube.length:.1f} m, quality Q {report['quality']:.3f}"
    )
    say(
        f"  smallest gap between body and wall {report['min_clearance_m']:.3f} m, "
        f"{report['contacts']} steps with contact"
    )
    say(f"  trajectory {report['trajectory_hash'][:16]}…, recorded in {report['run_dir']}")


def _reference(tube: Tube) -> TubeReference:
    return TubeReference(str(tube.path.resolve()), tube.axes, tube.scale, tube.sha256)


def _manifest(
    options: FlightOptions,
    tube: Tube,
    pilot: Pilot,
    session: AgentSession,
    parameters: dict[str, float],
    rendezvous: str,
) -> dict[str, Any]:
    """What is known before the first step: enough to fly the same again."""
    names = [parameter.name for parameter in PARAMETERS]
    defaults = dict(zip(names, session.description.defaults, strict=True))
    chosen = defaults | {"body_radius": pilot.settings.drone.body_radius} | parameters
    return {
        "cosim": __version__,
        "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "options": {
            name: str(value) if isinstance(value, Path) else value for name, value in asdict(options).items()
        },
        "mesh": {
            "path": str(tube.path),
            "sha256": tube.sha256,
            "axes": tube.axes,
            "scale": tube.scale,
            "centreline": str(tube.centreline_path),
            "centreline_sha256": tube.centreline_sha256,
            "length_m": tube.length,
        },
        "policy": pilot.description,
        "settings": asdict(pilot.settings),
        "session": {
            "rendezvous": rendezvous,
            "dt": session.dt,
            "physics_dt": session.physics_dt,
            "inner_steps": session.inner_steps,
            "step_limit": options.max_steps or max_steps(pilot.settings, tube.length, session.dt),
        },
        "plant": asdict(session.description) | {"defaults": defaults},
        "parameters": chosen,
        "physics_pid": session.peer_pid,
        "versions": {name: metadata.version(name) for name in PACKAGES}
        | {"python": platform.python_version()},
        "platform": platform.platform(),
    }
