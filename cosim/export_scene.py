"""A run as an animated 3-D file: glTF (binary, .glb) and USD, which Blender and Unity import.

Both hold the tube (translucent), the centreline, the trajectory and the drone, which moves by the recorded poses in
simulated time.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim import __version__
from cosim.errors import CosimError, OutputError
from cosim.runs import Run
from cosim.scene import Scene, read_scene

TUBE_COLOUR: Final = (0.55, 0.62, 0.70, 0.30)
AXIS_COLOUR: Final = (0.95, 0.75, 0.20, 1.0)
PATH_COLOUR: Final = (0.16, 0.47, 0.84, 1.0)
DRONE_COLOUR: Final = (0.86, 0.22, 0.18, 1.0)

USD_SUFFIXES: Final = (".usd", ".usda", ".usdc")

_Z_UP_TO_Y_UP: Final = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]
"""Turn by -90 degrees about x, x y z w: glTF's world has Y up."""


def write_gltf(run: Run, target: Path) -> str:
    """Write a binary glTF 2.0 file; returns what is not as it was flown.

    Raises:
        CosimError: pygltflib is not installed.
    """
    try:
        import pygltflib as gltf  # writes and checks the structure of the file
    except ImportError as error:
        raise CosimError("glTF needs pygltflib; install it with: pip install 'tube-cosim[export]'") from error
    scene = read_scene(run)
    build = _Gltf(gltf)
    colours = (TUBE_COLOUR, AXIS_COLOUR, PATH_COLOUR, DRONE_COLOUR)
    materials = [build.material(colour) for colour in colours]
    children = [
        build.mesh("tube", scene.tube.vertices, scene.tube.faces, materials[0]),
        build.line("centreline", scene.axis, materials[1]),
        build.line("trajectory", scene.positions, materials[2]),
        build.mesh("drone", scene.drone.vertices, scene.drone.faces, materials[3]),
    ]
    build.animate(children[-1], scene)
    build.finish(children, target)
    return scene.note


class _Gltf:
    """A glTF document under construction, and the one buffer behind it."""

    def __init__(self, gltf: Any) -> None:
        self._gltf = gltf
        self._document = gltf.GLTF2(asset=gltf.Asset(generator=f"tube-cosim {__version__}"))
        self._pieces: list[bytes] = []
        self._size = 0

    def material(self, colour: tuple[float, float, float, float]) -> int:
        gltf = self._gltf
        surface = gltf.PbrMetallicRoughness(
            baseColorFactor=list(colour), metallicFactor=0.0, roughnessFactor=0.9
        )
        mode = gltf.OPAQUE if colour[3] == 1.0 else gltf.BLEND
        self._document.materials.append(
            gltf.Material(pbrMetallicRoughness=surface, alphaMode=mode, alphaCutoff=None, doubleSided=True)
        )
        return len(self._document.materials) - 1

    def mesh(self, name: str, vertices: NDArray[Any], faces: NDArray[Any], material: int) -> int:
        indices = self._accessor(faces.ravel().astype("<u4"), "SCALAR", self._gltf.ELEMENT_ARRAY_BUFFER)
        return self._node(name, vertices, material, self._gltf.TRIANGLES, indices)

    def line(self, name: str, points: NDArray[Any], material: int) -> int:
        return self._node(name, points, material, self._gltf.LINE_STRIP, None)

    def animate(self, node: int, scene: Scene) -> None:
        gltf = self._gltf
        times = self._accessor(scene.times.astype("<f4"), "SCALAR", None)
        samplers, channels = [], []
        for path, values, kind in (
            ("translation", scene.positions, "VEC3"),
            ("rotation", _continuous(scene.quaternions), "VEC4"),
        ):
            output = self._accessor(values.astype("<f4"), kind, None)
            samplers.append(gltf.AnimationSampler(input=times, output=output, interpolation="LINEAR"))
            where = gltf.AnimationChannelTarget(node=node, path=path)
            channels.append(gltf.AnimationChannel(sampler=len(samplers) - 1, target=where))
        self._document.animations.append(gltf.Animation(name="flight", samplers=samplers, channels=channels))

    def finish(self, children: list[int], target: Path) -> None:
        gltf, document = self._gltf, self._document
        document.nodes.append(gltf.Node(name="world", rotation=_Z_UP_TO_Y_UP, children=children))
        document.scenes.append(gltf.Scene(nodes=[len(document.nodes) - 1]))
        document.scene = 0
        document.buffers.append(gltf.Buffer(byteLength=self._size))
        document.set_binary_blob(b"".join(self._pieces))
        document.save_binary(str(target))

    def _node(self, name: str, points: NDArray[Any], material: int, mode: int, indices: int | None) -> int:
        gltf = self._gltf
        place = self._accessor(points.astype("<f4"), "VEC3", gltf.ARRAY_BUFFER)
        attributes = gltf.Attributes(POSITION=place)
        part = gltf.Primitive(attributes=attributes, indices=indices, material=material, mode=mode)
        self._document.meshes.append(gltf.Mesh(name=name, primitives=[part]))
        self._document.nodes.append(gltf.Node(name=name, mesh=len(self._document.meshes) - 1))
        return len(self._document.nodes) - 1

    def _accessor(self, values: NDArray[Any], kind: str, target: int | None) -> int:
        gltf = self._gltf
        document, raw = self._document, values.tobytes()
        document.bufferViews.append(
            gltf.BufferView(buffer=0, byteOffset=self._size, byteLength=len(raw), target=target)
        )
        component = gltf.UNSIGNED_INT if values.dtype.kind == "u" else gltf.FLOAT
        flat = values.reshape(len(values), -1)
        document.accessors.append(
            gltf.Accessor(
                bufferView=len(document.bufferViews) - 1,
                componentType=component,
                count=len(values),
                type=kind,
                min=flat.min(axis=0).tolist(),
                max=flat.max(axis=0).tolist(),
            )
        )
        self._pieces.append(raw)  # of 4-byte items: every piece stays aligned
        self._size += len(raw)
        return len(document.accessors) - 1


def write_usd(run: Run, target: Path) -> str:
    """Write a USD stage with one time code a control step; returns what is not as it was flown.

    Raises:
        CosimError: usd-core is not installed.
        OutputError: the file's name does not say which kind of USD is meant.
    """
    if target.suffix not in USD_SUFFIXES:
        raise OutputError(f"{target.name}: expected a name that ends in {' or '.join(USD_SUFFIXES)}")
    try:
        from pxr import Gf, Usd, UsdGeom, Vt  # Pixar's own library: no other writes the binary format
    except ImportError as error:
        raise CosimError("USD needs usd-core; install it with: pip install 'tube-cosim[export]'") from error
    scene = read_scene(run)
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    rate = 1.0 / run.manifest["session"]["dt"]
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(scene.times) - 1)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())

    def vectors(points: NDArray[Any]) -> Any:
        return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points, np.float32))

    def mesh(path: str, surface: Any, colour: tuple[float, float, float, float]) -> Any:
        shape = UsdGeom.Mesh.Define(stage, path)
        shape.CreatePointsAttr(vectors(surface.vertices))
        shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(surface.faces), 3, np.int32)))
        shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(surface.faces.ravel().astype(np.int32)))
        shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        shape.CreateDoubleSidedAttr(True)
        shape.CreateDisplayColorAttr([Gf.Vec3f(*colour[:3])])
        shape.CreateDisplayOpacityAttr([colour[3]])
        return shape

    def line(path: str, points: NDArray[Any], colour: tuple[float, float, float, float]) -> None:
        curve = UsdGeom.BasisCurves.Define(stage, path)
        curve.CreateTypeAttr(UsdGeom.Tokens.linear)
        curve.CreatePointsAttr(vectors(points))
        curve.CreateCurveVertexCountsAttr([len(points)])
        curve.CreateWidthsAttr([0.02])
        curve.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        curve.CreateDisplayColorAttr([Gf.Vec3f(*colour[:3])])

    mesh("/World/Tube", scene.tube, TUBE_COLOUR)
    line("/World/Centreline", scene.axis, AXIS_COLOUR)
    line("/World/Trajectory", scene.positions, PATH_COLOUR)
    drone = mesh("/World/Drone", scene.drone, DRONE_COLOUR)
    double = UsdGeom.XformOp.PrecisionDouble
    place, turn = drone.AddTranslateOp(double), drone.AddOrientOp(double)
    for step, (position, (x, y, z, w)) in enumerate(
        zip(scene.positions.tolist(), _continuous(scene.quaternions).tolist(), strict=True)
    ):
        place.Set(Gf.Vec3d(*position), step)
        turn.Set(Gf.Quatd(w, x, y, z), step)
    stage.GetRootLayer().Export(str(target))
    return scene.note


def _continuous(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same rotations with signs that do not jump, so that what lies between two of them is the short way."""
    signs = np.ones(len(quaternions))
    signs[1:] = np.where(np.einsum("ij,ij->i", quaternions[1:], quaternions[:-1]) < 0.0, -1.0, 1.0)
    return quaternions * np.cumprod(signs)[:, None]
