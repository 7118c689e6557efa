"""`cosim verify`: whether a recorded run is whole, and what a fresh physics process makes of its commands."""

from __future__ import annotations

import hashlib
import json
import struct
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import click
import numpy as np

from cosim.errors import RunError
from cosim.integrity import Finding, check_data
from cosim.live import counting
from cosim.recording import MANIFEST, PAYLOAD, POSE_BYTES
from cosim.runs import Run, element_names, payloads, read_run
from cosim.scene import where_is
from cosim.sessions import ATTACH_TIMEOUT, TUBE, physics_session, rendezvous_of
from cosim.supervise import PhysicsProcess, physics_command
from cosim.versions import versions
from meshes.gltf import locate
from protocol.agent import AgentSession, SessionSettings
from protocol.errors import ProtocolError
from protocol.layout import Axes
from protocol.plant import PARAMETERS, CommandBatch, PlantDescription, ResetBatch, TubeReference

POSE_FIELDS: Final = [name for name, *_ in PAYLOAD][4:]
"""Columns of a record that are words of the pose row."""
MOST: Final = 8
"""Findings that are printed for people."""
BAR_EVERY: Final = 500
"""Control steps between two updates of the bar."""


@dataclass(frozen=True)
class Replay:
    """What a fresh physics process made of the recorded commands."""

    steps: int
    """Control steps that were replayed."""
    first_difference: Finding | None
    loop_s: float
    """Time of the step loop, start-up and reading apart (s)."""
    physics_s: float
    """What physics took for the same steps when they were recorded (s)."""


@dataclass
class Examination:
    """What was found of a run."""

    damage: list[Finding]
    """Of its data: the manifest and the log."""
    changed: list[Finding] = field(default_factory=list)
    """Files that are not the recorded ones."""
    drift: list[Finding] = field(default_factory=list)
    """Software that is not the recorded one; the poses tell whether it matters."""
    replay: Replay | None = None
    not_replayed: str = ""
    """Why not."""

    @property
    def verified(self) -> bool:
        """Whether all is as it was recorded."""
        same = self.replay is not None and self.replay.first_difference is None
        return same and not (self.damage or self.changed)


def verify(
    folder: Path, *, mesh: Path | None, policy: Path | None, server: str | None, as_json: bool
) -> bool:
    """Check a run, print what was found, and return whether all of it is as it was recorded.

    Args:
        folder: of the run.
        mesh: where its tube is now, None for where it was.
        policy: where its checkpoint is now, None for where it was.
        server: command of the physics process, None for the run's own.
        as_json: one JSON object on stdout and nothing else.

    Raises:
        RunError: the folder holds no readable run, or one that cannot be replayed.
        ProtocolError: the physics process or the protocol failed.
    """
    run = read_run(folder)
    if not len(run.records):
        raise RunError(f"{folder}: expected a run with at least its reset pose, found no whole record")
    with counting("checking", len(run.records)) as done:
        found = Examination(list(check_data(run, done)))
    try:
        tube, found.changed = find_tube(run, mesh)
        found.changed += _check_policy(run, policy)
        found.drift += _check_versions(run)
        if tube is None:
            found.not_replayed = "the mesh is another; name the one that was flown with --mesh"
        else:
            found.replay, changed_plant = replay_physics(run, tube, server)
            found.drift += changed_plant
    except (
        RunError,
        ProtocolError,
        LookupError,
        TypeError,
        ValueError,
        AttributeError,
        struct.error,
    ) as error:
        if not any(finding.what == MANIFEST for finding in found.damage):
            raise
        found.not_replayed = f"the manifest, which was changed, does not tell how ({error})"
    if as_json:
        click.echo(json.dumps(_report(run, found)))
    else:
        _print(run, found)
    return found.verified


def find_tube(run: Run, mesh: Path | None) -> tuple[TubeReference | None, list[Finding]]:
    """The tube that a run was flown in, and what is wrong with its files; None where it is not the same any more.

    A file that the run keeps itself (a generated tube) is looked for in its folder first, a centreline that is
    gone beside `mesh`.
    """
    described = run.manifest["mesh"]
    path = mesh or where_is(run, described["path"])
    findings = list(_compare_file("mesh", path, described["sha256"]))
    for name, sha256 in described.get("companions", {}).items():
        findings += _compare_file("mesh", locate(path, name), sha256)
    same = not findings
    if described.get("centreline"):
        centreline = where_is(run, described["centreline"])
        if mesh is not None and not centreline.is_file():
            centreline = mesh.with_name(centreline.name)
        findings += _compare_file("centreline", centreline, described["centreline_sha256"])
    if not same:
        return None, findings
    reference = TubeReference(
        str(path.resolve()), Axes[described["axes"]].name, described["scale"], described["sha256"]
    )
    return reference, findings


def replay_physics(run: Run, tube: TubeReference, server: str | None) -> tuple[Replay, list[Finding]]:
    """Send the recorded commands to a fresh physics process and compare every pose, bit for bit.

    Returns:
        What it made of them, and how it describes itself in other words than the recorded one.

    Raises:
        RunError: the run does not say how its physics process is started.
        ProtocolError: the physics process or the protocol failed.
    """
    manifest = run.manifest
    options, described = manifest["options"], manifest["session"]
    server = server or options["server"]
    if server is None and options["connect"] is not None:
        raise RunError(
            f"{run.folder}: its physics process was started by hand (--connect {options['connect']}); "
            "say with --server how one is started"
        )
    settings = SessionSettings(1, described["dt"], described["physics_dt"])
    rendezvous = rendezvous_of(None, None, options["transport"])
    with (
        tempfile.TemporaryDirectory(prefix="cosim-verify-") as logs,
        PhysicsProcess(physics_command(server), rendezvous, Path(logs)) as process,
        physics_session(rendezvous, settings, process=process, attach_timeout=ATTACH_TIMEOUT) as session,
    ):
        session.register_tube(TUBE, tube)
        return _compare(session, run, reset_of(run)), list(_check_plant(run, session.description))


def reset_of(run: Run) -> ResetBatch:
    """The reset that a run began with.

    Raises:
        RunError: the manifest does not say it.
    """
    resets, manifest = ResetBatch.zeros(1), run.manifest
    for name in ("position", "quaternion", "linear_velocity", "angular_velocity", "seed"):
        getattr(resets, name)[0] = manifest["reset"][name]
    resets.parameters[0, : len(PARAMETERS)] = [manifest["parameters"][p.name] for p in PARAMETERS]
    resets.selected[0], resets.tube[0] = 1, TUBE
    return resets


def _compare(session: AgentSession, run: Run, resets: ResetBatch) -> Replay:
    count = len(run.records)
    sent, poses_then = payloads(run.records)
    recorded = poses_then.tobytes()
    physics_s = 1e-9 * float(run.records["phases"][:, 1].sum())
    batch = CommandBatch.zeros(1)
    row, commands = batch.raw[0], list(sent)
    poses = session.reset(resets)
    answer = poses.raw.data.cast("B")
    index, same = 0, answer == recorded[:POSE_BYTES]
    began = time.perf_counter()
    with counting("replaying", count - 1) as done:
        while same and index + 1 < count:
            index += 1
            row[:] = commands[index]
            session.step(batch)
            same = answer == recorded[index * POSE_BYTES : (index + 1) * POSE_BYTES]
            if not index % BAR_EVERY:
                done(BAR_EVERY)
    loop_s = time.perf_counter() - began
    return Replay(index, None if same else _difference(run, index, poses.raw[0]), loop_s, physics_s)


def _difference(run: Run, index: int, pose: Any) -> Finding:
    """Name the first word of a pose that differs from the recorded one."""
    record = run.records[index]
    at = 0
    for name in POSE_FIELDS:
        column = next(c for c in run.columns if c.name == name)
        recorded = np.atleast_1d(record[name])
        replayed = pose[at : at + recorded.size].view(recorded.dtype)
        at += recorded.size
        for element, (expected, found) in enumerate(zip(recorded, replayed, strict=True)):
            if expected.tobytes() != found.tobytes():
                return Finding(
                    element_names(column)[element], repr(expected.item()), repr(found.item()), index
                )
    raise AssertionError("poses of different bytes have a word that differs")


def _check_policy(run: Run, path: Path | None) -> Iterator[Finding]:
    policy = run.manifest["policy"]
    if "sha256" in policy:
        yield from _compare_file("policy", path or where_is(run, policy["path"]), policy["sha256"])


def _check_plant(run: Run, found: PlantDescription) -> Iterator[Finding]:
    """How the physics process describes itself, where that is not what was recorded."""
    for name in ("name", "version", "engine", "speed_max", "walls"):
        expected, now = run.manifest["plant"][name], getattr(found, name)
        if expected != now:
            yield Finding(f"{name} of physics", str(expected), str(now))


def _check_versions(run: Run) -> Iterator[Finding]:
    """Software that is not the recorded one: the poses tell whether it matters."""
    now = versions()
    for name, then in run.manifest["versions"].items():
        if now.get(name) != then:
            yield Finding(f"version of {name}", str(then), str(now.get(name)))


def _compare_file(what: str, path: Path, sha256: str) -> Iterator[Finding]:
    expected = f"SHA-256 {sha256[:16]}…"
    try:
        found = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        where = "its folder, or beside --mesh" if what == "centreline" else f"--{what}"
        why = f"no readable file ({error.strerror}); if it was moved, say where it is: {where}"
        yield Finding(f"{what} {path}", expected, why)
        return
    if found != sha256:
        yield Finding(f"{what} {path}", expected, f"{found[:16]}…")


def _report(run: Run, found: Examination) -> dict[str, Any]:
    return {
        "verified": found.verified,
        "run_dir": str(run.folder),
        "status": run.manifest.get("status"),
        "records": len(run.records),
        "damage": [asdict(finding) for finding in found.damage],
        "changed_files": [asdict(finding) for finding in found.changed],
        "changed_versions": [asdict(finding) for finding in found.drift],
        "replay": None if found.replay is None else asdict(found.replay),
        "not_replayed": found.not_replayed or None,
    }


def _print(run: Run, found: Examination) -> None:
    """What was found, for people."""
    steps = len(run.records) - 1
    if found.verified:
        click.echo(f"{click.style('verified', fg='green', bold=True)}: {steps} control steps of {run.folder}")
    else:
        click.echo(f"{click.style('not verified', fg='red', bold=True)}: {run.folder}")
    if (status := run.manifest.get("status")) != "completed":
        click.echo(f"  the run itself is {status}: what stands of it was checked")
    findings = found.damage + found.changed
    for finding in findings[:MOST]:
        click.echo(f"  {finding}")
    if len(findings) > MOST:
        click.echo(f"  and {len(findings) - MOST} more (--json names them all)")
    for finding in found.drift:
        click.echo(f"  note: {finding}")
    replay = found.replay
    if replay is None:
        click.echo(f"  not replayed: {found.not_replayed}")
    elif replay.first_difference is not None:
        click.echo(f"  physics differs first at {replay.first_difference}")
    else:
        click.echo(
            f"  a fresh physics process gave the same poses, bit for bit, in {replay.loop_s:.2f} s "
            f"(the run's physics: {replay.physics_s:.2f} s)"
        )
