"""The draw of the pixels of the fit, and the table of the specular light that was traced for pixels."""

from types import SimpleNamespace

import numpy as np
import pytest

from iif_core.camera.pixels import ViewPixels
from tests.errors import refused
from workflow.artifacts.files import read_parquet, write_parquet
from workflow.fitting.fit_pixels import PixelDraw, count_eligible
from workflow.scene.cached_light import SpecularLight, read_specular

VIEW = SimpleNamespace(view_id=7, name="v007")


def _pixels(seed=0, n=20_000):
    """Pixels of four objects, of which the last has 30 interior ones; the last of ten faces is an emitter."""
    rng = np.random.default_rng(seed)
    owner = rng.choice(4, n, p=[0.7, 0.2, 0.09, 0.01])
    interior = rng.random(n) < 0.9
    interior[np.flatnonzero((owner == 3) & interior)[30:]] = False
    face, way = rng.integers(0, 10, n).astype(np.int32), np.zeros((n, 3), np.float32)
    valid, front = rng.random(n) < 0.95, np.ones(n, bool)
    return ViewPixels(
        index=np.arange(n),
        points=way,
        normals=way,
        wo=way,
        face=face,
        object_id=owner.astype(np.int32),
        from_front=front,
        value=way,
        valid=valid,
        interior=interior,
        number=np.arange(n, dtype=np.uint32),
    )


def test_objects_get_the_same_number_and_a_larger_draw_contains_a_smaller_one():
    pixels, mixed = _pixels(), np.arange(10) == 9
    counts = count_eligible(pixels, mixed, 4)
    assert counts[3] < 30
    small, large = (PixelDraw.evenly(counts, budget, mixed, 5).of(pixels, VIEW) for budget in (1500, 6000))
    assert np.isin(small, large).all() and (np.diff(large) > 0).all()
    chosen = pixels.take(small)
    assert chosen.valid.all() and not mixed[chosen.face].any()
    number = np.bincount(chosen.object_id, minlength=4)
    assert (np.abs(number[:3] - 500) < 90).all()
    # All of an object with few pixels, border pixels included; of others the interior alone.
    assert number[3] > counts[3] and chosen.interior[chosen.object_id < 3].all()


def test_light_is_found_by_pixel_and_its_absence_is_named():
    rng = np.random.default_rng(1)
    light = SpecularLight(np.array([3, 8, 40]), rng.random((2, 3, 4, 3)), rng.random((2, 3, 4, 3)))
    some = light.at(np.array([40, 3]))
    np.testing.assert_array_equal(some.s0, light.s0[:, [2, 0]])
    with refused("shading.pixels", "shading: {pixels: all}"):
        light.at(np.array([8, 9]))
    none = SpecularLight(np.zeros(0, np.int64), np.zeros((2, 0, 4, 3)), np.zeros((2, 0, 4, 3)))
    assert none.at(np.zeros(0, np.int64)).s1.shape == (2, 0, 4, 3)
    with refused("shading.pixels", "shading: {pixels: all}"):
        none.at(np.array([1]))


@pytest.mark.parametrize("index", [[3, 8, 40], []])
def test_the_table_comes_back_also_without_pixels(tmp_path, index):
    rng = np.random.default_rng(2)
    light = SpecularLight(np.array(index, np.int64), *(rng.random((2, len(index), 4, 3), np.float32) for _ in range(2)))
    write_parquet(tmp_path / "v.parquet", light.columns(), {})
    reader = SimpleNamespace(table=lambda name: read_parquet(tmp_path / "v.parquet"))
    found = read_specular(SimpleNamespace(read=lambda stage: reader), VIEW)
    np.testing.assert_array_equal(found.index, light.index)
    assert found.s0.shape == (2, len(index), 4, 3)
    np.testing.assert_array_equal(found.s0, light.s0)
    np.testing.assert_array_equal(found.s1, light.s1)
