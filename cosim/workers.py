"""Flying many episodes and training many policies at once: jobs, and the processes that do them.

One file holds all that is parallel. A job says everything that its result depends on, so that it does not matter
who does it. Each worker has at most one physics server, for one lane: lanes whose episode is over would cost as
much as those that still fly.
"""

from __future__ import annotations

import atexit
import itertools
import multiprocessing
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from multiprocessing.connection import wait
from typing import Any, Final, Literal, TypeAlias

from agent_client.conditions import Conditions
from agent_client.evaluation import Episode, EpisodeResult, fly_episodes
from agent_client.kinematic import KinematicPlant
from agent_client.training_log import Progress
from agent_client.training_options import TrainingOptions
from agent_client.tubes import TubeRecipe
from agent_client.tuning import Tuning, tune_pure_pursuit
from cosim.errors import PEER, TERMINATED, OutputError, WorkerError, exit_status
from cosim.folders import scratch_folder
from cosim.live import counting
from cosim.options import DEFAULT_PHYSICS_DT
from cosim.pilots import ANY_DRONE, Pilot, PilotChoice, Terms, read_pilot
from cosim.sessions import server_session
from cosim.train import load_training
from cosim.walls import WallRegistry
from physics_server.reference import ReferencePlant
from protocol.agent import AgentSession, SessionSettings
from protocol.errors import ProtocolError
from protocol.twin import open_twin

Engine: TypeAlias = Literal["kinematic", "reference", "bullet"]

LANES: Final = 50
"""Episodes side by side in a world of this process."""
BULLET_EPISODES: Final = 10
"""Episodes of a job on a physics server, one after the other: enough to make waiting for the next job short."""
WALLS: Final = 16
"""Walls that a worker's server keeps, for the pilots that fly the same tubes in turn."""
END_SECONDS: Final = 5.0
"""How long workers may take to end when they are told to, before they are killed."""


@dataclass(frozen=True)
class FlyJob:
    """Some episodes of one level, flown by each of some pilots in turn."""

    pilots: tuple[PilotChoice, ...]
    episodes: tuple[Episode, ...]
    conditions: Conditions
    engine: Engine

    @property
    def weight(self) -> int:
        """Episodes, for the display of progress."""
        return len(self.pilots) * len(self.episodes)


@dataclass(frozen=True)
class TuneJob:
    """Finding the best Pure Pursuit of a level, in a world of this process."""

    level: int
    conditions: Conditions
    recipe: TubeRecipe
    engine: Engine
    episodes: int
    seed: int

    @property
    def weight(self) -> int:
        """About as many episodes as all candidates fly together."""
        return 10 * self.episodes


@dataclass(frozen=True)
class TrainJob:
    """Training a policy, in a world of this process; its checkpoint and its log are written when it is complete."""

    options: TrainingOptions
    engine: Engine
    """Not `bullet`."""

    @property
    def weight(self) -> int:
        """Control steps."""
        return self.options.steps


Job: TypeAlias = FlyJob | TuneJob | TrainJob
Flown: TypeAlias = tuple[tuple[EpisodeResult, ...], ...]
"""Results of a FlyJob: those of each pilot, in the order of its episodes."""
Trained: TypeAlias = tuple[Progress, ...]
"""Log of a TrainJob: a row an iteration."""
RunJobs: TypeAlias = Callable[[Sequence[Job]], Iterator[Any]]
"""Does jobs and yields their results in their order: Flown for a FlyJob, Tuning, Trained."""


class Worker:
    """Does jobs, and keeps a physics server between them where jobs need one."""

    def __init__(self) -> None:
        self._stack = ExitStack()
        self._session: AgentSession | None = None
        self._walls = WallRegistry(WALLS)

    def do(self, job: Job) -> Flown | Tuning | Trained:
        """Do a job.

        Raises:
            ProtocolError: the physics server failed; what it said last is a note of the error.
            CosimError: training is not installed, or its files cannot be written.
        """
        if isinstance(job, TrainJob):
            return _train(job)
        if isinstance(job, TuneJob):
            return _tune(job)
        pilots = [_pilot(choice) for choice in job.pilots]
        if job.engine == "bullet":
            return self._fly_bullet(job, pilots)
        return tuple(_fly_here(job, pilot) for pilot in pilots)

    def _fly_bullet(self, job: FlyJob, pilots: Sequence[Pilot]) -> Flown:
        """Fly one after the other; the pilots take turns, so that a wall is registered once for all of them."""
        results: list[list[EpisodeResult]] = [[] for _ in pilots]
        try:
            for dt in sorted({pilot.dt for pilot in pilots}):
                session = self._serve(dt)
                turns = [
                    (pilot, flown) for pilot, flown in zip(pilots, results, strict=True) if pilot.dt == dt
                ]
                for episode, (pilot, flown) in itertools.product(job.episodes, turns):
                    flown += fly_episodes(
                        session,
                        [episode],
                        pilot.make_controller,
                        pilot.settings,
                        job.conditions,
                        self._walls,
                    )
        except ProtocolError as error:
            self._session = None
            self._stack.__exit__(type(error), error, error.__traceback__)  # adds the server's last words
            raise
        return tuple(map(tuple, results))

    def _serve(self, dt: float) -> AgentSession:
        """The session with this worker's server; a new one where the control step is another."""
        if self._session is None or self._session.dt != dt:
            self.close()
            settings = SessionSettings(1, dt, DEFAULT_PHYSICS_DT)
            self._session = self._stack.enter_context(server_session(settings, "bullet"))
        return self._session

    def close(self) -> None:
        """End the server."""
        self._session = None
        self._stack.close()

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_world(engine: Engine, lanes: int, dt: float) -> AgentSession:
    """A session with a world of this process."""
    if engine == "kinematic":
        return open_twin(KinematicPlant(), SessionSettings(lanes, dt, dt))
    return open_twin(ReferencePlant(), SessionSettings(lanes, dt, DEFAULT_PHYSICS_DT))


def _fly_here(job: FlyJob, pilot: Pilot) -> tuple[EpisodeResult, ...]:
    """Fly side by side in a world of this process."""
    with open_world(job.engine, len(job.episodes), pilot.dt) as session:
        return tuple(
            fly_episodes(session, job.episodes, pilot.make_controller, pilot.settings, job.conditions)
        )


def _tune(job: TuneJob) -> Tuning:
    dt = _pilot(PilotChoice("pure-pursuit")).dt
    return tune_pure_pursuit(
        lambda lanes: open_world(job.engine, lanes, dt),
        job.level,
        job.conditions,
        job.recipe,
        episodes=job.episodes,
        seed=job.seed,
    )


def _train(job: TrainJob) -> Trained:
    log: list[Progress] = []
    run, out = load_training(), job.options.out
    with scratch_folder("cosim-train-") as scratch:
        path = run(
            replace(job.options, out=scratch / out.name),
            log.append,
            lambda settings: open_world(job.engine, settings.lanes, settings.dt),
        )
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            for suffix in (".csv", ".zip"):
                shutil.move(path.with_suffix(suffix), out.with_suffix(suffix))
        except OSError as error:
            raise OutputError(f"{out} cannot be written: {error.strerror}") from error
    return tuple(log)


@lru_cache(maxsize=32)
def _pilot(choice: PilotChoice) -> Pilot:
    return read_pilot(choice, Terms(allowed=ANY_DRONE))


@contextmanager
def crew(workers: int) -> Iterator[RunJobs]:
    """So many processes that do jobs, all of them gone at the end; one worker is this process itself.

    Raises:
        WorkerError: a job failed, or a worker was killed.
    """
    if workers == 1:
        with Worker() as worker:
            yield lambda jobs: map(worker.do, jobs)
        return
    with scratch_folder("cosim-evaluate-") as folder:
        executor = ProcessPoolExecutor(
            workers,
            multiprocessing.get_context("spawn"),
            initializer=_begin,
            initargs=(str(folder),),
        )

        def run(jobs: Sequence[Job]) -> Iterator[Any]:
            # Ctrl-C in a terminal reaches all processes; until they can ignore it, it waits for ours alone.
            usual = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                results = executor.map(_do, jobs)
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, usual)
            return results

        try:
            yield run
            executor.shutdown()
        except BrokenProcessPool as error:
            raise WorkerError("a worker process was killed, or died; there is no result", PEER) from error
        finally:
            _end(executor)


def do_jobs(
    run: RunJobs, jobs: Sequence[Job], what: str, tell: Callable[[int, Any], None] | None = None
) -> list[Any]:
    """Results of jobs, with a bar while they are done.

    Args:
        run: from `crew`.
        jobs: to be done.
        what: is done, for the bar.
        tell: is told the index and the result of each job, in their order.
    """
    results: list[Any] = []
    with counting(what, sum(job.weight for job in jobs)) as advance:
        for job, result in zip(jobs, run(jobs), strict=True):
            advance(job.weight)
            if tell is not None:
                tell(len(results), result)
            results.append(result)
    return results


def _end(executor: ProcessPoolExecutor) -> None:
    """End what still runs: workers and, by their hands, servers."""
    executor.shutdown(wait=False, cancel_futures=True)
    children = multiprocessing.active_children()
    for child in children:
        child.terminate()
    for child in children:
        child.join(END_SECONDS)
        child.kill()
        child.join()


_worker: Worker | None = None
"""That of a worker process."""


def _begin(folder: str) -> None:
    """Prepare a worker process: it leaves Ctrl-C to its parent, ends when told to, and does not outlive it."""
    global _worker  # noqa: PLW0603  the one object of a worker process
    _worker = worker = Worker()
    tempfile.tempdir = folder  # the parent removes it, however this process ends

    def leave(number: int, _frame: object) -> None:
        signal.signal(number, signal.SIG_IGN)
        # Here and at once: an exception would be caught by the pool and sent to the parent as a result.
        with suppress(Exception):
            worker.close()
        os._exit(TERMINATED)

    def follow_parent() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, leave)
    atexit.register(worker.close)
    threading.Thread(target=follow_parent, daemon=True).start()


def _do(job: Job) -> Flown | Tuning | Trained:
    """Do a job in a worker process; what was raised on purpose travels as a sentence and an exit status."""
    assert _worker is not None
    try:
        return _worker.do(job)
    except Exception as error:
        status = exit_status(error)
        if status is None:
            raise
        raise WorkerError("\n".join([str(error), *getattr(error, "__notes__", ())]), status) from None
