"""A run as an animated 3-D file: glTF (binary, .glb) and USD, which Blender and Unity import.

Both hold the tube (translucent), the centreline, the trajectory and the drone, which moves by the recorded poses in
simulated time.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim import __version__
from cosim.errors import CosimError, OutputError
from cosim.requirements import install_command
from cosim.runs import Run, chunks
from cosim.scene import Surface, drone_surface, read_surroundings

Floats = NDArray[np.float64]
Colour = tuple[float, float, float, float]
Done = Callable[[float], None]

TUBE_COLOUR: Final = (0.55, 0.62, 0.70, 0.30)
AXIS_COLOUR: Final = (0.95, 0.75, 0.20, 1.0)
PATH_COLOUR: Final = (0.16, 0.47, 0.84, 1.0)
DRONE_COLOUR: Final = (0.86, 0.22, 0.18, 1.0)

USD_SUFFIXES: Final = (".usd", ".usda", ".usdc")
USD_RATE: Final = 24.0
"""Time codes a second: Blender takes one for a frame, and its scenes have 24 a second."""
MOST_POSES: Final = 200_000
"""Of an animation in USD, whose library holds all of it in memory, about half a kilobyte each."""

_Z_UP_TO_Y_UP: Final = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]
"""Turn by -90 degrees about x, x y z w: glTF's world has Y up."""


@dataclass(frozen=True)
class _Poses:
    """Some of the drone's poses, in order."""

    times: Floats  # (T,)
    """Simulated time (s)."""
    positions: Floats  # (T, 3)
    quaternions: Floats  # (T, 4)
    """x y z w, body to world; their signs do not jump, so that what lies between two of them is the short way."""


def _poses(run: Run, stride: int = 1) -> Iterator[_Poses]:
    """Every stride-th pose of a run and the last one, some thousands at a time."""
    first, last = 0, len(run.records) - 1
    before: Floats = np.zeros((1, 4))
    for records in chunks(run):
        number = np.arange(first, first + len(records))
        first += len(records)
        taken = records[(number % stride == 0) | (number == last)]
        if not len(taken):
            continue
        turns = np.concatenate([before, taken["quaternion"]])
        signs = np.where(np.einsum("ij,ij->i", turns[1:], turns[:-1]) < 0.0, -1.0, 1.0)
        quaternions: Floats = turns[1:] * np.cumprod(signs).astype(np.float64)[:, None]
        before = quaternions[-1:]
        yield _Poses(taken["sim_time"].copy(), taken["position"].copy(), quaternions)


def write_gltf(run: Run, target: Path, done: Done) -> str:
    """Write a binary glTF 2.0 file; returns what is not as it was flown.

    The poses are written as the log is read: a flight of any length fits in memory.
    """
    tube, axis, note = read_surroundings(run)
    drone = drone_surface(run.manifest["parameters"]["body_radius"])
    document = _Gltf()
    document.mesh("tube", tube, TUBE_COLOUR)
    document.line("centreline", document.points(axis), AXIS_COLOUR)
    count = len(run.records)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for poses in _poses(run):
        low = np.minimum(low, poses.positions.min(axis=0))
        high = np.maximum(high, poses.positions.max(axis=0))
    ends = [float(run.records["sim_time"][i]) for i in (0, -1)]
    path = document.room(count, "VEC3", (low.tolist(), high.tolist()), ARRAY_BUFFER)
    document.line("trajectory", path, PATH_COLOUR)
    times = document.room(count, "SCALAR", ([ends[0]], [ends[1]]))
    places, turns = document.room(count, "VEC3"), document.room(count, "VEC4")
    document.animate(document.mesh("drone", drone, DRONE_COLOUR), times, places, turns)
    with target.open("wb") as file:
        document.write(file)
        for poses in _poses(run):
            document.fill(file, path, poses.positions)
            document.fill(file, times, poses.times)
            document.fill(file, places, poses.positions)
            document.fill(file, turns, poses.quaternions)
            done(len(poses.times))
    return note


ARRAY_BUFFER: Final = 34962
ELEMENT_ARRAY_BUFFER: Final = 34963
_FLOAT: Final = 5126
_UNSIGNED_INT: Final = 5125
_LINE_STRIP: Final = 3
_TRIANGLES: Final = 4
_WIDTHS: Final = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


class _Gltf:
    """A glTF document under construction, with one buffer, of which parts are written after the document."""

    def __init__(self) -> None:
        self._nodes: list[dict[str, Any]] = []
        self._meshes: list[dict[str, Any]] = []
        self._materials: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._views: list[dict[str, Any]] = []
        self._animations: list[dict[str, Any]] = []
        self._known: list[tuple[int, NDArray[Any]]] = []
        """Accessors whose values are there already."""
        self._filled: dict[int, int] = {}
        """Bytes that were written of an accessor."""
        self._size = 0
        self._start = 0
        """Of the buffer in the file."""

    def mesh(self, name: str, surface: Surface, colour: Colour) -> int:
        """Add triangles; returns their node."""
        indices = self.room(
            surface.faces.size, "SCALAR", target=ELEMENT_ARRAY_BUFFER, component=_UNSIGNED_INT
        )
        self._known.append((indices, surface.faces.ravel().astype("<u4")))
        return self._node(
            name, self.points(surface.vertices), colour, {"mode": _TRIANGLES, "indices": indices}
        )

    def line(self, name: str, points: int, colour: Colour) -> None:
        """Add a line through the points of an accessor; of a single point none, which importers fail at."""
        if self._accessors[points]["count"] > 1:
            self._node(name, points, colour, {"mode": _LINE_STRIP})

    def points(self, points: Floats) -> int:
        """Add places (N, 3); returns their accessor."""
        values = points.astype("<f4")
        limits = (values.min(axis=0).tolist(), values.max(axis=0).tolist())
        accessor = self.room(len(values), "VEC3", limits, ARRAY_BUFFER)
        self._known.append((accessor, values))
        return accessor

    def room(
        self,
        count: int,
        kind: str,
        limits: tuple[list[float], list[float]] | None = None,
        target: int | None = None,
        component: int = _FLOAT,
    ) -> int:
        """Make room for values that `fill` writes; returns their accessor."""
        size = 4 * count * _WIDTHS[kind]  # of 4-byte items: everything stays aligned
        view = {"buffer": 0, "byteOffset": self._size, "byteLength": size}
        self._views.append(view if target is None else view | {"target": target})
        accessor = {
            "bufferView": len(self._views) - 1,
            "componentType": component,
            "count": count,
            "type": kind,
        }
        self._accessors.append(
            accessor if limits is None else accessor | {"min": limits[0], "max": limits[1]}
        )
        self._size += size
        return len(self._accessors) - 1

    def animate(self, node: int, times: int, places: int, turns: int) -> None:
        """Let a node move by the values of three accessors."""
        outputs = (("translation", places), ("rotation", turns))
        self._animations.append(
            {
                "name": "flight",
                "samplers": [{"input": times, "output": o, "interpolation": "LINEAR"} for _, o in outputs],
                "channels": [
                    {"sampler": i, "target": {"node": node, "path": path}}
                    for i, (path, _) in enumerate(outputs)
                ],
            }
        )

    def write(self, file: Any) -> None:
        """Write the document, and of the buffer what is there already."""
        world = {"name": "world", "rotation": _Z_UP_TO_Y_UP, "children": list(range(len(self._nodes)))}
        text = json.dumps(
            {
                "asset": {"version": "2.0", "generator": f"tube-cosim {__version__}"},
                "scene": 0,
                "scenes": [{"nodes": [len(self._nodes)]}],
                "nodes": [*self._nodes, world],
                "meshes": self._meshes,
                "materials": self._materials,
                "accessors": self._accessors,
                "bufferViews": self._views,
                "buffers": [{"byteLength": self._size}],
                "animations": self._animations,
            },
            allow_nan=False,
        ).encode()
        text += b" " * (-len(text) % 4)
        self._start = 12 + 8 + len(text) + 8
        file.write(struct.pack("<4sII", b"glTF", 2, self._start + self._size))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", self._size, b"BIN\0"))
        for accessor, values in self._known:
            self.fill(file, accessor, values)

    def fill(self, file: Any, accessor: int, values: NDArray[Any]) -> None:
        """Write the next values of an accessor."""
        raw = values.astype("<f4" if values.dtype.kind == "f" else "<u4").tobytes()
        filled = self._filled.get(accessor, 0)
        file.seek(self._start + int(self._views[accessor]["byteOffset"]) + filled)
        file.write(raw)
        self._filled[accessor] = filled + len(raw)

    def _node(self, name: str, points: int, colour: Colour, rest: dict[str, Any]) -> int:
        surface = {"baseColorFactor": list(colour), "metallicFactor": 0.0, "roughnessFactor": 0.9}
        material = {"name": name, "pbrMetallicRoughness": surface, "doubleSided": True}
        self._materials.append(material if colour[3] == 1.0 else material | {"alphaMode": "BLEND"})
        part = {"attributes": {"POSITION": points}, "material": len(self._materials) - 1} | rest
        self._meshes.append({"name": name, "primitives": [part]})
        self._nodes.append({"name": name, "mesh": len(self._meshes) - 1})
        return len(self._nodes) - 1


def write_usd(run: Run, target: Path, done: Done) -> str:
    """Write a USD stage of 24 time codes a second; returns what is not as it was flown.

    Raises:
        CosimError: usd-core is not installed.
        OutputError: the file's name does not say which kind of USD is meant.
        OSError: it cannot be written.
    """
    if target.suffix not in USD_SUFFIXES:
        raise OutputError(
            f"--out: expected a name that ends in {' or '.join(USD_SUFFIXES)}, found {target.suffix!r}"
        )
    try:
        from pxr import Tf, Usd, UsdGeom  # Pixar's own library: no other writes the binary format
    except ImportError as error:
        raise CosimError(f"USD needs usd-core; install it with: {install_command('export')}") from error
    tube, axis, note = read_surroundings(run)
    count = len(run.records)
    stride = -(-count // MOST_POSES)
    if stride > 1:
        note += f"{'; ' if note else ''}one in {stride} of {count} poses (glTF and the tables hold all)"
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(USD_RATE)
    stage.SetFramesPerSecond(USD_RATE)
    stage.SetStartTimeCode(USD_RATE * float(run.records["sim_time"][0]))
    stage.SetEndTimeCode(USD_RATE * float(run.records["sim_time"][-1]))
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    _usd_mesh(stage, "Tube", tube, TUBE_COLOUR)
    _usd_line(stage, "Centreline", axis, AXIS_COLOUR)
    body_radius = run.manifest["parameters"]["body_radius"]
    drone = _usd_mesh(stage, "Drone", drone_surface(body_radius), DRONE_COLOUR)
    path = _usd_animate(drone, run, stride, done)
    _usd_line(stage, "Trajectory", path, PATH_COLOUR)
    try:
        stage.GetRootLayer().Export(str(target))
    except Tf.ErrorException as error:
        first = str(error).strip().splitlines()[0]  # what follows comes of it
        raise OSError(first.split(" : '", 1)[-1].removesuffix("'")) from error
    return note


def _usd_mesh(stage: Any, name: str, surface: Surface, colour: Colour) -> Any:
    from pxr import UsdGeom, Vt

    shape = UsdGeom.Mesh.Define(stage, f"/World/{name}")
    shape.CreatePointsAttr(_usd_vectors(surface.vertices))
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(surface.faces), 3, np.int32)))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(surface.faces.ravel().astype(np.int32)))
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    shape.CreateDoubleSidedAttr(True)
    _usd_colour(stage, shape, name, colour)
    return shape


def _usd_line(stage: Any, name: str, points: Floats, colour: Colour) -> None:
    from pxr import UsdGeom

    if len(points) < 2:
        return
    curve = UsdGeom.BasisCurves.Define(stage, f"/World/{name}")
    curve.CreateTypeAttr(UsdGeom.Tokens.linear)
    curve.CreatePointsAttr(_usd_vectors(points))
    curve.CreateCurveVertexCountsAttr([len(points)])
    curve.CreateWidthsAttr([0.02])
    curve.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    _usd_colour(stage, curve, name, colour)


def _usd_vectors(points: Floats) -> Any:
    from pxr import Vt

    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points, np.float32))


def _usd_colour(stage: Any, shape: Any, name: str, colour: Colour) -> None:
    """Give a shape its colour twice: viewers show the display colour, Blender and Unity the material."""
    from pxr import Gf, Sdf, UsdShade

    shape.CreateDisplayColorAttr([Gf.Vec3f(*colour[:3])])
    shape.CreateDisplayOpacityAttr([colour[3]])
    material = UsdShade.Material.Define(stage, f"/World/Materials/{name}")
    shader = UsdShade.Shader.Define(stage, f"/World/Materials/{name}/Surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*colour[:3]))
    shader.CreateInput("opacity", Sdf.ValueTypeNames.Float).Set(colour[3])
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.9)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)


def _usd_animate(drone: Any, run: Run, stride: int, done: Done) -> Floats:
    """Let the drone move by every stride-th pose; returns their positions (T, 3)."""
    from pxr import Gf, UsdGeom

    double = UsdGeom.XformOp.PrecisionDouble
    place, turn = drone.AddTranslateOp(double), drone.AddOrientOp(double)
    path = []
    for poses in _poses(run, stride):
        path.append(poses.positions)
        codes = (USD_RATE * poses.times).tolist()
        rows = zip(codes, poses.positions.tolist(), poses.quaternions.tolist(), strict=True)
        for code, position, (x, y, z, w) in rows:
            place.Set(Gf.Vec3d(*position), code)
            turn.Set(Gf.Quatd(w, x, y, z), code)
        done(stride * len(codes))
    return np.concatenate(path)
