"""Meshes of swept tubes, and the files that they are written to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from meshes.curves import Curve, generate_curve
from meshes.errors import MeshError
from meshes.obj import read_obj
from meshes.sweep import sweep_wall, write_centreline_obj, write_obj
from meshes.swept import circular, sweep_section
from meshes.tube import read_tube


@pytest.mark.parametrize("sides", [8, 16, 48])
def test_mean_distance_of_the_polygon_is_the_radius(sides: int) -> None:
    """The section's polygon is as far from the axis, in the mean over the angle, as the round wall."""
    x = 0.2 * np.arange(3)
    tube = circular(Curve(np.stack([x, 0 * x, 0 * x], axis=1), 0.2), 1.3)
    vertices, _ = sweep_wall(tube, sides)
    corners = vertices[:sides]
    angle = np.linspace(0.0, np.pi / sides, 2001)
    corner = np.linalg.norm(corners[0])
    apothem = np.linalg.norm(0.5 * (corners[0] + corners[1]))
    assert apothem == pytest.approx(corner * np.cos(np.pi / sides))
    assert np.trapezoid(apothem / np.cos(angle), angle) / angle[-1] == pytest.approx(1.3, rel=1e-6)


def test_vertices_follow_the_section() -> None:
    """Corners of a lobed section stand at the section's distance, in the planes normal to the axis."""
    tube = sweep_section(generate_curve(1, [2]), 0.9, np.array([[0.15, 0.05], [0.0, 0.05]]))
    vertices, _ = sweep_wall(tube, 96)
    outward = vertices.reshape(-1, 96, 3) - tube.points[:, None]
    np.testing.assert_allclose(np.einsum("msi,mi->ms", outward, tube.tangents), 0.0, atol=1e-12)
    ratio = np.linalg.norm(outward, axis=2) / tube.section(2.0 * np.pi * np.arange(96) / 96)
    np.testing.assert_allclose(ratio, ratio[0, 0])
    assert 1.0 < ratio[0, 0] < 1.001
    np.testing.assert_allclose(
        tube.section(np.linspace(0.0, 6.2831853, 100)[:-1]).mean(axis=1), 0.9, rtol=1e-6
    )


def test_the_wall_is_open_at_its_ends_only() -> None:
    """Each edge joins two triangles in opposite directions, but for the two rims; normals point away."""
    tube = circular(generate_curve(2, [3]))
    vertices, faces = sweep_wall(tube, 24)
    assert vertices.shape == (101 * 24, 3)
    assert faces.shape == (2 * 100 * 24, 3)
    assert faces.dtype == np.int32
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    directed = {(int(a), int(b)) for a, b in edges}
    assert len(directed) == len(edges)
    rim = {edge[0] // 24 for edge in directed if edge[::-1] not in directed}
    assert rim == {0, 100}
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = tube.points[faces[:, 0] // 24]
    assert (((corners.mean(axis=1) - axis) * normals).sum(axis=1) > 0.0).all()


def test_too_few_sides() -> None:
    """A section of fewer than 8 sides is refused."""
    with pytest.raises(MeshError, match="sides: expected at least 8 but found 6"):
        sweep_wall(circular(generate_curve(0, [1])), 6)


def test_files_read_back(tmp_path: Path) -> None:
    """Wall and centreline read back through the package's own reader, to 9 digits."""
    tube = circular(generate_curve(1, [4]), 0.8)
    vertices, faces = sweep_wall(tube)
    wall, centreline = tmp_path / "tube.obj", tmp_path / "tube_centerline.obj"
    write_obj(wall, vertices, faces)
    write_centreline_obj(centreline, tube.points)
    data = read_obj(wall)
    np.testing.assert_allclose(data.vertices, vertices, atol=1e-7)
    np.testing.assert_array_equal(data.faces, faces)
    lines = read_obj(centreline)
    np.testing.assert_allclose(lines.vertices, tube.points, atol=1e-7)
    found = read_tube(wall)
    assert found.length == pytest.approx(20.0, abs=0.02)
    np.testing.assert_allclose(found.radius, 0.8, atol=0.005)
    np.testing.assert_allclose(found.axis[[0, -1]], tube.points[[0, -1]], atol=1e-6)
