"""Skipped, repeated, early and torn messages, driven by hand: both sides end the session, neither goes on."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from protocol import layout
from protocol.agent import AgentSession, SessionSettings
from protocol.errors import PeerLost, PeerViolation, Refusal, SessionError, Verdict
from protocol.handshake import Answer, part, read_farewell, read_offer, write_answer, write_farewell
from protocol.layout import COMMAND, FAREWELL, POSE, Farewell, Field, Op
from protocol.physics import PhysicsSession
from protocol.plant import CommandBatch, PoseBatch, ResetBatch
from protocol.toy import ToyPlant
from protocol.waiting import Peer

Resets = Callable[..., ResetBatch]
Commands = Callable[..., CommandBatch]


def put(view: memoryview, fields: dict[str, Field], **words: int) -> None:
    """Write words by name."""
    for name, value in words.items():
        layout.write_i64(view, fields[name], value)


class Meddler(ToyPlant):
    """Lets a test write into the segments while the plant works."""

    def __init__(self) -> None:
        self.meddle: Callable[[], None] = lambda: None

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Meddle, then step."""
        self.meddle()
        super().step(commands, poses)


class HandAgent:
    """An agent driven word by word against a real physics side."""

    def __init__(self, resets: ResetBatch, commands: CommandBatch) -> None:
        self.command = memoryview(bytearray(layout.command_bytes(1)))
        self.pose = memoryview(bytearray(layout.pose_bytes(1)))
        self.plant = Meddler()
        AgentSession(self.command, self.pose, SessionSettings(1, 0.1, 0.1))
        self.physics = PhysicsSession(self.command, self.pose, self.plant)
        self.command[layout.reset_rows(1)] = resets.raw.tobytes()
        self.command[layout.command_rows(1)] = commands.raw.tobytes()
        assert self.ask(1, Op.RESET, 0)
        assert self.ask(2, Op.STEP, 1)

    def ask(self, number: int, op: int, step: int, **words: int) -> bool:
        """Publish a request, with other words than those of a correct one where a test says so."""
        right = {"begin": number, "op": op, "step": step, "end": number, "doorbell": number}
        put(self.command, COMMAND, **{**right, **words})
        try:
            return self.physics.answer(number)
        except PeerViolation as error:
            part(self.pose, error)
            raise


@pytest.fixture
def agent(resets: Resets, commands: Commands) -> HandAgent:
    """A hand-driven agent after one reset and one step: request 3 and step 2 are due."""
    return HandAgent(resets(), commands())


@pytest.mark.parametrize(
    ("request_words", "message"),
    [
        ({"number": 4, "op": 1, "step": 2}, "rang the doorbell with 4 where 3 was due"),
        ({"number": 2, "op": 1, "step": 2}, "rang the doorbell with 2 where 3 was due"),
        ({"number": 3, "op": 1, "step": 1}, "repeated a step: asked for step 1 where 2 was due"),
        ({"number": 3, "op": 1, "step": 3}, "skipped a step: asked for step 3 where 2 was due"),
        ({"number": 3, "op": 2, "step": 2}, "RESET at step 2 where 1 was due"),
        ({"number": 3, "op": 5, "step": 0}, "GOODBYE at step 0 where 1 was due"),
        ({"number": 3, "op": 0, "step": 1}, "op 0, which version 1 does not know"),
        ({"number": 3, "op": 6, "step": 1}, "op 6"),
        ({"number": 3, "op": 1, "step": 2, "begin": 4}, "torn request: begin 4, end 3"),
        ({"number": 3, "op": 1, "step": 2, "end": 2}, "torn request: begin 3, end 2"),
    ],
)
def test_physics_ends_a_session_whose_agent_breaks_the_protocol(
    agent: HandAgent, request_words: dict[str, int], message: str
) -> None:
    """Each wrong word is a violation: nothing is integrated or answered, and the farewell says what was wrong."""
    before = bytes(agent.pose[layout.pose_rows(1)])
    with pytest.raises(PeerViolation, match=message):
        agent.ask(**request_words)
    assert layout.read_i64(agent.pose, POSE["doorbell"]) == 2
    assert bytes(agent.pose[layout.pose_rows(1)]) == before
    reason, text = read_farewell(agent.pose)
    assert reason == Farewell.VIOLATION
    assert message.split(":")[0] in text


@pytest.mark.parametrize("words", [{"doorbell": 4}, {"begin": 4}, {"doorbell": 2}])
def test_physics_notices_a_request_that_comes_early(agent: HandAgent, words: dict[str, int]) -> None:
    """A request that is begun while the last one is worked on is a violation, and the work is not published."""
    agent.plant.meddle = lambda: put(agent.command, COMMAND, **words)
    with pytest.raises(PeerViolation, match="early request before request 3 was answered"):
        agent.ask(3, Op.STEP, 2)
    assert layout.read_i64(agent.pose, POSE["doorbell"]) == 2


def test_an_early_request_is_noticed_before_a_refusal_is_written(agent: HandAgent) -> None:
    """The pose segment stays as the last reply left it, also where the request was to be refused."""

    def refuse_late() -> None:
        put(agent.command, COMMAND, begin=4)
        raise Refusal("engine", "a mood to step", "none", 0)

    agent.plant.meddle = refuse_late
    before = bytes(agent.pose[: FAREWELL[0].offset]), bytes(agent.pose[POSE["refusal_code"].offset :])
    with pytest.raises(PeerViolation, match="early request before request 3 was answered"):
        agent.ask(3, Op.STEP, 2)
    after = bytes(agent.pose[: FAREWELL[0].offset]), bytes(agent.pose[POSE["refusal_code"].offset :])
    assert after == before


def test_physics_answers_nothing_after_a_goodbye(agent: HandAgent) -> None:
    """A request behind the goodbye is a violation."""
    assert agent.ask(3, Op.GOODBYE, 1) is False
    with pytest.raises(PeerViolation):
        agent.ask(4, Op.STEP, 2)


class HandPhysics:
    """A physics side driven word by word against a real agent session."""

    def __init__(self) -> None:
        self.command = memoryview(bytearray(layout.command_bytes(1)))
        self.pose = memoryview(bytearray(layout.pose_bytes(1)))
        self.session = AgentSession(self.command, self.pose, SessionSettings(1, 0.1, 0.1))
        offer = read_offer(self.command)
        write_answer(self.pose, offer, Answer(ToyPlant().describe(), 1, 0))
        self.words: dict[str, int] = {}
        self.interrupt = False
        self.session.attached(self.reply)

    def reply(self, old: int, step: int, phase: str) -> int:
        """Publish a reply, with other words than those of a correct one where a test says so."""
        if self.interrupt:
            raise KeyboardInterrupt
        due = layout.read_i64(self.command, COMMAND["step"])
        right = {"begin": old + 1, "status": 0, "step": due, "end": old + 1, "doorbell": old + 1}
        put(self.pose, POSE, **{**right, **self.words})
        return layout.read_i64(self.pose, POSE["doorbell"])


@pytest.fixture
def physics(resets: Resets, commands: Commands) -> Iterator[HandPhysics]:
    """A hand-driven physics side after one reset and one step: reply 3 and step 2 are due."""
    physics = HandPhysics()
    physics.session.reset(resets())
    physics.session.step(commands())
    yield physics
    physics.words = {}
    physics.session.close()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"doorbell": 4}, "rang its doorbell with 4 where 3 was due"),
        ({"doorbell": 1}, "rang its doorbell with 1 where 3 was due"),
        ({"begin": 2}, "torn reply: begin 2, end 3"),
        ({"end": 4}, "torn reply: begin 3, end 4"),
        ({"step": 1}, "status 0 at step 1 where 2 was due"),
        ({"step": 3}, "status 0 at step 3 where 2 was due"),
        ({"status": 2}, "status 2"),
        ({"status": 1, "step": 2}, "status 1 at step 2"),
    ],
)
def test_the_agent_ends_a_session_whose_physics_breaks_the_protocol(
    physics: HandPhysics, commands: Commands, words: dict[str, int], message: str
) -> None:
    """Each wrong word is a violation: the session is over and the farewell says what was wrong."""
    physics.words = words
    with pytest.raises(PeerViolation, match=message):
        physics.session.step(commands())
    assert physics.session.steps == 1
    assert read_farewell(physics.command)[0] == Farewell.VIOLATION
    with pytest.raises(SessionError, match="BROKEN"):
        physics.session.step(commands())


def test_the_agent_notices_a_reply_to_nothing(physics: HandPhysics, commands: Commands) -> None:
    """A reply that stands before its request was made is a violation, however right it looks."""
    put(physics.pose, POSE, begin=3, status=0, step=2, end=3, doorbell=3)
    with pytest.raises(PeerViolation, match="answered request 3 before it was made"):
        physics.session.step(commands())


def test_a_violation_is_told_to_the_side_that_made_it(resets: Resets) -> None:
    """An agent that physics accuses gets an error of its own side, with the accusation."""
    view = memoryview(bytearray(layout.pose_bytes(1)))
    write_farewell(view, Farewell.VIOLATION, "skipped a step")
    with pytest.raises(SessionError, match=r"physics ended the session .* it says that we skipped a step"):
        Peer("physics", 0, 0, view).check(3, "step")


def test_a_farewell_is_never_changed() -> None:
    """The first reason to leave stands."""
    view = memoryview(bytearray(layout.pose_bytes(1)))
    write_farewell(view, Farewell.FAILED, "first")
    write_farewell(view, Farewell.STOPPED, "second")
    assert read_farewell(view) == (Farewell.FAILED, "first")


def test_an_interrupted_agent_says_that_it_was_told_to_stop(physics: HandPhysics, commands: Commands) -> None:
    """Ctrl-C while a reply is awaited ends the session with a farewell and reaches the caller."""

    physics.interrupt = True
    with pytest.raises(KeyboardInterrupt):
        physics.session.step(commands())
    assert read_farewell(physics.command)[0] == Farewell.STOPPED
    with pytest.raises(PeerLost, match="told to stop") as caught:
        Peer("agent", 0, 0, physics.command).check(2, "idle")
    assert caught.value.verdict is Verdict.LEFT


class Terminated(BaseException):
    """What a program may raise when it is told to stop."""


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (KeyboardInterrupt(), Farewell.STOPPED),
        (SystemExit(143), Farewell.STOPPED),
        (Terminated(), Farewell.STOPPED),
        (ZeroDivisionError(), Farewell.FAILED),
    ],
)
def test_a_farewell_tells_who_was_told_to_stop_from_who_failed(
    error: BaseException, reason: Farewell
) -> None:
    """An exception that is no Exception is a request to end, whatever its name."""
    view = memoryview(bytearray(layout.command_bytes(1)))
    part(view, error)
    assert read_farewell(view)[0] == reason
