"""One lane's world in the Bullet engine: the one importer of pybullet.

A sphere in a static concave triangle mesh, in a DIRECT client of its own. Bullet integrates semi-implicitly:
velocities first, from the forces at the beginning of the inner step, then the pose from the new velocities.
Where it departs from the equations, and by how much:

- The gyroscopic torque of unequal moments of inertia is taken at the beginning of the inner step: free
  rotation gains energy in proportion to the step, 1.8 % in 2 s at 3.7 rad/s, moments 1 : 2 : 3 and 1/240 s.
  With equal moments, the default, free rotation is exact.
- Contacts are found at the beginning of an inner step: a body that comes to touch the wall by the last inner
  step of a control step reports it in the next one.
- A body is stopped where it is found, inside of the wall by at most the way of one inner step, and pushed out
  slowly (CONTACT_ERP), so that a bounce is faster by up to that fraction of the speed of impact.
- Impacts slower than RESTITUTION_SPEED do not bounce.

Continuous collision detection is off: in 1/240 s a drone of 2 m/s moves 8 mm, and one at the largest speed
that a command may carry 42 mm, against a radius of 150 mm. It cannot pass through a surface undetected.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from typing import Final, NamedTuple

import numpy as np

from meshes.geometry import Floats
from physics_server.errors import EngineError
from physics_server.law import Law, Quaternion, Vector
from physics_server.parameters import BodyParameters
from physics_server.walls import Piece, RegisteredWall


@contextmanager
def _silenced_stderr() -> Iterator[None]:
    """Swallow what C code prints to stderr: pybullet announces its build time there when it is imported."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


try:
    with _silenced_stderr():
        import pybullet
except ImportError as error:
    raise EngineError(
        f"the engine 'bullet' needs pybullet, which cannot be imported here ({error}); PyPI has wheels of it "
        "for Linux only and not for the newest CPython: install it there, or fly with another physics peer"
    ) from error

ENGINE: Final = f"bullet {version('pybullet')}"

WORLDS_MAX: Final = 1024
"""Clients that pybullet can hold in one process."""

VERTICES_MAX: Final = 131_072
INDICES_MAX: Final = 524_288
"""What pybullet takes in one collision shape; a larger wall is split into several static bodies."""

CONTACT_ERP: Final = 0.02
"""Fraction of a penetration that the solver takes back in an inner step.

Bullet's default of 0.08 throws a drone that ought to stick back at up to 8 % of its speed of impact; with 0 a
drone that slides along a bend sinks into the wall."""

RESTITUTION_SPEED: Final = 0.2
"""Speed of impact (m/s) below which a body does not bounce, so that it can come to rest; Bullet's default."""

_STATIC: Final = 2
"""Bullet's filter group of bodies that do not move."""

_DISTANCE: Final = 8
"""Index of the distance in what getContactPoints returns; negative where the body is inside of the wall."""


class BodyState(NamedTuple):
    """Pose and velocities of a body: metres, quaternion x y z w (body to world), m/s, rad/s, world frame."""

    position: Vector
    quaternion: Quaternion
    linear_velocity: Vector
    angular_velocity: Vector


CLOSE_STEPS: Final = 16
"""Control steps in which contacts are watched without asking how far the wall is, once it was near."""


class World:
    """One client of the engine: the wall of at most one tube, and at most one body.

    Costs 28 MB and, where memory is fresh, up to 80 ms; building a wall of 38,000 triangles takes 32 ms.
    """

    def __init__(self, physics_dt: float) -> None:
        """Open an empty world that integrates by `physics_dt` (s)."""
        self.wall: RegisteredWall | None = None
        self._physics_dt = physics_dt
        self._client: int = pybullet.connect(pybullet.DIRECT)
        if self._client < 0:
            raise EngineError(f"{ENGINE}: expected a further world, found no room for one; use fewer lanes")
        self._body = -1
        self._first_wall = -1
        self._close = 0
        self._pieces = 0
        self.build(None)

    def build(self, wall: RegisteredWall | None) -> None:
        """Empty the world and put a wall into it."""
        client = self._client
        pybullet.resetSimulation(physicsClientId=client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self._physics_dt,
            numSubSteps=0,
            enableFileCaching=0,  # it would keep an older wall of the same name
            deterministicOverlappingPairs=1,
            contactERP=CONTACT_ERP,
            restitutionVelocityThreshold=RESTITUTION_SPEED,
            physicsClientId=client,
        )
        pieces = [] if wall is None else wall.pieces
        for piece in pieces:
            self._first_wall = _add_static(client, piece)
        self.wall, self._body, self._pieces = wall, -1, len(pieces)

    def place(self, wall: RegisteredWall | None, body: BodyParameters, state: BodyState) -> BodyState:
        """Begin anew with one body in this state; returns the state as the engine has it.

        The same wall is kept: the body goes, and with it its contacts and all that the engine remembers of
        them, and a new one comes. With several pieces the order in which the engine takes the pairs may
        depend on the past, so that such a world is built anew.
        """
        client = self._client
        if self.wall is not wall or self._pieces > 1:
            self.build(wall)
        elif self._body >= 0:
            pybullet.removeBody(self._body, physicsClientId=client)
        self._body = drone = _add_body(client, body)
        self._close = 0
        pybullet.setGravity(0.0, 0.0, -body.gravity, physicsClientId=client)
        pybullet.resetBasePositionAndOrientation(
            drone, state.position, state.quaternion, physicsClientId=client
        )
        pybullet.resetBaseVelocity(
            drone, state.linear_velocity, state.angular_velocity, physicsClientId=client
        )
        position, quaternion = pybullet.getBasePositionAndOrientation(drone, physicsClientId=client)
        linear, angular = pybullet.getBaseVelocity(drone, physicsClientId=client)
        return BodyState(position, quaternion, linear, angular)

    def far_from_wall(self, distance: float) -> bool:
        """Whether the wall is known to be further than `distance` (m) from the body's surface.

        Asking takes 2 us where the wall is far, but hundreds where many triangles are near: after a no it is
        not asked again for CLOSE_STEPS calls, and the answer is no meanwhile. Of a wall in several pieces it is
        always no.
        """
        if self._pieces != 1:
            return self._pieces == 0
        if self._close > 0:
            self._close -= 1
            return False
        near = pybullet.getClosestPoints(
            self._body, self._first_wall, distance, -1, -1, physicsClientId=self._client
        )
        if near:
            self._close = CLOSE_STEPS
        return not near

    def integrate(
        self,
        state: BodyState,
        law: Law,
        inner_steps: int,
        watch_contacts: bool = True,
        torque_in_world: bool = False,
    ) -> tuple[BodyState, int]:
        """Take inner steps under a law; returns the new state, and in how many of them the body touched.

        The innermost loop of the project: names are bound locally and arguments are positional, which saves a
        tenth of the time.

        Args:
            state: where the body stands, as the last call left it.
            law: force (world frame) and torque from the state.
            inner_steps: how many.
            torque_in_world: whether the torque is in the world frame, else in the body frame.
            watch_contacts: False where no contact is possible, which saves asking for it after every inner step.
        """
        position, quaternion, velocity, omega = state
        client, drone = self._client, self._body
        world = pybullet.WORLD_FRAME
        torque_frame = world if torque_in_world else pybullet.LINK_FRAME
        apply_force, apply_torque = pybullet.applyExternalForce, pybullet.applyExternalTorque
        simulate, contact_points = pybullet.stepSimulation, pybullet.getContactPoints
        get_pose, get_velocity = pybullet.getBasePositionAndOrientation, pybullet.getBaseVelocity
        touched = 0
        for _ in range(inner_steps):
            force, torque = law(quaternion, velocity, omega)
            apply_force(drone, -1, force, position, world, client)
            apply_torque(drone, -1, torque, torque_frame, client)
            simulate(client)
            if watch_contacts:
                # The engine also lists points that are near: at a distance of 0 or less they touch.
                for contact in contact_points(drone, -1, -2, -2, client):
                    if contact[_DISTANCE] <= 0.0:
                        touched += 1
                        break
            position, quaternion = get_pose(drone, client)
            velocity, omega = get_velocity(drone, client)
        return BodyState(position, quaternion, velocity, omega), touched

    def distances(self, origins: Floats, directions: Floats, reach: float) -> Floats:
        """Distance (m) to the wall along each ray (M, 3), at most `reach` (m), (M,); the body is not seen."""
        ends = (origins + directions * reach).tolist()
        hits: Sequence[tuple[int, int, float]] = pybullet.rayTestBatch(
            origins.tolist(), ends, collisionFilterMask=_STATIC, physicsClientId=self._client
        )
        return np.array([hit[2] * reach for hit in hits])

    def close(self) -> None:
        """Give the client back."""
        pybullet.disconnect(physicsClientId=self._client)


def _add_static(client: int, piece: Piece) -> int:
    """Put one piece of wall into a world; returns its id."""
    shape = pybullet.createCollisionShape(
        pybullet.GEOM_MESH,
        vertices=piece.vertices,
        indices=piece.indices,  # without them the engine takes the convex hull: a tube filled solid
        flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH,
        physicsClientId=client,
    )
    wall: int = pybullet.createMultiBody(0.0, shape, physicsClientId=client)
    # The engine multiplies the coefficients of both bodies: 1 here leaves the lane's parameters as they are.
    pybullet.changeDynamics(
        wall, -1, restitution=1.0, lateralFriction=1.0, contactProcessingThreshold=0.0, physicsClientId=client
    )
    return wall


def _add_body(client: int, body: BodyParameters) -> int:
    """Put the drone's sphere into a world, at the origin; returns its id."""
    shape = pybullet.createCollisionShape(
        pybullet.GEOM_SPHERE, radius=body.body_radius, physicsClientId=client
    )
    drone: int = pybullet.createMultiBody(body.mass, shape, physicsClientId=client)
    pybullet.changeDynamics(
        drone,
        -1,
        localInertiaDiagonal=(body.inertia_x, body.inertia_y, body.inertia_z),
        restitution=body.restitution,
        lateralFriction=body.friction,
        rollingFriction=0.0,
        spinningFriction=0.0,
        linearDamping=0.0,
        angularDamping=0.0,
        maxJointVelocity=np.inf,  # Bullet would cut off every component of velocity at 100
        contactProcessingThreshold=0.0,  # a wall that is near but not yet touched must not slow the body down
        activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
        physicsClientId=client,
    )
    return drone
