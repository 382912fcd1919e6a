"""Materials and palettes of the laboratory's rooms."""

from __future__ import annotations

import colorsys

import numpy as np
import pytest

from iif_core.numerics.color import srgb_from_linear
from iif_core.numerics.xp import NUMPY
from lab.prior import materials, palette
from lab.prior.assets import Assets, load, measured_materials
from lab.rooms import patterns
from tests.errors import refused


@pytest.fixture
def coloured() -> Assets:
    """Two textures: one left-right ramp, one of a single colour."""
    ramp = np.zeros((160, 200, 4), np.uint8)
    ramp[..., 0] = np.linspace(0, 255, 200)
    ramp[..., 3] = 128
    return Assets(("ramp", "flat"), (ramp, np.full((160, 160, 4), (90, 120, 30, 200), np.uint8)), ())


def drawn(assets: Assets) -> tuple[list[np.ndarray], palette.Palette]:
    own = palette.Palette(np.random.default_rng(3), assets)
    places = [*palette.CLASS_SHARES, "mirror", "gloss"]
    return [own.material(place, face) for place in places for face in (None, "x") for _ in range(12)], own


def test_the_renderer_and_numpy_see_the_same_material(llvm, coloured):
    rows, own = drawn(coloured)
    table = materials.Materials(rows, own.layers)
    rng = np.random.default_rng(0)
    points, ids = rng.uniform(-1, 5, (20_000, 3)).astype(np.float32), rng.integers(0, len(rows), 20_000)
    shown = {materials.KINDS[int(materials.entry(row, "kind"))] for row in rows}
    assert {"picture", "wood", "cells", "text"} <= shown
    for a, b in zip(table.numpy(points, ids), table.at(points, ids), strict=True):
        # Steps of patterns may fall on the other side of a point; everything else is equal up to rounding.
        assert np.mean(np.abs(a - b) > 1e-4) < 1e-3


def test_values_keep_their_bounds(coloured):
    rows, own = drawn(coloured)
    points = np.random.default_rng(1).uniform(-3, 3, (len(rows) * 50, 3))
    albedo, rough, metal = materials.Materials(rows, own.layers).numpy(points, np.repeat(np.arange(len(rows)), 50))
    assert materials.DARKEST <= albedo.min() + 1e-7 and albedo.max() <= materials.BRIGHTEST + 1e-6
    assert materials.SMOOTHEST <= rough.min() + 1e-7 and rough.max() <= 1
    assert metal.min() >= 0 and metal.max() <= 1


def test_a_row_has_every_entry_that_the_products_patterns_read():
    row, asked = materials.row((0.1, 0.2, 0.3)), set()

    def column(name):
        asked.add(name)
        return np.array([materials.entry(row, name)])

    albedo, rough, _ = patterns.evaluate(NUMPY, np.zeros((3, 1)), column)
    assert asked <= set(materials.COLUMNS) and len(asked) > 30
    assert np.allclose(np.ravel(albedo), (0.1, 0.2, 0.3)) and np.allclose(rough, 0.6)
    with refused("row", "'shine'", "fine", "layer", kind=TypeError):
        materials.row((0, 0, 0), shine=1.0)


def test_a_picture_is_mirrored_at_its_edges_and_interpolated():
    layer = np.zeros((materials.LAYER, materials.LAYER, 4), np.float32)
    layer[..., 0] = np.linspace(0.1, 0.9, materials.LAYER)  # red rises along x
    layer[..., 3] = 0.5
    flat = materials.row((1, 1, 1), kind="picture", size=(2.0, 2.0), rough=(0.4, 0.0, 0.0))
    table = materials.Materials([flat], [layer])
    x = np.array([0.0, 0.5, 1.0, 2.0, 3.0, 3.5, 4.0])
    albedo, _, _ = table.numpy(np.stack([x, 0 * x, 0 * x], 1), np.zeros(len(x), int))
    assert np.allclose(albedo[:, 0], [0.1, 0.3, 0.5, 0.9, 0.5, 0.3, 0.1], atol=1e-5)


def test_walls_and_ceilings_are_mostly_grey_and_bright():
    saturation, value = [], []
    for seed in range(60):
        own = palette.Palette(np.random.default_rng(seed), Assets())
        for place in ("wall", "ceiling"):
            _, s, v = colorsys.rgb_to_hsv(*srgb_from_linear(np.array(own.colour(place))))
            saturation.append(s)
            value.append(v)
    assert np.mean(np.array(saturation) < 0.35) > 0.85
    assert np.mean(np.array(value) > 0.7) > 0.6
    assert np.max(saturation) > 0.5, "saturated walls must occur, if rarely"


def test_half_of_the_walls_and_most_ceilings_have_no_gloss_and_few_things(coloured):
    palettes = [palette.Palette(np.random.default_rng(seed), coloured) for seed in range(40)]
    matte = {
        place: np.mean([[materials.entry(p.material(place), "r_0") == 1 for _ in range(20)] for p in palettes])
        for place in ("wall", "ceiling", "thing", "thin")
    }
    assert 0.35 < matte["wall"] < 0.6 < matte["ceiling"] < 0.75
    assert 0.1 < matte["thing"] < 0.35 and matte["thin"] < 0.15


def test_what_has_no_gloss_has_none_anywhere(coloured):
    drawn = [palette.Palette(np.random.default_rng(seed), coloured).material("wall") for seed in range(60)]
    for row in (row for row in drawn if materials.entry(row, "r_0") == 1):
        assert materials.entry(row, "r_t") == materials.entry(row, "r_s") == materials.entry(row, "uneven") == 0


@pytest.mark.parametrize("table", [palette.TONE_SHARES, palette.CLASS_SHARES])
def test_shares_add_up(table):
    assert all(sum(shares) == pytest.approx(1, abs=1e-9) for shares in table.values())


def test_thin_things_are_often_metal_and_walls_hardly_ever():
    def metals(place: str) -> float:
        own = palette.Palette(np.random.default_rng(5), Assets())
        return float(np.mean([materials.entry(own.material(place), "metallic") > 0.4 for _ in range(300)]))

    assert metals("thin") > 0.4 > 0.05 > metals("wall")


def test_measured_materials_are_in_range_and_hold_known_metals():
    table = {m.name: m for m in measured_materials()}
    assert len(table) > 60 and table["Gold"].metallic == 1 and table["Gold"].base_color[0] > table["Gold"].base_color[2]
    for own in table.values():
        # Gold's red lies outside of the gamut.
        assert 0 <= min(own.base_color) and max(own.base_color) < 1.06 and 0 <= own.roughness <= 1


def test_assets_survive_the_file_and_a_folder_without_any_is_refused(tmp_path, coloured):
    sky = np.random.default_rng(0).uniform(0, 5, (64, 128, 3)).astype(np.float32)
    Assets(coloured.names, coloured.textures, (sky,)).save(tmp_path / "assets.npz")
    again = load(tmp_path / "assets.npz")
    assert again.names == coloured.names
    for a, b in zip(again.textures, coloured.textures, strict=True):
        assert a.shape == b.shape and np.abs(a.astype(int) - b).mean() < 4, "JPEG keeps them roughly"
    assert np.allclose(again.skies[0], sky, rtol=1e-3)
    (tmp_path / "empty").mkdir()
    with refused(tmp_path / "empty", "textures/*.jpg", "hdri/*.exr", kind=FileNotFoundError):
        load(tmp_path / "empty")


def test_a_folder_of_textures_pairs_colour_with_roughness(tmp_path):
    from PIL import Image

    (tmp_path / "textures").mkdir()
    Image.new("RGB", (320, 320), (200, 10, 10)).save(tmp_path / "textures/brick_diff.png")
    Image.new("L", (320, 320), 40).save(tmp_path / "textures/brick_rough.png")
    Image.new("RGB", (320, 320), (5, 5, 200)).save(tmp_path / "textures/poster.png")
    made = load(tmp_path)
    assert made.names == ("brick", "poster")
    assert tuple(made.textures[0][0, 0]) == (200, 10, 10, 40) and tuple(made.textures[1][0, 0]) == (5, 5, 200, 128)
