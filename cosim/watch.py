"""`cosim watch`: the live state of a session that another process runs, without disturbing it."""

from __future__ import annotations

import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from protocol.errors import SessionError
from protocol.observer import Observer, Party, SessionStatus, Snapshot, sessions
from protocol.states import State

if TYPE_CHECKING:
    from rich.table import Table

TERMINAL_INTERVAL_S: Final = 0.1
PLAIN_INTERVAL_S: Final = 1.0
LOOK_S: Final = 0.1
"""Time between two looks at whether the session has ended."""
LAST_WORDS_S: Final = 0.15
"""How long the survivor of a session is given to say what it saw; it looks every 30 ms."""
ONCE_S: Final = 0.2
"""Time over which --once measures the rate of steps."""

_NICE: Final = 19
"""The system's lowest priority."""

Figures = dict[str, Any]


@dataclass(frozen=True)
class WatchOptions:
    """What is watched, and how often it is said."""

    session: str | None
    """Name or rendezvous; None: the only one that runs."""
    interval: float | None = None
    """Time between two reports (s); None: as fits a terminal or a log."""
    wait: float = 0.0
    """Patience for a session that is not there yet (s)."""
    once: bool = False
    """One report, then the end."""


def watch(options: WatchOptions, *, as_json: bool) -> bool:
    """Report the session's state until it ends; Ctrl-C ends the watching and nothing else.

    Returns:
        Whether nothing went wrong: the session goes on, or ended by goodbye.

    Raises:
        SessionError: there is no such session, or more than one and none was named.
        HandshakeError: what has that name is no session, or of another version.
    """
    step_back()
    try:
        with _attach(options) as observer:
            if options.once:
                return _report_once(observer, as_json)
            return _report_all(observer, options, as_json)
    except KeyboardInterrupt:
        return True


def step_back() -> None:
    """Leave the cores to whoever works: the session that is watched, above all."""
    if hasattr(os, "nice"):
        os.nice(_NICE)


def _attach(options: WatchOptions) -> Observer:
    """Look on at the session that was named, or at the only one there is."""
    if options.session is not None:
        return Observer.attach(options.session, options.wait)
    until = time.monotonic() + options.wait
    while not (running := sessions([Path(tempfile.gettempdir())])):
        if time.monotonic() >= until:
            raise SessionError(
                "no session is running; start one (cosim launch), or wait for one: --wait SECONDS"
            )
        time.sleep(LOOK_S / 5)
    if len(running) > 1:
        names = "".join(f"\n  {found.rendezvous}   {found.why}" for found in running)
        raise SessionError(
            f"{len(running)} sessions are running; name the one to watch: cosim watch ...{names}"
        )
    return Observer.attach(str(running[0].rendezvous), options.wait)


def _report_once(observer: Observer, as_json: bool) -> bool:
    gauge = _Gauge()
    gauge.figures(observer, observer.status())
    time.sleep(ONCE_S)
    status = observer.status()
    _say_line(gauge.figures(observer, status), as_json)
    return status.state is not State.BROKEN


def _report_all(observer: Observer, options: WatchOptions, as_json: bool) -> bool:
    live = sys.stdout.isatty() and not as_json
    interval = options.interval or (TERMINAL_INTERVAL_S if live else PLAIN_INTERVAL_S)
    gauge = _Gauge()
    with _table() if live else _lines(as_json) as show:
        due = time.monotonic()
        while not (status := observer.status()).ended:
            if time.monotonic() >= due:
                show(gauge.figures(observer, status))
                due += interval * max(1.0, math.ceil((time.monotonic() - due) / interval))
            time.sleep(max(0.0, min(LOOK_S, due - time.monotonic())))
        if status.state is State.BROKEN:
            time.sleep(LAST_WORDS_S)
            status = observer.status()
        show(gauge.figures(observer, status))
    if not as_json:
        steps = gauge.step or 0
        click.echo(f"{observer.rendezvous} ended after {steps} control steps: {status.why}")
    return status.state is State.CLOSED


class _Gauge:
    """Makes figures of what is seen; remembers the last look, for the rate of steps."""

    def __init__(self) -> None:
        self.step: int | None = None
        """Control steps integrated at the last look; None before the first reply."""
        self._at = 0.0
        self._last: Snapshot | None = None

    def figures(self, observer: Observer, status: SessionStatus) -> Figures:
        """What --json prints, and what the other reports are made from."""
        snapshot, request, now = observer.latest() or self._last, observer.request(), time.monotonic()
        self._last = snapshot
        settings = observer.settings
        plant = observer.description if status.physics.pid and status.state is not State.BROKEN else None
        figures: Figures = {
            "session": str(observer.rendezvous),
            "state": status.state.name.lower(),
            "ended": status.why or None,
            "agent": _process(status.agent),
            "physics": _process(status.physics),
            "plant": plant and f"{plant.name} {plant.version}, {plant.engine}",
            "lanes": settings.lanes,
            "dt_s": settings.dt,
            "inner_steps": settings.inner_steps,
            "step": None,
            "steps_per_second": None,
        }
        if snapshot is None:
            return figures
        poses = snapshot.poses
        if self.step is not None:
            figures["steps_per_second"] = round((snapshot.step - self.step) / (now - self._at), 1)
        self.step, self._at = snapshot.step, now
        return figures | {
            "step": snapshot.step,
            "engine_us": round(1e6 * snapshot.engine_seconds, 2),
            "sim_time_s": float(poses.sim_time[0]),
            "position_m": poses.position[0].tolist(),
            "speed_m_s": math.hypot(*poses.linear_velocity[0]),
            "commanded_m_s": None if request is None else float(request.commands.speed[0]),
            "contact_steps": int(poses.contact_steps[0]),
        }


def _process(party: Party) -> dict[str, Any] | None:
    return {"pid": party.pid, "life": party.life.value} if party.pid else None


@contextmanager
def _lines(as_json: bool) -> Iterator[Callable[[Figures], None]]:
    yield lambda figures: _say_line(figures, as_json)


def _say_line(figures: Figures, as_json: bool) -> None:
    words = (f"{name} {text}" for name, text in _words(figures).items())
    click.echo(json.dumps(figures) if as_json else "  ".join(words))


@contextmanager
def _table() -> Iterator[Callable[[Figures], None]]:
    """A small table that is redrawn in its place."""
    from rich.console import Console
    from rich.live import Live

    with Live(console=Console(), auto_refresh=False) as live:
        yield lambda figures: live.update(_draw(figures), refresh=True)


def _draw(figures: Figures) -> Table:
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2))
    for name, words in _words(figures).items():
        table.add_row(Text(name, style="dim"), Text(words))
    return table


def _words(figures: Figures) -> dict[str, str]:
    """The figures in words, by name."""
    words = {"session": figures["session"], "state": figures["state"]}
    for name in ("agent", "physics"):
        process = figures[name]
        words[name] = f"{process['pid']} {process['life']}" if process else "none yet"
    if figures["step"] is None:
        return words
    rate, contact = figures["steps_per_second"], figures["contact_steps"]
    if figures["lanes"] > 1:
        words["lane"] = f"0 of {figures['lanes']}"
    return words | {
        "step": f"{figures['step']}" + ("" if rate is None else f", {rate:.0f}/s"),
        "time": f"{figures['sim_time_s']:.2f} s",
        "position": "{:.2f} {:.2f} {:.2f} m".format(*figures["position_m"]),
        "speed": f"{figures['speed_m_s']:.2f} m/s",
        "contact": f"{contact} of {figures['inner_steps']} inner steps" if contact else "none",
        "engine": f"{figures['engine_us']:.0f} us",
    }
