"""The paper's reward (section Reward Shaping): three regimes by what is seen, a warm-up bonus, an end.

Every term is kept apart; their sum is the reward. With `per_metre`, our departure from the paper, the terms
of a step are multiplied by the progress of that step over v_max dt: the literal reward is positive in every
step, so that an agent earns the more the longer it stays, and loiters.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agent_client.episodes import Records

Ints = NDArray[np.int64]

TERMS: Final = (
    "align",  # S_align; regimes 1 and 2
    "front_symmetry",  # w_F S_F
    "rear_symmetry",  # w_R S_R
    "front_mean",  # 0.4 mu_F; regimes 1 and 3
    "horizontal",  # 0.3 or 0.4 times 1 - |h_f|; regimes 1 and 2
    "vertical",  # 0.3 (1 - |v_f|); regime 2
    "imbalance",  # -0.3 |S_F - S_R|; regime 3
    "warmup",
    "centring",  # a weight times S_center; our addition, 0 unless set
    "terminal",
)
"""Names of the reward's terms, in the order of the columns of `reward_terms`."""


class Regime(IntEnum):
    """What the instantaneous reward is made of; the paper's three cases."""

    VISIBLE = 1
    MEMORY = 2
    BLIND = 3


@njit(cache=True)
def choose_regimes(lanes: Ints, episodes: Records) -> None:
    """The regime of each lane, S_align in it (heading against target, memory, or axis), and S_center.

    Args:
        lanes: (K,) the lanes to compute.
        episodes: (N,) records; `regime`, `alignment` and `centring` are written.
    """
    for k in range(lanes.shape[0]):
        e = episodes[lanes[k]]
        alignment = 0.0
        for c in range(3):
            if e.target_visible:
                alignment += e.frame[0, c] * e.target_direction[c]
            elif e.memory_available:
                alignment += e.frame[0, c] * e.memory_direction[c]
            else:
                alignment += e.frame[0, c] * e.tangent[c]
        e.alignment = alignment
        e.regime = 1 if e.target_visible else (2 if e.memory_available else 3)
        e.centring = min(max(1.0 - e.radial_distance / e.radius, 0.0), 1.0)


@njit(cache=True)
def score(lanes: Ints, episodes: Records, constants: Records) -> None:
    """Reward of the step that led here.

    The terminal reward comes on top of the last step's terms (the paper leaves this open).

    Args:
        lanes: (K,) the lanes to compute.
        episodes: (N,) records, judged; `reward` and `reward_terms` are written.
        constants: (1,) record of the task's constants.
    """
    constant = constants[0]
    for k in range(lanes.shape[0]):
        e = episodes[lanes[k]]
        terms = e.reward_terms
        terms[:] = 0.0
        g, imbalance = e.gain, abs(e.S_F - e.S_R)
        terms[1] = g * 0.6 * (1.0 - 0.4 * e.C_turn) * e.S_F
        terms[2] = g * 0.4 * (1.0 + 0.4 * e.C_turn) * e.S_R
        regime = np.int64(e.regime) if constant.reward_regimes > 0.0 else 3
        if regime == 1:
            terms[0] = g * e.alignment
            terms[3] = g * 0.4 * e.mu_F
            terms[4] = g * 0.3 * (1.0 - abs(e.h_f))
        elif regime == 2:
            terms[0] = g * e.alignment
            terms[4] = g * 0.4 * (1.0 - abs(e.h_f))
            terms[5] = g * 0.3 * (1.0 - abs(e.v_f))
        else:
            terms[3] = g * 0.4 * e.mu_F
            terms[6] = -g * 0.3 * imbalance
        if e.step <= constant.warmup_steps:
            symmetry = (0.7 * e.S_F + 0.3 * e.S_R) * (1.0 - imbalance)
            terms[7] = g * 0.5 * symmetry * (1.0 - 0.5 * e.C_turn)
        # Never paid by more than v_max dt of progress, which a cut corner would exceed.
        terms[8] = min(g, 1.0) * constant.reward_centring * e.centring
        if e.outcome == 1:
            terms[9] = constant.reward_success
        elif e.outcome == 2 or e.outcome == 3:
            terms[9] = constant.reward_failure
        elif e.outcome == 4:
            terms[9] = constant.reward_timeout
        total = 0.0
        for t in range(terms.shape[0]):
            total += terms[t]
        e.reward = total
