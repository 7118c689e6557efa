"""A small physics side by hand, without physics: its bodies stay where they are. `server.py RULE RENDEZVOUS`."""

from __future__ import annotations

import os
import signal
import struct
import sys
import time

from common import (
    BROKEN,
    COMMAND_MAGIC,
    FAREWELL,
    GOODBYE,
    HANDSHAKE,
    HEADER_BYTES,
    INNER_STEPS,
    LANES,
    LOOK_S,
    NO_MAGIC,
    PID,
    POSE_MAGIC,
    REGISTER_TUBE,
    RELEASE_TUBE,
    RESET,
    SEGMENT_BYTES,
    SESSION,
    START_TIME,
    STEP,
    STOPPED,
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

DOORBELL, BEGIN, OP, COUNT, END, COMMANDS = 6272, 6400, 6408, 6416, 6424, 6464
REPLY_DOORBELL, REPLY_BEGIN, REPLY_STATUS, REPLY_COUNT, REPLY_NS, REPLY_END, POSES = (
    *(3072, 3200, 3208, 3216, 3224, 3232, 3264),
)
REFUSAL_CODE, REFUSAL_LANE, REFUSAL_FIELD = 2048, 2056, 2064
PLANT = 10
SPEED_MAX, DEFAULTS = 128, 256
INNER_STEP_S = 2e-7
"""How long the engine works on an inner step."""


def alive(command: Segment) -> bool:
    """Whether the agent lives."""
    names = {"zombie": "agent-zombie", "reused": "agent-pid-reused", "stopped": "agent-paused"}
    return lives(command[PID], command[START_TIME], **names)


def attach() -> tuple[Segment, Segment]:
    """Wait for a session, and claim it."""
    unfinished_since = time.monotonic()
    while True:
        time.sleep(0.005)
        try:
            command = Segment(path(".cmd"), os.open(path(".cmd"), os.O_RDWR))
            pose = Segment(path(".pose"), os.open(path(".pose"), os.O_RDWR))
        except (FileNotFoundError, ValueError):
            unfinished_since = time.monotonic()
            continue
        finished = command.size >= HEADER_BYTES and command.map[:8] != NO_MAGIC
        if finished:
            unfinished_since = time.monotonic()
        patience = 0.5 if keeps("abandoned-header-removed") else 1e9
        abandoned = time.monotonic() - unfinished_since > patience
        stale = finished and not alive(command) and keeps("stale-segments-removed")
        if (stale or abandoned) and command.lock():
            pose.unlink()
            command.unlink()
        elif finished and not stale and command[FAREWELL] == 0:
            claim(pose)
            return command, pose
        for segment in (command, pose):
            segment.map.close()
            os.close(segment.descriptor)


def claim(pose: Segment) -> None:
    """Become the one physics process of the session, or leave."""
    if not keeps("second-server"):
        pose[PID] = os.getpid()
    if not keeps("died-before-magic-replaced") and pose[PID] != 0:
        sys.exit("somebody was here before")
    if not pose.lock():
        sys.exit("another physics process serves this session")
    if keeps("served-session-left") and (pose.map[:8] != NO_MAGIC or pose[FAREWELL] != 0):
        sys.exit("a physics process has served this session")


def answer_header(command: Segment, pose: Segment) -> None:
    """Check the little that the rules about faults look at, and write the header."""
    pose[PID], pose[START_TIME] = os.getpid(), start_time(os.getpid())[1]
    if command.map[:8] != COMMAND_MAGIC:
        raise Left(HANDSHAKE, f"magic: expected {COMMAND_MAGIC!r}, found {command.map[:8]!r}")
    pose[VERSION_MAJOR], pose[VERSION_MINOR] = 1, 1
    pose[SEGMENT_BYTES] = POSES + 128 * command[LANES]
    pose.map[SESSION : SESSION + 16] = command.map[SESSION : SESSION + 16]
    pose.map[LANES:128] = command.map[LANES:128]
    struct.pack_into("<d", pose.map, SPEED_MAX, 10.0)
    struct.pack_into("<6d", pose.map, DEFAULTS, 1.0, 0.01, 0.01, 0.02, 0.15, 8.0)
    pose[0] = int.from_bytes(POSE_MAGIC, "little")


class Server:
    """The session from its header on."""

    def __init__(self, command: Segment, pose: Segment) -> None:
        self.command, self.pose = command, pose
        self.number = self.steps = 0
        self.over = False

    def serve(self) -> None:
        """Answer until the goodbye."""
        if not keeps("request-before-session"):
            self.number = max(0, self.command[DOORBELL] - 1)
        looked = time.monotonic()
        bell = DOORBELL if keeps("slow-request-awaited") else BEGIN
        while not self.over:
            if not keeps("request-taken-first"):
                self.look()
            if self.command[bell] != self.number:
                self.answer()
                continue
            now = time.monotonic()
            if now - looked > LOOK_S:
                if now - looked > 0.2 and not keeps("server-paused") and self.number:
                    time.sleep(0.02)
                    self.pose[REPLY_DOORBELL] = self.number + 1  # it thinks that it has missed one
                looked = now
                self.look()
            time.sleep(0.0005)

    def look(self) -> None:
        """Look at the agent."""
        ignored = () if keeps("agent-farewell") else (HANDSHAKE,)
        kind = self.command[FAREWELL]
        gone = (kind != 0 and kind not in ignored) or not alive(self.command)
        if gone and (self.command[DOORBELL] == self.number or not keeps("request-taken-first")):
            raise Left(STOPPED, "the agent is gone")

    def answer(self) -> None:
        """Answer one request."""
        command, number = self.command, self.number + 1
        if command[DOORBELL] != number and BROKEN in ("doorbell-jump", "early-doorbell"):
            number = command[DOORBELL]
        begin, op, count, end = struct.unpack_from("<4q", command.map, BEGIN)
        if keeps("slow-request-awaited") and command[DOORBELL] != number:
            raise Left(VIOLATION, f"rang the doorbell with {command[DOORBELL]} where {number} was due")
        if (
            begin != number
            and not self.leaves_out("torn-begin", op)
            and not self.leaves_out("early-begin", op)
        ):
            raise Left(VIOLATION, f"published a torn request: begin {begin} where {number} was due")
        if end != number and keeps("slow-request-awaited") and not self.leaves_out("torn-end", op):
            raise Left(VIOLATION, f"published a torn request: end {end} where {number} was due")
        self.check(op, count)
        refused = op in (REGISTER_TUBE, RELEASE_TUBE)
        if op == STEP:
            self.steps += 1
            until = time.monotonic() + INNER_STEP_S * command[INNER_STEPS]
            while time.monotonic() < until:
                pass
        early = command[DOORBELL] != number or (command[BEGIN] != number and begin == number)
        if early and keeps("early-at-work") and keeps("slow-request-awaited"):
            raise Left(VIOLATION, "wrote an early request")
        self.publish(number, refused)
        self.over = op == GOODBYE
        if not keeps("agent-killed-at-work") and command[INNER_STEPS] > 1000:
            time.sleep(1.0)  # it rests after long work

    def leaves_out(self, rule: str, op: int) -> bool:
        """Whether a check is left out: for the last kind of request alone, so that the rule must try them all."""
        return not keeps(rule) and op == GOODBYE

    def check(self, op: int, count: int) -> None:
        """Check op and step count."""
        if op not in (STEP, RESET, REGISTER_TUBE, RELEASE_TUBE, GOODBYE) and keeps("unknown-op"):
            raise Left(VIOLATION, f"asked for op {op}")
        due = self.steps + 1 if op == STEP else self.steps
        if count == due or not keeps("slow-request-awaited"):
            return
        rule = "step-count-of-others" if op != STEP else "step-skipped" if count > due else "step-repeated"
        if keeps(rule):
            raise Left(VIOLATION, f"asked for step {count} where {due} was due")

    def publish(self, number: int, refused: bool) -> None:
        """Write the reply."""
        pose = self.pose
        pose[REPLY_BEGIN] = number
        if refused:
            pose[REFUSAL_CODE], pose[REFUSAL_LANE] = PLANT, -1
            pose.map[REFUSAL_FIELD : REFUSAL_FIELD + 4] = b"tube"
        struct.pack_into("<4q", pose.map, REPLY_STATUS, int(refused), self.steps, 1000, number)
        pose[REPLY_DOORBELL] = self.number = number


def leave(command: Segment, pose: Segment, over: bool) -> None:
    """Remove what a dead agent leaves behind."""
    if not alive(command) and not (over and not keeps("agent-killed")):
        whatever = not keeps("newer-segments-kept")
        until = time.monotonic() + 0.5
        while keeps("names-under-lock") and not command.lock():
            if time.monotonic() > until:
                return
            time.sleep(0.005)
        for segment in (pose, command) if keeps("pose-removed-first") else (command, pose):
            segment.unlink(whatever_stands_there=whatever)


def main() -> int:
    """Serve one session."""
    if keeps("told-to-stop"):
        signal.signal(signal.SIGTERM, told_to_stop)
    else:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        command, pose = attach()
    except Left:
        return 1
    server = Server(command, pose)
    try:
        answer_header(command, pose)
        server.serve()
    except Left as left:
        pose.farewell(left.kind, left.text)
    except KeyboardInterrupt:
        pose.farewell(STOPPED, "interrupted")
    leave(command, pose, server.over)
    return 0


if __name__ == "__main__":
    sys.exit(main())
