"""`cosim launch --view`: a live window in a process of its own, which looks on at the session and touches nothing.

Poses and commands are on the wire, and shown as they are. LiDAR rays, the camera's field, target, memory and the gap
to the wall are computed here from the mesh, at the poses that it sees, without the sensors' noise: `cosim view` shows
afterwards what the agent had of them.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Final, Self

import protocol
from agent_client.settings import Settings
from cosim.live import working
from cosim.senses import Sensors
from protocol.liveness import describe_exit

FRAMES_PER_S: Final = 10.0
READY: Final = b"ready\n"
READY_S: Final = 30.0
"""How long a flight waits for its window (s); after that it goes on without."""
LINGER_S: Final = 2.0
"""How long the window stays when the session has ended (s)."""
STOP_S: Final = 2.0
"""How long the viewer may take to end (s) before it is killed."""
NICE: Final = 4
"""Two fifths of the weight of the session's processes: enough for most pictures where these take all cores."""

_VIEWER: Final = (
    f"import sys; sys.path.append({str(Path(protocol.__file__).resolve().parents[1])!r}); "
    "from cosim.live_view import main; sys.exit(main(sys.argv[1]))"
)


@dataclass(frozen=True)
class ViewChoice:
    """That a flight is to be seen live."""

    frames: Path | None = None
    """Folder for pictures in place of a window; for tests."""


@dataclass(frozen=True)
class Watched:
    """What the viewer is told of a flight."""

    rendezvous: str
    mesh: str
    centreline: str
    axes: str
    scale: float
    start_end: str
    sensors: Sensors
    memory_steps: int
    """Control steps for which the direction of a target that is no longer seen is remembered."""
    body_radius: float
    """(m)"""
    frames: str | None = None
    """Folder for pictures, which are drawn in place of a window; for tests."""


class LiveView:
    """The viewer as a child of ours, in a process group of its own; whatever becomes of it, the flight goes on.

    Args:
        choice: how it is to be seen; None: not at all, and nothing is started.
        say: tells the user; called once at most.
    """

    def __init__(self, choice: ViewChoice | None, say: Callable[[str], None]) -> None:
        self._choice, self._say = choice, say
        self._process: subprocess.Popen[bytes] | None = None
        self._errors: IO[bytes] | None = None
        self._told = False
        """Whether the user knows that there is no view any more."""

    def start(
        self,
        rendezvous: str,
        described: dict[str, Any],
        start_end: str,
        settings: Settings,
        field_of_view: float,
    ) -> None:
        """Start it, and wait for its first picture, but not for long.

        Args:
            rendezvous: of the session, which is on offer.
            described: the tube's entry `mesh` in the manifest.
            start_end: end of the centreline to start from.
            settings: of the task.
            field_of_view: the flight's condition.
        """
        if self._choice is None:
            return
        frames = self._choice.frames
        what = Watched(
            rendezvous=rendezvous,
            mesh=described["path"],
            centreline=described["centreline"],
            axes=described["axes"],
            scale=described["scale"],
            start_end=start_end,
            sensors=Sensors.of_settings(settings, field_of_view),
            memory_steps=settings.memory.steps,
            body_radius=settings.drone.body_radius,
            frames=None if frames is None else str(frames.resolve()),
        )
        command = [sys.executable, "-P", "-c", _VIEWER, json.dumps(asdict(what))]
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  closed by __exit__
        self._launch(command)

    def _launch(self, command: list[str]) -> None:
        assert self._errors is not None
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                start_new_session=True,
            )
        except OSError as error:
            self._say(f"live view: cannot be started: {error.strerror}; the flight goes on without it")
            return
        assert self._process.stdout is not None
        with working("opening the window"):
            answers = select.select([self._process.stdout], [], [], READY_S)[0]
        if not answers:
            self._say(
                f"live view: no picture within {READY_S:g} s; the flight goes on, and it may come later"
            )
        elif os.read(self._process.stdout.fileno(), len(READY)) != READY:
            self._give_up("the flight goes on without it")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if (
                self._process is not None
                and not self._told
                and self._ends_by_itself(0.0 if error else LINGER_S + STOP_S)
            ):
                self._give_up("the flight went on without it")
        finally:
            if self._process is not None:
                self._process.kill()
                self._process.wait()
                assert self._process.stdout is not None
                self._process.stdout.close()
            if self._errors is not None:
                self._errors.close()

    def _ends_by_itself(self, patience: float) -> bool:
        """Wait for it to leave, and tell whether it failed before it was told to."""
        assert self._process is not None
        try:
            return self._process.wait(patience) != 0
        except subprocess.TimeoutExpired:
            self._process.terminate()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(STOP_S)
            return False

    def _give_up(self, then: str) -> None:
        """Say why there is no view any more, once."""
        process, errors = self._process, self._errors
        assert process is not None
        assert errors is not None
        try:
            code = process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            code = process.wait()
        self._told = True
        errors.seek(0)
        words = errors.read().decode(errors="replace").strip().splitlines()
        # What is set in belongs to the line above it, which says more.
        why = next((line for line in reversed(words) if not line[:1].isspace()), describe_exit(code))
        self._say(f"live view: {why}; {then}")


def main(told: str) -> int:
    """The viewer's process; returns its exit status."""
    # One thread draws: where there is no graphics card, others would take the cores of the session.
    os.environ.setdefault("LP_NUM_THREADS", "1")
    # Here: they take a second of a core, which the launcher must not spend.
    from cosim.errors import CosimError
    from cosim.live_scene import LiveScene
    from meshes.errors import MeshError
    from protocol.errors import ProtocolError
    from protocol.observer import Observer

    found = json.loads(told)
    what = Watched(**found | {"sensors": Sensors(**found["sensors"])})
    try:
        with Observer.attach(what.rendezvous) as observer:
            scene = LiveScene(what)
            try:
                scene.draw(observer)
                _step_back()  # not before: the flight waits
                with suppress(BrokenPipeError):  # the launcher does not wait any more
                    os.write(1, READY)
                _look_on(scene, observer)
            finally:
                scene.close()
    except (CosimError, MeshError, ProtocolError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


def _step_back() -> None:
    """Leave the cores to the session."""
    if hasattr(os, "nice"):
        os.nice(NICE)
    # Where the system shares its cores among sessions of processes first, the priority within ours says nothing.
    with suppress(OSError):
        Path("/proc/self/autogroup").write_text(str(NICE))


def _look_on(scene: Any, observer: Any) -> None:
    """Until the session ends or the window is closed."""
    due = time.monotonic()
    while scene.open:
        now = time.monotonic()
        if now >= due:
            ended = observer.status().ended
            scene.draw(observer)
            if ended:
                break
            due = max(due + 1.0 / FRAMES_PER_S, time.monotonic())
        scene.wait(due, observer)
    else:
        return
    scene.linger(LINGER_S, observer)
