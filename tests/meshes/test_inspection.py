"""What is said of a tube along its axis, against closed forms, and of its mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tubular import Mesh, circle, cut, extrude, helix, in_tube, join, line, wall_of

from meshes.formats import UNSTATED, Stated
from meshes.inspection import examine, measure_profile
from meshes.scale import guess_unit
from meshes.sweep import write_centreline_obj, write_obj
from meshes.tube import Tube, read_tube

Floats = NDArray[np.float64]
STRAIGHT = line([0.0, 0.0, 0.0], [20.0, 0.0, 0.0], 81)


def tube_of(folder: Path, mesh: Mesh, axis: Floats | None = None) -> Tube:
    """A mesh read from a file, with its axis beside it if there is one."""
    write_obj(folder / "tube.obj", mesh[0], mesh[1].astype(np.int32))
    if axis is not None:
        write_centreline_obj(folder / "tube_centerline.obj", axis)
    return read_tube(folder / "tube.obj")


def test_curvature_and_torsion_of_a_helix(tmp_path: Path) -> None:
    """a/(a² + b²) and b/(a² + b²), with radius a and pitch 2πb, everywhere; and the same where it is found."""
    axis = helix(2.0, 4.0, 6.0, 400)
    b = 6.0 / (2.0 * np.pi)
    curvature, torsion = 4.0 / (16.0 + b * b), b / (16.0 + b * b)
    for given, bar in ((axis, 0.03), (None, 0.25)):
        folder = tmp_path / ("found" if given is None else "given")
        folder.mkdir()
        profile = measure_profile(tube_of(folder, extrude(axis, circle(32)), given))
        np.testing.assert_allclose(profile.curvature, curvature, rtol=bar)
        np.testing.assert_allclose(np.median(profile.torsion), torsion, rtol=bar)
        assert profile.arc_length[-1] == pytest.approx(4.0 * np.pi * np.hypot(4.0, b), rel=0.01)


def test_straight_tube_has_no_torsion(tmp_path: Path) -> None:
    """Where the axis does not bend its torsion is none, not noise."""
    profile = measure_profile(tube_of(tmp_path, extrude(STRAIGHT, circle(32)), STRAIGHT))
    assert np.isnan(profile.torsion).all()
    assert profile.bend.max() < 0.01
    assert profile.shape == "round"


def test_narrowest_place_and_room_of_an_hourglass(tmp_path: Path) -> None:
    """Radius 1 - 0.4 exp(-(s - 12)²): narrowest at 12 m, 0.6 m from the wall of a polygon of 48 sides."""
    radii = 1.0 - 0.4 * np.exp(-((STRAIGHT[:, 0] - 12.0) ** 2))
    profile = measure_profile(tube_of(tmp_path, extrude(STRAIGHT, [circle(48, r) for r in radii]), STRAIGHT))
    assert profile.arc_length[profile.narrowest] == pytest.approx(12.0, abs=0.2)
    assert profile.clearance[profile.narrowest] == pytest.approx(0.6, abs=0.01)
    assert profile.radius[0] == pytest.approx(1.0, abs=0.01)


def test_tightest_bend_is_where_the_radius_is_least(tmp_path: Path) -> None:
    """A straight, then a bend of 4 m: curvature times radius is a quarter, in the bend."""
    turn = np.linspace(0.0, np.pi / 2.0, 60)
    bend = 4.0 * np.stack([np.sin(turn), 1.0 - np.cos(turn), 0.0 * turn], axis=1) + np.array([10.0, 0.0, 0.0])
    axis = np.concatenate([line([0, 0, 0], [10, 0, 0], 60)[:-1], bend])
    profile = measure_profile(tube_of(tmp_path, extrude(axis, circle(32)), axis))
    assert profile.bend[profile.tightest] == pytest.approx(0.25, rel=0.1)
    assert profile.arc_length[profile.tightest] > 9.0
    assert profile.bend[: len(profile.bend) // 3].max() < 0.02


@pytest.mark.parametrize(("order", "shape"), [(2, "elliptic"), (3, "3 lobes"), (5, "5 lobes")])
def test_harmonics_of_sections_are_those_they_were_made_of(order: int, shape: str, tmp_path: Path) -> None:
    """r = 1 + 0.1 cos(kθ): amplitude 0.1 at k, next to nothing elsewhere, and a word for it."""
    angle = 2.0 * np.pi * np.arange(180) / 180
    section = (1.0 + 0.1 * np.cos(order * angle))[:, None] * circle(180)
    profile = measure_profile(tube_of(tmp_path, extrude(STRAIGHT, section), STRAIGHT))
    amplitudes = np.median(profile.harmonics, axis=0)
    assert amplitudes[order - 1] == pytest.approx(0.1, abs=0.005)
    assert np.delete(amplitudes, order - 1).max() < 0.01
    assert profile.shape == shape
    assert profile.greatest.max() == pytest.approx(1.1, abs=0.01)


def test_side_branch_does_not_widen_its_section(tmp_path: Path) -> None:
    """Beside a branch as wide as the tube the mean radius stays that of the tube."""
    branch = line([10.0, 0.0, 0.0], [10.0, 6.0, 0.0], 25)
    main = cut(extrude(STRAIGHT, circle(48)), in_tube(branch[[0, -1]], 0.95), rounds=1)
    side = cut(extrude(branch, circle(48)), in_tube(STRAIGHT[[0, -1]], 0.95), rounds=1)
    profile = measure_profile(tube_of(tmp_path, join(main, side), STRAIGHT))
    np.testing.assert_allclose(profile.radius, 1.0, atol=0.1)


def test_mesh_of_a_plain_pipe_is_told(tmp_path: Path) -> None:
    """Single wall, normals one way, two openings, no cap; turned inside out the normals are the other way."""
    vertices, faces = extrude(STRAIGHT, circle(24))
    plain = examine(tube_of(tmp_path, (vertices, faces)))
    assert (plain.thickness, plain.capped, plain.holes, plain.flipped) == (None, (False, False), 0, 0.0)
    assert len(plain.openings) == 2
    turned = examine(tube_of(tmp_path, (vertices, faces[:, ::-1])))
    assert {plain.normals, turned.normals} == {"inward", "outward"}


def test_odd_meshes_are_told(tmp_path: Path) -> None:
    """A double wall with its thickness, faces twice, a fifth of the normals the other way, caps."""
    inner, outer = extrude(STRAIGHT, circle(48)), extrude(STRAIGHT, circle(48, 1.25))
    assert examine(tube_of(tmp_path, join(inner, outer))).thickness == pytest.approx(0.25, abs=0.01)

    vertices, faces = inner
    doubled = examine(tube_of(tmp_path, (vertices, np.concatenate([faces, faces]))))
    assert doubled.duplicate_faces == len(faces)

    rng = np.random.default_rng(1)
    chosen = rng.random(len(faces)) < 0.2
    mixed = faces.copy()
    mixed[chosen] = mixed[chosen][:, ::-1]
    odd = examine(tube_of(tmp_path, (vertices, mixed)))
    assert (odd.normals, odd.flipped) == ("mixed", pytest.approx(0.2, abs=0.05))

    assert examine(tube_of(tmp_path, extrude(STRAIGHT, circle(24), caps=True))).capped == (True, True)


def test_openings_are_told_beside_a_given_centreline(tmp_path: Path) -> None:
    """A centreline from a file hides no opening of its tube."""
    told = examine(tube_of(tmp_path, extrude(STRAIGHT, circle(24)), STRAIGHT))
    assert [round(float(opening.centre[0])) for opening in told.openings] == [0, 20]
    assert told.openings[0].radius == pytest.approx(1.0, abs=0.15)


def test_unit_is_guessed_from_the_size_and_its_reason_given() -> None:
    """R 44 without a unit looks like millimetres, R 0.3 like metres; a file that states its unit is believed unless
    its tube would be wider than tubes are."""
    assert guess_unit(44.0, UNSTATED).metres == 0.001
    assert "looks like millimetres: 44 mm" in guess_unit(44.0, UNSTATED).reason
    assert "--scale" in guess_unit(44.0, UNSTATED).advice
    assert (guess_unit(0.3, UNSTATED).metres, guess_unit(0.3, UNSTATED).advice) == (1.0, "")
    stated = Stated("zup", 0.01, "the file states 0.01 m a unit and Z_UP")
    assert guess_unit(44.0, stated) == guess_unit(0.3, stated)
    lying = guess_unit(44.0, Stated("yup", 1.0, "glTF is in metres with Y up"))
    assert "(44 m) looks like millimetres" in lying.reason


def test_faces_of_rays_are_those_that_they_meet() -> None:
    """The face that a ray meets first, and -1 where it meets none."""
    wall = wall_of((np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]]),
                    np.array([[0, 1, 2], [3, 4, 5]])))  # fmt: skip
    origins = np.array([[0.2, 0.2, 2.0], [0.2, 0.2, -1.0], [0.2, 0.2, 0.5], [5.0, 5.0, 2.0]])
    down = np.array([[0, 0, -1.0], [0, 0, 1], [0, 0, -1], [0, 0, -1]])
    assert wall.scene.faces_hit(origins, down).tolist() == [1, 0, 0, -1]
