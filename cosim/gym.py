"""The Gymnasium ids of this project; importing this module registers them, and so does installing the project.

cosim/TubeKinematic-v0    tubes in the kinematic world of training
cosim/TubeCosim-v0        tubes in rigid-body physics, in a process that the environment starts and ends

Both are made by `gymnasium.make`, and as N drones side by side by `gymnasium.make_vec`; what they may be given
says `cosim.environments`. Gymnasium loads this module whenever it is itself imported: it imports nothing else.
"""

from __future__ import annotations

from typing import Final

from gymnasium.envs.registration import register, registry

_MAKERS: Final = {
    "cosim/TubeKinematic-v0": ("make_kinematic", "make_kinematic_vector"),
    "cosim/TubeCosim-v0": ("make_cosim", "make_cosim_vector"),
}


def register_environments() -> None:
    """Register the ids, if that was not done yet."""
    for name, (single, vector) in _MAKERS.items():
        if name not in registry:
            register(
                name,
                entry_point=f"cosim.environments:{single}",
                vector_entry_point=f"cosim.environments:{vector}",
            )


register_environments()
