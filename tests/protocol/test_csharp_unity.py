"""What Unity's part is made of, against formulas and our own readers; and that part itself over a stand-in for Unity.

Unity is not here: its component is compiled against `unity_stubs.cs`, types by Unity's names with a naive engine
behind them, and has to pass the kit over that.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from csharp import (
    MONO,
    SOURCES,
    Floats,
    build,
    needs_mono,
    open_session,
    random_commands,
    random_resets,
    run_rules,
    serving,
    unit,
)
from scipy.spatial.transform import Rotation

from meshes.obj import read_obj
from meshes.tube import INDUSTRIAL
from protocol.conformance.rule import Level
from protocol.errors import Refusal, RefusalCode
from protocol.liveness import start_time
from protocol.plant import PARAMETERS, CommandBatch, ResetBatch, TubeReference

pytestmark = needs_mono

HERE = Path(__file__).parent
SYMBOLS = {
    "2021": (),
    "2022": ("UNITY_2022_2_OR_NEWER",),
    "6000": ("UNITY_2022_2_OR_NEWER", "UNITY_6000_0_OR_NEWER"),
}
"""What Unity defines for the compiler, by its version."""

QUIET_S = 0.2
"""Longer than the component waits for more within a frame."""

Ask = Callable[..., list[Floats]]
Commands = Callable[..., CommandBatch]
Folder = pytest.TempPathFactory
Resets = Callable[..., ResetBatch]


def build_player(folder: Path, version: str) -> Path:
    """Compile Unity's part as some version of Unity would, against the stand-in for it."""
    sources = [*sorted((SOURCES / "unity").glob("*.cs")), HERE / "unity_stubs.cs"]
    return build(folder / "player.exe", "Player", *sources, defines=SYMBOLS[version])


@pytest.fixture(scope="session")
def checks(tmp_path_factory: Folder) -> Path:
    """The program that answers questions about the library's functions."""
    return build(tmp_path_factory.mktemp("csharp") / "checks.exe", "Checks", HERE / "csharp_checks.cs")


@pytest.fixture(scope="session")
def player(tmp_path_factory: Folder) -> Path:
    """The component over the stand-in, as Unity 6 has it."""
    return build_player(tmp_path_factory.mktemp("csharp"), "6000")


@pytest.fixture
def ask(checks: Path) -> Ask:
    """Ask about functions of the library, a line each; returns the numbers of each answer."""

    def run(*questions: str) -> list[Floats]:
        done = subprocess.run(
            [*MONO.split(), str(checks)],
            input="".join(f"{question}\n" for question in questions),
            capture_output=True,
            text=True,
            check=False,
            timeout=60,
        )
        assert done.returncode == 0, done.stderr
        answers = [np.array(line.split(), dtype=float) for line in done.stdout.splitlines()]
        assert len(answers) == len(questions)
        return answers

    return run


def text(numbers: Floats) -> str:
    """Write numbers as a question has them, every bit of them."""
    return " ".join(map(repr, numbers.tolist()))


def test_liveness_goes_by_pid_and_start_time(ask: Ask) -> None:
    """This process lives, but not as one that was started at another time; a reaped child and a zombie are dead."""
    reaped = subprocess.Popen(["true"])
    reaped.wait()
    zombie = subprocess.Popen(["true"])
    os.waitid(os.P_PID, zombie.pid, os.WEXITED | os.WNOWAIT)
    pid, started = os.getpid(), start_time(os.getpid())
    cases = [(pid, started), (pid, 0), (0, 0), (pid, started + 1), (reaped.pid, 0), (zombie.pid, 0)]
    answers = ask(*(f"alive {case[0]} {case[1]}" for case in cases))
    zombie.wait()
    assert [bool(answer[0]) for answer in answers] == [True, True, True, False, False, False]


def test_frames_mirror_the_world(ask: Ask) -> None:
    """200 random poses: rotating and converting commute, and a rotation is S R S with the swap S of Y and Z.

    The derivative of S R S is that of a body with Unity's angular velocity, by numerical difference.
    """
    rng = np.random.default_rng(5)
    swap = np.eye(3)[[0, 2, 1]]
    quaternions, vectors, spins = unit(rng, 200, 4), rng.normal(size=(200, 3)), rng.normal(size=(200, 3))
    matrices = Rotation.from_quat(quaternions).as_matrix()
    there = np.array(ask(*(f"rotation {text(q)}" for q in quaternions)))
    np.testing.assert_allclose(Rotation.from_quat(there).as_matrix(), swap @ matrices @ swap, atol=1e-14)
    moved = np.array(ask(*(f"vector {text(v)}" for v in vectors)))
    np.testing.assert_array_equal(moved, vectors @ swap)
    rotated = np.array(ask(*(f"rotate {text(q)} {text(v)}" for q, v in zip(there, moved, strict=True))))
    np.testing.assert_allclose(rotated, np.einsum("nij,nj->ni", matrices, vectors) @ swap, atol=1e-14)

    h = 1e-6
    turned = np.array(ask(*(f"spin {text(w)}" for w in spins)))
    later = Rotation.from_rotvec(h * spins).as_matrix() @ matrices
    change = swap @ (later - matrices) @ swap / h
    cross = np.cross(turned[:, None, :], np.eye(3)[None]).transpose(0, 2, 1)  # [omega]x, column by column
    np.testing.assert_allclose(change, cross @ (swap @ matrices @ swap), atol=1e-5)
    back = np.array(ask(*(f"rotation {text(q)}" for q in there)))
    np.testing.assert_array_equal(back, quaternions)


def test_force_and_torque_are_those_of_annex_a(ask: Ask) -> None:
    """50 random states and commands against the formulas in matrices."""
    rng = np.random.default_rng(6)
    questions, expected = [], []
    for _ in range(50):
        resets, commands = random_resets(rng, 1), random_commands(rng, 1)
        p = dict(zip((parameter.name for parameter in PARAMETERS), resets.parameters[0], strict=False))
        q, v, w = resets.quaternion[0], resets.linear_velocity[0], resets.angular_velocity[0]
        d, speed, c = commands.direction[0], commands.speed[0], commands.compensation[0]
        gust = rng.normal(size=3)
        matrix = Rotation.from_quat(q).as_matrix()
        inertia = matrix @ np.diag([p["inertia_x"], p["inertia_y"], p["inertia_z"]]) @ matrix.T
        forward, up = matrix[:, 0], np.array([0.0, 0.0, 1.0])
        along = forward if p["force_along_body"] else d
        disturbance = [p["disturbance_x"], p["disturbance_y"], p["disturbance_z"]]
        force = p["mass"] * p["force_gain"] * (speed * along - v) + c * p["mass"] * p["gravity"] * up
        force += disturbance + gust - p["linear_drag"] * v
        torque = (
            inertia @ (p["torque_kp"] * np.cross(forward, d) - p["torque_kd"] * w) - p["angular_drag"] * w
        )
        expected.append([*force, *torque, *-np.cross(w, inertia @ w)])
        known = resets.parameters[0, : len(PARAMETERS)]
        questions.append(f"law {text(np.concatenate([q, v, w, d, [speed, c], gust, known]))}")
    np.testing.assert_allclose(np.array(ask(*questions)), expected, rtol=1e-12, atol=1e-12)


def test_gusts_are_those_of_annex_a(ask: Ask) -> None:
    """splitmix64 as the specification checks it, and components from plain integers of any size."""

    def splitmix(x: int) -> int:
        mask = (1 << 64) - 1
        z = (x + 0x9E3779B97F4A7C15) & mask
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & mask
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & mask
        return z ^ (z >> 31)

    def gust(seed: int, step: int, amplitude: float) -> list[float]:
        words = [splitmix((seed + 3 * (step - 1) + axis) % (1 << 64)) for axis in range(3)]
        return [amplitude * (2 * ((word >> 11) / 2**53) - 1) for word in words]

    (halves,) = ask("splitmix 0")
    assert (int(halves[0]) << 32) + int(halves[1]) == 0xE220A8397B1DCDAF
    cases = [(0, 1, 1.0), (7, 2, 0.5), (-1, 1, 2.0), (2**63 - 1, 1000, 3.0)]
    answers = ask(*(f"gust {seed} {step} {amplitude}" for seed, step, amplitude in cases))
    for answer, case in zip(answers, cases, strict=True):
        assert answer.tolist() == gust(*case)


def test_a_wall_is_read_as_it_stands_in_the_file(ask: Ask, tmp_path: Path) -> None:
    """The conduit has the triangles that our own reader finds; a small file shows fans, signs, axes and scale."""
    sha256 = hashlib.sha256(INDUSTRIAL.read_bytes()).hexdigest()
    (corners,) = ask(f"mesh zup 1.0 {sha256} {INDUSTRIAL}")
    data = read_obj(INDUSTRIAL)
    np.testing.assert_allclose(corners.reshape(-1, 3, 3), data.vertices[data.faces], rtol=1e-15)

    square = tmp_path / "square.OBJ"
    square.write_text(
        "# a square\no s\nv 0 0 0\nv 1 0 0 1.0\nv 1 2 \\\n 0\nv 0 2 3e0\nl 1 2\nf 1/1/1 2//1 -2 -1/4\n"
    )
    (corners,) = ask(f"mesh yup 0.5 {hashlib.sha256(square.read_bytes()).hexdigest()} {square}")
    a, b, c, d = [0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.5, 0.0, 1.0], [0.0, -1.5, 1.0]
    assert corners.reshape(-1, 3).tolist() == [a, b, c, a, c, d]


@pytest.mark.parametrize(
    ("suffix", "content", "field"),
    [
        (".stl", "solid", "tube_path"),
        (".obj", None, "tube_path"),
        (".obj", "v 0 0 0\n", "tube_path"),
        (".obj", "v 0 0\n", "tube_path"),
        (".obj", "v 0 0 0\nf 1 2 3\n", "tube_path"),
        (".obj", "v 0 0 0\nf 1 0 1\n", "tube_path"),
        (".obj", "v 0 0 nan\n", "tube_path"),
        (".obj", "another file", "tube_sha256"),
    ],
)
def test_a_wall_that_cannot_be_read_is_refused(
    checks: Path, tmp_path: Path, suffix: str, content: str | None, field: str
) -> None:
    """A wrong format, no file, no faces, half a vertex, an unknown corner, no number, another hash."""
    mesh = tmp_path / f"tube{suffix}"
    if content is not None:
        mesh.write_text(content)
    sha256 = hashlib.sha256((content or "").encode()).hexdigest() if field == "tube_path" else "00" * 32
    done = subprocess.run(
        [*MONO.split(), str(checks)],
        input=f"mesh zup 1.0 {sha256} {mesh}\n",
        capture_output=True,
        text=True,
        check=True,
        timeout=30,
    )
    assert done.stdout == f"refused {field}\n"


@pytest.mark.parametrize("version", ["2021", "2022"])
def test_the_unity_part_compiles_as_older_versions_would(tmp_path: Path, version: str) -> None:
    """Against the names that those versions of Unity have."""
    build_player(tmp_path, version)


def test_the_unity_component_passes_the_suite_over_a_stand_in(player: Path) -> None:
    """Frames, law, walls, contact, lanes, resets and turns hold with a left-handed engine in floats behind them."""
    skipped = {"contact-none-promised": "the plant has walls"}
    assert run_rules(player, "shm", Level.CORE, Level.LANES) == ([], skipped)


def test_the_unity_component_refuses_a_wall_that_it_cannot_read(
    player: Path, rendezvous: str, resets: Resets, commands: Commands
) -> None:
    """The refusal names the file, and the session goes on, also over many frames without a request."""
    with serving(rendezvous) as serve:
        serve(player)
        with open_session(rendezvous) as session:
            with pytest.raises(Refusal, match=r"missing\.obj") as caught:
                session.register_tube(0, TubeReference("/missing.obj", "zup", 1.0, "0" * 64))
            assert caught.value.code is RefusalCode.PLANT
            session.reset(resets())
            time.sleep(QUIET_S)
            assert session.step(commands()).step[0] == 1
