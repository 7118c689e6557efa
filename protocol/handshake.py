"""The two headers and the farewells: what each side writes once, and what the other checks of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from protocol import layout
from protocol.errors import HandshakeError, PeerLost, PeerViolation, SessionError
from protocol.layout import COMMAND, HEADER, POSE, Farewell, Field, read_f64, read_i64, read_text
from protocol.memory import FENCE
from protocol.plant import PARAMETER_SLOTS, PARAMETERS, PlantDescription

_HEAD = {field.name: field for field in HEADER}
_MULTIPLE_TOLERANCE = 1e-9


@dataclass(frozen=True)
class SessionSettings:
    """What the agent asks of a session.

    Raises:
        SessionError: a value is out of range, or `dt` is no whole multiple of `physics_dt` or too long a one.
    """

    lanes: int
    """Number of drones N."""
    dt: float
    """Control step (s)."""
    physics_dt: float
    """Inner step of the physics (s)."""
    tube_slots: int = 64
    """How many tubes may be registered at the same time."""

    def __post_init__(self) -> None:
        for name, most in (("lanes", layout.LANES_MAX), ("tube_slots", layout.TUBE_SLOTS_MAX)):
            if not 1 <= getattr(self, name) <= most:
                raise SessionError(f"{name}: expected 1 to {most}, found {getattr(self, name)}")
        for name in ("dt", "physics_dt"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise SessionError(f"{name}: expected a time in seconds > 0, found {getattr(self, name)}")
        steps, most = self.dt / self.physics_dt, layout.INNER_STEPS_MAX
        if steps > most + 0.5:  # it may be infinite, which cannot be rounded
            raise SessionError(
                f"dt: expected at most {most} inner steps of physics_dt = {self.physics_dt:.12g} s, "
                f"found {self.dt:.12g} s, {steps:.12g} of them; shorten dt or lengthen physics_dt"
            )
        if not _is_multiple(self.dt, self.physics_dt, self.inner_steps):
            nearest = self.inner_steps * self.physics_dt
            raise SessionError(
                f"dt: expected a whole multiple of physics_dt = {self.physics_dt:.12g} s, found {self.dt:.12g} s; "
                f"the nearest is {nearest:.12g} s ({self.inner_steps} inner steps)"
            )

    @property
    def inner_steps(self) -> int:
        """Inner steps of one control step."""
        return max(1, round(self.dt / self.physics_dt))


@dataclass(frozen=True)
class Offer:
    """The agent's header: the session that it offers and who it is."""

    settings: SessionSettings
    session: bytes  # 16 random bytes
    pid: int
    started: int


@dataclass(frozen=True)
class Answer:
    """The physics side's header: what it is."""

    description: PlantDescription
    pid: int
    started: int


def write_offer(view: memoryview, offer: Offer) -> None:
    """Write the agent's header, its magic last."""
    _write_common(view, offer, layout.command_bytes(offer.settings.lanes), offer.pid, offer.started)
    _publish(view, layout.COMMAND_MAGIC)


def read_offer(view: memoryview) -> Offer:
    """Read and check the agent's header, whose magic stands.

    Raises:
        HandshakeError: a field is not what this version expects.
    """
    _check_head(view, layout.COMMAND_MAGIC, "command segment")
    lanes, slots = _value(view, "lanes"), _value(view, "tube_slots")
    dt, physics_dt = _time(view, "dt"), _time(view, "physics_dt")
    inner_steps = _value(view, "inner_steps")
    _demand("lanes", 1 <= lanes <= layout.LANES_MAX, f"1 to {layout.LANES_MAX}", lanes)
    _demand("tube_slots", 1 <= slots <= layout.TUBE_SLOTS_MAX, f"1 to {layout.TUBE_SLOTS_MAX}", slots)
    _demand("dt", math.isfinite(dt) and dt > 0, "a time > 0 s", dt)
    _demand("physics_dt", math.isfinite(physics_dt) and physics_dt > 0, "a time > 0 s", physics_dt)
    _demand(
        "inner_steps",
        1 <= inner_steps <= layout.INNER_STEPS_MAX and _is_multiple(dt, physics_dt, inner_steps),
        f"dt / physics_dt = {dt / physics_dt:.12g}, a whole number up to {layout.INNER_STEPS_MAX}",
        inner_steps,
    )
    for name, stride in (
        ("command_stride", layout.COMMAND_STRIDE),
        ("pose_stride", layout.POSE_STRIDE),
        ("reset_stride", layout.RESET_STRIDE),
    ):
        _demand(name, _value(view, name) == stride, str(stride), _value(view, name))
    _check_stated_size(view, layout.command_bytes(lanes), "command segment")
    settings = SessionSettings(lanes, dt, physics_dt, slots)
    return Offer(settings, _session(view), _value(view, "pid"), _value(view, "start_time"))


def write_answer(view: memoryview, offer: Offer, answer: Answer) -> None:
    """Write the physics side's header, which echoes the offer; its magic last."""
    said = answer.description
    _write_common(view, offer, layout.pose_bytes(offer.settings.lanes), answer.pid, answer.started)
    layout.write_f64(view, POSE["speed_max"], said.speed_max)
    layout.write_i64(view, POSE["walls"], int(said.walls))
    defaults = (*said.defaults, *(0.0,) * (PARAMETER_SLOTS - len(said.defaults)))
    layout.write_f64(view, POSE["defaults"], *defaults)
    layout.write_text(view, POSE["plant_name"], said.name)
    layout.write_text(view, POSE["plant_version"], said.version)
    layout.write_text(view, POSE["plant_engine"], said.engine)
    _publish(view, layout.POSE_MAGIC)


def read_answer(view: memoryview, offer: Offer) -> Answer:
    """Read and check the physics side's header, whose magic stands.

    Raises:
        HandshakeError: a field is not what this version expects, or does not echo the offer.
    """
    _check_head(view, layout.POSE_MAGIC, "pose segment")
    settings = offer.settings
    _demand("session", _session(view) == offer.session, offer.session.hex(), _session(view).hex())
    for name, expected in _echoed(settings).items():
        found = _time(view, name) if isinstance(expected, float) else _value(view, name)
        _demand(name, found == expected, repr(expected), found)
    _check_stated_size(view, layout.pose_bytes(settings.lanes), "pose segment")
    (speed_max,) = read_f64(view, POSE["speed_max"])
    _demand("speed_max", math.isfinite(speed_max) and speed_max > 0, "a speed > 0 m/s", speed_max)
    defaults = read_f64(view, POSE["defaults"])
    _demand("defaults", all(map(math.isfinite, defaults)), "finite numbers", defaults)
    walls = read_i64(view, POSE["walls"])
    _demand("walls", walls in (0, 1), "0 or 1", walls)
    description = PlantDescription(
        name=read_text(view, POSE["plant_name"]),
        version=read_text(view, POSE["plant_version"]),
        engine=read_text(view, POSE["plant_engine"]),
        speed_max=speed_max,
        defaults=defaults[: len(PARAMETERS)],
        walls=walls == 1,
    )
    return Answer(description, _value(view, "pid"), _value(view, "start_time"))


def magic(view: memoryview) -> bytes:
    """Return the segment's magic, zero bytes until its writer has finished the header; what is read next is newer."""
    word = bytes(view[_HEAD["magic"].bytes])
    if FENCE is not None:
        FENCE()
    return word


def owner(view: memoryview) -> tuple[int, int]:
    """Return pid and start time of a segment's writer, zeros where it has not written them."""
    return _value(view, "pid"), _value(view, "start_time")


def write_farewell(view: memoryview, reason: Farewell, text: str) -> None:
    """Say in our own segment why we leave; a farewell that stands already is kept."""
    if read_i64(view, COMMAND["farewell"]) != Farewell.NONE:
        return
    layout.write_text(view, COMMAND["farewell_text"], text)
    if FENCE is not None:
        FENCE()
    layout.write_i64(view, COMMAND["farewell"], reason)


def read_farewell(view: memoryview) -> tuple[int, str]:
    """Return why a segment's writer left, and what it says; (0, "") while it is there."""
    reason = read_i64(view, COMMAND["farewell"])
    if reason and FENCE is not None:
        FENCE()
    return (reason, read_text(view, COMMAND["farewell_text"])) if reason else (0, "")


def part(view: memoryview, error: BaseException, peer: memoryview | None = None) -> None:
    """Write the farewell that an error of ours, or one that we found in the peer, calls for.

    `peer` is the other side's segment: what only passes on a farewell that stands there is of kind 1.
    """
    passes_on = (
        isinstance(error, (SessionError, HandshakeError)) and peer is not None and read_farewell(peer)[0]
    )
    if passes_on or isinstance(error, PeerLost):
        write_farewell(view, Farewell.STOPPED, f"it gave up: {error}")
    elif isinstance(error, PeerViolation):
        write_farewell(view, Farewell.VIOLATION, str(error))
    elif isinstance(error, HandshakeError):
        write_farewell(view, Farewell.HANDSHAKE, str(error))
    elif not isinstance(error, Exception):  # KeyboardInterrupt, SystemExit, and what programs make of SIGTERM
        write_farewell(view, Farewell.STOPPED, f"it was told to stop ({type(error).__name__})")
    else:
        write_farewell(view, Farewell.FAILED, f"{type(error).__name__}: {error}")


def _echoed(settings: SessionSettings) -> dict[str, int | float]:
    return {
        "lanes": settings.lanes,
        "dt": float(settings.dt),
        "physics_dt": float(settings.physics_dt),
        "inner_steps": settings.inner_steps,
        "tube_slots": settings.tube_slots,
        "command_stride": layout.COMMAND_STRIDE,
        "pose_stride": layout.POSE_STRIDE,
        "reset_stride": layout.RESET_STRIDE,
    }


def _write_common(view: memoryview, offer: Offer, size: int, pid: int, started: int) -> None:
    numbers = {
        "pid": pid,  # first, so that a header cut short still tells whose it was
        "start_time": started,
        "version_major": layout.VERSION_MAJOR,
        "version_minor": layout.VERSION_MINOR,
        "segment_bytes": size,
        **_echoed(offer.settings),
    }
    for name, value in numbers.items():
        if isinstance(value, float):
            layout.write_f64(view, _HEAD[name], value)
        else:
            layout.write_i64(view, _HEAD[name], value)
    view[_HEAD["session"].bytes] = offer.session


def _publish(view: memoryview, word: bytes) -> None:
    if FENCE is not None:
        FENCE()
    # One store of a whole word: the other side never sees half a magic.
    with view.cast("q") as words:
        words[0] = int.from_bytes(word, "little", signed=True)


def _check_head(view: memoryview, word: bytes, segment: str) -> None:
    _demand(f"magic of the {segment}", magic(view) == word, repr(word), magic(view))
    major = _value(view, "version_major")
    _demand(
        f"version_major of the {segment}", major == layout.VERSION_MAJOR, str(layout.VERSION_MAJOR), major
    )


def check_size(view: memoryview, size: int, segment: str) -> None:
    """Raise a HandshakeError where a segment has not the bytes that its lanes need."""
    _demand(f"size of the {segment}", len(view) >= size, f"{size} bytes", len(view))


def _check_stated_size(view: memoryview, size: int, segment: str) -> None:
    stated = _value(view, "segment_bytes")
    _demand(f"segment_bytes of the {segment}", stated == size, str(size), stated)
    check_size(view, size, segment)


def _value(view: memoryview, name: str) -> int:
    return read_i64(view, _HEAD[name])


def _time(view: memoryview, name: str) -> float:
    return read_f64(view, _HEAD[name])[0]


def _session(view: memoryview) -> bytes:
    field: Field = _HEAD["session"]
    return bytes(view[field.bytes])


def _demand(field: str, holds: bool, expected: str, found: object) -> None:
    if not holds:
        raise HandshakeError(field, expected, repr(found))


def _is_multiple(dt: float, physics_dt: float, inner_steps: int) -> bool:
    return abs(inner_steps * physics_dt - dt) <= _MULTIPLE_TOLERANCE * dt
