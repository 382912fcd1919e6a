"""Retinex prior: scenes with known albedo, use of the mesh, extreme input."""

import numpy as np
import pytest

from iif_core.priors import retinex
from tests.errors import refused


def patches(smooth_light=True):
    """A 48 x 64 wall of 12 tiles under light that falls off smoothly; (albedo, linear photograph, tile ids)."""
    rng = np.random.default_rng(0)
    tile = np.kron(np.arange(12).reshape(3, 4), np.ones((16, 16), int))
    albedo = (0.15 + 0.7 * rng.random((12, 3)))[tile]
    y, x = np.mgrid[:48, :64] / 64
    light = 0.2 + np.exp(-4 * ((x - 0.2) ** 2 + (y - 0.3) ** 2)) if smooth_light else np.ones((48, 64))
    return albedo, 0.5 * albedo * light[..., None], tile


def log_error(found, truth):
    difference = np.log(found) - np.log(truth)
    return (difference - difference.mean((0, 1))).std()


def test_removes_smooth_light():
    albedo, photo, _ = patches()
    before = log_error(photo, albedo)
    predictions = retinex.retinex_predictions(photo, 5)
    errors = [log_error(p[..., :3], albedo) for p in predictions]
    assert min(errors) < 0.15 * before
    assert predictions.shape == (5, 48, 64, 5) and predictions.dtype == np.float32


def test_mesh_tells_material_from_light():
    """A dark corner: the wall turns by 90 degrees and receives a third of the light. Only the normals show this."""
    albedo = np.full((32, 32, 3), 0.5)
    light = np.where(np.arange(32) < 16, 0.9, 0.3)[None, :, None]
    normals = np.where(np.arange(32)[None, :, None] < 16, [0, 0, 1.0], [1.0, 0, 0]) * np.ones((32, 1, 1))
    plain = retinex.retinex_predictions(albedo * light, 3)[0, ..., :3]
    helped = retinex.retinex_predictions(albedo * light, 3, object_id=np.zeros((32, 32), int), normals=normals)
    assert plain[:, 20].mean() < 0.5 * plain[:, 5].mean()
    np.testing.assert_allclose(helped[..., :3], 0.4, atol=1e-6)


def test_steps_between_objects_are_material():
    light = np.where(np.arange(32) < 16, 0.5, 0.52)[None, :, None] * np.ones((32, 32, 3))  # weaker than any threshold
    ids = np.where(np.arange(32) < 16, 3, 7)[None, :] * np.ones((32, 1), int)
    found = retinex.retinex_predictions(light, 1, object_id=ids)[0, ..., :3]
    np.testing.assert_allclose(found[:, 20] / found[:, 5], 0.52 / 0.5, rtol=1e-5)


def test_integration_is_the_inverse_of_differences():
    image = np.random.default_rng(1).normal(size=(13, 9, 3))
    steps = [np.diff(image, axis=0), np.diff(image, axis=1)]
    np.testing.assert_allclose(retinex._integrated(steps, image, 0.0), image, atol=1e-12)
    np.testing.assert_allclose(retinex._integrated(steps, image, 0.3), image, atol=1e-12)


def test_screened_integration_is_the_least_squares_solution():
    rng = np.random.default_rng(2)
    image, steps = rng.normal(size=(4, 3, 3)), [rng.normal(size=(3, 3, 3)), rng.normal(size=(4, 2, 3))]
    index = np.arange(12).reshape(4, 3)
    pairs = [(index[:-1], index[1:]), (index[:, :-1], index[:, 1:])]
    rows = [np.eye(12)[b.ravel()] - np.eye(12)[a.ravel()] for a, b in pairs] + [np.sqrt(0.2) * np.eye(12)]
    right = np.concatenate([*(s.reshape(-1, 3) for s in steps), np.sqrt(0.2) * image.reshape(-1, 3)])
    expected = np.linalg.lstsq(np.concatenate(rows), right, rcond=None)[0].reshape(4, 3, 3)
    np.testing.assert_allclose(retinex._integrated(steps, image, 0.2), expected, atol=1e-12)


def test_known_light_gives_the_albedo_as_it_is():
    """Two versions of the light, used in turn: the correct one gives the albedo including its level."""
    albedo, photo, tile = patches()
    right = np.log(photo / albedo)
    found = retinex.retinex_predictions(photo, 4, object_id=tile, light=np.stack([right, right + np.log(2.0)]))[..., :3]
    for k, factor in enumerate((1, 0.5, 1, 0.5)):
        np.testing.assert_allclose(found[k], factor * albedo, rtol=1e-4)


@pytest.mark.parametrize("mean", [0.1, 0.4, 0.8])
def test_mean_albedo_is_as_asked(mean):
    _, photo, _ = patches()
    for prediction in retinex.retinex_predictions(photo, 3, mean)[..., :3]:
        assert prediction.mean() == pytest.approx(mean, rel=1e-4)


def test_hypotheses_differ_and_materials_are_neutral():
    _, photo, _ = patches()
    grain = np.exp(0.15 * np.random.default_rng(0).standard_normal((48, 64, 1)))
    predictions = retinex.retinex_predictions(photo * grain, 4)
    assert np.abs(np.diff(predictions[..., :3], axis=0)).max((1, 2, 3)).min() > 1e-3
    assert len(np.unique(predictions[:, 0, 0, 3])) == 4 and predictions[..., 4].max() <= 0.1


def test_an_object_has_one_draw_of_roughness_in_all_views():
    _, photo, tile = patches()
    first = retinex.retinex_predictions(photo, 3, object_id=tile, seed=5)[..., 3:]
    other = retinex.retinex_predictions(photo[:, ::-1], 3, object_id=tile[:, ::-1], seed=5)[..., 3:]
    np.testing.assert_array_equal(first, other[:, :, ::-1])
    assert len(np.unique(first[0, ..., 0])) == 12
    assert not np.array_equal(first, retinex.retinex_predictions(photo, 3, object_id=tile, seed=6)[..., 3:])


def test_level_of_the_albedo():
    """The wanted mean, unless more than 3 % would be brighter than 0.9."""
    weight = np.full(100, 2.0)
    assert retinex.albedo_level(np.full((100, 3), 0.2), weight, 0.4) == pytest.approx(2.0)
    few, many = np.full((100, 3), 0.1), np.full((100, 3), 0.1)
    few[:2], many[:20] = 1.0, 1.0
    assert retinex.albedo_level(few, weight, 0.4) == pytest.approx(0.4 / few.mean())
    assert retinex.albedo_level(many, weight, 0.4) == pytest.approx(0.9)
    assert retinex.albedo_level(many, 0 * weight, 0.4) == 1.0 and np.isfinite(retinex.albedo_level(0 * many, weight, 0.4))


@pytest.mark.parametrize(
    "photo",
    [np.zeros((8, 8, 3)), np.ones((8, 8, 3)), np.full((8, 8, 3), np.nan), np.ones((1, 1, 3)), np.full((1, 5, 3), 0.3)],
)
def test_dull_photographs_give_a_plain_albedo(photo):
    predictions = retinex.retinex_predictions(photo, 2)
    np.testing.assert_allclose(predictions[..., :3], 0.4, atol=1e-6)


def test_pixels_that_do_not_count_do_not_spread():
    _, photo, _ = patches(smooth_light=False)
    valid = np.ones((48, 64), bool)
    valid[20:24, 30:34] = False
    spoilt = photo.copy()
    spoilt[~valid] = [[np.inf, 5.0, np.nan]]
    first = retinex.retinex_predictions(spoilt, 2, valid=valid)
    spoilt[~valid] = 0.01
    np.testing.assert_array_equal(first, retinex.retinex_predictions(spoilt, 2, valid=valid))
    assert np.isfinite(first).all()


def test_bad_input_is_refused():
    with refused("(4, 4)", "(H, W, 3)"):
        retinex.retinex_predictions(np.zeros((4, 4)), 1)
    with refused("object ids", "(3, 4)", "(4, 4)"):
        retinex.retinex_predictions(np.zeros((4, 4, 3)), 1, object_id=np.zeros((3, 4), int))
    with refused("light", "(4, 4, 3)"):
        retinex.retinex_predictions(np.zeros((4, 4, 3)), 1, light=np.zeros((4, 4, 3)))
    with refused("samples", 0, 1):
        retinex.retinex_predictions(np.zeros((4, 4, 3)), 0)
