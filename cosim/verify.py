"""`cosim verify`: whether a recorded run is whole, and what a fresh physics process makes of its commands."""

from __future__ import annotations

import hashlib
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import click
import numpy as np

from cosim.errors import RunError
from cosim.integrity import Finding, check_data
from cosim.live import counting
from cosim.recording import PAYLOAD, POSE_BYTES
from cosim.runs import Run, element_names, payloads, read_run
from cosim.scene import where_is
from cosim.sessions import ATTACH_TIMEOUT, TUBE, physics_session, rendezvous_of
from cosim.supervise import PhysicsProcess, physics_command
from cosim.versions import versions
from meshes.gltf import locate
from protocol.agent import AgentSession, SessionSettings
from protocol.layout import Axes
from protocol.plant import PARAMETERS, CommandBatch, ResetBatch, TubeReference

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


def verify(folder: Path, *, mesh: Path | None, server: str | None, as_json: bool) -> bool:
    """Check a run, print what was found, and return whether all of it is as it was recorded.

    Args:
        folder: of the run.
        mesh: where its tube is now, None for where it was.
        server: command of the physics process, None for the run's own.
        as_json: one JSON object on stdout and nothing else.

    Raises:
        RunError: the folder holds no readable run, or one that cannot be replayed.
        ProtocolError: the physics process or the protocol failed.
    """
    run = read_run(folder)
    if not len(run.records):
        raise RunError(f"{folder}: expected a run with at least its reset pose, found no whole record")
    damage = list(check_data(run))
    tube, changed = find_tube(run, mesh)
    changed += list(_check_policy(run))
    replay = None if tube is None else replay_physics(run, tube, server)
    drift = list(_check_versions(run))
    verified = not (damage or changed) and replay is not None and replay.first_difference is None
    if as_json:
        click.echo(json.dumps(_report(run, verified, damage, changed, drift, replay)))
    else:
        _print(run, verified, damage + changed, drift, replay)
    return verified


def find_tube(run: Run, mesh: Path | None) -> tuple[TubeReference | None, list[Finding]]:
    """The tube that a run was flown in, and what is wrong with its files; None where it is not the same any more.

    A file that the run keeps itself (a generated tube) is looked for in its folder first.
    """
    described = run.manifest["mesh"]
    path = mesh or where_is(run, described["path"])
    found = _file_hash(path)
    findings = []
    if found != described["sha256"]:
        findings.append(Finding(f"mesh {path}", f"SHA-256 {described['sha256'][:16]}…", found[:16] + "…"))
    centreline = where_is(run, described["centreline"]) if described.get("centreline") else None
    if centreline is not None and mesh is None:
        hashed = _file_hash(centreline)
        if hashed != described["centreline_sha256"]:
            expected = f"SHA-256 {described['centreline_sha256'][:16]}…"
            findings.append(Finding(f"centreline {centreline}", expected, hashed[:16] + "…"))
    same = found == described["sha256"]
    for name, sha256 in described.get("companions", {}).items():
        part = locate(path, name)
        hashed = _file_hash(part)
        if hashed != sha256:
            findings.append(Finding(f"mesh {part}", f"SHA-256 {sha256[:16]}…", hashed[:16] + "…"))
            same = False
    if not same:
        return None, findings
    reference = TubeReference(
        str(path.resolve()), Axes[described["axes"]].name, described["scale"], described["sha256"]
    )
    return reference, findings


def replay_physics(run: Run, tube: TubeReference, server: str | None) -> Replay:
    """Send the recorded commands to a fresh physics process and compare every pose, bit for bit.

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
        return _compare(session, run, reset_of(run))


def reset_of(run: Run) -> ResetBatch:
    """The reset that a run began with.

    Raises:
        RunError: the manifest does not say it.
    """
    resets, manifest = ResetBatch.zeros(1), run.manifest
    try:
        for name in ("position", "quaternion", "linear_velocity", "angular_velocity", "seed"):
            getattr(resets, name)[0] = manifest["reset"][name]
        resets.parameters[0, : len(PARAMETERS)] = [manifest["parameters"][p.name] for p in PARAMETERS]
    except KeyError as error:
        raise RunError(f"{run.folder}: manifest: expected {error} of the reset, found none") from error
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


def _check_policy(run: Run) -> Iterator[Finding]:
    policy = run.manifest["policy"]
    if "sha256" in policy:
        path = Path(policy["path"])
        found = _file_hash(path)
        if found != policy["sha256"]:
            yield Finding(f"policy {path}", f"SHA-256 {policy['sha256'][:16]}…", found[:16] + "…")


def _check_versions(run: Run) -> Iterator[Finding]:
    """Software that is not the recorded one: the poses tell whether it matters."""
    now = versions()
    for name, then in run.manifest["versions"].items():
        if now.get(name) != then:
            yield Finding(f"version of {name}", str(then), str(now.get(name)))


def _file_hash(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        return f"no readable file ({error.strerror})"


def _report(
    run: Run,
    verified: bool,
    damage: list[Finding],
    changed: list[Finding],
    drift: list[Finding],
    replay: Replay | None,
) -> dict[str, Any]:
    return {
        "verified": verified,
        "run_dir": str(run.folder),
        "status": run.manifest["status"],
        "records": len(run.records),
        "damage": [asdict(finding) for finding in damage],
        "changed_files": [asdict(finding) for finding in changed],
        "changed_versions": [asdict(finding) for finding in drift],
        "replay": None if replay is None else asdict(replay),
    }


def _print(
    run: Run, verified: bool, findings: list[Finding], drift: list[Finding], replay: Replay | None
) -> None:
    steps = len(run.records) - 1
    if verified:
        click.echo(f"{click.style('verified', fg='green', bold=True)}: {steps} control steps of {run.folder}")
    else:
        click.echo(f"{click.style('not verified', fg='red', bold=True)}: {run.folder}")
    if run.manifest["status"] != "completed":
        click.echo(f"  the run itself is {run.manifest['status']}: what stands of it was checked")
    for finding in findings[:MOST]:
        click.echo(f"  {finding}")
    if len(findings) > MOST:
        click.echo(f"  and {len(findings) - MOST} more (--json names them all)")
    for finding in drift:
        click.echo(f"  note: {finding}")
    if replay is None:
        click.echo("  not replayed: the mesh is another; name the one that was flown with --mesh")
    elif replay.first_difference is not None:
        click.echo(f"  physics differs first at {replay.first_difference}")
    else:
        click.echo(
            f"  a fresh physics process gave the same poses, bit for bit, in {replay.loop_s:.2f} s "
            f"(the run's physics: {replay.physics_s:.2f} s)"
        )
