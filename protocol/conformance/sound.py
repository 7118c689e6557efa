"""Sound requests for rules to send, and what rules ask of the replies to them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from protocol import layout
from protocol.conformance.raw_agent import RawAgent, Refused, Reply
from protocol.conformance.rule import Failure, Skip, demand, expect
from protocol.errors import RefusalCode
from protocol.layout import POSE, Axes, Op
from protocol.plant import PARAMETER_INDEX, PARAMETERS, CommandBatch, Floats, PoseBatch, ResetBatch

Vector = Sequence[float]

AT_REST = {
    "force_gain": 0.0,
    "force_along_body": 0.0,
    "torque_kp": 0.0,
    "torque_kd": 0.0,
    "linear_drag": 0.0,
    "angular_drag": 0.0,
    "gravity": 0.0,
    "disturbance_x": 0.0,
    "disturbance_y": 0.0,
    "disturbance_z": 0.0,
    "gust": 0.0,
}
"""Parameters under which nothing acts on a body."""


def speed_max(agent: RawAgent) -> float:
    """The largest speed that the server takes (m/s)."""
    return layout.read_f64(agent.pose, POSE["speed_max"])[0]


def has_walls(agent: RawAgent) -> bool:
    """Whether the server says that registered tubes stop the body."""
    return agent.get("walls") == 1


def resets(agent: RawAgent, lanes: Sequence[int] | None = None, /, **parameters: float) -> ResetBatch:
    """Resets of all lanes, or of those given, to rest at the origin, with the server's own defaults.

    Args:
        agent: whose session it is.
        lanes: the lanes to reset.
        parameters: by name, in place of the defaults.
    """
    batch = ResetBatch.zeros(agent.settings.lanes)
    batch.selected[range(agent.settings.lanes) if lanes is None else list(lanes)] = 1
    batch.parameters[:] = layout.read_f64(agent.pose, POSE["defaults"])
    for name, value in parameters.items():
        batch.parameters[:, PARAMETER_INDEX[name]] = value
    return batch


def commands(
    agent: RawAgent, direction: Vector = (1.0, 0.0, 0.0), speed: float = 0.0, compensation: float = 1.0
) -> CommandBatch:
    """The same command for every lane; as it is, one that hovers."""
    batch = CommandBatch.zeros(agent.settings.lanes)
    batch.direction[:], batch.speed[:], batch.compensation[:] = direction, speed, compensation
    return batch


def done(reply: Reply, what: str) -> PoseBatch:
    """Demand that a request was carried out, and return the poses of its reply.

    Raises:
        Failure: it was refused, or answered with an unknown status.
    """
    if reply.refused is not None:
        raise Failure(what, "status 0", f"status {reply.status}, {words(reply.refused)}")
    return reply.poses


def words(refused: Refused) -> str:
    """Put a refusal into words."""
    where = "" if refused.lane < 0 else f" in lane {refused.lane}"
    return (
        f"refusal {refused.code}: {refused.field}{where}: expected {refused.expected}, found {refused.found}"
    )


def done_or_skip(reply: Reply, what: str) -> PoseBatch:
    """As `done`, for what a plant may be unable to do.

    Raises:
        Skip: it was refused with the code PLANT.
        Failure: it was refused otherwise.
    """
    if reply.refused is not None and reply.refused.code == RefusalCode.PLANT:
        raise Skip(f"the plant refuses {what} ({words(reply.refused)})")
    return done(reply, what)


def refused(reply: Reply, what: str, code: RefusalCode, lane: int) -> None:
    """Demand that a request was refused with this code and lane, and with all three texts.

    Raises:
        Failure: it was carried out, or refused otherwise.
    """
    expected = f"refusal {code.value} ({code.name}), lane {lane}"
    if reply.refused is None:
        raise Failure(what, expected, "status 0")
    expect(f"status of the reply to {what}", reply.status, layout.Status.REFUSED.value)
    found = f"refusal {reply.refused.code}, lane {reply.refused.lane} ({words(reply.refused)})"
    demand((reply.refused.code, reply.refused.lane) == (code.value, lane), what, expected, found)
    for name in ("field", "expected", "found"):
        demand(bool(getattr(reply.refused, name)), f"{what}, refusal_{name}", "a text", "none")


def fly(agent: RawAgent, commands: CommandBatch, steps: int) -> list[PoseBatch]:
    """Step with the same commands; the poses after each step."""
    return [done(agent.step(commands), f"step {agent.steps + 1}") for _ in range(steps)]


def same_bits(
    what: str, found: PoseBatch, expected: PoseBatch, lanes: slice | Sequence[int] = slice(None)
) -> None:
    """Demand that pose rows are the same bit for bit.

    Raises:
        Failure: a word differs; names the first.
    """
    differing = np.argwhere(found.raw.view(np.int64)[lanes] != expected.raw.view(np.int64)[lanes])
    if differing.size:
        row, word = differing[0].tolist()
        lane = int(np.arange(len(found.raw))[lanes][row])
        field = next(field for field in reversed(layout.POSE_ROW) if field.offset <= word * layout.WORD)
        values = (getattr(batch, field.name)[lane].tolist() for batch in (expected, found))
        raise Failure(f"{what}, {field.name} of lane {lane}", *values)


def close_to(what: str, found: Vector | Floats, expected: Vector | Floats, tolerance: float) -> None:
    """Demand that numbers agree within a tolerance.

    Raises:
        Failure: one does not; names them all.
    """
    one, other = np.asarray(found, dtype=float), np.asarray(expected, dtype=float)
    if not (np.isfinite(one).all() and (np.abs(one - other) <= tolerance).all()):
        raise Failure(what, f"{other.tolist()} within {tolerance:.3g}", one.tolist())


def parameter_names() -> list[str]:
    """Names of the plant parameters in the order of their words."""
    return [parameter.name for parameter in PARAMETERS]


# --- tubes ---


def write_box(path: Path, half: Vector = (1.0, 1.0, 1.0), centre: Vector = (0.0, 0.0, 0.0)) -> Path:
    """Write a closed box as Wavefront text, its six faces polygons of four corners."""
    corners = [
        [centre[axis] + (2 * sign[axis] - 1) * half[axis] for axis in range(3)]
        for sign in np.ndindex(2, 2, 2)
    ]
    faces = ((1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4))
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in corners]
    lines += ["f " + " ".join(map(str, face)) for face in faces]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    return path


def put_tube(
    agent: RawAgent,
    index: int,
    path: Path,
    axes: int = Axes.zup,
    scale: float = 1.0,
    sha256: bytes | None = None,
) -> None:
    """Write the words of a registration; the hash is the file's unless one is given."""
    encoded = str(path).encode()
    digest = sha256
    if digest is None:
        digest = hashlib.sha256(path.read_bytes()).digest() if path.is_file() else bytes(32)
    agent.put(
        tube_index=index,
        tube_axes=int(axes),
        tube_scale=float(scale),
        tube_sha256=digest,
        tube_path_bytes=len(encoded),
        tube_path=encoded,
    )


def register(agent: RawAgent, index: int, path: Path, axes: int = Axes.zup, scale: float = 1.0) -> Reply:
    """Ask for the registration of a mesh."""
    put_tube(agent, index, path, axes, scale)
    return agent.ask(Op.REGISTER_TUBE)


def release(agent: RawAgent, index: int) -> Reply:
    """Ask for the release of a tube."""
    agent.put(tube_index=index)
    return agent.ask(Op.RELEASE_TUBE)


def take_box(agent: RawAgent, folder: Path, index: int = 0) -> Path:
    """Register a box of 2 m side around the origin, and return its file.

    Raises:
        Skip: the plant takes no tubes.
    """
    path = write_box(folder / f"box-{index}.obj")
    done_or_skip(register(agent, index, path), "tubes")
    return path
