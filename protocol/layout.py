"""The one table of bytes: where each word of the two segments stands, what it is, and what it means.

Everything else takes its offsets from here, and a test compares these tables with those in `README.md`.
All numbers are little endian; every word has 8 bytes and stands on an 8-byte boundary. Texts are UTF-8, padded
with zero bytes.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np

from protocol.plant import COMMAND_WORDS, PARAMETER_SLOTS, POSE_WORDS, RESET_WORDS, Floats

VERSION_MAJOR: Final = 1
VERSION_MINOR: Final = 1

COMMAND_MAGIC: Final = b"TUBE.CMD"
POSE_MAGIC: Final = b"TUBE.POS"

WORD: Final = 8
COMMAND_STRIDE: Final = COMMAND_WORDS * WORD
POSE_STRIDE: Final = POSE_WORDS * WORD
RESET_STRIDE: Final = RESET_WORDS * WORD

LANES_MAX: Final = 65_536
TUBE_SLOTS_MAX: Final = 65_536
INNER_STEPS_MAX: Final = 1_000_000


class Op(IntEnum):
    """What a request asks for."""

    STEP = 1
    RESET = 2
    REGISTER_TUBE = 3
    RELEASE_TUBE = 4
    GOODBYE = 5


class Status(IntEnum):
    """What a reply says."""

    DONE = 0
    REFUSED = 1


class Farewell(IntEnum):
    """Why a side left before the session's orderly end."""

    NONE = 0
    STOPPED = 1
    """It was told to stop (a signal, the user, the end of its program), or gave up waiting."""
    FAILED = 2
    """An error of its own; the text says which."""
    VIOLATION = 3
    """It found that the other side broke the protocol; the text says how."""
    HANDSHAKE = 4
    """It does not accept the other side's header; the text names field, expected and found."""


class Axes(IntEnum):
    """Which axis of a mesh file points up."""

    zup = 0
    yup = 1


@dataclass(frozen=True)
class Field:
    """One entry of a table of bytes: `count` words of kind i64 or f64, or `count` bytes."""

    offset: int
    name: str
    kind: str
    count: int
    meaning: str

    @property
    def size(self) -> int:
        """Bytes that the field takes."""
        return self.count if self.kind == "bytes" else self.count * WORD

    @property
    def word(self) -> int:
        """Index of the field's first 8-byte word."""
        return self.offset // WORD

    @property
    def bytes(self) -> slice:
        """The field's place among the bytes of its segment or row."""
        return slice(self.offset, self.offset + self.size)


HEADER: Final[tuple[Field, ...]] = (
    Field(0, "magic", "bytes", 8, "`TUBE.CMD` or `TUBE.POS`; written last, zero until then"),
    Field(8, "version_major", "i64", 1, "1"),
    Field(16, "version_minor", "i64", 1, "1"),
    Field(24, "segment_bytes", "i64", 1, "size of this segment"),
    Field(32, "session", "bytes", 16, "random identity of the session; physics echoes it"),
    Field(48, "pid", "i64", 1, "process id of the writer"),
    Field(56, "start_time", "i64", 1, "start of that process, in the system's own unit; 0: not known"),
    Field(64, "lanes", "i64", 1, "N, number of lanes, 1 to 65536"),
    Field(72, "dt", "f64", 1, "control step (s)"),
    Field(80, "physics_dt", "f64", 1, "inner step (s)"),
    Field(
        88,
        "inner_steps",
        "i64",
        1,
        "n, inner steps a control step, 1 to 1000000; n physics_dt = dt within 1e-9 dt",
    ),
    Field(96, "tube_slots", "i64", 1, "tube indices run from 0 to tube_slots - 1; 1 to 65536"),
    Field(104, "command_stride", "i64", 1, "bytes of a command row, 64"),
    Field(112, "pose_stride", "i64", 1, "bytes of a pose row, 128"),
    Field(120, "reset_stride", "i64", 1, "bytes of a reset row, 384"),
)
"""The header's common part: both segments begin with it; physics echoes everything from `lanes` on."""

FAREWELL: Final[tuple[Field, ...]] = (
    Field(1024, "farewell", "i64", 1, "0, or why the writer left; written after the text"),
    Field(1032, "farewell_text", "bytes", 1016, "what happened, for people"),
)

COMMAND_SEGMENT: Final[tuple[Field, ...]] = (
    *HEADER,
    *FAREWELL,
    Field(2048, "tube_index", "i64", 1, "register_tube, release_tube: 0 to tube_slots - 1"),
    Field(2056, "tube_axes", "i64", 1, "register_tube: axis of the file that points up, 0 Z, 1 Y"),
    Field(2064, "tube_scale", "f64", 1, "register_tube: metres per unit of the file, > 0"),
    Field(2072, "tube_sha256", "bytes", 32, "register_tube: SHA-256 of the file's bytes"),
    Field(2104, "tube_path_bytes", "i64", 1, "register_tube: length of the path, 1 to 4096"),
    Field(2112, "tube_path", "bytes", 4096, "register_tube: absolute path of the mesh file, UTF-8"),
    Field(6272, "doorbell", "i64", 1, "number of the last request published; alone in its 128 bytes"),
    Field(6400, "begin", "i64", 1, "number of the request; first word written"),
    Field(6408, "op", "i64", 1, "what is asked: 1 step, 2 reset, 3 register_tube, 4 release_tube, 5 goodbye"),
    Field(6416, "step", "i64", 1, "control steps integrated once the request is done"),
    Field(6424, "end", "i64", 1, "number of the request; last word written before the doorbell"),
    Field(6464, "commands", "f64", 0, "N command rows of 64 bytes; behind them N reset rows of 384 bytes"),
)

POSE_SEGMENT: Final[tuple[Field, ...]] = (
    *HEADER,
    Field(128, "speed_max", "f64", 1, "largest speed that a command may carry (m/s), > 0"),
    Field(
        136,
        "walls",
        "i64",
        1,
        "1: registered tubes stop the body and contact is reported; 0: not so or not said",
    ),
    Field(256, "defaults", "f64", PARAMETER_SLOTS, "the plant's default parameters, reserved words zero"),
    Field(512, "plant_name", "bytes", 128, "implementation, UTF-8"),
    Field(640, "plant_version", "bytes", 128, "its version, UTF-8"),
    Field(768, "plant_engine", "bytes", 128, "its engine and the engine's version, UTF-8"),
    *FAREWELL,
    Field(2048, "refusal_code", "i64", 1, "status 1: why the request was refused"),
    Field(2056, "refusal_lane", "i64", 1, "status 1: lane, or -1 where no lane is meant"),
    Field(2064, "refusal_field", "bytes", 112, "status 1: name of the field, UTF-8"),
    Field(2176, "refusal_expected", "bytes", 384, "status 1: what was expected, UTF-8"),
    Field(2560, "refusal_found", "bytes", 512, "status 1: what was found, UTF-8"),
    Field(3072, "doorbell", "i64", 1, "number of the last request answered; alone in its 128 bytes"),
    Field(3200, "begin", "i64", 1, "number of the request that is answered; first word written"),
    Field(3208, "status", "i64", 1, "0 done, 1 refused"),
    Field(3216, "step", "i64", 1, "control steps integrated in this session"),
    Field(3224, "engine_ns", "i64", 1, "how long the plant worked on this request (ns)"),
    Field(3232, "end", "i64", 1, "number of the request that is answered; last word before the doorbell"),
    Field(3264, "poses", "f64", 0, "N pose rows of 128 bytes"),
)

COMMAND_ROW: Final[tuple[Field, ...]] = (
    Field(0, "direction", "f64", 3, "unit vector d, world frame"),
    Field(24, "speed", "f64", 1, "v_cmd (m/s), 0 to speed_max"),
    Field(32, "compensation", "f64", 1, "c, fraction of the weight, 0 to 2"),
    Field(40, "reserved", "i64", 3, "zero"),
)

POSE_ROW: Final[tuple[Field, ...]] = (
    Field(0, "position", "f64", 3, "centre of mass (m), world frame"),
    Field(24, "quaternion", "f64", 4, "x y z w, body to world"),
    Field(56, "linear_velocity", "f64", 3, "of the centre of mass (m/s), world frame"),
    Field(80, "angular_velocity", "f64", 3, "(rad/s), world frame"),
    Field(104, "sim_time", "f64", 1, "simulated time since the lane's reset (s)"),
    Field(112, "contact_steps", "i64", 1, "inner steps of this control step with wall contact, 0 to n"),
    Field(120, "step", "i64", 1, "control steps since the lane's reset; a reset answers 0"),
)

RESET_ROW: Final[tuple[Field, ...]] = (
    Field(0, "position", "f64", 3, "centre of mass (m), world frame"),
    Field(24, "quaternion", "f64", 4, "x y z w, body to world, length 1"),
    Field(56, "linear_velocity", "f64", 3, "(m/s), world frame"),
    Field(80, "angular_velocity", "f64", 3, "(rad/s), world frame"),
    Field(104, "tube", "i64", 1, "index of a registered tube, or -1: free space"),
    Field(112, "seed", "i64", 1, "seed of the lane's gusts"),
    Field(
        120, "selected", "i64", 1, "1: reset this lane; 0: leave it alone, the row's other words mean nothing"
    ),
    Field(128, "parameters", "f64", PARAMETER_SLOTS, "plant parameters, reserved words zero"),
)

COMMAND: Final[dict[str, Field]] = {field.name: field for field in COMMAND_SEGMENT}
POSE: Final[dict[str, Field]] = {field.name: field for field in POSE_SEGMENT}

REQUEST_REST: Final = struct.Struct("<3q")
"""Words of a request after `begin`: op, step, end."""
REQUEST: Final = struct.Struct("<4q")
"""A whole request: begin, op, step, end."""
REPLY_REST: Final = struct.Struct("<4q")
"""Words of a reply after `begin`: status, step, engine_ns, end."""
REPLY: Final = struct.Struct("<5q")
"""A whole reply: begin, status, step, engine_ns, end."""


def command_bytes(lanes: int) -> int:
    """Size of the command segment."""
    return COMMAND["commands"].offset + lanes * (COMMAND_STRIDE + RESET_STRIDE)


def pose_bytes(lanes: int) -> int:
    """Size of the pose segment."""
    return POSE["poses"].offset + lanes * POSE_STRIDE


def command_rows(lanes: int) -> slice:
    """Bytes of the command rows in the command segment."""
    start = COMMAND["commands"].offset
    return slice(start, start + lanes * COMMAND_STRIDE)


def reset_rows(lanes: int) -> slice:
    """Bytes of the reset rows in the command segment."""
    start = COMMAND["commands"].offset + lanes * COMMAND_STRIDE
    return slice(start, start + lanes * RESET_STRIDE)


def pose_rows(lanes: int) -> slice:
    """Bytes of the pose rows in the pose segment."""
    start = POSE["poses"].offset
    return slice(start, start + lanes * POSE_STRIDE)


def read_i64(view: memoryview, field: Field) -> int:
    """Read the integer word of a field."""
    return int.from_bytes(view[field.bytes], "little", signed=True)


def write_i64(view: memoryview, field: Field, value: int) -> None:
    """Write the integer word of a field."""
    view[field.bytes] = value.to_bytes(WORD, "little", signed=True)


def read_f64(view: memoryview, field: Field) -> tuple[float, ...]:
    """Read the float words of a field."""
    return struct.unpack_from(f"<{field.count}d", view, field.offset)


def write_f64(view: memoryview, field: Field, *values: float) -> None:
    """Write the float words of a field; as many values as it has words."""
    struct.pack_into(f"<{field.count}d", view, field.offset, *values)


def read_text(view: memoryview, field: Field) -> str:
    """Read a padded text; bytes that are no UTF-8 are shown as replacement characters."""
    return bytes(view[field.bytes]).rstrip(b"\0").decode(errors="replace")


def write_text(view: memoryview, field: Field, text: str) -> None:
    """Write a text padded with zero bytes, cut at a character boundary where it is too long."""
    encoded = text.encode()[: field.count].decode(errors="ignore").encode()
    view[field.bytes] = encoded.ljust(field.count, b"\0")


def flat_bytes(raw: Floats, words: int, lanes: int, what: str) -> memoryview:
    """View a batch's block of rows as plain bytes, so that sending it is one copy.

    Raises:
        ValueError: `raw` is not a C-contiguous float64 array of shape (lanes, words).
    """
    if raw.shape != (lanes, words) or raw.dtype != np.float64 or not raw.flags.c_contiguous:
        raise ValueError(
            f"{what}: expected a contiguous float64 array of shape {(lanes, words)}, "
            f"found {raw.dtype} of shape {raw.shape}"
        )
    return raw.data.cast("B")


def markdown_table(fields: tuple[Field, ...]) -> str:
    """Write a table of bytes as it stands in the specification."""
    lines = ["| offset | field | type | meaning |", "| --- | --- | --- | --- |"]
    for field in fields:
        kind = f"{field.count} bytes" if field.kind == "bytes" else field.kind
        if field.kind != "bytes" and field.count != 1:
            kind = f"{field.kind} x {field.count or '...'}"
        lines.append(f"| {field.offset} | `{field.name}` | {kind} | {field.meaning} |")
    return "\n".join(lines)
