"""What inner steps with their forces, rays and network cost by themselves, without any of our classes.

A bare script-like loop of the libraries' calls over a recorded flight: the same commands from the same start,
hence the same states. It is the yardstick of the whole control loop.
"""

from __future__ import annotations

import itertools
import time
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from meshes import embree
from meshes.tube import Tube
from physics_server import bullet_world

Floats = NDArray[np.float64]

GRAVITY: Final = 9.81


def physics_microseconds(tube: Tube, records: NDArray[np.void], inner_steps: int, dt: float) -> float:
    """Mean time of the inner steps of one control step: read the state, form the force, apply it, simulate.

    Args:
        tube: the tube that was flown through.
        records: the flight's records, the reset pose first.
        inner_steps: of one control step.
        dt: control step (s).
    """
    p: Any = bullet_world.pybullet  # type: ignore[attr-defined]  # its one importer
    client = p.connect(p.DIRECT)
    try:
        p.setPhysicsEngineParameter(
            fixedTimeStep=dt / inner_steps, enableFileCaching=0, physicsClientId=client
        )
        p.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=client)
        wall = p.createCollisionShape(
            p.GEOM_MESH,
            vertices=tube.wall.vertices.tolist(),
            indices=tube.wall.faces.ravel().tolist(),
            flags=p.GEOM_FORCE_CONCAVE_TRIMESH,
            physicsClientId=client,
        )
        p.createMultiBody(0.0, wall, physicsClientId=client)
        sphere = p.createCollisionShape(p.GEOM_SPHERE, radius=0.15, physicsClientId=client)
        body = p.createMultiBody(1.0, sphere, physicsClientId=client)
        p.changeDynamics(
            body, -1, localInertiaDiagonal=(0.004,) * 3, linearDamping=0.0, angularDamping=0.0,
            physicsClientId=client,
        )  # fmt: skip
        start = records[0]
        p.resetBasePositionAndOrientation(
            body, start["position"].tolist(), start["quaternion"].tolist(), physicsClientId=client
        )
        commands = [
            (*row["direction"].tolist(), float(row["commanded_speed"]), float(row["compensation"]))
            for row in records[1:]
        ]
        started = time.perf_counter()
        for command in commands:
            _inner_steps(p, client, body, command, inner_steps)
        return (time.perf_counter() - started) / len(commands) * 1e6
    finally:
        p.disconnect(client)


def _inner_steps(
    p: Any, client: int, body: int, command: tuple[float, float, float, float, float], inner_steps: int
) -> None:
    """The inner steps of one control step with the default plant: mass 1 kg, gain 8 /s."""
    dx, dy, dz, speed, compensation = command
    for _ in range(inner_steps):
        position, (x, y, z, w) = p.getBasePositionAndOrientation(body, client)
        (vx, vy, vz), (ox, oy, oz) = p.getBaseVelocity(body, client)
        fx, fy, fz = 1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)
        force = (
            8.0 * (speed * dx - vx),
            8.0 * (speed * dy - vy),
            8.0 * (speed * dz - vz) + compensation * GRAVITY,
        )
        torque = (
            0.004 * (120.0 * (fy * dz - fz * dy) - 18.0 * ox),
            0.004 * (120.0 * (fz * dx - fx * dz) - 18.0 * oy),
            0.004 * (120.0 * (fx * dy - fy * dx) - 18.0 * oz),
        )
        p.applyExternalForce(body, -1, force, position, p.WORLD_FRAME, client)
        p.applyExternalTorque(body, -1, torque, p.WORLD_FRAME, client)
        p.stepSimulation(client)


def rays_microseconds(tube: Tube, records: NDArray[np.void], rays: int, reach: float) -> float:
    """Mean time of one call of Embree with as many rays as the LiDAR has, from the flight's positions."""
    scene = embree.EmbreeScene(robust=True)  # type: ignore[attr-defined]  # its one importer
    centre = tube.wall.vertices.mean(axis=0)
    vertices = (tube.wall.vertices - centre).astype(np.float32)
    mesh = embree.TriangleMesh(scene, vertices, tube.wall.faces)  # type: ignore[attr-defined]
    angle = np.linspace(0.0, 2.0 * np.pi, rays, endpoint=False)
    directions = np.stack([np.zeros(rays), np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)
    origins = [np.tile((row["position"] - centre).astype(np.float32), (rays, 1)) for row in records[1:]]
    scene.run(origins[0], directions, dists=reach, query="DISTANCE")  # the first call builds the scene
    started = time.perf_counter()
    for at in origins:
        scene.run(at, directions, dists=reach, query="DISTANCE")
    taken = (time.perf_counter() - started) / len(origins) * 1e6
    del mesh  # the scene does not own it
    return taken


def network_microseconds(records: NDArray[np.void], sizes: tuple[int, ...]) -> float:
    """Mean time of the network alone: dense layers by numpy, tanh between them, the largest logit."""
    rng = np.random.default_rng(0)
    layers = [
        (rng.standard_normal((n, m)).astype(np.float32) / n, np.zeros(m, np.float32))
        for n, m in itertools.pairwise(sizes)
    ]
    observations = [np.array(row["observation"]) for row in records[1:]]
    started = time.perf_counter()
    for x in observations:
        for weight, bias in layers[:-1]:
            x = np.tanh(x @ weight + bias)
        (x @ layers[-1][0] + layers[-1][1]).argmax()
    return (time.perf_counter() - started) / len(observations) * 1e6
