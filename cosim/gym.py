"""The Gymnasium ids of this project; importing this module registers them, and imports nothing else of ours.

cosim/TubeKinematic-v0    tubes in the kinematic world of training
cosim/TubeCosim-v0        tubes in rigid-body physics, in a process that the environment starts and ends

Both are made by `gymnasium.make`, and as N drones side by side by `gymnasium.make_vec`; what they may be given
says `cosim.environments`. Gymnasium itself imports the module where the id says so:
`gymnasium.make("cosim.gym:cosim/TubeKinematic-v0")`. (It has no entry points for installed environments any more.)
"""

from __future__ import annotations

from gymnasium.envs.registration import register

register(
    "cosim/TubeKinematic-v0",
    entry_point="cosim.environments:make_kinematic",
    vector_entry_point="cosim.environments:make_kinematic_vector",
)
register(
    "cosim/TubeCosim-v0",
    entry_point="cosim.environments:make_cosim",
    vector_entry_point="cosim.environments:make_cosim_vector",
)
