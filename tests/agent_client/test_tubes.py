"""Recipes of tubes: each setting does what it says, and tubes come from seeds and domains alone."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from agent_client.errors import SettingsError
from agent_client.tubes import (
    HARD_TUBES,
    PAPER_TUBES,
    TUBE_SETTINGS,
    TUBE_SHAPES,
    VARIED_TUBES,
    WIDEST_FOLD,
    TubeRecipe,
    draw_pool,
    draw_tube,
)
from meshes.curves import SHAPES, Curve, check_curve, generate_curve
from meshes.swept import SweptTube, circular

COUNT = 30
"""Tubes of a level that are looked at."""

EVERYTHING = TubeRecipe(
    (10.0, 20.0), (0.6, 1.6), (0.0, 0.3), 0.9, (0.0, 0.3), (0.0, 0.2), (3, 8), shape="mixed"
)
"""All settings over their whole ranges."""

WIDE = replace(EVERYTHING, swing=(0.3, 0.3), ellipse=(0.3, 0.3), lobes=(0.2, 0.2))
"""The walls that need most room."""


def tubes_of(recipe: TubeRecipe, level: int = 2, count: int = COUNT) -> list[SweptTube]:
    """The first tubes of a level in the tuning domain."""
    return [draw_tube(level, (i,), "tune", recipe) for i in range(count)]


def scale_of(tube: SweptTube) -> float:
    """Mean radius (m) that a tube was scaled by, from its step: 0.2 R."""
    return tube.step / 0.2


@pytest.mark.parametrize("level", [0, 1, 2])
def test_the_default_recipe_is_the_paper_s(level: int) -> None:
    """By default a tube is round, 20 m long and of 1 m radius, along the curve of its level and seed."""
    for i in range(5):
        tube = draw_tube(level, (7, i), "evaluate")
        expected = circular(generate_curve(level, (7, i), domain="evaluate"))
        np.testing.assert_array_equal(tube.points, expected.points)
        np.testing.assert_array_equal(tube.radius, 1.0)
        assert tube.harmonics.shape == (101, 0, 2)


@pytest.mark.parametrize("shape", TUBE_SHAPES)
@pytest.mark.parametrize("recipe", [PAPER_TUBES, VARIED_TUBES, HARD_TUBES, EVERYTHING, WIDE])
@pytest.mark.parametrize("level", [0, 1, 2])
def test_every_tube_can_be_flown(shape: str, recipe: TubeRecipe, level: int) -> None:
    """No recipe draws a wall that folds, closes, or meets another part of itself; bends keep to the cap."""
    for tube in tubes_of(replace(recipe, shape=shape), level, 10):
        scale = scale_of(tube)
        widest = tube.section(np.linspace(0.0, 2.0 * np.pi, 180)).max() / scale
        curve = Curve(tube.points, tube.step)
        check_curve(curve, recipe.curvature_cap, scale)
        assert curve.curvature.max() * scale * widest <= WIDEST_FOLD + 1e-9
        check_curve(curve, 0.9, scale * max(1.0, 0.999 * widest / 1.15))
        assert tube.section(np.linspace(0.0, 2.0 * np.pi, 180)).min() > 0.2 * scale


def test_the_same_arguments_give_the_same_tube() -> None:
    """A tube depends on level, seed, domain and recipe alone; domains share none."""
    for shape in TUBE_SHAPES:
        recipe = replace(EVERYTHING, shape=shape)
        one, again = draw_tube(1, (5,), "tune", recipe), draw_tube(1, (5,), "tune", recipe)
        for name in (field.name for field in fields(SweptTube)):
            np.testing.assert_array_equal(getattr(one, name), getattr(again, name))
        ends = [draw_tube(1, (5,), domain, recipe).points[-1] for domain in ("train", "tune", "evaluate")]
        assert min(np.linalg.norm(ends[a] - ends[b]) for a, b in ((0, 1), (0, 2), (1, 2))) > 1e-3
    pool = draw_pool(1, 5, 2, (EVERYTHING,))
    np.testing.assert_array_equal(pool[1].points, draw_tube(1, (5, 1), "train", EVERYTHING).points)


def test_radii_fill_their_range() -> None:
    """The mean radius is drawn from its range; the tube is scaled by it, so that bends are the same over R."""
    tubes = tubes_of(TubeRecipe(radius=(0.6, 1.6)))
    radii = np.array([tube.radius[0] for tube in tubes])
    assert 0.6 <= radii.min() < 0.75
    assert 1.5 < radii.max() <= 1.6
    for tube, plain in zip(tubes, tubes_of(PAPER_TUBES), strict=True):
        np.testing.assert_allclose(tube.points, plain.points * tube.radius[0], atol=1e-12)


def test_the_radius_swings_as_far_as_asked() -> None:
    """Along a long tube the radius reaches its mean times one plus and minus the swing."""
    for tube in tubes_of(TubeRecipe((100.0,), swing=(0.2, 0.2)), 0, 5):
        assert tube.radius.max() == pytest.approx(1.2, rel=0.01)
        assert tube.radius.min() == pytest.approx(0.8, rel=0.01)
        assert np.abs(np.diff(tube.radius)).max() < 0.2 * 2.0 * np.pi / 8.0 * tube.step


@pytest.mark.parametrize("name", ["ellipse", "lobes"])
def test_a_section_has_the_amplitude_asked_for(name: str) -> None:
    """The wall's Fourier coefficients over the angle are the setting's, at angles of their own, and no other."""
    angles = 2.0 * np.pi * np.arange(64) / 64
    orders, phases = set(), []
    for tube in tubes_of(TubeRecipe(**{name: (0.15, 0.15)})):  # type: ignore[arg-type]
        section = tube.section(angles)
        np.testing.assert_allclose(section, np.broadcast_to(section[0], section.shape), atol=1e-12)
        waves = np.fft.rfft(section[0]) / 32
        assert waves[0].real / 2.0 == pytest.approx(1.0)
        order = int(np.abs(waves[1:]).argmax()) + 1
        assert abs(waves[order]) == pytest.approx(0.15)
        assert np.delete(np.abs(waves), [0, order]).max() < 1e-12
        orders.add(order)
        phases.append(np.angle(waves[order]))
    assert orders == ({2} if name == "ellipse" else {3, 4, 5})
    assert np.ptp(phases) > np.pi


def test_one_setting_moves_no_other_s_draw() -> None:
    """Switching one setting on leaves the others' draws as they were, so that each can be swept alone."""
    base = TubeRecipe(radius=(0.8, 1.2), swing=(0.0, 0.1), ellipse=(0.0, 0.1))
    for tube, lobed in zip(tubes_of(base), tubes_of(replace(base, lobes=(0.05, 0.1))), strict=True):
        np.testing.assert_array_equal(tube.points, lobed.points)
        np.testing.assert_array_equal(tube.radius, lobed.radius)
        np.testing.assert_array_equal(tube.harmonics[:, 0], lobed.harmonics[:, 0])
        assert lobed.harmonics.shape[1] > 1


def test_the_cap_holds_at_level_2_alone() -> None:
    """A cap of 0.9 makes level 2's bends tighter, down to a radius of 1.1 R, and leaves levels 0 and 1 alone."""
    tightest = [Curve(t.points, t.step).curvature.max() for t in tubes_of(HARD_TUBES, 2)]
    assert 0.85 < max(tightest) <= 0.9 + 1e-9
    for level in (0, 1):
        for hard, plain in zip(tubes_of(HARD_TUBES, level), tubes_of(PAPER_TUBES, level), strict=True):
            np.testing.assert_array_equal(hard.points, plain.points)


def test_a_tube_with_no_room_for_its_wall_is_bent_less() -> None:
    """Where wall and cap do not go together, the bend is as tight as the wall allows; other tubes stay as are."""
    elbow = TubeRecipe(shape="elbow", curvature_cap=0.9, ellipse=(0.3, 0.3))
    for tube in tubes_of(elbow, 2, 5):
        assert Curve(tube.points, tube.step).curvature.max() == pytest.approx(WIDEST_FOLD / 1.3)
    for tube, plain in zip(
        tubes_of(replace(elbow, curvature_cap=0.65)), tubes_of(TubeRecipe(shape="elbow")), strict=True
    ):
        np.testing.assert_array_equal(tube.points, plain.points)


def test_mixed_tubes_have_every_shape() -> None:
    """Mixed tubes are each the tube of one shape, and all shapes occur."""
    by_shape = {shape: tubes_of(TubeRecipe(shape=shape)) for shape in SHAPES}
    found = set()
    for i, tube in enumerate(tubes_of(TubeRecipe(shape="mixed"))):
        same = [shape for shape in SHAPES if np.array_equal(by_shape[shape][i].points, tube.points)]
        assert len(same) == 1
        found.add(same[0])
    assert found == set(SHAPES)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"lengths": ()}, "lengths: expected at least one length over R, found none"),
        ({"lengths": (20.0, float("nan"))}, "lengths: expected"),
        ({"lengths": (20.0, 0.5)}, r"lengths: expected numbers .* within 1 to 2000 R, found 0\.5"),
        (
            {"curvature_cap": 0.95},
            r"curvature_cap: expected numbers .* within 0\.05 to 0\.9 1/R, found 0\.95",
        ),
        (
            {"radius": (1.2, 0.8)},
            r"radius: expected numbers low <= high within 0\.5 to 2 m, found 1\.2 to 0\.8",
        ),
        ({"radius": (0.8, float("nan"))}, "radius: expected"),
        ({"swing": (0.0, 0.4)}, "swing: expected"),
        ({"ellipse": (-0.1, 0.1)}, "ellipse: expected"),
        ({"lobes": (0.0, 0.25)}, "lobes: expected"),
        ({"lobe_count": (3, 4.5)}, "lobe_count: expected whole numbers low <= high within 3 to 8"),
        ({"shape": "knot"}, "shape: expected one of curriculum, helix, s-bend, elbow, mixed, found 'knot'"),
    ],
)
def test_settings_out_of_bounds_are_refused(setting: dict[str, Any], message: str) -> None:
    """A setting that cannot be used is refused by name, with what was expected and what was found."""
    with pytest.raises(SettingsError, match=message):
        TubeRecipe(**setting)


def test_the_table_names_every_setting() -> None:
    """The table has a row for each field of a recipe but the shape, and its bounds hold the defaults."""
    names = [field.name for field in fields(TubeRecipe)]
    assert sorted([*(row.name for row in TUBE_SETTINGS), "shape"]) == sorted(names)
    for row in TUBE_SETTINGS:
        assert row.lowest <= np.min(getattr(PAPER_TUBES, row.name)) <= row.highest
        assert row.unit
        assert row.meaning
