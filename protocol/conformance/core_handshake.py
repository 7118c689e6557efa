"""Core rules of the handshake: who attaches when, what the header says, and which headers are not accepted."""

from __future__ import annotations

import itertools
import math
import os
import struct
import sys
import time
from typing import Final

from protocol import handshake, layout
from protocol.conformance.raw_agent import RawAgent, Value
from protocol.conformance.rig import PeerProcess, Rig, await_end, segments_left
from protocol.conformance.rule import Level, demand, expect, server_rule
from protocol.conformance.sound import done, parameter_names, resets
from protocol.layout import HEADER, POSE, POSE_MAGIC, Farewell, Field
from protocol.liveness import start_time
from protocol.plant import PARAMETERS
from protocol.states import Event, State

_NO_MAGIC: Final = bytes(8)
_MOMENT_S: Final = 0.05
"""Long enough for a header or a reply that is not whole to be completed."""
_LOOK_S: Final = 0.001
_ATTACH: Final = ((State.OFFERED, Event.ATTACH),)
_REFUSED_OFFER: Final = ((State.OFFERED, Event.FAREWELL),)


def _odd(rig: Rig) -> RawAgent:
    """Open a session whose every setting is unusual."""
    return rig.open(lanes=3, dt=0.07, inner_steps=7, tube_slots=11)


@server_rule(
    "header-whole-at-magic", Level.CORE, "4", "the header is whole when its magic shows", covers=_ATTACH
)
def header_whole_at_magic(rig: Rig) -> None:
    """What stands with the magic stays as it is."""
    agent = rig.open()
    seen = bytes(agent.pose[: POSE["farewell"].offset])
    time.sleep(_MOMENT_S)
    later = bytes(agent.pose[: POSE["farewell"].offset])
    for field in layout.POSE_SEGMENT:
        if field.offset < POSE["farewell"].offset:
            expect(f"bytes of {field.name} when the magic showed", seen[field.bytes], later[field.bytes])


@server_rule("header-echoes", Level.CORE, "4", "the header echoes session, lanes, times, slots and strides")
def header_echoes(rig: Rig) -> None:
    """Every echoed word has the bits of the agent's."""
    agent = _odd(rig)
    echoed = [field for field in HEADER if field.name == "session" or field.offset >= POSE["lanes"].offset]
    for field in echoed:
        found, sent = bytes(agent.pose[field.bytes]), bytes(agent.command[field.bytes])
        demand(found == sent, field.name, _in_words(sent, field), _in_words(found, field))


def _in_words(raw: bytes, field: Field) -> str:
    """Write a header's word as what it is."""
    return (
        raw.hex()
        if field.kind == "bytes"
        else str(struct.unpack("<q" if field.kind == "i64" else "<d", raw)[0])
    )


@server_rule("header-version", Level.CORE, "13", "the header carries version 1 and a minor version")
def header_version(rig: Rig) -> None:
    """The major version is ours; any minor one is accepted."""
    agent = rig.open()
    expect("version_major", agent.get("version_major"), layout.VERSION_MAJOR)
    demand(agent.get("version_minor") >= 0, "version_minor", "a number >= 0", agent.get("version_minor"))


@server_rule("header-size", Level.CORE, "3", "the header states the size of the pose segment: 3264 + 128 N")
def header_size(rig: Rig) -> None:
    """The stated size is that of the table."""
    expect("segment_bytes", _odd(rig).get("segment_bytes"), layout.pose_bytes(3))


@server_rule("header-process", Level.CORE, "10", "pid and start time in the header are the server's own")
def header_process(rig: Rig) -> None:
    """The pid is of the process that was started or of one that it started."""
    agent = rig.open()
    assert agent.process is not None
    pid, started = handshake.owner(agent.pose)
    try:
        group = os.getpgid(pid) if pid > 0 else 0
    except ProcessLookupError:
        group = 0
    demand(group == agent.process.pid, "pid", f"{agent.process.pid} or a process that it started", pid)
    if sys.platform == "linux":
        expect("start_time, field 22 of /proc/PID/stat", started, start_time(pid))


@server_rule("header-speed-max", Level.CORE, "3", "speed_max is finite and > 0")
def header_speed_max(rig: Rig) -> None:
    """Commands have a range."""
    (speed,) = layout.read_f64(rig.open().pose, POSE["speed_max"])
    demand(math.isfinite(speed) and speed > 0, "speed_max", "a finite speed > 0", speed)


@server_rule("header-walls", Level.CORE, "3", "walls is 0 or 1")
def header_walls(rig: Rig) -> None:
    """Whether contact is reported is said in one of two words."""
    walls = rig.open().get("walls")
    demand(walls in (0, 1), "walls", "0 or 1", walls)


@server_rule(
    "header-defaults", Level.CORE, "3", "the default parameters are within their ranges and can be sent back"
)
def header_defaults(rig: Rig) -> None:
    """A reset with the defaults, which an agent sends back, is carried out; reserved words are zero."""
    agent = rig.open()
    defaults = layout.read_f64(agent.pose, POSE["defaults"])
    for name, value in zip(parameter_names(), defaults, strict=False):
        demand(math.isfinite(value), f"default {name}", "a finite number", value)
    reserved = agent.get_bytes("defaults")[layout.WORD * len(PARAMETERS) :]
    expect("reserved words of the defaults", reserved, bytes(len(reserved)))
    done(agent.reset(resets(agent)), "a reset with the server's defaults")


@server_rule("header-texts", Level.CORE, "3", "the plant's texts are UTF-8, padded with zero bytes")
def header_texts(rig: Rig) -> None:
    """Name, version and engine can be read, and nothing stands behind their end."""
    agent = rig.open()
    for name in ("plant_name", "plant_version", "plant_engine"):
        raw = agent.get_bytes(name)
        text = raw.rstrip(b"\0")
        demand(b"\0" not in text, name, "zero bytes behind the text's end alone", raw)
        demand(text.decode(errors="replace").encode() == text, name, "UTF-8", raw)


@server_rule(
    "header-unnamed-bytes", Level.CORE, "3", "bytes of the pose segment that no table names stay zero"
)
def header_unnamed_bytes(rig: Rig) -> None:
    """After the handshake, a reset and a step, nothing stands between the fields."""
    agent = rig.open()
    done(agent.reset(resets(agent)), "a reset")
    named = sorted((field.offset, field.offset + field.size) for field in layout.POSE_SEGMENT)
    for (_, end), (start, _) in itertools.pairwise(named):
        written = [end + at for at, byte in enumerate(bytes(agent.pose[end:start])) if byte]
        expect(f"bytes of the pose segment from {end} to {start} that are not zero", written, [])


@server_rule("pose-locked", Level.CORE, "2", "the server holds the lock on its segment")
def pose_locked(rig: Rig) -> None:
    """Nobody else gets the lock while the session lives."""
    demand(not rig.open().locks_pose(), "the lock on .pose", "held by the server", "free")


@server_rule(
    "newer-minor-version", Level.CORE, "13", "a header of a newer minor version is accepted", covers=_ATTACH
)
def newer_minor_version(rig: Rig) -> None:
    """A minor version of 7 is no reason to leave."""
    agent = rig.agent()
    agent.offer(version_minor=7)
    agent.attend(rig.start())
    agent.await_header()


@server_rule(
    "waits-for-agent",
    Level.CORE,
    "4",
    "a server that was started first waits for the segments",
    covers=_ATTACH,
)
def waits_for_agent(rig: Rig) -> None:
    """The segments come to be while the server looks for them."""
    process = rig.start()
    time.sleep(0.3)
    agent = rig.agent()
    agent.offer()
    agent.attend(process)
    agent.await_header()


# --- headers that are not accepted ---


def _verdict(agent: RawAgent, process: PeerProcess) -> tuple[int, str]:
    """Wait until the server has said farewell, has ended, or has published a header all the same."""
    patience = time.monotonic() + agent.timeout
    while time.monotonic() < patience:
        if any(handshake.magic(agent.pose)) or agent.farewell()[0] or process.watch() is not None:
            break
        time.sleep(_LOOK_S)
    return agent.farewell()


def _turned_down(rig: Rig, names: tuple[str, ...], **words: Value) -> None:
    """Offer a header with wrong words: farewell 4 that names one of the fields, no magic, and the end."""
    rendezvous = rig.rendezvous if not segments_left(rig.rendezvous) else rig.new_rendezvous()
    agent = rig.agent(lanes=2, rendezvous=rendezvous)
    agent.offer(**words)
    process = rig.start(rendezvous)
    agent.attend(process)
    reason, text = _verdict(agent, process)
    said = f"a header with {', '.join(f'{name} = {value!r}' for name, value in words.items())}"
    expect(f"farewell to {said}", reason, int(Farewell.HANDSHAKE))
    plain = text.lower().replace("_", " ")
    named = any(name.replace("_", " ") in plain for name in names)
    demand(named, f"farewell text to {said}", f"one that names {' or '.join(names)}", repr(text))
    expect(f"magic of the pose segment, after {said}", handshake.magic(agent.pose), _NO_MAGIC)
    await_end(process, f"after {said}")
    agent.close()


@server_rule(
    "offer-magic", Level.CORE, "4", "another magic than TUBE.CMD is turned down", covers=_REFUSED_OFFER
)
def offer_magic(rig: Rig) -> None:
    """A pose segment's magic is not a command segment's."""
    _turned_down(rig, ("magic",), magic=POSE_MAGIC)


@server_rule(
    "offer-major-version", Level.CORE, "13", "another major version is turned down", covers=_REFUSED_OFFER
)
def offer_major_version(rig: Rig) -> None:
    """Neither an older nor a newer one is understood."""
    for version in (0, 2):
        _turned_down(rig, ("version_major", "version"), version_major=version)


@server_rule(
    "offer-lanes",
    Level.CORE,
    "4",
    "a number of lanes outside of 1 to 65536 is turned down",
    covers=_REFUSED_OFFER,
)
def offer_lanes(rig: Rig) -> None:
    """No lanes, and one too many, with a size that fits."""
    for lanes in (0, layout.LANES_MAX + 1):
        _turned_down(rig, ("lanes",), lanes=lanes, segment_bytes=layout.command_bytes(lanes))


@server_rule(
    "offer-times",
    Level.CORE,
    "4",
    "time steps that are not finite and > 0 are turned down",
    covers=_REFUSED_OFFER,
)
def offer_times(rig: Rig) -> None:
    """A dt that is no number, and a physics_dt below zero."""
    _turned_down(rig, ("dt",), dt=math.nan)
    _turned_down(rig, ("physics_dt",), physics_dt=-0.025)


@server_rule(
    "offer-inner-steps",
    Level.CORE,
    "4",
    "inner steps that do not make up dt are turned down",
    covers=_REFUSED_OFFER,
)
def offer_inner_steps(rig: Rig) -> None:
    """Five inner steps of a fourth of dt are not dt."""
    _turned_down(rig, ("inner_steps", "physics_dt", "dt"), inner_steps=5)


@server_rule(
    "offer-tube-slots",
    Level.CORE,
    "4",
    "tube slots outside of 1 to 65536 are turned down",
    covers=_REFUSED_OFFER,
)
def offer_tube_slots(rig: Rig) -> None:
    """There is at least one slot."""
    _turned_down(rig, ("tube_slots",), tube_slots=0)


@server_rule(
    "offer-strides", Level.CORE, "4", "rows of another length are turned down", covers=_REFUSED_OFFER
)
def offer_strides(rig: Rig) -> None:
    """Each of the three strides is looked at."""
    for name, stride in (
        ("command_stride", layout.COMMAND_STRIDE),
        ("pose_stride", layout.POSE_STRIDE),
        ("reset_stride", layout.RESET_STRIDE),
    ):
        _turned_down(rig, (name,), **{name: stride + layout.WORD})


@server_rule(
    "offer-size",
    Level.CORE,
    "4",
    "a stated size that does not fit the lanes is turned down",
    covers=_REFUSED_OFFER,
)
def offer_size(rig: Rig) -> None:
    """The size of three lanes is not that of two."""
    _turned_down(rig, ("segment_bytes", "size"), segment_bytes=layout.command_bytes(3))


@server_rule(
    "offer-short-mapping",
    Level.CORE,
    "4",
    "segments too short for their header are turned down",
    covers=_REFUSED_OFFER,
)
def offer_short_mapping(rig: Rig) -> None:
    """A header that speaks of 64 lanes in segments that hold two."""
    _turned_down(rig, ("size", "bytes", "segment"), lanes=64, segment_bytes=layout.command_bytes(64))
