"""The environments behind the Gymnasium ids of `cosim.gym`: the kinematic world, and the co-simulation.

The makers take the fields of `agent_client.gym_env.TubeEnvOptions` by their names, and so does `gymnasium.make`:

    gymnasium.make("cosim/TubeKinematic-v0", level=2, conditions=HARD)
    gymnasium.make_vec("cosim/TubeCosim-v0", num_envs=8, level=1)
"""

from __future__ import annotations

from typing import Any

from agent_client.gym_env import TubeEnv, TubeEnvOptions, TubeVectorEnv
from agent_client.kinematic import KinematicPlant
from agent_client.world import OpenSession
from cosim.options import DEFAULT_PHYSICS_DT
from cosim.walls import WallRegistry, wall_slots, walled_session
from protocol.twin import open_twin


def make_kinematic(**options: Any) -> TubeEnv:
    """One drone in the kinematic world of training (`cosim/TubeKinematic-v0`)."""
    chosen = TubeEnvOptions(**options)
    return TubeEnv(_kinematic(chosen), chosen)


def make_kinematic_vector(num_envs: int = 1, **options: Any) -> TubeVectorEnv:
    """N drones in the kinematic world (`cosim/TubeKinematic-v0` by `gymnasium.make_vec`)."""
    chosen = TubeEnvOptions(**options)
    return TubeVectorEnv(_kinematic(chosen), num_envs, chosen)


def make_cosim(**options: Any) -> TubeEnv:
    """One drone in a physics process of its own, with walls (`cosim/TubeCosim-v0`)."""
    return TubeEnv(walled_session, _rigid(options), WallRegistry(wall_slots(1)))


def make_cosim_vector(num_envs: int = 1, **options: Any) -> TubeVectorEnv:
    """N drones in one physics process with walls (`cosim/TubeCosim-v0` by `gymnasium.make_vec`)."""
    return TubeVectorEnv(walled_session, num_envs, _rigid(options), WallRegistry(wall_slots(num_envs)))


def _kinematic(options: TubeEnvOptions) -> OpenSession:
    return lambda settings: open_twin(KinematicPlant(options.settings), settings)


def _rigid(options: dict[str, Any]) -> TubeEnvOptions:
    return TubeEnvOptions(**{"physics_dt": DEFAULT_PHYSICS_DT} | options)
