"""`cosim doctor`: what this machine has, what it lacks, what dead sessions left on it, and what to do about each."""

from __future__ import annotations

import json
import os
import platform
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from enum import Enum
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Final

import click

from cosim.requirements import Requirement, install_command, is_checkout, read_requirements
from protocol.compiled_choice import AUTO, COMPILED, ENVIRONMENT, STDLIB
from protocol.errors import SessionError
from protocol.layout import command_bytes, pose_bytes
from protocol.leftovers import Found, Standing, remove, survey
from protocol.memory import SHM_FOLDER

PYTHON: Final = (3, 11)
CONTAINER_SHM: Final = 64 * 2**20
"""Bytes of /dev/shm that a container gets where nobody says otherwise."""
LANES: Final = (1, 256)
"""Sizes of sessions that shared memory should have room for."""
CLOCK_NS: Final = 1000
"""Coarsest clock with which single steps can be timed."""
SCRATCH: Final = re.compile(
    r"(cosim-(physics|bench|verify|ablate|wall|train|evaluate)|conformance)-[a-z0-9_]{8}"
)
"""Names of our temporary folders, as `tempfile` completes them."""
OLD_S: Final = 86_400.0
"""Age from which on a temporary folder that nobody has open is taken for a leftover."""


class Level(Enum):
    """How a check came out."""

    OK = "ok"
    WARN = "warn"
    """Something optional is missing, or not as good as it could be."""
    FAIL = "fail"
    """cosim does not work like this."""


@dataclass(frozen=True)
class Check:
    """One thing that was looked at."""

    name: str
    level: Level
    found: str
    advice: str = ""
    """What to do; empty where nothing is."""


def doctor(*, clean: bool, as_json: bool) -> bool:
    """Look at everything, print it, and return whether nothing failed.

    Args:
        clean: remove the segments of dead sessions and our forgotten temporary folders.
        as_json: one JSON object on stdout and nothing else.
    """
    checks = list(look(clean))
    sound = all(check.level is not Level.FAIL for check in checks)
    if as_json:
        rows = [asdict(check) | {"level": check.level.value} for check in checks]
        click.echo(json.dumps({"ok": sound, "checks": rows}))
    else:
        for line in report(checks):
            click.echo(line)
    return sound


def look(clean: bool) -> Iterator[Check]:
    """Make every check; with `clean` those of leftovers remove what is proved dead."""
    yield check_python()
    yield from check_packages(read_requirements(with_dev=is_checkout()))
    yield check_shared_memory()
    yield check_segments(clean)
    yield check_scratch(Path(tempfile.gettempdir()), clean)
    yield check_cores()
    yield check_clock()
    yield check_fence()
    yield check_exchange()
    yield from check_programs()


def report(checks: list[Check]) -> Iterator[str]:
    """The checks as lines for people: one each, and what to do under those that are not in order."""
    colours = {Level.OK: "green", Level.WARN: "yellow", Level.FAIL: "red"}
    for check in checks:
        yield f"{click.style(f'{check.level.value:<5}', fg=colours[check.level])}{check.name:<15}{check.found}"
        if check.advice:
            yield f"{'':<20}-> {check.advice}"
    counts = {level: sum(check.level is level for check in checks) for level in Level}
    yield f"{counts[Level.OK]} in order, {counts[Level.WARN]} to look at, {counts[Level.FAIL]} failed"


def check_python() -> Check:
    """The interpreter's version."""
    needed = ".".join(map(str, PYTHON))
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    if sys.version_info < PYTHON:
        return Check("python", Level.FAIL, found, f"install Python {needed} or later")
    return Check("python", Level.OK, found)


def check_packages(requirements: dict[str, tuple[Requirement, ...]]) -> Iterator[Check]:
    """The libraries that are needed, then those of each extra.

    Args:
        requirements: by extra; those that are always needed have the name "".
    """
    for extra, needed in requirements.items():
        wrong = [requirement.complaint for requirement in needed if requirement.complaint]
        found = ", ".join(wrong or [f"{requirement.name} {requirement.installed}" for requirement in needed])
        name = f"[{extra}]" if extra else "packages"
        if not wrong:
            yield Check(name, Level.OK, found)
        elif extra:
            advice = f"optional: {install_command(extra)}"
            yield Check(name, Level.WARN, found, advice)
        else:
            yield Check(name, Level.FAIL, found, install_command())


def check_shared_memory() -> Check:
    """Room for sessions in shared memory."""
    name = "shared memory"
    if not SHM_FOLDER.is_dir():
        return Check(name, Level.WARN, f"no {SHM_FOLDER} on this system", "fly with --transport file")
    usage = shutil.disk_usage(SHM_FOLDER)
    needs = {lanes: command_bytes(lanes) + pose_bytes(lanes) for lanes in LANES}
    needed = ", ".join(f"{lanes} lane{'s' * (lanes > 1)} {_size(need)}" for lanes, need in needs.items())
    found = f"{_size(usage.free)} free of {_size(usage.total)} ({needed})"
    advice = "enlarge it (docker run --shm-size=256m), see what fills it (ls /dev/shm), or fly with --transport file"
    if not os.access(SHM_FOLDER, os.W_OK) or usage.free < needs[LANES[0]]:
        return Check(name, Level.FAIL, found, advice)
    if usage.free < needs[LANES[-1]]:
        return Check(name, Level.WARN, found, advice)
    if usage.total <= CONTAINER_SHM:
        return Check(name, Level.OK, f"{found}; small, as containers have it")
    return Check(name, Level.OK, found)


def _size(count: float) -> str:
    for unit in ("bytes", "KB", "MB"):
        if count < 1000:
            return f"{count:.0f} {unit}"
        count /= 1000
    return f"{count:.1f} GB"


def check_segments(clean: bool) -> Check:
    """Segments that nobody serves any more, here and among the temporary files."""
    found = survey([Path(tempfile.gettempdir())])
    dead = [one for one in found if one.standing is Standing.DEAD]
    orphaned = [one for one in found if one.standing is Standing.ORPHANED]
    live = sum(one.standing is Standing.LIVE for one in found)
    kept = _remove_dead(dead) if clean else [f"{one.rendezvous} ({one.why})" for one in dead]
    kept += [f"{one.rendezvous} ({one.why})" for one in orphaned]
    words = [f"{live} live session{'s' * (live != 1)}"]
    if clean and dead:
        words.append(f"{len(dead)} dead removed" if not kept else f"{len(dead)} dead")
    words += kept
    advice = "cosim doctor --clean removes the segments of the dead" if dead and not clean else ""
    if orphaned:
        advice = (
            advice or "an orphan removes its segments as soon as it looks; kill the process if it is stuck"
        )
    return Check("segments", Level.WARN if kept else Level.OK, ", ".join(words), advice if kept else "")


def _remove_dead(dead: list[Found]) -> list[str]:
    """Remove what dead sessions left; returns what could not be removed, and why."""
    kept = []
    for one in dead:
        try:
            remove(one.rendezvous)
        except SessionError as error:
            kept.append(str(error))
    return kept


def check_scratch(folder: Path, clean: bool) -> Check:
    """Temporary folders of ours that a killed process left."""
    old = [path for path in _scratch(folder) if not _in_use(path)]
    for path in old if clean else ():
        shutil.rmtree(path, ignore_errors=True)
    kept = [path for path in old if path.exists()]
    if kept:
        found = f"{len(kept)} forgotten for more than a day: {', '.join(map(str, kept[:3]))}"
        advice = f"remove them by hand in {folder}" if clean else "cosim doctor --clean removes them"
        return Check("scratch", Level.WARN, found, advice)
    removed = f"{len(old)} forgotten ones removed from" if old else "nothing forgotten in"
    return Check("scratch", Level.OK, f"{removed} {folder}")


def _scratch(folder: Path) -> Iterator[Path]:
    """Our own temporary folders that nobody has touched for a day."""
    for path in sorted(folder.iterdir()):
        if SCRATCH.fullmatch(path.name) is None or path.is_symlink() or not path.is_dir():
            continue
        try:
            status = path.stat()
        except FileNotFoundError:  # just removed by its owner
            continue
        ours = not hasattr(os, "getuid") or status.st_uid == os.getuid()
        if ours and time.time() - status.st_mtime > OLD_S:
            yield path


def _in_use(folder: Path) -> bool:
    """Whether a process works in a folder or has a file in it open; True where nobody can tell."""
    processes = Path("/proc")
    if not (processes / "self/fd").is_dir():
        return True
    for link in (*processes.glob("[0-9]*/fd/*"), *processes.glob("[0-9]*/cwd")):
        try:
            target = link.readlink()
        except OSError:  # it is gone by now, or another user's
            continue
        if target.is_relative_to(folder):
            return True
    return False


def check_cores() -> Check:
    """Cores that this process may use."""
    present = os.cpu_count() or 1
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else present
    found = f"{usable} usable of {present}"
    if usable > 1:
        return Check("cores", Level.OK, found)
    advice = "it works, but both sides take turns on it: expect round trips twice as long; see taskset, cgroup limits"
    return Check("cores", Level.WARN, found, advice)


def check_clock() -> Check:
    """The finest time that can be told."""
    ticks = sorted({time.perf_counter_ns() for _ in range(1000)})
    finest = min((after - before for before, after in pairwise(ticks)), default=10**9)
    clock = time.get_clock_info("perf_counter")
    found = f"{clock.implementation}, resolution {clock.resolution * 1e9:.0f} ns, seen to tick in {finest} ns"
    if finest > CLOCK_NS:
        return Check("clock", Level.WARN, found, "single steps are timed coarsely here; nothing else suffers")
    return Check("clock", Level.OK, found)


def check_fence() -> Check:
    """What keeps the order of stores on this processor. (Without it, the protocol would not even be imported.)"""
    from protocol.memory import FENCE

    machine = platform.machine()
    if FENCE is None:
        return Check("fence", Level.OK, f"{machine} keeps the order of stores by itself")
    return Check("fence", Level.OK, f"{machine} reorders stores; the system library's fence is called")


def check_exchange() -> Check:
    """Whether a session's steps can go by machine code."""
    wish = os.environ.get(ENVIRONMENT, AUTO)
    if wish not in (AUTO, COMPILED, STDLIB):
        advice = f"unset {ENVIRONMENT}, or set it to {AUTO}, {COMPILED} or {STDLIB}"
        return Check("exchange", Level.FAIL, f"{ENVIRONMENT}={wish}", advice)
    if find_spec("numba") is None:
        return Check("exchange", Level.WARN, "the standard library alone", "optional: pip install numba")
    found = (
        "the standard library" if wish == STDLIB else "machine code where a process has two cores and numba"
    )
    return Check("exchange", Level.OK, f"{found} ({ENVIRONMENT}={wish})")


@dataclass(frozen=True)
class _Program:
    name: str
    commands: tuple[str, ...]
    packages: str
    use: str


_PROGRAMS: Final = (
    _Program("C# (Mono)", ("mcs", "mono"), "mono-mcs mono-runtime libmono-system-core4.0-cil", "the C# peer"),
    _Program("C compiler", ("cc",), "gcc libc6-dev", "the C peer"),
    _Program("model checker", ("spin", "cc"), "spin gcc", "the model of the protocol"),
)


def check_programs() -> Iterator[Check]:
    """Programs that only the peers of other languages, the model and the viewer need."""
    for program in _PROGRAMS:
        paths = [shutil.which(command) for command in program.commands]
        missing = [command for command, path in zip(program.commands, paths, strict=True) if path is None]
        if missing:
            advice = f"optional, for {program.use}: apt-get install {program.packages}"
            yield Check(program.name, Level.WARN, f"no {', no '.join(missing)}", advice)
        else:
            yield Check(program.name, Level.OK, ", ".join(map(str, paths)))
    yield check_display(os.environ)


def check_display(environment: Mapping[str, str]) -> Check:
    """A screen for a window."""
    found = next(
        (f"{name}={environment[name]}" for name in ("DISPLAY", "WAYLAND_DISPLAY") if environment.get(name)),
        "",
    )
    if found or sys.platform in ("win32", "darwin"):
        return Check("display", Level.OK, found or sys.platform)
    return Check(
        "display",
        Level.WARN,
        "none",
        "optional, for windows: ssh -X, or xvfb-run COMMAND (apt-get install xvfb)",
    )
