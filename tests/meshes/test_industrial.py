"""The shipped conduit is what it is said to be."""

from __future__ import annotations

import numpy as np
import pytest

from meshes.mesh_geometry import MeshGeometry
from meshes.obj import read_obj
from meshes.tube import INDUSTRIAL, Tube, read_tube


@pytest.fixture(scope="module")
def conduit() -> Tube:
    """The conduit as a launch reads it."""
    return read_tube(INDUSTRIAL)


def test_files_are_those_of_the_authoring_script() -> None:
    """Mesh, centreline and the script that made them lie together; the objects are those that it models."""
    assert (INDUSTRIAL.parent / "author.py").is_file()
    assert read_obj(INDUSTRIAL).objects == ("", "pipe", "welds", "flanges", "bolts", "posts")
    assert INDUSTRIAL.read_text().startswith("# Blender")
    size = sum(file.stat().st_size for file in INDUSTRIAL.parent.glob("*.obj"))
    assert size < 4_000_000


def test_length_and_radius(conduit: Tube) -> None:
    """About 75 m long; radius about 1 m, in gradual change between 0.8 and 1.15 m."""
    assert conduit.length == pytest.approx(75.0, abs=0.1)
    assert conduit.radius.min() == pytest.approx(0.80, abs=0.01)
    assert conduit.radius.max() == pytest.approx(1.15, abs=0.01)
    assert np.abs(np.diff(conduit.radius)).max() < 0.02


def test_bends(conduit: Tube) -> None:
    """The tightest bend is about 2.5 R, and eight elbows turn through more than 450 degrees in all."""
    turned = np.arccos(np.clip(np.sum(conduit.tangent[5:] * conduit.tangent[:-5], axis=1), -1, 1))
    bend_radius = 5 * conduit.step / np.maximum(turned, 1e-9)
    assert (bend_radius / conduit.radius[2:-3]).min() == pytest.approx(2.5, abs=0.1)
    assert np.degrees(turned.sum() / 5) > 450


def test_all_three_dimensions_and_a_vertical_rise(conduit: Tube) -> None:
    """It extends over 8 m each way and rises straight up for 6 m."""
    assert np.all(np.ptp(conduit.axis, axis=0) > 8.0)
    assert (conduit.tangent[:, 2] > 0.9999).sum() * conduit.step == pytest.approx(6.0, abs=0.5)


def test_nothing_stands_in_the_way(conduit: Tube) -> None:
    """Everywhere on the axis a ball of 0.97 R fits, so that welds, flanges, bolts and posts leave it free."""
    geometry = MeshGeometry([conduit], lanes=len(conduit.axis))
    nearest = geometry.project(conduit.axis)
    clearance = geometry.clearance(conduit.axis, nearest)
    assert np.all(clearance > 0.97 * nearest.radius)
    assert np.all(geometry.inside(conduit.axis, nearest))


def test_both_ends_are_open(conduit: Tube) -> None:
    """Seen along the axis, nothing closes the mouth at either end."""
    geometry = MeshGeometry([conduit], lanes=2)
    points, tangents = geometry.axis(np.array([1.0, conduit.length - 1.0]))
    outward = tangents * [[-1.0], [1.0]]
    assert np.all(geometry.rays(points[:, None], outward[:, None], 10.0) == 10.0)


def test_wall_has_a_thickness(conduit: Tube) -> None:
    """From within the first run, the wall that a ray meets first is 3 cm thick."""
    scene = conduit.wall.scene
    axis, down = conduit.axis[30:31], np.array([[0.0, 0.0, -1.0]])
    inner = scene.distances(axis, down, 3.0)
    outer = scene.distances(axis + (inner[:, None] + 0.001) * down, down, 3.0) + 0.001
    np.testing.assert_allclose(outer, 0.03, atol=0.002)
