"""The Gymnasium ids: made, checked, and the physics process that the co-simulation starts and ends."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="the extra 'train' is not installed")

import gymnasium
import stable_baselines3.common.env_checker
from flights import DEADLINE, environment, gone, leftovers, wait_until
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import cosim.gym  # noqa: F401 - registers the ids
from agent_client.conditions import HARD, Conditions
from agent_client.tubes import TubeRecipe
from protocol.errors import PeerLost

KINEMATIC, COSIM = "cosim/TubeKinematic-v0", "cosim/TubeCosim-v0"
SHORT = TubeRecipe(lengths=(4.0,))


@pytest.fixture
def make() -> Iterator[Callable[..., gymnasium.Env]]:
    """Makes environments as a user does, and closes them; no shared memory of this process may be left."""
    made: list[gymnasium.Env] = []

    def make_one(name: str, **options: Any) -> gymnasium.Env:
        made.append(gymnasium.make(name, **options))
        return made[-1]

    yield make_one
    for env in made:
        env.close()
    assert leftovers(f"cosim-{os.getpid()}-") == []


@pytest.mark.parametrize("name", [KINEMATIC, COSIM])
def test_gymnasium_finds_nothing_to_complain_about(make: Callable[..., gymnasium.Env], name: str) -> None:
    """Its checker passes without a warning: spaces, seeds, determinism, returned data, closing twice."""
    check_env(make(name, level=1).unwrapped)


@pytest.mark.parametrize("name", [KINEMATIC, COSIM])
def test_stable_baselines3_finds_nothing_to_complain_about(
    make: Callable[..., gymnasium.Env], name: str
) -> None:
    """Its checker passes without a warning."""
    stable_baselines3.common.env_checker.check_env(make(name, level=1).unwrapped)


def test_makers_take_the_options_by_name(make: Callable[..., gymnasium.Env]) -> None:
    """Level, recipe, conditions and lags reach the environment; an option that does not exist is named."""
    env = make(KINEMATIC, level=2, recipe=SHORT, conditions=HARD, lags=(0, 1))
    observation, info = env.reset(seed=0)
    assert observation.shape == (74,)
    assert info["level"] == 2
    assert env.unwrapped.options.conditions is HARD
    assert info["progress"] == pytest.approx(0.6 / 4.0, abs=0.01)
    with pytest.raises(TypeError, match="levle"):
        gymnasium.make(KINEMATIC, levle=2)


@pytest.mark.parametrize("name", [KINEMATIC, COSIM])
def test_vectors_are_made_by_the_same_id(name: str) -> None:
    """`make_vec` gives our own vector environment, whose lanes are one session."""
    env = gymnasium.make_vec(name, num_envs=3, recipe=SHORT, pool=4)
    try:
        assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
        assert env.unwrapped.session.lanes == 3
        observation, infos = env.reset(seed=0)
        assert observation in env.observation_space
        assert set(infos["tube_seed"].tolist()) <= set(range(4))
        ended = 0
        for _ in range(60):
            observation, _, terminated, truncated, infos = env.step(np.full(3, 3))
            assert observation in env.observation_space
            ended += int((terminated | truncated).sum())
            if "final_info" in infos:
                outcomes = infos["final_info"]["outcome"][infos["_final_info"]]
                assert set(outcomes) <= {"success", "collision"}
        assert ended >= 3
    finally:
        env.close()
    assert leftovers(f"cosim-{os.getpid()}-") == []


def test_the_co_simulation_has_inertia_and_walls(make: Callable[..., gymnasium.Env]) -> None:
    """From rest the drone gains speed as its gain says, k_v (v_cmd - V); and physics reports what it touches."""
    conditions = Conditions(gain=(2.0, 2.0), compensation=(1.0, 1.0))
    env = make(COSIM, conditions=conditions, recipe=TubeRecipe())
    observation, _ = env.reset(seed=1)
    speeds = []
    for _ in range(5):
        observation, *_ = env.step(np.int64(3))
        speeds.append((observation[18] + 1.0) / 2.0 * 2.0)  # v, of a drone that looks where it flies
    # With k_v h = 2/240 an inner step takes 1 - k_v h of what is missing.
    expected = 2.0 * (1.0 - (1.0 - 2.0 / 240.0) ** (24 * np.arange(1, 6)))
    np.testing.assert_allclose(speeds, expected, atol=0.02)
    ended = False
    while not ended:
        *_, ended, _, info = env.step(np.int64(7))  # to the right
    assert info["outcome"] == "collision"
    assert info["clearance"] == pytest.approx(0.15, abs=0.05)


def test_co_simulated_episodes_come_again_with_the_seed(make: Callable[..., gymnasium.Env]) -> None:
    """Bit for bit, in another process too, after other episodes too."""
    conditions = Conditions(gain=(1.5, 6.0), gust=(0.0, 1.0), lidar_noise=(0.0, 0.05))
    one, other = (make(COSIM, conditions=conditions, recipe=SHORT, pool=3) for _ in range(2))
    assert one.unwrapped.session.peer_pid != other.unwrapped.session.peer_pid

    def run(env: gymnasium.Env, seed: int) -> list[bytes]:
        seen = [env.reset(seed=seed)[0].tobytes()]
        for _ in range(3):
            ended = False
            while not ended:
                observation, _, terminated, truncated, _ = env.step(np.int64(3))
                seen.append(observation.tobytes())
                ended = terminated or truncated
            seen.append(env.reset()[0].tobytes())
        return seen

    first = run(one, 5)
    assert run(other, 4) != first
    assert run(other, 5) == run(one, 5) == first


def test_closing_ends_the_physics_process(make: Callable[..., gymnasium.Env]) -> None:
    """It is gone, and its shared memory, when `close` returns; so it is when the environment is forgotten."""
    env = make(COSIM)
    env.reset(seed=0)
    pid = env.unwrapped.session.peer_pid
    assert not gone(pid)
    env.close()
    assert gone(pid)
    assert leftovers(f"cosim-{os.getpid()}-") == []
    forgotten: Any = gymnasium.make(COSIM)
    pid = forgotten.unwrapped.session.peer_pid
    assert not gone(pid)
    del forgotten
    gc.collect()
    assert gone(pid)


def test_a_killed_physics_process_is_a_typed_error(make: Callable[..., gymnasium.Env]) -> None:
    """The next step says who ended and how, at once; closing cleans up all the same."""
    for name, count in (("single", None), ("vector", 2)):
        env = make(COSIM) if count is None else gymnasium.make_vec(COSIM, num_envs=count, pool=2)
        env.reset(seed=0)
        os.kill(env.unwrapped.session.peer_pid, signal.SIGKILL)
        action = np.int64(3) if count is None else np.full(count, 3)
        with pytest.raises(PeerLost, match="SIGKILL"):
            env.step(action)
        env.close()
        assert leftovers(f"cosim-{os.getpid()}-") == [], name


PROGRAM = """
import sys
import gymnasium, cosim.gym
env = gymnasium.{make}
env.reset(seed=0)
print(env.unwrapped.session.peer_pid, flush=True)
{end}
"""


@pytest.mark.parametrize(
    ("make", "end", "status"),
    [
        (f"make({COSIM!r})", "raise RuntimeError('a bug')", 1),
        (f"make_vec({COSIM!r}, num_envs=2, pool=2)", "sys.exit(5)", 5),
        (f"make({COSIM!r})", "", 0),
    ],
)
def test_a_program_that_ends_takes_its_physics_process_along(make: str, end: str, status: int) -> None:
    """By an exception, by sys.exit, or at its last line, without ever closing the environment."""
    done = Program(PROGRAM.format(make=make, end=end))
    assert done.returncode == status, done.stderr
    assert ("a bug" in done.stderr) == (status == 1)
    assert "Exception ignored" not in done.stderr
    wait_until(lambda: gone(int(done.stdout)))
    assert leftovers(f"cosim-{done.pid}-") == []


def test_the_ids_are_registered_without_loading_the_environments() -> None:
    """The module may be named in the id; importing it brings in nothing heavy before an environment is made."""
    heavy = "sorted({'torch', 'numba', 'agent_client', 'click'} & set(sys.modules))"
    done = Program(f"import sys, cosim.gym; print({heavy})")
    assert done.stdout == "[]\n", done.stderr
    done = Program(f"import gymnasium; print(gymnasium.make('cosim.gym:{KINEMATIC}').spec.id)")
    assert done.stdout == f"{KINEMATIC}\n", done.stderr


class Program:
    """Python code, run to its end in a process of its own."""

    def __init__(self, code: str) -> None:
        process = subprocess.Popen(
            [sys.executable, "-c", code],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment(),
        )
        self.pid = process.pid
        try:
            self.stdout, self.stderr = process.communicate(timeout=DEADLINE)
        finally:
            process.kill()
            process.wait()
        self.returncode = process.returncode
