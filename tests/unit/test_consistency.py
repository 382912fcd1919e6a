"""Scores without truth: shading left, spread over views, the gain of a held-out photograph."""

from types import SimpleNamespace

import numpy as np
import pytest

from iif_core.camera.response import response
from iif_core.evaluation.consistency import ShadingLeft, ViewSpread, held_out_gain
from workflow.scoring import no_reference


def surface(n=4000, seed=0):
    """(albedo, light, object): texture that is independent of the light."""
    rng = np.random.default_rng(seed)
    object_id = rng.integers(0, 5, n)
    albedo = (0.2 + 0.6 * rng.random((5, 3)))[object_id] * np.exp(0.1 * rng.standard_normal((n, 1)))
    light = np.exp(0.5 * rng.standard_normal((n, 1)) + rng.random(5)[object_id][:, None]) * np.ones(3)
    return albedo, light, object_id


def left(albedo, light, object_id):
    score = ShadingLeft()
    for part in np.array_split(np.arange(len(albedo)), 3):
        score.add(albedo[part], light[part], object_id[part])
    return score.finish()


def test_shading_left():
    albedo, light, object_id = surface()
    clean, photograph = left(albedo, light, object_id), left(albedo * light, light, object_id)
    assert abs(clean.correlation) < 0.05 and abs(clean.slope) < 0.02
    assert photograph.slope == pytest.approx(1, abs=0.02) and photograph.correlation > 0.95
    assert left(albedo * light**0.3, light, object_id).slope == pytest.approx(0.3, abs=0.02)
    # a level of every object says nothing
    other = left(albedo * np.arange(1, 6)[object_id][:, None], light, object_id)
    assert other.correlation == pytest.approx(clean.correlation, abs=1e-9)


def test_shading_left_is_the_pooled_correlation():
    albedo, light, object_id = surface(300)
    x, y = np.log(light).mean(-1), np.log(albedo).mean(-1)
    for o in range(5):
        x[object_id == o] -= x[object_id == o].mean()
        y[object_id == o] -= y[object_id == o].mean()
    found = left(albedo, light, object_id)
    assert found.correlation == pytest.approx(np.corrcoef(x, y)[0, 1], abs=1e-9)
    assert found.slope == pytest.approx((x * y).sum() / (x * x).sum(), abs=1e-9) and found.pixels == 300


def test_extremes_of_shading_left():
    albedo, light, object_id = surface(50)
    assert ShadingLeft().finish().pixels == 0
    assert left(albedo, np.ones_like(light), object_id).correlation == 0.0
    score = ShadingLeft()
    score.add(np.full((2, 3), np.nan), light[:2], object_id[:2])
    score.add(albedo[:2], light[:2], np.array([-1, -1]))
    assert score.finish().pixels == 0
    assert np.isfinite(left(np.zeros_like(albedo), light * 0, object_id).slope)


def test_spread_over_views():
    """Two views 2 d apart in log: standard deviation sqrt(2) d; cells seen once do not count."""
    cell = np.repeat(np.arange(10, dtype=np.uint64), 3)
    albedo = np.full((30, 3), 0.4)
    score = ViewSpread()
    score.add(albedo * np.exp(0.1), cell)
    assert score.finish() is None
    score.add(albedo[:15] * np.exp(-0.1), cell[:15])
    assert score.finish() == pytest.approx(np.sqrt(2) * 0.1, rel=1e-9)
    same = ViewSpread()
    for _ in range(3):
        same.add(albedo, cell)
    assert same.finish() == pytest.approx(0, abs=1e-7)


@pytest.mark.parametrize("gain", [1e-3, 0.3, 1.0, 7.0])
def test_gain_of_a_held_out_photograph(gain):
    rng = np.random.default_rng(0)
    radiance = 0.4 * rng.random((12, 16, 3)) / gain
    curve = response("srgb")
    photo = curve(np.clip(gain * radiance, 0, 1)) + 0.01 * rng.standard_normal(radiance.shape)
    mask = np.ones((12, 16), bool)
    mask[0] = False
    photo[0] = 1.0  # not counted
    assert held_out_gain(radiance, photo, mask, curve) == pytest.approx([gain] * 3, rel=0.01)
    tint = np.array([1.2, 1.0, 0.8])
    photo[1:] = curve(np.clip(gain * tint * radiance[1:], 0, 1))
    assert held_out_gain(radiance, photo, mask, curve, per_channel=True) == pytest.approx(gain * tint, rel=0.01)


def test_extremes_of_the_gain():
    curve, some = response("srgb"), np.full((2, 2, 3), 0.5)
    assert held_out_gain(np.zeros((2, 2, 3)), some, np.ones((2, 2), bool), curve).tolist() == [1.0] * 3
    assert held_out_gain(some, some, np.zeros((2, 2), bool), curve).tolist() == [1.0] * 3
    assert np.isfinite(held_out_gain(some, np.zeros((2, 2, 3)), np.ones((2, 2), bool), curve)).all()
    assert np.isfinite(held_out_gain(some, np.ones((2, 2, 3)), np.ones((2, 2), bool), curve)).all()


def test_scores_are_of_lit_inner_surface_that_neither_shines_nor_lets_light_through(monkeypatch):
    """Two views of one wall, of which a result, its base and two predictions keep 0.2, 0.5, 0.8 and 1 of the light. Where a pixel
    does not count, its albedo and light are wild."""
    rng = np.random.default_rng(4)
    shape, n = (20, 30), 600
    face, objects = np.arange(n).reshape(shape) % 50, np.arange(n).reshape(shape) % 3
    light, level = np.exp(rng.normal(0, 0.5, (2, *shape, 1))) * np.ones(3), np.array([0.2, 0.4, 0.6])[objects][..., None]
    valid, interior = rng.random(shape) > 0.1, (rng.random(shape) > 0.1).astype(float)
    emits, sheer = np.arange(50) % 7 == 3, np.arange(50) % 11 == 5
    dark = rng.random(shape) < 0.05
    face[0], objects[1] = -1, 2**32 - 1
    off = ~valid | (interior < 0.5) | emits[face] | sheer[face] | (face < 0) | (objects > 2) | dark
    wild = np.where(off, np.exp(rng.normal(0, 3, shape)), 1.0)[..., None] * np.ones(3)
    keeps = {"affines": [0.2], "base": [0.5], "prior": [0.8, 1.0]}

    def maps(stage, file):
        if stage == "segmentation":
            return {"object.id": objects.astype(np.uint32), "interior": interior}
        number, out = int(file[5]), {}
        for k, keep in enumerate(keeps[stage]):
            albedo, layer = wild * level * light[number] ** keep, f"prior.{k:03d}.albedo" if stage == "prior" else "albedo"
            out |= {f"{layer}.{c}": albedo[..., i] for i, c in enumerate("RGB")}
        return out | ({"cell.id": np.arange(n).reshape(shape).astype(np.uint32)} if stage == "base" else {})

    def read(stage):
        json = {"diffuse": {"cell_edge_m": 1.0}}
        return SimpleNamespace(exr=lambda file: maps(stage, file), has=lambda file: stage in keeps, json=lambda file: json)

    points = np.dstack([*np.indices(shape), np.zeros(shape)]) + 0.5  # every pixel is a cell of its own
    capture = SimpleNamespace(
        mesh=lambda: (np.array([[0.0, 0, 0], [20, 0, 0], [0, 30, 1]]), np.array([[0, 1, 2]])), gbuffer=lambda view: (None, face),
        points=lambda view, depth: points, photo=lambda view: (None, valid),
    )  # fmt: skip
    lit = SimpleNamespace(is_sheer=sheer), SimpleNamespace(emits=emits)
    seen = np.where(dark[..., None], 1e-3 * light, np.where(off[..., None], light / wild**2, light))
    monkeypatch.setattr(no_reference, "read_lit_scene", lambda job: lit)
    monkeypatch.setattr(
        no_reference, "read_diffuse", lambda job, view: np.stack([0.5 * seen[int(view.name)], 1.5 * seen[int(view.name)]])
    )
    views = [SimpleNamespace(name="0"), SimpleNamespace(name="1")]
    photo = ((light[0] * light[1]) ** 0.5 * wild * level).reshape(-1, 3)  # the mean of two photographs that are taken for albedo
    found = no_reference.truth_free_scores(SimpleNamespace(read=read), capture, views, photo)
    rows = {name: scores for name, _, _, scores in found}
    correlation, slope, spread = (score.value for score in rows["photo_as_albedo"])
    assert 0.6 < correlation < 0.8 and slope == pytest.approx(0.5, abs=0.05) and spread < 1e-6
    apart = (np.log(light[0] / light[1])[~off][:, 0] ** 2 / 2).mean() ** 0.5
    for name, keep in (("result", 0.2), ("base", 0.5), ("prior_k0", 0.8), ("prior_mean_k", 0.9)):
        found = [score.value for score in rows[name]]
        np.testing.assert_allclose(found, [1, keep, keep * apart], rtol=1e-5)
