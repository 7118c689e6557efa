"""Model the industrial conduit in Blender and export it: `industrial.obj` and `industrial_centerline.obj`.

Run it with Blender's Python module, which is needed for this and for nothing else (Python 3.11 only):

    python -m venv blender && blender/bin/pip install bpy==5.0.1
    blender/bin/python author.py [FOLDER]

The files go beside this script unless a folder is named, and are byte-identical from run to run.

The conduit is a steel pipe of about 2 m in diameter: straight runs and elbows in all three dimensions, one
run a vertical rise, a reducer, an expander, weld beads where runs and elbows meet, flanges with bolts, and posts
down to the ground. Inside there is nothing but the wall and its weld beads. World frame: Z up, metres.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

WALL_THICKNESS = 0.03
SIDES = 32
RESOLUTION = 20
"""Rings of the wall in each run and each elbow."""
CENTRELINE_RESOLUTION = 40

START = (0.0, 0.0, 1.7)
START_DIRECTION = (1.0, 0.0, 0.0)
START_RADIUS = 1.0


@dataclass(frozen=True)
class Run:
    """A straight run, with flanges at its end or not, and posts under it at fractions of its length."""

    length: float
    radius: float
    """Inner radius at its end: other than that at its start in a reducer or an expander."""
    flange: bool = False
    posts: tuple[float, ...] = ()


@dataclass(frozen=True)
class Elbow:
    """A bend along a circular arc into another direction, which need not be a unit vector."""

    direction: tuple[float, float, float]
    bend_radius: float


ROUTE: tuple[Run | Elbow, ...] = (
    Run(7.0, 1.0, flange=True, posts=(0.15, 0.75)),
    Elbow((0.0, 1.0, 0.0), 3.0),
    Run(4.0, 1.0, posts=(0.5,)),
    Elbow((0.0, 0.0, 1.0), 2.5),
    Run(6.0, 1.0, flange=True),
    Elbow((1.0, 0.0, 0.0), 2.5),
    Run(5.0, 0.8, flange=True, posts=(0.3,)),
    Elbow((0.5, -0.75, -0.43), 2.0),
    Run(6.0, 0.8, posts=(0.5,)),
    Elbow((1.0, 0.15, 0.0), 2.2),
    Run(7.0, 1.15, flange=True, posts=(0.25,)),
    Elbow((0.1, 1.0, 0.0), 3.4),
    Run(3.0, 1.15, posts=(0.5,)),
    Elbow((-0.25, 0.6, -0.76), 3.0),
    Run(4.0, 1.15, flange=True),
    Elbow((0.3, 1.0, 0.0), 3.2),
    Run(5.0, 1.15, posts=(0.3, 0.85)),
)


@dataclass(frozen=True)
class Station:
    """Where two parts of the route meet: a point of the guide curve."""

    position: Vector
    direction: Vector
    radius: float
    reach_back: float
    """Length of the Bezier handle towards the part before (m)."""
    reach_on: float
    """Length of the Bezier handle towards the part behind (m)."""


@dataclass
class Parts:
    """Solids of one object, collected in world coordinates."""

    vertices: list[tuple[float, ...]] = field(default_factory=list)
    faces: list[tuple[int, ...]] = field(default_factory=list)

    def lathe(self, at: Vector, axis: Vector, profile: list[tuple[float, float]], sides: int) -> None:
        """Turn a closed profile of (distance from the axis, height along it) around an axis through `at`."""
        one, other = basis(axis)
        base, count = len(self.vertices), len(profile)
        for i in range(sides):
            angle = 2 * np.pi * i / sides
            outward = np.cos(angle) * one + np.sin(angle) * other
            self.vertices.extend(tuple(at + r * outward + h * axis) for r, h in profile)
            for j in range(count):
                here, there = base + i * count, base + (i + 1) % sides * count
                k = (j + 1) % count
                self.faces.append((here + j, there + j, there + k, here + k))

    def prism(self, at: Vector, axis: Vector, radius: float, length: float, sides: int) -> None:
        """Set up a regular prism from `at` along an axis, closed by one polygon at each end."""
        one, other = basis(axis)
        base = len(self.vertices)
        angles = 2 * np.pi * (np.arange(sides) + 0.5) / sides
        for h in (0.0, length):
            self.vertices.extend(
                tuple(at + h * axis + radius * (np.cos(a) * one + np.sin(a) * other)) for a in angles
            )
        bottom, top = range(base, base + sides), range(base + sides, base + 2 * sides)
        self.faces.extend((bottom[i - 1], bottom[i], top[i], top[i - 1]) for i in range(sides))
        self.faces.extend([tuple(reversed(bottom)), tuple(top)])


def unit(vector: Vector | tuple[float, float, float]) -> Vector:
    """The vector at length 1."""
    array = np.asarray(vector, dtype=np.float64)
    return array / np.linalg.norm(array)


def basis(axis: Vector) -> tuple[Vector, Vector]:
    """Two unit vectors square to an axis and to each other."""
    one = unit(np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))]))
    return one, np.cross(axis, one)


def stations() -> list[Station]:
    """Walk the route."""
    position, direction, radius = np.array(START), unit(START_DIRECTION), START_RADIUS
    places = [(position, direction, radius)]
    handles: list[float] = []
    for part in ROUTE:
        if isinstance(part, Run):
            position = position + part.length * direction
            radius = part.radius
            handles.append(part.length / 3)
        else:
            onward = unit(part.direction)
            angle = np.arccos(direction @ onward)
            # From either end of the arc to the corner where the runs would meet.
            leg = part.bend_radius * np.tan(angle / 2)
            position = position + leg * (direction + onward)
            direction = onward
            # The cubic nearest to a circular arc.
            handles.append(part.bend_radius * 4 / 3 * float(np.tan(angle / 4)))
        places.append((position, direction, radius))
    return [
        Station(*place, back, on)
        for place, back, on in zip(places, [handles[0], *handles], [*handles, handles[-1]], strict=True)
    ]


def guide_curve(name: str, route: list[Station], resolution: int) -> bpy.types.Object:
    """The axis as a Bezier curve whose point radii are those of the pipe."""
    curve = bpy.data.curves.new(name, "CURVE")
    curve.dimensions = "3D"
    curve.resolution_u = resolution
    spline = curve.splines.new("BEZIER")
    spline.radius_interpolation = "EASE"
    spline.bezier_points.add(len(route) - 1)
    for point, station in zip(spline.bezier_points, route, strict=True):
        point.handle_left_type = point.handle_right_type = "FREE"
        point.co = station.position
        point.handle_left = station.position - station.reach_back * station.direction
        point.handle_right = station.position + station.reach_on * station.direction
        point.radius = station.radius
    thing = bpy.data.objects.new(name, curve)
    bpy.context.collection.objects.link(thing)
    return thing


def to_mesh(thing: bpy.types.Object) -> None:
    """Convert in place, with bevel and modifiers: a bevelled curve that is exported is written twice."""
    select([thing])
    bpy.ops.object.convert(target="MESH")


def select(things: list[bpy.types.Object]) -> None:
    """Select these alone."""
    bpy.ops.object.select_all(action="DESELECT")
    for thing in things:
        thing.select_set(True)
    bpy.context.view_layer.objects.active = things[0]


def pipe(route: list[Station]) -> bpy.types.Object:
    """The wall: the guide curve bevelled to the inner radius, then thickened outwards, open at both ends."""
    thing = guide_curve("pipe", route, RESOLUTION)
    thing.data.bevel_depth = 1.0
    thing.data.bevel_resolution = SIDES // 2 - 2
    thing.data.use_fill_caps = False
    to_mesh(thing)
    thickness = thing.modifiers.new("thickness", "SOLIDIFY")
    thickness.thickness = WALL_THICKNESS
    thickness.offset = 1.0  # outwards: the bevel's normals point away from the guide
    to_mesh(thing)
    return thing


def welds(route: list[Station]) -> Parts:
    """A bead around every joint, standing about a hundredth of the radius out of the inner wall."""
    parts = Parts()
    for station in route[1:-1]:
        foot, top = station.radius + 0.01, 0.985 * station.radius
        profile = [(foot, -0.035), (top + 0.006, -0.02), (top, 0.0), (top + 0.006, 0.02), (foot, 0.035)]
        parts.lathe(station.position, station.direction, profile, SIDES)
    return parts


def flanges(route: list[Station]) -> tuple[Parts, Parts]:
    """Discs around the two ends and in pairs around some joints, and the bolts that hold the pairs."""
    discs, bolts = Parts(), Parts()
    thickness, gap = 0.07, 0.01
    joints = [i + 1 for i, part in enumerate(ROUTE) if isinstance(part, Run) and part.flange]
    for i in [0, *joints, len(route) - 1]:
        station = route[i]
        inner, outer = station.radius + 0.01, station.radius + 0.2
        starts = {0: [0.0], len(route) - 1: [-thickness]}.get(i, [-thickness - gap / 2, gap / 2])
        for start in starts:
            profile = [(inner, start), (outer, start), (outer, start + thickness), (inner, start + thickness)]
            discs.lathe(station.position, station.direction, profile, SIDES)
        if len(starts) < 2:
            continue
        one, other = basis(station.direction)
        for angle in 2 * np.pi * (np.arange(16) + 0.5) / 16:
            outward = np.cos(angle) * one + np.sin(angle) * other
            foot = station.position + (station.radius + 0.12) * outward - 0.125 * station.direction
            bolts.prism(foot, station.direction, 0.035, 0.25, 6)
    return discs, bolts


def posts(route: list[Station]) -> Parts:
    """Clamps around the pipe, each on a post with a plate on the ground."""
    parts = Parts()
    up = np.array([0.0, 0.0, 1.0])
    for part, before, behind in zip(ROUTE, route[:-1], route[1:], strict=True):
        if not isinstance(part, Run):
            continue
        for fraction in part.posts:
            position = before.position + fraction * (behind.position - before.position)
            eased = fraction * fraction * (3 - 2 * fraction)
            radius = before.radius + eased * (behind.radius - before.radius)
            inner, outer = radius + 0.015, radius + 0.08
            clamp = [(inner, -0.12), (outer, -0.12), (outer, 0.12), (inner, 0.12)]
            parts.lathe(position, before.direction, clamp, SIDES)
            foot = np.array([position[0], position[1], 0.0])
            slope = np.hypot(before.direction[0], before.direction[1])
            parts.prism(foot, up, 0.12, position[2] - (radius + 0.09) / slope, 12)
            parts.prism(foot, up, 0.4, 0.04, 4)
    return parts


def add(name: str, parts: Parts) -> bpy.types.Object:
    """An object of these parts."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(parts.vertices, [], parts.faces)
    thing = bpy.data.objects.new(name, mesh)
    bpy.context.collection.objects.link(thing)
    return thing


def export(things: list[bpy.types.Object], path: Path) -> None:
    """Write objects in Blender's own axes."""
    select(things)
    bpy.ops.wm.obj_export(
        filepath=str(path),
        forward_axis="Y",
        up_axis="Z",
        export_selected_objects=True,
        export_materials=False,
        export_uv=False,
        export_normals=False,
    )


def main() -> None:
    """Model, export, and say how large it became."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parent
    bpy.ops.wm.read_factory_settings(use_empty=True)
    route = stations()
    discs, bolts = flanges(route)
    things = [
        pipe(route),
        add("welds", welds(route)),
        add("flanges", discs),
        add("bolts", bolts),
        add("posts", posts(route)),
    ]
    axis = guide_curve("centerline", route, CENTRELINE_RESOLUTION)
    to_mesh(axis)
    export(things, folder / "industrial.obj")
    export([axis], folder / "industrial_centerline.obj")
    for thing in [*things, axis]:
        print(f"{thing.name}: {len(thing.data.vertices)} vertices, {len(thing.data.polygons)} faces")


if __name__ == "__main__":
    main()
