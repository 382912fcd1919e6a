from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iif_core.evaluation import flip
from iif_core.evaluation import metrics as m
from tests.errors import refused
from tests.oracles import scores as single
from workflow.scoring import of_views

ALL = np.ones((24, 32), bool)


def image(seed=0, channels=3):
    shape = (24, 32, channels) if channels > 1 else (24, 32)
    return np.random.default_rng(seed).uniform(0.1, 0.9, shape)


def values(scores):
    return {(s.protocol, s.metric): s.value for s in scores}


def test_l2_and_psnr_known_values():
    truth = np.full((24, 32, 3), 0.4)
    assert single.l2(truth + 0.1, truth, ALL) == pytest.approx(0.01)
    assert single.psnr(truth + 0.1, truth, ALL) == pytest.approx(20.0)
    assert single.psnr(truth, truth, ALL) == 100.0
    half = truth.copy()
    half[:12] += 0.2
    assert single.psnr(half, truth, ALL) == pytest.approx(10 * np.log10(1 / 0.02))


def test_excluded_pixels_change_nothing():
    truth, prediction = image(0), image(1)
    mask = ALL.copy()
    mask[3:9, 4:20] = False
    spoilt = prediction.copy()
    spoilt[~mask] = 1e3
    for function in (single.l2, single.psnr, single.ssim, m.log_l2, m.iou):
        assert function(spoilt, truth, mask) == function(prediction, truth, mask)


def ssim_oracle(a, b):
    """Wang et al. 2004, window by window, in float64."""
    x = np.arange(11) - 5
    g = np.exp(-(x**2) / (2 * 1.5**2))
    window = np.outer(g, g) / g.sum() ** 2
    out = []
    for i in range(5, a.shape[0] - 5):
        for j in range(5, a.shape[1] - 5):
            p, q = a[i - 5 : i + 6, j - 5 : j + 6], b[i - 5 : i + 6, j - 5 : j + 6]
            mp, mq = (window * p).sum(), (window * q).sum()
            vp, vq = (window * p * p).sum() - mp**2, (window * q * q).sum() - mq**2
            cov = (window * p * q).sum() - mp * mq
            out.append((2 * mp * mq + 1e-4) * (2 * cov + 9e-4) / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4)))
    return np.mean(out)


def test_ssim_is_the_published_formula():
    a, b = image(2, 1), image(3, 1) * 0.5 + image(2, 1) * 0.5
    assert single.ssim(b, a, ALL) == pytest.approx(ssim_oracle(b, a), abs=2e-5)
    assert single.ssim(a, a, ALL) == pytest.approx(1.0)


def test_small_image_is_a_named_result():
    small = np.full((8, 40), 0.5)
    scores = values(m.score_map("roughness", small, small, np.ones((8, 40), bool)))
    assert scores["raw", "ssim"] is None and scores["raw", "psnr"] == 100.0
    reason = next(s.reason for s in m.score_map("roughness", small, small, np.ones((8, 40), bool)) if s.metric == "ssim")
    assert "at least 11" in reason


def test_one_masked_pixel_in_a_corner():
    mask = np.zeros((24, 32), bool)
    mask[0, 0] = True
    assert np.isfinite([s.value for s in m.score_map("albedo", image(0), image(1), mask, mask.astype(int))]).all()


def test_empty_mask_and_nan_are_named_results():
    truth = image(0)
    empty = m.score_map("albedo", truth, truth, np.zeros_like(ALL), np.zeros((24, 32), int))
    assert {s.value for s in empty} == {None} and {s.reason for s in empty} == {"no pixel counts"}
    broken = truth.copy()
    broken[2, 3, 1] = np.nan
    scores = m.score_map("albedo", broken, truth, ALL)
    assert {s.value for s in scores} == {None} and "prediction is not finite in 1 " in scores[0].reason
    outside = ALL.copy()
    outside[2, 3] = False
    assert all(s.value is not None for s in m.score_map("albedo", broken, truth, outside))


def test_log_l2_and_iou():
    truth = np.zeros((24, 32, 3))
    truth[:4] = 10.0
    prediction = np.zeros_like(truth)
    prediction[2:6] = 10.0
    assert m.iou(prediction, truth, ALL) == pytest.approx(2 / 6)
    assert m.iou(truth * 0, truth * 0, ALL) == 1.0
    assert m.iou(truth, truth, ALL) == 1.0
    assert m.log_l2(truth, truth * 0, ALL) == pytest.approx(np.log(11.0) ** 2 * 4 / 24)


@given(st.lists(st.floats(0.05, 1.0), min_size=3, max_size=3))
def test_scaled_undoes_a_gain_per_channel(gain):
    truth = image(4)
    np.testing.assert_allclose(single.scaled(truth * gain, truth, ALL), truth, rtol=1e-12)


def test_scaled_ignores_excluded_pixels_and_black():
    truth = image(5)
    mask = ALL.copy()
    mask[:6] = False
    prediction = truth * 0.5
    prediction[:6] = 1e4
    assert single.l2(single.scaled(prediction, truth, mask), truth, mask) < 1e-20
    np.testing.assert_array_equal(single.scaled(truth * 0, truth, ALL), 0)
    assert single.scaled(truth * 0.5, truth * 40, ALL).max() == 1.0
    assert single.scaled(truth * 0.5, truth * 40, ALL, None).max() > 30


def test_oracle_affine_recovers_one_map_per_object():
    rng = np.random.default_rng(6)
    truth, objects = image(7), rng.integers(-1, 4, (24, 32))
    prediction = np.zeros_like(truth)
    for o in range(-1, 4):
        a, b = rng.normal(0, 0.5, (3, 3)) + np.eye(3), rng.normal(0, 0.3, 3)
        prediction[objects == o] = (truth[objects == o] - b) @ np.linalg.inv(a).T
    assert single.psnr(single.oracle_affine(prediction, truth, ALL, objects), truth, ALL) > 60
    assert single.psnr(single.oracle_affine(prediction, truth, ALL, objects * 0), truth, ALL) < 30


def test_oracle_affine_agrees_with_least_squares():
    rng = np.random.default_rng(8)
    x, y = rng.uniform(0.4, 0.6, (24, 32)), rng.uniform(0.4, 0.6, (24, 32))
    slope, offset = np.polyfit(x.ravel(), y.ravel(), 1)
    mapped = single.oracle_affine(x, y, ALL, np.zeros((24, 32), int), ridge=1e-12)
    np.testing.assert_allclose(mapped, slope * x + offset, atol=1e-8)


def test_oracle_affine_of_a_constant_is_the_mean():
    truth = image(9)
    mapped = single.oracle_affine(np.full_like(truth, 0.3), truth, ALL, np.zeros((24, 32), int))
    np.testing.assert_allclose(mapped, np.broadcast_to(truth.mean((0, 1)), truth.shape), atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([1e-9, 1e-3, 1.0]))
def test_oracle_never_loses_to_raw(seed, spread):
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0, 1, (24, 32, 3))
    prediction = np.clip(0.5 + spread * rng.normal(size=truth.shape), 0, 1)
    objects = rng.integers(0, 40, (24, 32))
    assert (
        single.l2(single.oracle_affine(prediction, truth, ALL, objects), truth, ALL) <= single.l2(prediction, truth, ALL) + 1e-9
    )


def test_masks_follow_the_truth():
    valid, hit = np.ones((4, 4), bool), np.ones((4, 4), bool)
    emission, roughness = np.zeros((4, 4, 3)), np.full((4, 4), 0.5)
    valid[0, 0] = hit[0, 1] = False
    emission[1, 0, 2] = 3.0
    roughness[2, 0] = 0.02
    masks = m.material_masks(valid, hit, emission, roughness)
    assert masks["emission"].sum() == 14
    assert masks["roughness"].sum() == masks["metallic"].sum() == 13
    assert masks["albedo"].sum() == 12 and not masks["albedo"][2, 0]


def test_score_map_protocols():
    truth, objects = image(10), np.zeros((24, 32), int)
    scores = values(m.score_map("albedo", truth * 0.5, truth, ALL, objects))
    assert {p for p, _ in scores} == {"raw", "scaled", "oracle_affine"}
    assert scores["raw", "psnr"] < 15 and scores["scaled", "psnr"] == 100.0 and scores["oracle_affine", "psnr"] > 60
    emission = values(m.score_map("emission", truth * 0.5, truth * 50, ALL))
    assert emission["scaled", "l2"] < 1e-12 < emission["raw", "l2"]
    assert emission["raw", "iou"] == 1.0


def test_wrong_input_is_refused():
    with refused("'normal'", "albedo, roughness, metallic"):
        m.score_map("normal", image(), image(), ALL)
    with refused("score of albedo", "(24, 32, 3)", "(24, 32)"):
        m.score_map("albedo", image(), image(channels=1), ALL)


def test_flip_of_equal_images_is_zero():
    truth = image(11)
    assert single.flip(truth, truth, ALL) == 0.0
    assert single.flip(1 - truth, truth, ALL) > 0.2


@pytest.mark.parametrize("encoded", [False, True])
def test_flip_is_the_published_one(encoded):
    """Against the authors' program, pixel by pixel; a black, a smooth and a noisy pair."""
    evaluate = pytest.importorskip("flip_evaluator").evaluate
    rng = np.random.default_rng(12)
    ramp = np.stack(np.meshgrid(np.linspace(0, 1, 70), np.linspace(0, 1, 50)), -1)
    smooth = np.concatenate([ramp, 1 - ramp[..., :1]], -1).astype(np.float32)
    noisy = np.clip(smooth + 0.3 * rng.normal(size=smooth.shape) * (rng.random((50, 70, 1)) < 0.2), 0, 1).astype(np.float32)
    for truth, prediction in ((smooth, noisy), (noisy, smooth[::-1]), (np.zeros_like(smooth), smooth)):
        theirs = np.asarray(evaluate(truth, prediction, "LDR", inputsRGB=encoded, applyMagma=False, computeMeanError=False)[0])
        ours = flip.difference(flip.Seen(prediction, encoded), flip.Seen(truth, encoded))
        np.testing.assert_allclose(ours, theirs[..., 0], atol=1e-3)
        assert single.flip(prediction, truth, np.ones((50, 70), bool), encoded) == pytest.approx(theirs.mean(), abs=3e-5)


def test_ssim_of_colours_is_the_common_one():
    from skimage.metrics import structural_similarity

    truth, prediction = image(13), 0.6 * image(13) + 0.4 * image(14)
    theirs = structural_similarity(
        truth, prediction, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0, channel_axis=2
    )
    assert single.ssim(prediction, truth, ALL) == pytest.approx(theirs, abs=1e-12)


def test_one_target_scores_many_predictions():
    """Cached properties of the truth do not depend on earlier predictions; the plain functions give the same scores."""
    truth, mask, objects = image(15), ALL.copy(), np.arange(24 * 32).reshape(24, 32) // 200
    mask[4:9, :20] = False
    target = m.Target("albedo", truth, mask, objects)
    for seed in (16, 17):
        prediction = image(seed)
        scores = values(target.scores(prediction))
        assert scores == values(m.score_map("albedo", prediction, truth, mask, objects))
        for protocol, seen in (
            ("raw", prediction),
            ("scaled", single.scaled(prediction, truth, mask)),
            ("oracle_affine", single.oracle_affine(prediction, truth, mask, objects)),
        ):
            for name, function in (("l2", single.l2), ("psnr", single.psnr), ("ssim", single.ssim), ("flip", single.flip)):
                assert scores[protocol, name] == pytest.approx(function(seen, truth, mask), rel=1e-9), (protocol, name)
    some = values(target.scores(image(18), ("l2", "flip"), perceptual=("raw",)))
    assert set(some) == {("raw", "l2"), ("raw", "flip"), ("scaled", "l2"), ("oracle_affine", "l2")}


def test_scaled_gain_is_ratio_of_sums_not_least_squares():
    """Prediction (0.2, 0.4) against truth (0.3, 0.4): sums give 7/6, least squares would give 1.1."""
    prediction, truth = np.zeros((1, 2, 3)), np.zeros((1, 2, 3))
    prediction[0, :, :] = [[0.2] * 3, [0.4] * 3]
    truth[0, :, :] = [[0.3] * 3, [0.4] * 3]
    out = single.scaled(prediction, truth, np.ones((1, 2), bool))
    np.testing.assert_allclose(out[0, :, 0], [0.2 * 7 / 6, 0.4 * 7 / 6])


def test_scaling_does_not_erase_false_emitters():
    """The truth does not emit but the prediction does: the error remains in every protocol, and IoU has no scaled score."""
    prediction, truth = np.zeros((8, 8, 3)), np.zeros((8, 8, 3))
    prediction[2:4, 2:4] = 5.0
    scores = m.score_map("emission", prediction, truth, np.ones((8, 8), bool))
    by_key = {(s.metric, s.protocol): s.value for s in scores}
    assert by_key["l2", "scaled"] == by_key["l2", "raw"] > 0
    assert by_key["iou", "raw"] == 0 and ("iou", "scaled") not in by_key


@pytest.mark.parametrize(("roughness", "counts"), [(0.049, False), (0.051, True), (0.3, True)])
def test_mirror_threshold(roughness, counts):
    ones = np.ones((1, 1))
    masks = m.material_masks(ones > 0, ones > 0, np.zeros((1, 1, 3)), ones * roughness)
    assert bool(masks["albedo"][0, 0]) is counts


def test_the_gain_over_raw_predictions_is_a_difference_of_decibels_and_a_ratio_of_errors():
    def scores(psnr, l2):
        return {"raw": {"psnr": {"mean": psnr}, "l2": {"mean": l2}}}

    result = {"albedo": scores(23.5, 0.01), "roughness": scores(18.0, 0.0), "metallic": {"raw": {"lpips": {"mean": 0.1}}}}
    prior = {"albedo": scores(20.25, 0.03), "roughness": scores(17.0, 0.02), "metallic": scores(9.0, 0.2)}
    capture = SimpleNamespace(has_truth=True, views=[0, 1, 2])
    rows = SimpleNamespace(means=lambda: {"result": result, "prior_mean_k": prior}, missing=[])
    gains = of_views.summary(rows, capture, 2)["gain_over_raw_predictions"]
    assert gains == {"albedo": {"raw": {"psnr_db": 3.25, "l2_ratio": 3.0}}, "roughness": {"raw": {"psnr_db": 1.0}}}
    alone = SimpleNamespace(means=lambda: {"result": result}, missing=[])
    assert of_views.summary(alone, capture, 2)["gain_over_raw_predictions"] == {}


@pytest.mark.parametrize("is_hdr", [False, True])
def test_radiance_is_scored_once_against_the_truth_or_a_linear_photograph(monkeypatch, is_hdr):
    """A rendering that equals the linear photograph, and is twice the true radiance."""
    radiance, mask = image(1), ALL.copy()
    mask[:4] = False
    layers = {"": radiance, "ldr.": image(2), "emission.": 0 * radiance}
    channels = {f"{layer}{c}": picture[..., i] for layer, picture in layers.items() for i, c in enumerate("RGB")}
    reader = SimpleNamespace(exr=lambda file: channels, has=lambda file: False)

    def channels_of(layer):
        return np.stack([channels[f"{layer}{c}"] for c in "RGB"], -1)

    capture = SimpleNamespace(
        is_hdr=is_hdr, photo=lambda view, held_out: (radiance, mask), gbuffer=lambda view: (None, np.zeros(ALL.shape, int))
    )
    truth = SimpleNamespace(radiance=0.5 * radiance, emission=0 * radiance)
    materials = SimpleNamespace(truth=truth, masks={"emission": mask})
    monkeypatch.setattr(of_views, "read_base", lambda job: reader)
    monkeypatch.setattr(of_views, "material_truth", lambda *arguments: materials)
    job, view = SimpleNamespace(read=lambda stage: reader), SimpleNamespace(name="0", split="train")
    others = SimpleNamespace(albedo=None, corrected=lambda view, radiance, photo, counted: 0.5 * channels_of("ldr."))
    rows = list(of_views.scores_of_view(job, capture, view, 1.0, object(), others, {"rgb": {}}))
    corrected = [values(scores) for variant, _, quantity, scores in rows if (variant, quantity) == ("corrected", "rgb")]
    result = [values(scores) for variant, _, quantity, scores in rows if (variant, quantity) == ("result", "rgb")]
    assert len(corrected) == 1 and corrected[0].keys() == result[0].keys() and corrected != result[:1]
    found = [values(scores) for _, _, quantity, scores in rows if quantity == "rgb" and scores[0].metric == "log_l2"]
    expected = values(m.score_map("emission", radiance, radiance if is_hdr else truth.radiance, mask, metrics=("log_l2",)))
    assert found == [pytest.approx({key: value for key, value in expected.items() if key[1] == "log_l2"})]
    assert (found[0]["raw", "log_l2"] == pytest.approx(0)) == is_hdr
