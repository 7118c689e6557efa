"""`cosim bench --training`: how fast the environment, PPO as a whole, and the way past the paper's table are."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from agent_client.conditions import Conditions
from agent_client.controllers import PolicyController
from agent_client.curriculum import Curriculum
from agent_client.evaluation import draw_episodes, fly_episodes, summarise
from agent_client.kinematic import KinematicPlant
from agent_client.policy import Policy, load_policy
from agent_client.presets import PAPER
from agent_client.settings import Settings
from agent_client.tubes import LEVELS, POOL_SIZE, draw_pool
from agent_client.world import TubeWorld
from cosim.errors import CosimError
from cosim.evaluation_report import PAPER_SUCCESS
from cosim.train import CHECKPOINT, load_training
from protocol.agent import SessionSettings
from protocol.twin import open_twin

SEED: Final = 20_000
"""Of the tubes that the trained policy is judged on."""


@dataclass(frozen=True)
class Effort:
    """How much is measured."""

    pool: int = POOL_SIZE
    """Tubes of each level for environment and PPO; drawn before, which is not counted."""
    env_steps: int = 400
    """Steps of all lanes in one of the environment's five measurements."""
    warm_up: int = 2
    """PPO's batches that are not counted: the first ones load code and grow memory."""
    batches: int = 4
    """PPO's batches that are counted."""
    training: tuple[str, ...] = ()
    """Further arguments of `cosim train --preset quick`."""
    cold: bool = True
    """Whether that begins with an empty cache of compiled code."""
    episodes: int = 100
    """Unseen tubes a level that the trained policy is judged on."""


MEASUREMENT: Final = Effort()
LOOK: Final = Effort(20, 20, 1, 1, ("--steps", "1600", "--envs", "4", "--pool", "20"), False, 10)


def measure_training(effort: Effort, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure everything; about two minutes on two cores.

    Args:
        effort: how much.
        say: is told what is being measured.

    Returns:
        env_steps_per_second: lane steps of 65 kinematic lanes, flown by the policy that was just trained, whose own
            time is not counted; the tubes of all levels come from pools of `pool` a level.
        env_random_steps_per_second: the same by random actions, whose episodes last 20 steps: mostly restarts.
        ppo_steps_per_second: PPO as a whole with the preset `paper`.
        seconds_to_beat_paper: one process from its start to its end, with an empty cache of compiled code: imports,
            compiling, drawing tubes, training `quick`. None if the policy is not above the paper's success rates.
        reason: why that is None.
        evaluation_seconds: what judging the policy took, which is not part of it.
        success: its success rates by level.
    """
    with tempfile.TemporaryDirectory(prefix="cosim-bench-") as folder:
        out = Path(folder) / "out"
        say("training 'quick' from an empty cache of compiled code ...")
        seconds = time_quick_training(out, Path(folder) / "numba", effort)
        policy = load_policy(out / CHECKPOINT)
        begun = time.perf_counter()
        success = success_rates(policy, effort.episodes)
        evaluated = time.perf_counter() - begun
        say("the environment alone ...")
        flown, random = env_rates(policy, effort)
        say("PPO as a whole ...")
        whole = ppo_rate(Path(folder) / CHECKPOINT, effort)
    beaten = all(rate > bar for rate, bar in zip(success, PAPER_SUCCESS, strict=True))
    return {
        "env_steps_per_second": round(flown),
        "env_random_steps_per_second": round(random),
        "ppo_steps_per_second": round(whole),
        "seconds_to_beat_paper": round(seconds, 1) if beaten else None,
        "reason": None if beaten else f"success {success} is not above the paper's {list(PAPER_SUCCESS)}",
        "evaluation_seconds": round(evaluated, 1),
        "success": success,
        "episodes": effort.episodes,
        "pool": effort.pool,
    }


def time_quick_training(out: Path, cache: Path, effort: Effort) -> float:
    """Wall time (s) of a process that trains the preset `quick`.

    Raises:
        CosimError: the process failed; with what it said last.
    """
    command = [
        sys.executable,
        "-m",
        "cosim",
        "train",
        "--preset",
        "quick",
        "--out",
        str(out),
        *effort.training,
    ]
    environment = os.environ | ({"NUMBA_CACHE_DIR": str(cache)} if effort.cold else {})
    begun = time.perf_counter()
    done = subprocess.run(command, check=False, capture_output=True, text=True, env=environment)
    seconds = time.perf_counter() - begun
    if done.returncode:
        raise CosimError(
            f"cosim train --preset quick: exit status {done.returncode}: {done.stderr[-500:].strip()}"
        )
    return seconds


def success_rates(policy: Policy, episodes: int) -> list[float]:
    """Success rate at each level in the kinematic world, on tubes that training never sees."""
    settings, dt = Settings(), policy.contract.dt
    rates = []
    for level in range(LEVELS):
        with open_twin(KinematicPlant(settings), SessionSettings(episodes, dt, dt)) as session:
            results = fly_episodes(
                session,
                draw_episodes(level, episodes, SEED),
                lambda _: PolicyController(policy, settings, policy.contract.lags),
                settings,
                Conditions(),
            )
        rates.append(summarise(results).success)
    return rates


def env_rates(policy: Policy, effort: Effort) -> tuple[float, float]:
    """Lane steps per second of the environment alone, flown by a policy and by random actions; medians of five."""
    from agent_client.environment import TubeVecEnv

    pools = [draw_pool(level, PAPER.seed, effort.pool, PAPER.tubes) for level in range(LEVELS)]
    lanes = PAPER.hyperparameters.lanes
    rng = np.random.default_rng(0)
    rates: dict[bool, list[float]] = {True: [], False: []}
    with open_twin(
        KinematicPlant(PAPER.world.settings), SessionSettings(lanes, PAPER.dt, PAPER.dt)
    ) as session:
        # A third of the episodes at each level.
        world = TubeWorld(session, pools, Curriculum(level=2, replay=2 / 3), PAPER.world, PAPER.seed)
        env = TubeVecEnv(world)
        for flown in (True, False) * 6:
            spent, seen = 0.0, env.reset()
            for _ in range(effort.env_steps):
                actions = policy.act(seen) if flown else rng.integers(36, size=lanes)
                begun = time.perf_counter()
                seen, *_ = env.step(actions)
                spent += time.perf_counter() - begun
            rates[flown].append(lanes * effort.env_steps / spent)
    return statistics.median(rates[True][1:]), statistics.median(rates[False][1:])  # the first ones load code


def ppo_rate(out: Path, effort: Effort) -> float:
    """Control steps per second of a training by the preset `paper`: steps, updates, checkpoints, logs."""
    batch = PAPER.hyperparameters.batch
    total = (effort.warm_up + effort.batches) * batch
    options = replace(PAPER, out=out, steps=total, pool=effort.pool, tensorboard=out.parent / "tensorboard")
    clock: list[float] = []
    load_training()(options, lambda _: clock.append(time.perf_counter()))
    return effort.batches * batch / (clock[-1] - clock[effort.warm_up - 1])


def training_table(figures: dict[str, Any]) -> str:
    """The figures as text."""
    rates = " / ".join(f"{100.0 * rate:.0f}" for rate in figures["success"])
    bars = " / ".join(f"{100.0 * bar:.0f}" for bar in PAPER_SUCCESS)
    seconds = figures["seconds_to_beat_paper"]
    beaten = f"not reached: {figures['reason']}" if seconds is None else f"{seconds:.1f} s"
    return "\n".join(
        (
            "training",
            f"  environment alone, flown      {figures['env_steps_per_second']:8,} steps/s "
            f"(pools of {figures['pool']:,} tubes a level)",
            f"  environment, random actions   {figures['env_random_steps_per_second']:8,} steps/s "
            "(episodes of 20 steps)",
            f"  PPO as a whole                {figures['ppo_steps_per_second']:8,} steps/s",
            f"  from nothing past the paper   {beaten}, success {rates} % on {figures['episodes']} unseen tubes a "
            f"level against {bars}; judged in {figures['evaluation_seconds']:.1f} s more",
        )
    )
