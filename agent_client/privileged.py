"""What the value network may see while training and the policy never does: the hidden parameters and the axis.

An asymmetric critic (Pinto et al. 2018, "Asymmetric actor critic for image-based robot learning") knows why an
episode is hard, so that its estimate does not blame the policy for the draw. Our addition; the paper has none.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from agent_client.episodes import Records
from agent_client.task import TaskStep
from meshes.geometry import Geometry
from protocol.plant import PoseBatch

Singles = NDArray[np.float32]

AHEAD: Final = (0.5, 1.0, 2.0, 4.0)
"""Arc lengths ahead at which the critic sees the axis (m)."""

WIDTH: Final = 3 + 3 + 2 + 3 * len(AHEAD) + 2 + 6
"""Numbers that the critic sees beyond the policy's observation."""


def privileged(step: TaskStep, poses: PoseBatch, drawn: Records, geometry: Geometry) -> Singles:
    """Velocity and offset in the local frame, the axis ahead, and what the episode drew, (N, WIDTH).

    Args:
        step: what is known of the episodes.
        poses: (N,) that it came from.
        drawn: (N,) conditions of the episodes.
        geometry: the tubes.
    """
    frame, position = step.frame, step.position
    parts = [
        np.einsum("nij,nj->ni", frame, poses.linear_velocity),
        np.einsum("nij,nj->ni", frame, position - step.axis.position) / step.axis.radius[:, None],
        np.stack([step.axis.radius, 2.0 * step.progress - 1.0], axis=1),
    ]
    for ahead in AHEAD:
        points, _ = geometry.axis(step.axis.arc_length + ahead)
        parts.append(np.einsum("nij,nj->ni", frame, points - position))
    parts.append(
        np.stack(
            [step.episodes["length"] - step.axis.arc_length, step.episodes["step"] / step.max_steps], axis=1
        )
    )
    parts[-1][:, 0] = np.minimum(parts[-1][:, 0], 5.0)
    parts.append(
        np.stack(
            [
                np.log(drawn["gain"]), drawn["compensation"], drawn["drag"] / drawn["mass"],
                drawn["body_radius"], drawn["field_of_view"], drawn["near_wall"],
            ],
            axis=1,
        )
    )  # fmt: skip
    return np.concatenate(parts, axis=1).astype(np.float32)
