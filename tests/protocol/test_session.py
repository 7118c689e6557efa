"""The contract of a session, the same over memory, shared memory and mapped files."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from protocol.agent import AgentSession, SessionSettings
from protocol.errors import PeerLost, Refusal, RefusalCode, SessionError, Verdict
from protocol.plant import CommandBatch, ResetBatch, TubeReference
from protocol.toy import DEFAULTS, SPEED_MAX, ToyPlant
from protocol.twin import open_twin

Open = Callable[..., AgentSession]
Resets = Callable[..., ResetBatch]
Commands = Callable[..., CommandBatch]

TUBE = TubeReference("/tubes/röhre.obj", "yup", 0.01, "ab" * 32)


def test_a_session_says_what_it_agreed_on(open_session: Open) -> None:
    """Settings and the plant's description are there once the session is open."""
    session = open_session(lanes=3, dt=0.1, inner_steps=5)
    assert (session.lanes, session.dt, session.inner_steps) == (3, 0.1, 5)
    assert session.description.name == "protocol.toy"
    assert session.description.speed_max == SPEED_MAX
    assert session.description.defaults == DEFAULTS


def test_a_run_reads_as_a_trace(open_session: Open, resets: Resets, commands: Commands, trace: Path) -> None:
    """The plant is asked for exactly what the agent asked for, in that order, and closed at the end."""
    session = open_session(lanes=2)
    session.register_tube(3, TUBE)
    session.reset(resets(2))
    session.step(commands(2))
    session.step(commands(2))
    only_second = resets(2)
    only_second.selected[0] = 0
    session.reset(only_second)
    session.step(commands(2))
    session.release_tube(3)
    session.close()
    wanted = (
        "open 2 0.1 4\nregister 3 /tubes/röhre.obj yup 0.01 abab\nreset [0, 1]\nstep 1\nstep 2\n"
        "reset [1]\nstep 3\nrelease 3\n"
    )
    assert trace.read_text(encoding="utf-8").startswith(wanted)


@pytest.mark.parametrize("inner_steps", [1, 4, 24])
def test_a_step_is_exactly_its_inner_steps(
    open_session: Open, resets: Resets, commands: Commands, inner_steps: int
) -> None:
    """After k control steps a falling body stands where k n semi-implicit Euler steps put it, and time is k dt."""
    session = open_session(inner_steps=inner_steps)
    free = resets(force_gain=0.0, torque_kp=0.0, torque_kd=0.0)
    session.reset(free)
    for k in range(1, 6):
        poses = session.step(commands(compensation=0.0))
        n, h = k * inner_steps, 0.1 / inner_steps
        assert poses.position[0, 2] == pytest.approx(-9.81 * h * h * n * (n + 1) / 2, rel=1e-12)
        assert poses.linear_velocity[0, 2] == pytest.approx(-9.81 * h * n, rel=1e-12)
        assert (poses.step[0], poses.sim_time[0]) == (k, k * 0.1)
        assert session.steps == k


def test_the_agent_may_work_while_physics_does(
    open_session: Open, resets: Resets, commands: Commands
) -> None:
    """What is given as `meanwhile` runs once a step, sees the poses of the step before, and changes nothing."""
    session = open_session()
    poses = session.reset(resets())
    seen: list[int] = []
    for k in range(1, 4):
        session.step(commands(), lambda: seen.append(int(poses.step[0])))
        assert poses.step[0] == k
    assert seen == [0, 1, 2]


def test_an_error_in_the_agents_own_work_ends_the_session(
    open_session: Open, resets: Resets, commands: Commands
) -> None:
    """It arrives as it was raised, and the session cannot be used any more."""
    session = open_session()
    session.reset(resets())

    def fail() -> None:
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        session.step(commands(), fail)
    with pytest.raises(SessionError):
        session.step(commands())


def test_nothing_moves_without_a_command(open_session: Open, resets: Resets) -> None:
    """A lane that is reset keeps its state over any number of other requests."""
    session = open_session()
    start = resets()
    start.position[:] = [1.0, 2.0, 3.0]
    start.linear_velocity[:] = [1.0, 0.0, 0.0]
    session.reset(start)
    nobody = ResetBatch.zeros(1)
    for index in range(3):
        session.register_tube(index, TUBE)
        poses = session.reset(nobody)
    assert poses.position[0].tolist() == [1.0, 2.0, 3.0]
    assert poses.step[0] == 0


def test_resetting_one_lane_leaves_the_others_alone(
    open_session: Open, resets: Resets, commands: Commands
) -> None:
    """A reset answers with the new state of its lane and with the last poses of all others."""
    session = open_session(lanes=3)
    session.reset(resets(3))
    before = session.step(commands(3)).raw.copy()
    again = resets(3)
    again.selected[:] = [0, 1, 0]
    again.position[1] = [5.0, 5.0, 5.0]
    after = session.reset(again)
    assert after.raw[[0, 2]].tobytes() == before[[0, 2]].tobytes()
    assert after.position[1].tolist() == [5.0, 5.0, 5.0]
    assert after.step.tolist() == [1, 0, 1]
    assert session.step(commands(3)).step.tolist() == [2, 1, 2]


def test_lanes_never_reset_read_zero(open_session: Open, resets: Resets) -> None:
    """Until its first reset a lane's pose row is zero."""
    session = open_session(lanes=2)
    first = resets(2)
    first.selected[1] = 0
    assert not session.reset(first).raw[1].any()


def test_poses_are_one_batch(open_session: Open, resets: Resets, commands: Commands) -> None:
    """Every answer is the same object, so that a loop allocates nothing."""
    session = open_session()
    poses = session.reset(resets())
    batch = commands()
    assert session.step(batch) is poses
    assert session.step(batch) is poses


def test_the_plants_time_is_reported(
    open_session: Open, resets: Resets, commands: Commands, peers: ModuleType
) -> None:
    """A plant that works for a while says so, apart from the transport."""
    session = open_session()
    session.reset(resets())
    session.step(commands(speed=peers.LINGER))
    assert session.engine_seconds >= peers.LINGER_S


BAD_COMMANDS: list[tuple[int, float, str, RefusalCode]] = [
    (0, math.nan, "direction", RefusalCode.NOT_FINITE),
    (1, math.inf, "direction", RefusalCode.NOT_FINITE),
    (0, 0.0, "direction", RefusalCode.NOT_UNIT),
    (2, 1e-2, "direction", RefusalCode.NOT_UNIT),
    (0, 1e200, "direction", RefusalCode.NOT_UNIT),
    (3, -1e-9, "speed", RefusalCode.OUT_OF_RANGE),
    (3, SPEED_MAX * 1.0001, "speed", RefusalCode.OUT_OF_RANGE),
    (3, math.nan, "speed", RefusalCode.NOT_FINITE),
    (4, -0.1, "compensation", RefusalCode.OUT_OF_RANGE),
    (4, 2.1, "compensation", RefusalCode.OUT_OF_RANGE),
    (4, -math.inf, "compensation", RefusalCode.NOT_FINITE),
    (5, 1.0, "reserved", RefusalCode.RESERVED),
    (7, -0.0, "reserved", RefusalCode.RESERVED),
]


@pytest.mark.parametrize("lanes", [1, 3])
def test_bad_commands_are_refused_and_the_session_lives(
    open_session: Open, resets: Resets, commands: Commands, lanes: int
) -> None:
    """Each bad word is named with its lane; nothing is integrated, no lane moves, and the next step is as due."""
    session = open_session(lanes=lanes)
    session.reset(resets(lanes))
    before = session.step(commands(lanes)).raw.copy()
    for word, value, field, code in BAD_COMMANDS:
        bad = commands(lanes)
        bad.raw[-1, word] = value
        with pytest.raises(Refusal, match=r"expected .*, found ") as caught:
            session.step(bad)
        assert caught.value.field.startswith(field)
        assert (caught.value.lane, caught.value.code) == (lanes - 1, code)
        assert session.steps == 1
    assert session.reset(ResetBatch.zeros(lanes)).raw.tobytes() == before.tobytes()
    assert session.step(commands(lanes)).step.tolist() == [2] * lanes


def test_directions_of_nearly_unit_length_are_taken(
    open_session: Open, resets: Resets, commands: Commands
) -> None:
    """A squared length within 1e-6 of 1 passes, as float32 arithmetic may leave it."""
    session = open_session(lanes=2)
    session.reset(resets(2))
    nearly = commands(2)
    nearly.direction[:] = np.float32([0.6, 0.64, 0.48])
    session.step(nearly)


BAD_RESETS: list[tuple[str, object, str, RefusalCode]] = [
    ("position", [math.nan, 0, 0], "position", RefusalCode.NOT_FINITE),
    ("linear_velocity", [0, math.inf, 0], "linear_velocity", RefusalCode.NOT_FINITE),
    ("angular_velocity", [0, 0, -math.inf], "angular_velocity", RefusalCode.NOT_FINITE),
    ("quaternion", [0, 0, 0, 0], "quaternion", RefusalCode.NOT_UNIT),
    ("quaternion", [0, 0, 0, 1.001], "quaternion", RefusalCode.NOT_UNIT),
    ("tube", 2, "tube", RefusalCode.UNKNOWN_TUBE),
    ("tube", -2, "tube", RefusalCode.UNKNOWN_TUBE),
    ("selected", 2, "selected", RefusalCode.OUT_OF_RANGE),
]


def test_bad_resets_are_refused_and_the_session_lives(
    open_session: Open, resets: Resets, commands: Commands
) -> None:
    """Each bad field is named with its lane, and the lanes fly on from where they were."""
    session = open_session(lanes=2)
    session.reset(resets(2))
    session.step(commands(2))
    for name, value, field, code in BAD_RESETS:
        bad = resets(2)
        getattr(bad, name)[1] = value
        with pytest.raises(Refusal) as caught:
            session.reset(bad)
        assert (caught.value.field, caught.value.lane, caught.value.code) == (field, 1, code)
    assert session.step(commands(2)).step.tolist() == [2, 2]


@pytest.mark.parametrize(
    ("parameter", "value"),
    [
        ("mass", 0.0),
        ("mass", -1.0),
        ("inertia_y", 0.0),
        ("body_radius", math.nan),
        ("force_gain", -1.0),
        ("force_along_body", 0.5),
        ("restitution", 1.1),
        ("gravity", math.inf),
        ("gust", -0.1),
    ],
)
def test_parameters_out_of_range_are_refused(resets: Resets, parameter: str, value: float) -> None:
    """A parameter outside of its range in the table is refused by name."""
    with open_twin(ToyPlant(), SessionSettings(1, 0.1, 0.1)) as session:
        with pytest.raises(Refusal, match=f"{parameter} in lane 0: expected") as caught:
            session.reset(resets(**{parameter: value}))
        assert caught.value.field == parameter


def test_reserved_parameter_words_must_be_zero(resets: Resets) -> None:
    """A word behind the last parameter is refused unless it is zero."""
    with open_twin(ToyPlant(), SessionSettings(1, 0.1, 0.1)) as session:
        bad = resets()
        bad.parameters[0, 31] = 1e-300
        with pytest.raises(Refusal, match="reserved parameter words") as caught:
            session.reset(bad)
        assert caught.value.code is RefusalCode.RESERVED


def test_rows_that_are_not_selected_are_not_looked_at(open_session: Open, resets: Resets) -> None:
    """What stands in a row of a lane that is left alone does not matter."""
    session = open_session(lanes=2)
    session.reset(resets(2))
    half = resets(2)
    half.selected[1] = 0
    half.raw[1, :13] = math.nan
    session.reset(half)


def test_a_lane_that_was_never_reset_is_not_stepped(
    open_session: Open, resets: Resets, commands: Commands
) -> None:
    """A step is refused until every lane was reset once, and names the lane."""
    session = open_session(lanes=2)
    with pytest.raises(Refusal, match="never reset"):
        session.step(commands(2))
    first = resets(2)
    first.selected[1] = 0
    session.reset(first)
    with pytest.raises(Refusal) as caught:
        session.step(commands(2))
    assert (caught.value.lane, caught.value.code) == (1, RefusalCode.NOT_RESET)
    session.reset(resets(2))
    assert session.step(commands(2)).step.tolist() == [1, 1]


def test_tubes_are_registered_used_and_released(open_session: Open, resets: Resets) -> None:
    """A tube can be named once it is registered, not twice, and not released while a lane flies in it."""
    session = open_session(tube_slots=2)
    session.register_tube(1, TUBE)
    with pytest.raises(Refusal) as caught:
        session.register_tube(1, TUBE)
    assert caught.value.code is RefusalCode.TUBE_SLOT
    into = resets()
    into.tube[:] = 1
    session.reset(into)
    with pytest.raises(Refusal) as caught:
        session.release_tube(1)
    assert caught.value.code is RefusalCode.TUBE_IN_USE
    session.reset(resets())
    session.release_tube(1)
    with pytest.raises(Refusal) as caught:
        session.release_tube(1)
    assert caught.value.code is RefusalCode.UNKNOWN_TUBE
    with pytest.raises(Refusal) as caught:
        session.reset(into)
    assert caught.value.code is RefusalCode.UNKNOWN_TUBE


@pytest.mark.parametrize("index", [-1, 2, 2**40])
def test_tube_indices_stay_within_their_slots(index: int) -> None:
    """A tube index outside of the session's slots is refused, at registration and at release."""
    with open_twin(ToyPlant(), SessionSettings(1, 0.1, 0.1, tube_slots=2)) as session:
        for ask in (lambda: session.register_tube(index, TUBE), lambda: session.release_tube(index)):
            with pytest.raises(Refusal, match="expected 0 to 1") as caught:
                ask()
            assert caught.value.code is RefusalCode.TUBE_SLOT


@pytest.mark.parametrize(
    "tube",
    [
        TubeReference("", "zup", 1.0, "ab" * 32),
        TubeReference("x" * 4097, "zup", 1.0, "ab" * 32),
        TubeReference("/a.obj", "xup", 1.0, "ab" * 32),
        TubeReference("/a.obj", "zup", 1.0, "ab" * 31),
        TubeReference("/a.obj", "zup", 1.0, "no hexadecimal"),
    ],
)
def test_tubes_that_cannot_be_written_down_are_our_own_fault(tube: TubeReference) -> None:
    """A reference that does not fit on the wire never leaves the agent, and the session goes on."""
    with open_twin(ToyPlant(), SessionSettings(1, 0.1, 0.1)) as session:
        with pytest.raises(SessionError, match="expected"):
            session.register_tube(0, tube)
        session.register_tube(0, TUBE)


@pytest.mark.parametrize("scale", [0.0, -1.0, math.nan, math.inf])
def test_a_tube_needs_a_positive_scale(scale: float) -> None:
    """A scale that is no factor is refused."""
    with (
        open_twin(ToyPlant(), SessionSettings(1, 0.1, 0.1)) as session,
        pytest.raises(Refusal, match="tube_scale"),
    ):
        session.register_tube(0, TubeReference("/a.obj", "zup", scale, "ab" * 32))


def test_what_the_plant_refuses_is_told_and_the_session_lives(
    open_session: Open, resets: Resets, commands: Commands, peers: ModuleType
) -> None:
    """A plant's refusal of a tube or a step arrives as it is; poses that it began to write are not seen."""
    session = open_session()
    with pytest.raises(Refusal, match=r"tube_path: expected a file, found /no/missing.obj") as caught:
        session.register_tube(0, TubeReference("/no/missing.obj", "zup", 1.0, "ab" * 32))
    assert caught.value.code is RefusalCode.PLANT
    session.register_tube(0, TUBE)
    before = session.reset(resets()).raw.copy()
    with pytest.raises(Refusal, match="engine in lane 0: expected a mood to step, found none"):
        session.step(commands(speed=peers.REFUSE))
    assert session.reset(ResetBatch.zeros(1)).raw.tobytes() == before.tobytes()
    assert session.step(commands()).step.tolist() == [1]


def test_an_error_of_the_plant_ends_the_session_with_its_text(
    open_session: Open, resets: Resets, commands: Commands, peers: ModuleType
) -> None:
    """What the plant raised is told to the agent, with step and phase; afterwards the session is closed to all."""
    session = open_session()
    session.reset(resets())
    session.step(commands())
    with pytest.raises(PeerLost, match="ZeroDivisionError: the engine exploded") as caught:
        session.step(commands(speed=peers.FAIL))
    assert (caught.value.verdict, caught.value.step, caught.value.phase) == (Verdict.FAILED, 2, "step")
    with pytest.raises(SessionError, match="BROKEN"):
        session.step(commands())


def test_a_closed_session_takes_no_requests(
    open_session: Open, resets: Resets, commands: Commands, trace: Path, eventually: Callable[..., None]
) -> None:
    """Closing is orderly, may be repeated, closes the plant, and leaves nothing that could be asked."""
    session = open_session()
    session.reset(resets())
    session.close()
    session.close()
    with pytest.raises(SessionError, match="CLOSED"):
        session.step(commands())
    eventually(lambda: trace.read_text(encoding="utf-8").endswith("close\n"))


@pytest.mark.parametrize("shape", [(1, 8), (2, 7), (16,)])
def test_batches_of_another_shape_never_leave_the_agent(shape: tuple[int, ...], resets: Resets) -> None:
    """A batch that is not (N, 8) is an error of the caller, not broadcast and not sent."""
    with open_twin(ToyPlant(), SessionSettings(2, 0.1, 0.1)) as session:
        session.reset(resets(2))
        wrong = CommandBatch.zeros(2)
        object.__setattr__(wrong, "raw", np.zeros(shape))
        with pytest.raises(ValueError, match="commands: expected"):
            session.step(wrong)
        assert session.steps == 0


def test_every_transport_gives_the_twins_poses(open_session: Open, resets: Resets) -> None:
    """The same random commands give the same poses, bit for bit, in one process and in two."""
    random = np.random.default_rng(7)
    direction = random.normal(size=(100, 3, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)

    def fly(session: AgentSession) -> bytes:
        flown = [session.reset(resets(3)).raw.tobytes()]
        batch = CommandBatch.zeros(3)
        batch.compensation[:] = 0.9
        for step in range(100):
            batch.direction[:], batch.speed[:] = direction[step], step % 3
            flown.append(session.step(batch).raw.tobytes())
        return b"".join(flown)

    with open_twin(ToyPlant(), SessionSettings(3, 0.1, 0.1 / 4)) as twin:
        expected = fly(twin)
    assert fly(open_session(lanes=3)) == expected


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((0, 0.1, 0.1, 1), "lanes: expected 1 to 65536, found 0"),
        ((1, 0.1, 0.1, 0), "tube_slots"),
        ((1, math.nan, 0.1, 1), "dt: expected a time"),
        ((1, math.inf, 0.1, 1), "dt: expected a time"),
        ((1, 0.1, -0.1, 1), "physics_dt: expected a time"),
        ((1, 0.1, math.nan, 1), "physics_dt: expected a time"),
        (
            (1, 1e9, 0.1, 1),
            r"at most 1000000 inner steps of physics_dt = 0.1 s, found 1000000000 s, 10000000000 of",
        ),
        ((1, 1.000001, 1e-6, 1), "at most 1000000 inner steps"),
        ((1, 1e300, 1e-300, 1), "at most 1000000 inner steps .* inf of them"),
        ((1, 0.11, 0.02, 1), r"whole multiple of physics_dt = 0.02 s, found 0.11 s; the nearest is 0.1"),
        ((1, 0.01, 0.02, 1), r"the nearest is 0.02 s \(1 inner steps\)"),
    ],
)
def test_settings_that_make_no_session(values: tuple[int, float, float, int], message: str) -> None:
    """Impossible settings are refused before anything is created; a dt that is no multiple names the nearest."""
    with pytest.raises(SessionError, match=message):
        SessionSettings(*values)


def test_the_most_inner_steps() -> None:
    """A million inner steps are still allowed."""
    assert SessionSettings(1, 1.0, 1e-6).inner_steps == 1_000_000
