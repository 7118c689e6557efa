"""`cosim replay`: two policies compared from the same instant of a recorded run."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from agent_client.flight import FlownBefore
from agent_client.task import Outcome
from cosim.errors import RunError
from cosim.integrity import check_data
from cosim.launch import Continuation, launch
from cosim.named_settings import NamedSettings
from cosim.options import FlightOptions, Place, TubeChoice
from cosim.runs import Run, payloads, read_run
from cosim.scene import where_is
from cosim.verify import find_tube
from meshes.scale import MeanRadius
from protocol.plant import TubeReference


def replay(
    folder: Path,
    *,
    policy: str,
    from_step: int,
    mesh: Path | None,
    server: str | None,
    out: Path | None,
    as_json: bool,
) -> None:
    """Fly a run again up to a step, let another policy fly on, and compare the two from there.

    Args:
        folder: of the run.
        policy: who flies on, as for `cosim launch --policy`.
        from_step: last control step of the run that is flown again.
        mesh: where its tube is now, None for where it was.
        server: command of the physics process, None for the run's own.
        out: folder of the new run, None for a new one.
        as_json: one JSON object on stdout and nothing else.

    Raises:
        RunError: the run cannot be read, is damaged, has no such step, or physics makes other poses of its commands.
        CosimError, MeshError, AgentError, ProtocolError: as `launch`.
    """
    run = read_run(folder)
    last = _last_step(run)
    if not from_step <= last:
        raise RunError(
            f"{folder}: --from-step: expected 0 to {last}, found {from_step}: it has {len(run.records) - 1} steps"
        )
    for finding in check_data(run):
        if finding.step is None or finding.step <= from_step:
            raise RunError(f"{folder} is not as it was recorded: {finding}")
    tube, changed = find_tube(run, mesh)
    if tube is None or changed:
        raise RunError(f"{folder}: {changed[0]}")
    dt = run.manifest["session"]["dt"]  # the policy that flew may have brought its own
    options = replace(
        options_of(run), policy=policy, lookahead=None, speed=None, dt=dt, realtime=None, out=out
    )
    if options.tube is None:
        options = _same_tube(options, run, tube)
    if options.connect is not None and server is None:
        raise RunError(
            f"{folder}: its physics process was started by hand (--connect {options.connect}); say with --server "
            "how one is started"
        )
    options = replace(options, server=server or options.server, connect=None, session=None)
    report = launch(options, as_json=as_json, after=beginning(run, from_step))
    if not as_json:
        click.echo(comparison(run, read_run(Path(report["run_dir"])), from_step))


def _last_step(run: Run) -> int:
    """The last step from which a flight can go on: of a flight that came to its end the last but one.

    Raises:
        RunError: there is no whole record.
    """
    if not len(run.records):
        raise RunError(f"{run.folder}: expected a run with at least its reset pose, found no whole record")
    over = int(run.records["outcome"][-1]) != Outcome.RUNNING
    return len(run.records) - 1 - over


def _same_tube(options: FlightOptions, run: Run, tube: TubeReference) -> FlightOptions:
    """Options that name the tube as it was resolved, along the centreline that was flown: nothing is found anew."""
    centreline = where_is(run, run.manifest["mesh"]["centreline"])
    if not centreline.is_file():  # it is the recorded one: `find_tube` compared it
        centreline = Path(tube.path).with_name(centreline.name)
    return replace(
        options,
        mesh=tube.path,
        centerline=centreline,
        axes=tube.axes,
        scale=tube.scale,
        entry=None,
        exit=None,
    )


def options_of(run: Run) -> FlightOptions:
    """The options that a run was launched with.

    Raises:
        RunError: the manifest does not hold them.
    """
    try:
        stored = dict(run.manifest["options"])
        settings = stored.pop("settings")
        tube = stored.pop("tube")
        known = {
            name: stored[name] for name in (field.name for field in fields(FlightOptions)) if name in stored
        }
        for name in ("centerline", "out"):
            known[name] = None if known[name] is None else Path(known[name])
        for name in ("allow_mismatch", "parameters"):
            known[name] = tuple(known[name])
        for name in ("entry", "exit"):
            known[name] = _place_of(known[name])
        if isinstance(known["scale"], dict):
            known["scale"] = MeanRadius(**known["scale"])
        named = NamedSettings(settings["hard"], _pairs(settings["conditions"]), _pairs(settings["tubes"]))
        return FlightOptions(**known, settings=named, tube=None if tube is None else TubeChoice(**tube))
    except (KeyError, TypeError) as error:
        raise RunError(f"{run.folder}: manifest: the options are damaged ({error})") from error


def beginning(run: Run, steps: int) -> Continuation:
    """The first control steps of a run, to be flown again."""
    flown = run.records[1 : steps + 1]
    commands, _ = payloads(flown)
    before = FlownBefore(commands[:, None], flown["action"][:, None].copy())
    return Continuation(run.folder, before, run.records["chain"][steps].tobytes().hex())


def comparison(first: Run, second: Run, from_step: int) -> str:
    """What came of the two flights after the step at which they part, side by side."""
    rows = [_after(run, from_step) for run in (first, second)]
    lines = [f"from step {from_step} on{'':<11}{'recorded':>22}{'flown on':>22}"]
    lines += [f"  {name:<26}{rows[0][name]:>22}{rows[1][name]:>22}" for name in rows[0]]
    return "\n".join(lines)


def _after(run: Run, from_step: int) -> dict[str, str]:
    records, reached = run.records[from_step + 1 :], run.records[-1]
    body_radius = run.manifest["parameters"]["body_radius"]
    inside = records["clearance"][records["inside"].astype(bool)]
    speeds = np.linalg.norm(records["linear_velocity"], axis=1)
    return {
        "policy": str(run.manifest["policy"]["name"])[:20],
        "outcome": "cut short"
        if reached["outcome"] == Outcome.RUNNING
        else Outcome(int(reached["outcome"])).name.lower(),
        "control steps": str(len(records)),
        "progress": f"{100.0 * float(reached['progress']):.1f} %",
        "smallest gap to the wall": f"{float(inside.min()) - body_radius:.3f} m" if len(inside) else "-",
        "mean speed": f"{float(speeds.mean()):.2f} m/s" if len(records) else "-",
        "mean alignment": f"{float(records['alignment'].mean()):.3f}" if len(records) else "-",
        "reward": f"{float(records['reward'].sum()):.1f}",
    }


def _place_of(stored: int | list[float] | None) -> Place | None:
    if stored is None or isinstance(stored, int):
        return stored
    x, y, z = stored
    return x, y, z


def _pairs(values: dict[str, Any]) -> dict[str, Any]:
    """JSON's lists as the tuples that they were."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
