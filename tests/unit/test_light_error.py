"""The spread of the error of the light over objects."""

from types import SimpleNamespace

import numpy as np
import pytest

from iif_core.evaluation.light import LightSpread
from workflow.scene.cached_light import SpecularLight
from workflow.scoring import light_error


def spread_of(gains, pixels=400, level=1.0, views=2):
    rng = np.random.default_rng(0)
    found = LightSpread()
    for _ in range(views):
        for o, gain in enumerate(gains):
            light = rng.uniform(0.1, 2.0, (pixels, 3))
            found.add(level * gain * light, light, np.full(pixels, o))
    return found.finish()


def test_closed_form():
    gains = [0.5, 1.0, 2.0]
    assert spread_of(gains) == pytest.approx(np.log(2) * np.sqrt(2 / 3))
    assert spread_of(gains, level=1e6) == pytest.approx(spread_of(gains))
    assert spread_of([1.0, 1.0]) == pytest.approx(0, abs=1e-12)


def test_small_objects_and_bad_pixels_do_not_count():
    found = LightSpread()
    found.add(np.ones((500, 3)), np.ones((500, 3)), np.zeros(500, int))
    found.add(np.full((500, 3), 3.0), np.ones((500, 3)), np.ones(500, int))
    before = found.finish()
    found.add(np.full((5, 3), 100.0), np.ones((5, 3)), np.full(5, 2))
    found.add(np.full((50, 3), np.nan), np.ones((50, 3)), np.full(50, 1))
    found.add(np.ones((50, 3)), np.full((50, 3), np.inf), np.full(50, 1))
    assert found.finish() == pytest.approx(before) == pytest.approx(np.log(3) / 2)


def test_too_little_to_compare():
    assert LightSpread().finish() is None
    assert spread_of([1.0]) is None
    found = LightSpread()
    found.add(np.zeros((10, 3)), np.ones((10, 3)), np.repeat([0, 1], 5))  # black objects have no logarithm
    assert found.finish() is None


def test_light_is_read_at_the_true_roughness(monkeypatch):
    """Light that is linear in the roughness, and the means of halves that differ, give the true radiance again. Left out are
    pixels without specular light, invalid ones, what shines, borders, holes, and what lets light through."""
    rng = np.random.default_rng(1)
    levels, shape = np.array([0.1, 0.4, 1.0]), (4, 5)
    face, object_id = np.arange(20).reshape(shape) % 7, np.arange(20).reshape(shape) % 3
    roughness, metallic, albedo = rng.uniform(0.1, 1, shape), rng.uniform(0, 1, shape), rng.uniform(0, 1, (*shape, 3))
    roughness.flat[[6, 7, 9]] = 0.02, 1.0, 0.4  # below all levels, the last one, and one between
    at, slope, diffuse = rng.uniform(0.5, 1, (20, 3)), rng.uniform(-0.4, 0.4, (20, 3)), rng.uniform(0, 1, (*shape, 3))
    s0 = at[:, None] + slope[:, None] * levels[:, None]
    halves = np.array([0.7, 1.3])[:, None, None, None]
    traced = np.array([1, 2, 3, 4, 5, 6, 7, 9, 11, 13, 15])
    specular = SpecularLight(traced, halves * s0[traced], halves * 0.1 * s0[traced])
    valid, emission, interior = np.ones(shape, bool), np.zeros((*shape, 3)), np.ones(shape)
    valid.flat[2], emission[0, 3, 1], interior.flat[4], face.flat[5] = False, 2.0, 0.5, -1
    lobe = at.reshape(*shape, 3) + slope.reshape(*shape, 3) * np.clip(roughness, 0.1, 1)[..., None]
    m = metallic[..., None]
    radiance = (1 - m) * albedo * diffuse + (0.04 * (1 - m) + m * albedo + 0.1) * lobe
    truth = SimpleNamespace(
        valid=valid, emission=emission, albedo=albedo, roughness=roughness, metallic=metallic, radiance=radiance
    )
    capture = SimpleNamespace(truth=lambda _: truth, gbuffer=lambda _: (None, face))
    maps = {"object.id": object_id.astype(np.uint32), "interior": interior}
    job = SimpleNamespace(read=lambda _: SimpleNamespace(exr=lambda _: maps))
    monkeypatch.setattr(light_error, "read_specular", lambda *_: specular)
    monkeypatch.setattr(light_error, "read_diffuse", lambda *_: np.stack([0.9 * diffuse, 1.1 * diffuse]))
    sheer = np.arange(7) == 4  # pixels 4, 11 and 18
    true, predicted, objects, all_objects = light_error._pixels(job, capture, SimpleNamespace(name="0"), sheer, levels)
    counts = np.array([1, 6, 7, 9, 13, 15])
    np.testing.assert_allclose(predicted, true, rtol=1e-12)
    np.testing.assert_array_equal(true, radiance.reshape(20, 3)[counts])
    np.testing.assert_array_equal(objects, counts % 3)
    assert len(all_objects) == 20 - 4 - 2  # four of their own kind, two more of the face that lets light through
