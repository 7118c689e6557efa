"""The plant of the physics process: one Bullet world a lane."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from meshes.geometry import Floats
from physics_server.bullet_world import ENGINE, INDICES_MAX, VERTICES_MAX, WORLDS_MAX, BodyState, World
from physics_server.errors import EngineError
from physics_server.law import control_law, gust_force, torque_in_world, travel_bound
from physics_server.parameters import BodyParameters, description
from physics_server.walls import AGREEMENT, RegisteredWall, read_registered, ring_around
from protocol.errors import Refusal
from protocol.plant import (
    NO_TUBE,
    CommandBatch,
    Plant,
    PlantDescription,
    PoseBatch,
    ResetBatch,
    TubeReference,
)

RAYS_MAX: Final = 16_000
"""Rays that pybullet takes in one batch, and a little less."""


def measure_wall(tube: TubeReference, origins: Floats, directions: Floats, reach: float) -> Floats:
    """Distance (m) to a tube's wall as the engine sees it, along rays (M, 3), (M, 3), at most `reach` (m), (M,).

    Raises:
        Refusal: the file cannot be read as a mesh, or is another than the reference says.
    """
    world = World(1.0 / 240.0)
    try:
        world.build(read_registered(tube, VERTICES_MAX, INDICES_MAX))
        batches = range(0, len(origins), RAYS_MAX)
        return np.concatenate(
            [world.distances(origins[i : i + RAYS_MAX], directions[i : i + RAYS_MAX], reach) for i in batches]
        )
    finally:
        world.close()


class _Lane:
    """One lane's world and where it stands."""

    def __init__(self, physics_dt: float) -> None:
        self.world = World(physics_dt)
        self.body = BodyParameters()
        self.seed = 0
        self.steps = 0
        self.state = BodyState((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


CONTACT_MARGIN: Final = 0.05
"""Contacts are not watched where the wall is further than the body can get in the control step, and this (m)
further still: more than any margin that the engine keeps around a triangle."""


class BulletPlant(Plant):
    """Rigid bodies by Bullet; `physics_server.bullet_world` says where the engine departs from the equations.

    The session has checked every request before it comes here: numbers, tube indices, and that each lane was
    reset before its first step.
    """

    def __init__(self) -> None:
        self._lanes: list[_Lane] = []
        self._walls: dict[int, RegisteredWall] = {}
        self._probe: World | None = None
        self._dt = self._physics_dt = 0.0
        self._inner_steps = 0

    def describe(self) -> PlantDescription:
        """Name the engine and publish the default parameters."""
        return description(ENGINE, walls=True)

    def open(self, lanes: int, dt: float, physics_dt: float, inner_steps: int) -> None:
        """Prepare one empty world a lane.

        Raises:
            EngineError: more lanes than the engine can hold.
        """
        if lanes >= WORLDS_MAX:  # one more is needed to check walls
            raise EngineError(
                f"lanes: expected at most {WORLDS_MAX - 1} with {ENGINE}, found {lanes}; use several servers"
            )
        self._dt, self._physics_dt, self._inner_steps = dt, physics_dt, inner_steps
        self._lanes = [_Lane(physics_dt) for _ in range(lanes)]

    def register_tube(self, index: int, tube: TubeReference) -> None:
        """Read a tube's wall.

        Raises:
            Refusal: the file cannot be read as a mesh, or is not the one that the agent read.
        """
        self._walls[index] = read_registered(tube, VERTICES_MAX, INDICES_MAX)

    def release_tube(self, index: int) -> None:
        """Forget a tube."""
        del self._walls[index]

    def reset(self, resets: ResetBatch, poses: PoseBatch) -> None:
        """Put the selected lanes into their initial states.

        Raises:
            Refusal: engine and perception do not agree on the wall around a start. No lane has moved.
        """
        selected = np.flatnonzero(resets.selected).tolist()
        for number in selected:
            tube = int(resets.tube[number])
            if tube != NO_TUBE:
                self._check_wall(
                    number, self._walls[tube], resets.position[number], resets.quaternion[number]
                )
        for number in selected:
            lane, tube = self._lanes[number], int(resets.tube[number])
            lane.body = BodyParameters.from_row(resets.parameters[number].tolist())
            lane.seed, lane.steps = int(resets.seed[number]), 0
            wall = None if tube == NO_TUBE else self._walls[tube]
            lane.state = lane.world.place(wall, lane.body, _initial_state(resets, number))
            self._write(number, 0, poses)

    def step(self, commands: CommandBatch, poses: PoseBatch) -> None:
        """Take one control step in every lane.

        Raises:
            EngineError: a state is no longer finite.
        """
        for number, (lane, command) in enumerate(zip(self._lanes, commands.raw.tolist(), strict=True)):
            lane.steps += 1
            dx, dy, dz, speed, compensation = command[:5]
            gust = gust_force(lane.body.gust, lane.seed, lane.steps)
            law = control_law(lane.body, (dx, dy, dz), speed, compensation, gust)
            furthest = travel_bound(
                lane.body,
                lane.state.linear_velocity,
                speed,
                compensation,
                gust,
                self._physics_dt,
                self._inner_steps,
            )
            watch = not lane.world.far_from_wall(furthest + CONTACT_MARGIN)
            lane.state, touched = lane.world.integrate(
                lane.state, law, self._inner_steps, watch, torque_in_world(lane.body)
            )
            self._write(number, touched, poses)

    def close(self) -> None:
        """Give all worlds back."""
        for lane in self._lanes:
            lane.world.close()
        if self._probe is not None:
            self._probe.close()
        self._lanes, self._walls, self._probe = [], {}, None

    def _check_wall(self, lane: int, wall: RegisteredWall, position: Floats, quaternion: Floats) -> None:
        """Compare the engine's wall around a start with perception's, on a ring around the forward axis.

        An engine may fill a hollow tube solid; then its rays do not find the wall that the sensors see. A lane
        that comes from another tube is not touched before all is well: the wall is built in a spare world.
        """
        world = self._lanes[lane].world
        if world.wall is not wall:
            world = self._probe = self._probe or World(self._physics_dt)
            if world.wall is not wall:
                world.build(wall)
        directions = ring_around(quaternion)
        origins = np.tile(position, (len(directions), 1))
        perception = np.median(wall.wall.scene.distances(origins, directions, wall.reach))
        engine = np.median(world.distances(origins, directions, wall.reach))
        if abs(engine - perception) > AGREEMENT * perception:
            raise Refusal(
                "wall",
                f"a median of {perception:.4f} m around the start, as perception sees {wall.wall.path}",
                f"{engine:.4f} m by the engine's rays: a hollow tube must not be solid to the engine",
                lane,
            )

    def _write(self, number: int, touched: int, poses: PoseBatch) -> None:
        """Write one lane's row of the poses."""
        lane = self._lanes[number]
        position, quaternion, linear, angular = lane.state
        if not math.isfinite(sum(position) + sum(quaternion) + sum(linear) + sum(angular)):
            raise EngineError(
                f"lane {number}, control step {lane.steps}: expected a finite state, found {lane.state}; "
                f"the gains of its reset may be too stiff for inner steps of {self._physics_dt:g} s"
            )
        # The time is a product: a sum over the steps would drift.
        poses.raw[number, :14] = (*position, *quaternion, *linear, *angular, lane.steps * self._dt)
        poses.contact_steps[number] = touched
        poses.step[number] = lane.steps


def _initial_state(resets: ResetBatch, lane: int) -> BodyState:
    """The state in one lane's row of a reset, as Python floats."""
    return BodyState(
        resets.position[lane].tolist(),
        resets.quaternion[lane].tolist(),
        resets.linear_velocity[lane].tolist(),
        resets.angular_velocity[lane].tolist(),
    )
