"""Core rules and rules of lanes for agents: what one whole session looks like from the physics side."""

from __future__ import annotations

import math
import os
import struct
import sys
from collections.abc import Iterator
from pathlib import PurePosixPath, PureWindowsPath
from typing import Final

from protocol import layout
from protocol.conformance.flight import Flight, flown, meeting, unnamed_bytes
from protocol.conformance.raw_physics import Request
from protocol.conformance.rig import Rig
from protocol.conformance.rule import Failure, Level, Skip, agent_rule, demand, expect
from protocol.handshake import SessionSettings, owner, read_offer
from protocol.layout import COMMAND, HEADER, Op
from protocol.liveness import start_time
from protocol.plant import ResetBatch
from protocol.states import Event, State
from protocol.toy import SPEED_MAX
from protocol.validation import command_refusal, reset_refusal

CORE: Final = Level.CORE
_ASKS: Final = tuple((State.READY, Event(op)) for op in Op)
_ANSWERED: Final = tuple((state, Event.DONE) for state in (State.STEPPING, State.RESETTING, State.CLOSING))


# --- handshake ---


@agent_rule(
    "header-sound",
    CORE,
    "3",
    "the header's words are as the table says",
    covers=((State.ABSENT, Event.OFFER),),
)
def _header_sound(rig: Rig) -> str:
    """Magic, version, lanes, times, slots, strides and stated size agree with each other and with the segments."""
    flight = flown(rig)
    try:
        settings = read_offer(memoryview(flight.offer)).settings
    except Exception as error:  # whatever makes it unreadable
        raise Failure("the agent's header", "every field as specified", error) from error
    expect("size of .cmd", len(flight.offer), layout.command_bytes(settings.lanes))
    expect("size of .pose", flight.pose_bytes, layout.pose_bytes(settings.lanes))
    return _in_words(settings)


def _in_words(settings: SessionSettings) -> str:
    return f"{settings.lanes} lanes, dt {settings.dt:g} s, {settings.inner_steps} inner steps"


@agent_rule("header-whole-at-magic", CORE, "4", "the header is whole when its magic shows")
def _header_whole(rig: Rig) -> None:
    """What stands with the magic still stands when the first request comes."""
    flight = flown(rig)
    for f in HEADER:
        expect(f"{f.name} when the magic showed", flight.offer[f.bytes], flight.offer_later[f.bytes])


@agent_rule("header-process", CORE, "10", "pid and start time in the header are the agent's own")
def _header_process(rig: Rig) -> None:
    """The pid is of the process that was started or of one that it started."""
    with meeting(rig) as physics:
        pid, started = owner(physics.command)
        try:
            group = os.getpgid(pid) if pid > 0 else 0
        except ProcessLookupError:
            group = 0
        demand(
            group == physics.process.pid, "pid", f"{physics.process.pid} or a process that it started", pid
        )
        if sys.platform == "linux":
            expect("start_time, field 22 of /proc/PID/stat", started, start_time(pid))


@agent_rule("session-random", CORE, "3", "the session's identity is another in every session")
def _session_random(rig: Rig) -> None:
    """Two sessions of the same agent have two identities, neither of them zero."""
    first = flown(rig).offer[COMMAND["session"].bytes]
    demand(any(first), "session", "random bytes", "zero")
    with meeting(rig) as physics:
        second = bytes(physics.command[COMMAND["session"].bytes])
    demand(first != second, "session of a second run", "another than that of the first", second.hex())


@agent_rule("command-locked", CORE, "2", "the agent holds the lock on its segment")
def _command_locked(rig: Rig) -> None:
    """Nobody else would get the lock while the session is offered."""
    demand(flown(rig).locked, "the lock on .cmd", "held by the agent", "free")


@agent_rule("segments-new", CORE, "2", "both segments are zero when they are new, but for the agent's header")
def _segments_new(rig: Rig) -> None:
    """The pose segment is blank, and the command segment has a header alone."""
    flight = flown(rig)
    demand(flight.blank_pose, ".pose when the magic showed", "zero bytes", "something else")
    demand(
        not any(flight.offer[layout.WORD * 16 :]), ".cmd behind the header", "zero bytes", "something else"
    )


@agent_rule("memory-reserved", CORE, "2", "the memory of both segments is reserved when they are created")
def _memory_reserved(rig: Rig) -> None:
    """A segment has storage behind all its bytes, so that a full /dev/shm is no bus error later."""
    flight = flown(rig)
    if rig.transport != "shm":
        raise Skip("a file system may say otherwise what it has reserved; shm shows it")
    for name, size in flight.reserved.items():
        stated = len(flight.offer) if name.endswith(".cmd") else flight.pose_bytes
        demand(size >= stated, f"storage behind {name}", f"at least {stated} bytes", size)


# --- requests ---


def number_faults(requests: list[Request]) -> Iterator[str]:
    """What is wrong with the numbers of requests."""
    for due, request in enumerate(requests, start=1):
        if not request.rung == request.begin == request.end == due:
            yield (
                f"request {due}: doorbell {request.rung}, begin {request.begin}, end {request.end} "
                f"where each is {due}"
            )


def step_faults(requests: list[Request], refused: frozenset[int] = frozenset()) -> Iterator[str]:
    """What is wrong with the step counts of requests, of which those of the numbers `refused` were refused."""
    steps = 0
    for number, request in enumerate(requests, start=1):
        due = steps + 1 if request.op == Op.STEP else steps
        if request.step != due:
            yield f"{request.name}: step {request.step} where {due} was due"
        if request.op == Op.STEP and number not in refused:
            steps += 1


def _none(what: str, faults: Iterator[str]) -> None:
    for fault in faults:
        raise Failure(what, "none at fault", fault)


@agent_rule(
    "request-numbers",
    CORE,
    "5",
    "requests are numbered from 1, and begin, end and doorbell are the number",
    covers=_ASKS + _ANSWERED,
)
def _request_numbers(rig: Rig) -> str:
    """No number is skipped or repeated, whatever is asked for, and no request is torn."""
    requests = flown(rig).requests
    _none("numbers of requests", number_faults(requests))
    return f"{len(requests)} requests"


@agent_rule("request-ops", CORE, "6", "every op is known, and nothing is asked after the goodbye")
def _request_ops(rig: Rig) -> str:
    """Only the five requests of the specification are made."""
    requests = flown(rig).requests
    for request in requests:
        demand(request.op in tuple(Op), f"op of request {request.rung}", "1 to 5", request.op)
    counts = {op.name.lower(): sum(r.op == op for r in requests) for op in Op}
    return ", ".join(f"{count} {name}" for name, count in counts.items() if count)


@agent_rule("request-steps", CORE, "5", "the step count of every request is the one that is due")
def _request_steps(rig: Rig) -> None:
    """A step request carries the last count plus one, every other one the count as it is."""
    flight = flown(rig)
    flight.of(Op.STEP)
    refused = frozenset(int(line.split()[1]) for line in flight.refused)
    _none("step counts", step_faults(flight.requests, refused))


@agent_rule(
    "resets-sound", CORE, "6", "every reset row that is selected is finite, of unit length and in its ranges"
)
def _resets_sound(rig: Rig) -> None:
    """Also its tube is registered or -1, and its reserved words are zero."""
    for request, tubes in _with_tubes(flown(rig)):
        if request.op == Op.RESET:
            refusal = reset_refusal(request.resets, tubes)
            demand(refusal is None, request.name, "sound reset rows", refusal)


@agent_rule("resets-first", CORE, "6", "every lane is reset before the first step")
def _resets_first(rig: Rig) -> None:
    """A step of a lane that was never reset has no beginning."""
    flight, reset = flown(rig), set[int]()
    first = flight.of(Op.STEP)[0].rung
    for request in flight.of(Op.RESET):
        if request.rung < first:
            reset.update(_selected(request.resets))
    expect(f"lanes that were reset before request {first}, the first step", reset, set(range(flight.lanes)))


@agent_rule(
    "commands-sound",
    CORE,
    "6",
    "every command has a unit direction, a speed up to speed_max, and c from 0 to 2",
)
def _commands_sound(rig: Rig) -> str:
    """The physics side published a speed_max of its own; reserved words are zero."""
    fastest = 0.0
    for request in flown(rig).of(Op.STEP):
        refusal = command_refusal(request.commands, SPEED_MAX)
        demand(refusal is None, request.name, "sound command rows", refusal)
        fastest = max(fastest, float(request.commands.speed.max()))
    return f"up to {fastest:.3g} of {SPEED_MAX:g} m/s"


def _with_tubes(flight: Flight) -> Iterator[tuple[Request, set[int]]]:
    """Requests with the indices that are registered when they come."""
    tubes: set[int] = set()
    for request in flight.requests:
        yield request, tubes
        if request.op == Op.REGISTER_TUBE:
            tubes.add(_word(request, "tube_index"))
        elif request.op == Op.RELEASE_TUBE:
            tubes.discard(_word(request, "tube_index"))


def _word(request: Request, name: str) -> int:
    return layout.read_i64(memoryview(request.segment), COMMAND[name])


def _selected(resets: ResetBatch) -> list[int]:
    return [lane for lane, chosen in enumerate(resets.selected.tolist()) if chosen == 1]


@agent_rule(
    "tubes-sound",
    CORE,
    "6",
    "a tube is registered with a free index, an absolute path and a scale above zero",
)
def _tubes_sound(rig: Rig) -> None:
    """Also its path is UTF-8 of the stated length, and its axes are 0 or 1."""
    flight = flown(rig)
    flight.of(Op.REGISTER_TUBE)
    slots = int.from_bytes(flight.offer[COMMAND["tube_slots"].bytes], "little")
    for request, tubes in _with_tubes(flight):
        if request.op != Op.REGISTER_TUBE:
            continue
        index, size = _word(request, "tube_index"), _word(request, "tube_path_bytes")
        demand(
            0 <= index < slots and index not in tubes,
            f"index of {request.name}",
            f"free, below {slots}",
            index,
        )
        demand(
            _word(request, "tube_axes") in (0, 1),
            f"axes of {request.name}",
            "0 or 1",
            _word(request, "tube_axes"),
        )
        (scale,) = struct.unpack_from("<d", request.segment, COMMAND["tube_scale"].offset)
        demand(math.isfinite(scale) and scale > 0, f"scale of {request.name}", "> 0", scale)
        raw = request.segment[COMMAND["tube_path"].bytes][: max(size, 0)]
        path = raw.decode(errors="replace")
        absolute = PurePosixPath(path).is_absolute() or PureWindowsPath(path).is_absolute()
        demand(
            1 <= size <= COMMAND["tube_path"].count
            and path.encode() == raw
            and "\0" not in path
            and absolute,
            f"path of {request.name}",
            "an absolute path of the stated length, in UTF-8",
            f"{size} bytes, {path!r}",
        )


@agent_rule(
    "tube-releases-sound", CORE, "6", "a tube is released that is registered and that no lane flies in"
)
def _tube_releases_sound(rig: Rig) -> None:
    """The last reset of every lane put it elsewhere."""
    flight, flies_in = flown(rig), dict[int, int]()
    flight.of(Op.RELEASE_TUBE)
    for request, tubes in _with_tubes(flight):
        if request.op == Op.RESET:
            flies_in.update({lane: int(request.resets.tube[lane]) for lane in _selected(request.resets)})
        elif request.op == Op.RELEASE_TUBE:
            index = _word(request, "tube_index")
            demand(index in tubes, f"index of {request.name}", "a registered one", index)
            lanes = [lane for lane, tube in flies_in.items() if tube == index]
            demand(not lanes, f"lanes in the tube of {request.name}", "none", lanes)


# --- whose turn it is ---


@agent_rule(
    "writes-in-turn", CORE, "5", "nothing is written between a doorbell and its reply, nor into .pose ever"
)
def _writes_in_turn(rig: Rig) -> None:
    """The first request of each kind is left unanswered for a while."""
    _none("writes", iter(flown(rig).out_of_turn))


@agent_rule("unnamed-bytes", CORE, "3", "bytes of the command segment that no table names are zero")
def _unnamed_bytes(rig: Rig) -> None:
    """Also after the last request."""
    flight = flown(rig)
    for segment in (flight.offer, flight.requests[-1].segment):
        expect("bytes that no table names and that are not zero", unnamed_bytes(segment, flight.lanes), [])


# --- the end ---


@agent_rule("goodbye", CORE, "6", "the session ends with a goodbye, after which the agent's process ends")
def _goodbye(rig: Rig) -> None:
    """Nothing else follows it, and no farewell stands."""
    flight = flown(rig)
    expect("the last request", flight.requests[-1].op, Op.GOODBYE.value)
    demand(flight.ended, "the agent after its goodbye was answered", "to end within 5 s", "it still runs")
    expect("farewell", layout.read_i64(memoryview(flight.requests[-1].segment), COMMAND["farewell"]), 0)


@agent_rule("names-removed-first", CORE, "2", "the names of both segments are taken away before the goodbye")
def _names_removed_first(rig: Rig) -> None:
    """Should the agent be killed over its goodbye, nothing stays behind."""
    expect("names when the goodbye came", flown(rig).names_at_goodbye, [])


# --- lanes ---


@agent_rule(
    "lanes-own-commands",
    Level.LANES,
    "6",
    "with several lanes, every step has a sound command for every lane",
)
def _lanes_own_commands(rig: Rig) -> str:
    """No row is left blank or stale in a way that a physics side would refuse."""
    flight = _several_lanes(rig)
    for request in flight.of(Op.STEP):
        blank = [lane for lane, row in enumerate(request.commands.raw) if not row.any()]
        expect(f"lanes without a command in {request.name}", blank, [])
    return f"{flight.lanes} lanes"


def _several_lanes(rig: Rig) -> Flight:
    flight = flown(rig)
    if flight.lanes == 1:
        raise Skip("the agent offers one lane")
    return flight
