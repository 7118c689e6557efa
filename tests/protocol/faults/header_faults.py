"""Faults of the handshake."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable

from fault import Deliberate, fault

from protocol import handshake, layout, opening, physics
from protocol.errors import HandshakeError
from protocol.handshake import Answer, Offer, SessionSettings
from protocol.layout import COMMAND, POSE, POSE_MAGIC
from protocol.liveness import start_time
from protocol.memory import Rendezvous, Segment, Segments
from protocol.plant import Plant
from protocol.toy import ToyPlant

Tamper = Callable[[memoryview], None]


def header(rule: str, tamper: Tamper) -> None:
    """Register the fault that something in our header is wrong when its magic shows."""

    @fault(rule)
    def make() -> Plant:
        write = handshake.write_answer

        def write_answer(view: memoryview, offer: Offer, answer: Answer) -> None:
            header = memoryview(bytearray(len(view)))
            write(header, offer, answer)
            tamper(header)
            view[8:1024] = header[8:1024]
            view[:8] = POSE_MAGIC

        handshake.write_answer = write_answer
        return ToyPlant()


def word(name: str, value: int) -> Tamper:
    """A wrong integer."""
    return lambda view: layout.write_i64(view, POSE[name], value)


header("header-echoes", word("tube_slots", 64))
header("header-version", word("version_major", 2))
header("header-size", word("segment_bytes", 8192))
header("header-process", word("pid", os.getppid()))
header("header-walls", word("walls", 2))
header("header-speed-max", lambda view: layout.write_f64(view, POSE["speed_max"], math.inf))
header("header-defaults", lambda view: layout.write_f64(view, POSE["defaults"], *[0.0] * 32))
header("header-texts", lambda view: view.__setitem__(slice(512, 519), "Müller!".encode("latin-1")))
header("header-unnamed-bytes", lambda view: view.__setitem__(900, 1))


@fault("header-whole-at-magic")
def magic_first() -> Plant:
    """The magic is the first word written."""
    write = handshake.write_answer

    def write_answer(view: memoryview, offer: Offer, answer: Answer) -> None:
        view[:8] = POSE_MAGIC
        time.sleep(0.02)
        write(view, offer, answer)

    handshake.write_answer = write_answer
    return ToyPlant()


@fault("pose-locked")
def no_lock() -> Plant:
    """The lock is never taken."""
    Segment.lock = lambda self: True  # type: ignore[method-assign]
    return ToyPlant()


def refuses(wrong: Callable[[memoryview], bool]) -> Plant:
    """Turn down a header that is sound."""
    read = handshake.read_offer

    def read_offer(view: memoryview) -> Offer:
        if wrong(view):
            raise HandshakeError("version_minor", "1", "another")
        return read(view)

    handshake.read_offer = read_offer
    return ToyPlant()


@fault("newer-minor-version")
def one_minor_version() -> Plant:
    """No minor version but its own."""
    return refuses(lambda view: layout.read_i64(view, COMMAND["version_minor"]) != 1)


@fault("waits-for-agent")
def impatient() -> Plant:
    """It serves what was there when it was started, and nothing else."""
    since_boot = start_time(os.getpid()) / os.sysconf("SC_CLK_TCK")
    started = time.time() - time.clock_gettime(time.CLOCK_BOOTTIME) + since_boot
    attach = opening.attach_segments

    def attach_segments(place: Rendezvous, timeout: float, launcher: int | None = None) -> Segments:
        segments = attach(place, timeout, launcher)
        if os.fstat(segments.command._descriptor).st_ctime > started + 0.05:
            raise Deliberate("the session came late")
        return segments

    physics.attach_segments = attach_segments
    return ToyPlant()


@fault("offer-magic", "offer-major-version", "offer-inner-steps", "offer-tube-slots", "offer-size")
def accepts_any_header() -> Plant:
    """Whatever is wrong with the agent's header, it goes on."""
    return answering_wrong_headers(lambda error: None)


@fault("offer-lanes", "offer-short-mapping")
def header_as_an_error() -> Plant:
    """A wrong header ends in an error of its own, farewell 2."""

    def fail(error: HandshakeError) -> None:
        raise Deliberate(str(error))

    return answering_wrong_headers(fail)


@fault("offer-times")
def silent_about_the_field() -> Plant:
    """The farewell does not say what was wrong."""

    def fail(error: HandshakeError) -> None:
        raise HandshakeError("something", "better", "worse")

    return answering_wrong_headers(fail)


@fault("offer-strides")
def one_stride() -> Plant:
    """It looks at the first of the strides alone."""

    def fail(error: HandshakeError) -> None:
        if error.field == "command_stride":
            raise error

    return answering_wrong_headers(fail)


def answering_wrong_headers(react: Callable[[HandshakeError], None]) -> Plant:
    """Let `react` raise what it likes to a wrong header; else a session of two lanes is taken for granted."""
    read = handshake.read_offer

    def read_offer(view: memoryview) -> Offer:
        try:
            return read(view)
        except HandshakeError as error:
            react(error)
            return Offer(SessionSettings(2, 0.1, 0.025, 4), bytes(16), *handshake.owner(view))

    handshake.read_offer = read_offer
    return ToyPlant()
