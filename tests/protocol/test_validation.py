"""The quick check of resets agrees with the one that says what is wrong."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol import validation
from protocol.plant import PARAMETERS, ResetBatch

TUBES = {0, 7}
ODD = (math.nan, math.inf, -math.inf, -1.0, -0.0, 0.0, 5e-324, 0.5, 1.0, 1.0 + 1e-7, 2.0, 1e300)


def sound(lanes: int) -> ResetBatch:
    """Rows that nothing is wrong with, every other one selected."""
    resets = ResetBatch.zeros(lanes)
    resets.selected[::2] = 1
    resets.tube[:] = np.resize([7, -1, 0], lanes)
    for index, parameter in enumerate(PARAMETERS):
        resets.parameters[:, index] = 1.0 if parameter.above_lowest else max(parameter.lowest, 0.0)
    return resets


def faults(resets: ResetBatch) -> list[object]:
    """What the thorough check of one row after the other finds in the selected ones."""
    return [
        refusal
        for lane in np.flatnonzero(resets.selected)
        if (refusal := validation._reset_row_refusal(resets, int(lane), TUBES)) is not None
    ]


def test_sound_resets_pass() -> None:
    """Both checks let them pass, with none, some or all lanes selected."""
    for selected in (0, 1):
        resets = sound(4)
        resets.selected[:] = selected
        assert validation.resets_are_sound(resets, TUBES)
        assert validation.reset_refusal(resets, TUBES) is None
    assert faults(sound(4)) == []


@settings(max_examples=300, deadline=None)
@given(st.integers(0, 47), st.integers(0, 3), st.sampled_from(ODD))
def test_the_quick_check_agrees_with_the_thorough_one(word: int, lane: int, value: float) -> None:
    """Whatever stands in one word of one row, it is sound if and only if nothing can be said against it."""
    resets = sound(4)
    if word in (13, 14, 15):  # whole numbers: tube, seed, selected
        resets.raw.view(np.int64)[lane, word] = int(min(max(value, -2.0), 9.0)) if math.isfinite(value) else 8
    else:
        resets.raw[lane, word] = value
    bad_selection = not np.isin(resets.selected, (0, 1)).all()
    expected = not bad_selection and not faults(resets)
    assert validation.resets_are_sound(resets, TUBES) is expected
    assert (validation.reset_refusal(resets, TUBES) is None) is expected


@pytest.mark.parametrize("parameter", PARAMETERS, ids=lambda parameter: parameter.name)
def test_a_parameter_is_taken_up_to_its_bounds_and_no_further(parameter: object) -> None:
    """The bounds themselves pass where they are meant to, the next number beyond does not."""
    index = PARAMETERS.index(parameter)

    def taken(value: float) -> bool:
        resets = sound(2)
        resets.parameters[0, index] = value
        assert validation.resets_are_sound(resets, TUBES) is not bool(faults(resets))
        return validation.resets_are_sound(resets, TUBES)

    if parameter.either:
        assert all(taken(value) for value in parameter.either)
        assert not taken(0.5)
        return
    for bound, beyond in ((parameter.lowest, -math.inf), (parameter.highest, math.inf)):
        if math.isfinite(bound):
            assert taken(bound) is not (parameter.above_lowest and bound == parameter.lowest)
            assert not taken(np.nextafter(bound, beyond))
        assert not taken(beyond)
