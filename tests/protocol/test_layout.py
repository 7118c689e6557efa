"""The byte table: the code, the specification and the arrays say the same."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from protocol import layout, states
from protocol.errors import RefusalCode
from protocol.layout import Field
from protocol.plant import PARAMETERS, CommandBatch, PoseBatch, ResetBatch

SPECIFICATION = (Path(layout.__file__).parent / "README.md").read_text(encoding="utf-8")
SEGMENTS = [layout.COMMAND_SEGMENT, layout.POSE_SEGMENT]
ROWS = [
    (layout.COMMAND_ROW, layout.COMMAND_STRIDE),
    (layout.POSE_ROW, layout.POSE_STRIDE),
    (layout.RESET_ROW, layout.RESET_STRIDE),
]


@pytest.mark.parametrize("fields", [*SEGMENTS, *(row for row, _ in ROWS)])
def test_the_specification_has_the_table_of_the_code(fields: tuple[Field, ...]) -> None:
    """Every byte table of the specification is the one in the code, line by line."""
    assert layout.markdown_table(fields) in SPECIFICATION


def test_the_specification_has_the_states_of_the_code() -> None:
    """The table of states of the specification is the one that both sides follow."""
    assert states.markdown_table() in SPECIFICATION


@pytest.mark.parametrize("code", RefusalCode)
def test_the_specification_has_every_refusal_code(code: RefusalCode) -> None:
    """Every refusal code stands in the specification with its number."""
    assert f"| {code.value} | {code.name} |" in SPECIFICATION


def test_the_specification_has_every_parameter_in_order() -> None:
    """The plant parameters stand in the specification with word, unit and range."""
    lines = [f"| {i} | `{p.name}` | {p.unit} | {p.range} | {p.meaning} |" for i, p in enumerate(PARAMETERS)]
    assert "\n".join(lines) in SPECIFICATION


@pytest.mark.parametrize("fields", [*SEGMENTS, *(row for row, _ in ROWS)])
def test_fields_stand_on_word_boundaries_and_do_not_overlap(fields: tuple[Field, ...]) -> None:
    """Every field begins on 8 bytes, behind the end of the one before it."""
    end = 0
    for field in fields:
        assert field.offset % layout.WORD == 0
        assert field.offset >= end
        end = field.offset + field.size


@pytest.mark.parametrize(("fields", "stride"), ROWS)
def test_rows_are_full(fields: tuple[Field, ...], stride: int) -> None:
    """The fields of a row cover all of its bytes."""
    assert sum(field.size for field in fields) == stride


@pytest.mark.parametrize("fields", SEGMENTS)
def test_doorbells_are_alone_in_128_bytes(fields: tuple[Field, ...]) -> None:
    """No other field shares the 128 bytes around a doorbell, and these are aligned."""
    (doorbell,) = (field for field in fields if field.name == "doorbell")
    assert doorbell.offset % 128 == 0
    for field in fields:
        if field is not doorbell:
            assert field.offset + field.size <= doorbell.offset or field.offset >= doorbell.offset + 128


def test_the_hot_words_of_one_lane_touch_few_cache_lines() -> None:
    """A step of one lane touches three cache lines of the command and four of the pose segment."""
    hot = {
        "command": (layout.COMMAND, ["doorbell", "begin", "op", "step", "end"], layout.command_rows(1)),
        "pose": (
            layout.POSE,
            ["doorbell", "begin", "status", "step", "engine_ns", "end"],
            layout.pose_rows(1),
        ),
    }
    lines = {
        name: {fields[word].offset // 64 for word in words}
        | {byte // 64 for byte in range(rows.start, rows.stop)}
        for name, (fields, words, rows) in hot.items()
    }
    assert {name: len(touched) for name, touched in lines.items()} == {"command": 3, "pose": 4}


@pytest.mark.parametrize(
    ("batch", "fields"),
    [
        (CommandBatch.zeros(2), layout.COMMAND_ROW),
        (PoseBatch.zeros(2), layout.POSE_ROW),
        (ResetBatch.zeros(2), layout.RESET_ROW),
    ],
)
def test_arrays_lie_as_the_table_says(
    batch: CommandBatch | PoseBatch | ResetBatch, fields: tuple[Field, ...]
) -> None:
    """Each named view of a batch is the words that the byte table gives to that field, in every lane."""
    batch.raw.view(np.int64)[...] = np.arange(batch.raw.size).reshape(batch.raw.shape)
    data = batch.raw.tobytes()
    for field in fields:
        if field.name == "reserved":
            continue
        values = getattr(batch, field.name)
        for lane in range(2):
            place = lane * batch.raw.shape[1] * layout.WORD + field.offset
            expected = struct.unpack_from(f"<{field.count}q", data, place)
            assert np.atleast_1d(values[lane]).view(np.int64).tolist() == list(expected), field.name


@pytest.mark.parametrize("lanes", [1, 2, 7])
def test_rows_follow_each_other_to_the_segment_end(lanes: int) -> None:
    """Command rows are followed by reset rows, and the segments end with their last row."""
    assert layout.command_rows(lanes).stop == layout.reset_rows(lanes).start
    assert layout.reset_rows(lanes).stop == layout.command_bytes(lanes) == 6464 + 448 * lanes
    assert layout.pose_rows(lanes).stop == layout.pose_bytes(lanes) == 3264 + 128 * lanes


def test_texts_are_cut_at_a_character() -> None:
    """A text that is too long loses whole characters, never half of one."""
    field = Field(0, "text", "bytes", 8, "")
    view = memoryview(bytearray(8))
    layout.write_text(view, field, "abcdefgé")
    assert layout.read_text(view, field) == "abcdefg"
