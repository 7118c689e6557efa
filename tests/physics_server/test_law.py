"""The force and torque law, in both of its forms, against the equations of the annex, written with matrices."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physics_server import reference_kernels as kernels
from physics_server.law import control_law, gust_force, splitmix64, torque_in_world
from physics_server.parameters import SPEED_MAX, BodyParameters
from protocol import plant
from protocol.plant import PARAMETERS

numbers = st.floats(-5, 5)
gains = st.floats(0, 50)


@st.composite
def unit(draw: st.DrawFn, size: int) -> tuple[float, ...]:
    """A random unit vector or quaternion."""
    vector = np.array(draw(st.lists(st.floats(-1, 1), min_size=size, max_size=size)))
    norm = np.linalg.norm(vector)
    if norm < 0.1:
        vector, norm = np.eye(size)[0], 1.0
    return tuple((vector / norm).tolist())


@st.composite
def bodies(draw: st.DrawFn) -> BodyParameters:
    """Random parameters, every term of the law present."""
    row = [draw(st.floats(0.1, 3)) for _ in PARAMETERS]
    if draw(st.booleans()):
        row[2:4] = [row[1]] * 2  # three equal moments
    body = BodyParameters.from_row(row)
    return dataclasses.replace(body, force_along_body=draw(st.sampled_from([0.0, 1.0])))


def rotation(quaternion: tuple[float, ...]) -> np.ndarray:
    """Rotation matrix by Rodrigues' formula, another way than the law's."""
    v, w = np.array(quaternion[:3]), quaternion[3]
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * K + 2 * K @ K


vectors = st.tuples(numbers, numbers, numbers)


@settings(deadline=None)
@given(bodies(), unit(3), st.floats(0, SPEED_MAX), st.floats(0, 2), vectors, unit(4), vectors, vectors)
def test_force_and_torque_are_the_equations(
    body: BodyParameters,
    direction: tuple[float, float, float],
    speed: float,
    compensation: float,
    gust: tuple[float, float, float],
    quaternion: tuple[float, float, float, float],
    velocity: tuple[float, float, float],
    omega: tuple[float, float, float],
) -> None:
    """Both forms of the law agree with the annex's equations, with I rotated into the world, and with each other."""
    force, torque = control_law(body, direction, speed, compensation, gust)(quaternion, velocity, omega)

    M = rotation(quaternion)
    f, d, V, w = M[:, 0], np.array(direction), np.array(velocity), np.array(omega)
    a = f if body.force_along_body else d
    disturbance = np.array([body.disturbance_x, body.disturbance_y, body.disturbance_z])
    lift = np.array([0, 0, compensation * body.mass * body.gravity])
    F = body.mass * body.force_gain * (speed * a - V) + lift - body.linear_drag * V + disturbance + gust
    inertia = M @ np.diag([body.inertia_x, body.inertia_y, body.inertia_z]) @ M.T
    tau = inertia @ (body.torque_kp * np.cross(f, d) - body.torque_kd * w) - body.angular_drag * w
    np.testing.assert_allclose(force, F, rtol=1e-12, atol=1e-11)
    found = torque if torque_in_world(body) else M @ torque
    np.testing.assert_allclose(found, tau, rtol=1e-11, atol=1e-10)

    row, command = np.array(body.row()), np.array([*direction, speed, compensation, 0, 0, 0])
    constants = kernels.coefficients(row, command, gust)
    compiled = kernels.force_and_torque(constants, quaternion, velocity, tuple(M.T @ w))
    np.testing.assert_allclose(compiled[0], force, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(kernels.to_world(quaternion, compiled[1]), found, rtol=1e-12, atol=1e-12)


def test_compensation_tilts_neither_direction_nor_torque() -> None:
    """Compensation adds weight along world z, and leaves the horizontal force and the torque bit for bit."""
    state = (0.1, 0.2, 0.3, 0.9273618495495703), (0.3, -0.2, 0.1), (1.0, 2.0, 3.0)
    body, direction = BodyParameters(), (0.6, 0.0, 0.8)
    without, with_it = (control_law(body, direction, 1.0, c)(*state) for c in (0.0, 0.9))
    assert with_it[0][:2] == without[0][:2]
    assert with_it[0][2] - without[0][2] == pytest.approx(0.9 * 9.81, rel=1e-14)
    assert with_it[1] == without[1]


def test_zero_gains_and_compensation_command_nothing() -> None:
    """With all gains zero and c = 0 a command is neither force nor torque, whatever it says."""
    body = BodyParameters(force_gain=0.0, torque_kp=0.0, torque_kd=0.0)
    law = control_law(body, (0.0, 0.6, 0.8), SPEED_MAX, 0.0)
    force, torque = law((0.5, 0.5, 0.5, 0.5), (1.0, 2.0, 3.0), (4.0, 5.0, 6.0))
    assert force == (0.0, 0.0, 0.0)
    assert torque == (0.0, 0.0, 0.0)


def test_gusts_come_from_the_published_generator() -> None:
    """The generator repeats the published outputs of SplitMix64 for the seed 1234567, state by state."""
    golden = 0x9E3779B97F4A7C15
    outputs = [splitmix64(1234567 + k * golden) for k in range(3)]
    assert outputs == [6457827717110365317, 3203168211198807973, 9817491932198370423]


def test_both_generators_are_the_same() -> None:
    """The compiled generator and its gusts are those of the other form bit for bit, at every seed and step."""
    rng = np.random.default_rng(0)
    states = [0, 1, 2**63, 2**64 - 1, *rng.integers(2**64, size=200, dtype=np.uint64).tolist()]
    assert [kernels.splitmix64(np.uint64(state)) for state in states] == [
        splitmix64(state) for state in states
    ]
    for seed in (0, 1, -1, -3, 2**63 - 1, -(2**63), *rng.integers(-(2**63), 2**63 - 1, size=50).tolist()):
        word = np.array([seed]).view(np.uint64)[0]
        for step in (1, 2, 400, 10**9):
            assert kernels.gust_force(0.7, word, step) == gust_force(0.7, seed, step)
    assert kernels.gust_force(0.0, np.uint64(7), 1) == (0.0, 0.0, 0.0)


def test_a_gust_depends_on_seed_and_step_alone() -> None:
    """Components lie within the amplitude, repeat for the same seed and step, and no step shares another's."""
    gusts = np.array([gust_force(2.0, 7, step) for step in range(1, 401)])
    assert np.abs(gusts).max() <= 2.0
    assert len(np.unique(gusts)) == gusts.size
    assert gusts.mean() == pytest.approx(0.0, abs=0.15)
    assert gusts.std() == pytest.approx(2 / np.sqrt(3), rel=0.05)
    assert gust_force(2.0, 7, 400) == tuple(gusts[-1])
    assert gust_force(2.0, -3, 1) == gust_force(2.0, 2**64 - 3, 1)
    assert gust_force(0.0, 7, 1) == (0.0, 0.0, 0.0)


def test_the_defaults_are_the_table_of_the_protocol() -> None:
    """Names and order are the protocol's, and every default lies in its range."""
    assert [field.name for field in dataclasses.fields(BodyParameters)] == [p.name for p in PARAMETERS]
    for parameter, value in zip(PARAMETERS, BodyParameters().row(), strict=True):
        assert parameter.lowest <= value <= parameter.highest, parameter.name
        assert not (parameter.above_lowest and value == parameter.lowest), parameter.name
        assert not parameter.either or value in parameter.either, parameter.name


def test_the_specification_has_the_defaults() -> None:
    """The defaults and the largest speed that the protocol's page gives for this server are its own."""
    page = " ".join((Path(plant.__file__).parent / "README.md").read_text(encoding="utf-8").split())
    values = zip(PARAMETERS, BodyParameters().row(), strict=True)
    assert ", ".join(f"{parameter.name} {value:g}" for parameter, value in values) in page
    assert f"`speed_max` {SPEED_MAX:g} " in page
