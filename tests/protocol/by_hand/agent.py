"""A small agent by hand, two lanes, one tube: `agent.py RULE RENDEZVOUS`."""

from __future__ import annotations

import os
import signal
import struct
import sys
import time

from common import (
    COMMAND_MAGIC,
    COMMAND_STRIDE,
    DT,
    FAREWELL,
    FAREWELL_TEXT,
    GOODBYE,
    HANDSHAKE,
    HEADER_BYTES,
    INNER_STEPS,
    LANES,
    LOOK_S,
    NO_MAGIC,
    PHYSICS_DT,
    PID,
    POSE_MAGIC,
    POSE_STRIDE,
    REGISTER_TUBE,
    RELEASE_TUBE,
    RESET,
    RESET_STRIDE,
    SEGMENT_BYTES,
    SESSION,
    START_TIME,
    STEP,
    STOPPED,
    TEXT_BYTES,
    TUBE_SLOTS,
    VERSION_MAJOR,
    VERSION_MINOR,
    VIOLATION,
    Left,
    Segment,
    keeps,
    lives,
    path,
    start_time,
    told_to_stop,
)

N = 2
STEPS = 8
TUBE_INDEX, TUBE_AXES, TUBE_SCALE, TUBE_PATH_BYTES, TUBE_PATH = 2048, 2056, 2064, 2104, 2112
DOORBELL, BEGIN, OP, COUNT, END, COMMANDS = 6272, 6400, 6408, 6416, 6424, 6464
RESETS = COMMANDS + 64 * N
COMMAND_BYTES, POSE_BYTES = RESETS + 384 * N, 3264 + 128 * N
REPLY_DOORBELL, REPLY_BEGIN, REPLY_STATUS, REPLY_COUNT, REPLY_END = 3072, 3200, 3208, 3216, 3232
SPEED_MAX, WALLS, DEFAULTS = 128, 136, 256
NO_TUBE = -1


def alive(pose: Segment) -> bool:
    """Whether the physics side lives."""
    return lives(
        pose[PID], pose[START_TIME], zombie="physics-zombie", reused="physics-pid-reused", stopped=""
    )


# --- the two segments ---


def create(suffix: str, size: int) -> Segment:
    """Create a segment, in place of one whose agent is dead."""
    name = path(suffix)
    while True:
        try:
            descriptor = os.open(name, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
            break
        except FileExistsError:
            old = Segment(name, os.open(name, os.O_RDWR))
            if not is_stale(old, suffix):
                sys.exit(f"{name} is in use")
            old.unlink()
    if keeps("memory-reserved"):
        os.posix_fallocate(descriptor, 0, size)
    else:
        os.ftruncate(descriptor, size)
    return Segment(name, descriptor)


def is_stale(old: Segment, suffix: str) -> bool:
    """Whether a segment that is there may be removed."""
    if old.size < HEADER_BYTES or old.map[:8] not in (COMMAND_MAGIC, POSE_MAGIC, NO_MAGIC):
        return not keeps("foreign-file-refused")
    if suffix == ".pose":
        return True
    dead = not lives(old[PID], old[START_TIME], zombie="", reused="", stopped="")
    if not keeps("living-rendezvous-refused"):
        return dead  # whoever has the lock
    return dead and old.lock() and keeps("stale-rendezvous-replaced")


def offer() -> tuple[Segment, Segment]:
    """Create both segments and write the header."""
    command = create(".cmd", COMMAND_BYTES)
    if keeps("command-locked") and not command.lock():
        sys.exit("somebody else has the lock")
    pose = create(".pose", POSE_BYTES)
    if not keeps("segments-new"):
        command[TUBE_PATH] = 1
    if not keeps("unnamed-bytes"):
        command[200] = 1
    pid = os.getpid() if keeps("header-process") else os.getppid()
    command[PID], command[START_TIME] = pid, start_time(pid)[1]
    command[VERSION_MAJOR] = 1
    command[SEGMENT_BYTES] = COMMAND_BYTES if keeps("header-sound") else COMMAND_BYTES + 8
    command.map[SESSION : SESSION + 16] = os.urandom(16) if keeps("session-random") else b"always the same."
    command[LANES], command[INNER_STEPS], command[TUBE_SLOTS] = N, 4, 4
    struct.pack_into("<2d", command.map, DT, 0.02, 0.005)
    command[COMMAND_STRIDE], command[POSE_STRIDE], command[RESET_STRIDE] = 64, 128, 384
    if keeps("header-whole-at-magic"):
        command[VERSION_MINOR] = 1
    command[0] = int.from_bytes(COMMAND_MAGIC, "little")
    if not keeps("header-whole-at-magic"):
        time.sleep(0.1)
        command[VERSION_MINOR] = 1
    return command, pose


def read_header(command: Segment, pose: Segment) -> None:
    """Wait for the physics side's header and check it."""
    while pose.map[:8] == NO_MAGIC:
        time.sleep(0.001)
        if pose[FAREWELL]:
            raise Left(STOPPED, "the physics side left")
        if pose[PID] and not alive(pose) and not keeps("physics-replaced"):
            raise Left(STOPPED, "the physics side died before its magic")
    (speed,) = struct.unpack_from("<d", pose.map, SPEED_MAX)
    defaults = struct.unpack_from("<32d", pose.map, DEFAULTS)
    echoes = {
        "lanes": LANES, "dt": DT, "physics_dt": PHYSICS_DT, "inner_steps": INNER_STEPS, "tube_slots": TUBE_SLOTS,
        "command_stride": COMMAND_STRIDE, "pose_stride": POSE_STRIDE, "reset_stride": RESET_STRIDE,
    }  # fmt: skip
    same_session = pose.map[SESSION : SESSION + 16] == command.map[SESSION : SESSION + 16]
    demand("answer-magic", "magic", pose.map[:8] == POSE_MAGIC)
    demand("answer-major-version", "version_major", pose[VERSION_MAJOR] == 1)
    demand("answer-session", "session", same_session)
    for name, at in echoes.items():
        if name == "reset_stride" or keeps("answer-echoes"):  # the last one alone would be missed
            demand("answer-echoes", name, pose[at] == command[at])
    demand("answer-size", "segment_bytes", pose[SEGMENT_BYTES] == POSE_BYTES)
    demand("answer-speed-max", "speed_max", 0 < speed < float("inf"))
    demand("answer-defaults", "defaults", all(abs(value) < float("inf") for value in defaults))
    demand("answer-walls", "walls", pose[WALLS] in (0, 1))
    if not keeps("newer-minor-version") and pose[VERSION_MINOR] > 1:
        raise Left(HANDSHAKE, "version_minor: expected 1")


def demand(rule: str, field: str, holds: bool) -> None:
    """Turn a header down that does not hold, unless this peer breaks the rule about it."""
    if not holds and keeps(rule):
        raise Left(HANDSHAKE, f"{field}: expected what was agreed, found another")


# --- one exchange ---


class Agent:
    """The session from READY on."""

    def __init__(self, command: Segment, pose: Segment) -> None:
        self.command, self.pose = command, pose
        self.number = self.steps = 0

    def ask(self, op: int) -> bool:
        """Publish a request whose payload stands and take the reply; False where it was refused."""
        command, pose = self.command, self.pose
        if pose[REPLY_DOORBELL] != self.number and keeps("reply-early"):
            raise Left(VIOLATION, f"answered request {self.number + 1} before it was made")
        self.number += 1
        due = self.steps + 1 if op == STEP else self.steps
        command[BEGIN] = self.number
        command[OP] = op if keeps("request-ops") or op != RELEASE_TUBE else 6
        command[COUNT] = due if keeps("request-steps") or op == STEP else due + 1
        command[END] = self.number if keeps("request-numbers") or op != GOODBYE else 0
        command[DOORBELL] = self.number
        if not keeps("writes-in-turn") and op == STEP:
            time.sleep(0.01)
            command[COMMANDS] = 0
        began = time.monotonic()
        self.wait(op)
        if not keeps("agent-paused") and time.monotonic() - began > 0.1:
            self.number += 1  # it thinks that it has missed one
            return True
        rung, (begin, status, count, _, end) = (
            pose[REPLY_DOORBELL],
            struct.unpack_from("<5q", pose.map, REPLY_BEGIN),
        )
        if rung != self.number and keeps("reply-number"):
            raise Left(VIOLATION, f"rang with {rung} where {self.number} was due")
        self.number = rung
        self.check(op, begin == rung, end == rung, status, count, due)
        if status != 1:
            self.steps = due
        elif not keeps("refusals-taken"):
            raise Left(STOPPED, "it was refused something")
        return bool(status != 1)

    def check(self, op: int, begins: bool, ends: bool, status: int, count: int, due: int) -> None:
        """Check a reply; the last state that the rules try is the one in which a check is left out."""
        last = op == GOODBYE
        if not begins and (keeps("reply-begin") or not last):
            raise Left(VIOLATION, "published a torn reply, its begin another's")
        if not ends and (keeps("reply-end") or not last):
            raise Left(VIOLATION, "published a torn reply, its end another's")
        if status not in (0, 1) and keeps("reply-status"):
            raise Left(VIOLATION, f"answered with status {status}")
        expected = self.steps if status == 1 else due
        rule = "reply-refusal-step" if status == 1 else "reply-step"
        if count != expected and keeps(rule):
            raise Left(VIOLATION, f"answered at step {count} where {expected} was due")

    def wait(self, op: int) -> None:
        """Wait for the reply."""
        before, began, looked = self.number - 1, time.monotonic(), time.monotonic()
        while self.pose[REPLY_DOORBELL] == before:
            now = time.monotonic()
            if not keeps("physics-paused") and now - began > 0.5:
                raise Left(STOPPED, "no answer within 0.5 s")
            if now - looked > LOOK_S:
                looked = now
                self.look(op)
            time.sleep(0.0005)

    def look(self, op: int) -> None:
        """Look at the physics side; the ends of two rules are overlooked in the last state that they try."""
        gone = not alive(self.pose) and (keeps("physics-killed") or op != GOODBYE)
        left = self.pose[FAREWELL] != 0 and (keeps("physics-farewell") or op != GOODBYE)
        if (gone or left) and self.pose[REPLY_DOORBELL] == self.number - 1:
            raise Left(STOPPED, "the physics side is gone")

    # --- what it asks for ---

    def fly(self) -> None:
        """Ask for a little of everything; a refusal ends it early."""
        self.put_tube()
        if not self.ask(REGISTER_TUBE) or not self.reset(0):
            return
        for _ in range(STEPS):
            if not keeps("reply-early"):
                time.sleep(0.03)  # it thinks, so that there is time for an early reply
            self.put_commands()
            if not self.ask(STEP):
                return
        if keeps("tube-releases-sound") and not self.reset(NO_TUBE):
            return
        self.ask(RELEASE_TUBE)

    def put_tube(self) -> None:
        """Write the words of a registration."""
        name = b"/nowhere/tube.obj" if keeps("tubes-sound") else b"nowhere/tube.obj"
        self.command[TUBE_INDEX], self.command[TUBE_AXES], self.command[TUBE_PATH_BYTES] = 0, 0, len(name)
        struct.pack_into("<d", self.command.map, TUBE_SCALE, 1.0)
        self.command.map[TUBE_PATH : TUBE_PATH + len(name)] = name

    def put_commands(self) -> None:
        """Write the command rows."""
        speed = 0.5 if keeps("commands-sound") else 11.0
        for lane in range(N):
            row = (1.0, 0.0, 0.0, speed, 1.0) if lane == 0 or keeps("lanes-own-commands") else (0.0,) * 5
            struct.pack_into("<5d", self.command.map, COMMANDS + 64 * lane, *row)

    def reset(self, tube: int) -> bool:
        """Reset all lanes into a tube."""
        length = 1.0 if keeps("resets-sound") else 1.01
        for lane in range(N):
            at = RESETS + 384 * lane
            struct.pack_into("<13d", self.command.map, at, *(0.0,) * 6, length, *(0.0,) * 6)
            selected = int(lane == 0 or keeps("resets-first"))
            struct.pack_into("<3q", self.command.map, at + 104, tube, lane, selected)
            self.command.map[at + 128 : at + 384] = self.pose.map[DEFAULTS : DEFAULTS + 256]
        return self.ask(RESET)


# --- the end ---


def leave(command: Segment, pose: Segment, left: Left | None) -> int:
    """Remove the names, and say why; the exit status."""
    if keeps("names-removed-first"):
        pose.unlink()
        command.unlink()
    if left is not None and command[FAREWELL] == 0:
        text = left.text.encode()[:TEXT_BYTES]
        command.map[FAREWELL_TEXT : FAREWELL_TEXT + len(text)] = text
        command[FAREWELL] = left.kind
    return 0 if left is None else 3


def main() -> int:
    """Fly one session."""
    if keeps("told-to-stop"):
        signal.signal(signal.SIGTERM, told_to_stop)
    else:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    command, pose = offer()
    agent = Agent(command, pose)
    left: Left | None = None
    try:
        read_header(command, pose)
        agent.fly()
        if not keeps("goodbye"):
            raise Left(STOPPED, "it has enough")
    except Left as error:
        left = error
    except KeyboardInterrupt:
        left = Left(STOPPED, "interrupted")
    status = leave(command, pose, left)
    if left is None:
        try:
            agent.ask(GOODBYE)
        except Left as error:
            command.farewell(error.kind, error.text)
    pose.unlink()
    command.unlink()
    return status


if __name__ == "__main__":
    sys.exit(main())
