"""Errors that are not tied to objects: Gaussian fields in space, and errors of the learned prior as they were measured."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lab.prior import residuals
from lab.prior.residuals import EDGES, Sampled, correlations, fit
from lab.settings.prior import MEASURED_SAMPLES, SimulatedPrior
from lab.simulated import prior as simulated
from lab.simulated.errors import RGBX, SimulatedErrors, simulate_predictions
from lab.simulated.fields import Field
from lab.simulated.measured import BANK, CHANNELS, SCORES, ErrorBank, bank, coded, decoded, draw_predictions
from tests.errors import refused
from tests.unit.test_priors import HEIGHT, WIDTH, Capture, view

NONE = SimulatedErrors(
    **dict.fromkeys(RGBX.__dict__, 0.0) | {"roughness_target": (0, 1), "metallic_target": (0, 1), "good_residue": 0.1}
)


def spread(n: int, seed: int = 0) -> np.ndarray:
    """Points (1, n, 3) metres apart from one another."""
    return 1000 * np.random.default_rng(seed).random((1, n, 3))


def of_fields(points, errors, samples=2, view=0, seed=0, length=0.5):
    """Predictions (K, n, 5) of plain grey surface."""
    plain = np.full((*points.shape[:2], 3), 0.2), *np.full((2, *points.shape[:2]), 0.5)
    return simulate_predictions(*plain, None, samples, view, seed, errors=errors, points=points, length=length)[:, 0]


# ------------------------------------------------------------------------------------------------------------ fields


@pytest.mark.parametrize("length", [0.1, 2.0])
def test_a_field_has_mean_0_variance_1_and_its_correlation(length):
    steps = length * np.array([0, 0.5, 1, 2, 4])
    points = np.zeros((5, 3))
    points[:, 1] = steps + 7
    values = np.concatenate([Field(points, length, seed)(np.arange(200)) for seed in range(40)], 1)  # 8000 fields
    assert np.abs(values.mean(1)).max() < 0.05
    found = values @ values.T / values.shape[1]
    np.testing.assert_allclose(np.diag(found), 1, atol=0.06)
    np.testing.assert_allclose(found[0], np.exp(-0.5 * (steps / length) ** 2), atol=0.06)


def test_a_field_of_infinite_length_is_one_value_and_no_place_is_no_nan():
    points = np.array([[0, 0, 0], [9, 9, 9], [np.nan, 0, 0]])
    values = Field(points, np.inf, 1)(np.arange(3))
    np.testing.assert_array_equal(values, values[:1].repeat(3, 0))
    assert np.isfinite(Field(points, 0.3, 1)(2, np.arange(3))).all()


def test_fields_have_the_stated_sizes_and_are_shared_as_stated():
    """Log gains at unrelated places: the part of all views, that of a view, and that of a sample."""
    errors = replace(NONE, gain_object=0.06, gain_view=0.1, gain_sample=0.12)
    points = spread(400)
    covariance = 0.0
    for seed in range(20):  # fields of one length share their waves, which correlates them by a few per cent
        views = [np.log(of_fields(points, errors, view=v, seed=seed)[..., 0] / 0.2) for v in (3, 8)]
        values = np.concatenate(views)
        covariance = covariance + values @ values.T / values.size * len(values) / 20
    own, of_view, of_all = 0.06**2 + 0.1**2 + 0.12**2, 0.06**2 + 0.1**2, 0.06**2
    np.testing.assert_allclose(np.diag(covariance), own, rtol=0.06)
    assert covariance[0, 1] == pytest.approx(of_view, rel=0.1)
    np.testing.assert_allclose(covariance[:2, 2:], of_all, atol=0.001)


def test_hues_roughness_and_metallic_are_fields_too():
    points = np.concatenate([spread(2000), spread(2000) + 0.01], 1)  # pairs one centimetre apart
    errors = replace(NONE, tint_object=0.1, material_view=0.05)
    made = of_fields(points, errors)[0].astype(np.float64)
    values = np.c_[np.log(made[:, 0] / made[:, 1]), made[:, 3:] - 0.5]
    np.testing.assert_allclose(values.std(0), [0.1 * 2**0.5, 0.05, 0.05], rtol=0.1)
    near, far = values[:2000], values[2000:]
    for a, b in zip(near.T, far.T, strict=True):
        assert np.corrcoef(a, b)[0, 1] > 0.98
    assert np.abs(np.corrcoef(values.T) - np.eye(3)).max() < 0.1  # of one another they are independent


@pytest.mark.parametrize("share", [0.0, 0.1, 0.4])
def test_the_share_of_good_samples_is_that_of_the_setting(share):
    """Patterns alone: where a sample is good they are a tenth as strong."""
    points = spread(3000)
    points[0, :, :] = np.sort(points[0], 0)
    strong, weak = (
        np.log(of_fields(points, replace(NONE, pattern=0.4, good_share=g), samples=4)[..., 1] / 0.2) for g in (0.0, 1.0)
    )
    found = np.log(of_fields(points, replace(NONE, pattern=0.4, good_share=share), samples=4)[..., 1] / 0.2)
    good = np.isclose(found, weak, atol=1e-5) & ~np.isclose(strong, weak, atol=1e-4)
    np.testing.assert_allclose(weak, 0.1 * strong, atol=2e-5)
    assert good.mean() == pytest.approx(share, abs=0.03)


def test_the_field_at_a_place_does_not_depend_on_what_else_is_in_view_nor_on_earlier_views():
    errors = replace(NONE, gain_object=0.1, gain_sample=0.1, offset_sample=0.02, material_view=0.1)
    points = spread(300)
    whole = of_fields(points, errors, view=2, seed=5)
    of_fields(points, errors, view=9, seed=5)
    part = of_fields(points[:, 40:90], errors, view=2, seed=5)
    np.testing.assert_allclose(part, whole[:, 40:90], atol=1e-6)
    assert whole.tobytes() == of_fields(points, errors, view=2, seed=5).tobytes()
    for other in (of_fields(points, errors, view=3, seed=5), of_fields(points, errors, view=2, seed=6)):
        assert np.abs(other - whole).mean() > 0.01


def test_errors_tied_to_objects_are_those_of_before_they_could_be_others():
    """Numbers that the code before this file made."""
    from tests.lab.test_simulate import room

    albedo, roughness, metallic, ids, shading = room(40, 60)
    made = simulate_predictions(albedo, roughness, metallic, ids, 5, 0, 0, 1.0, shading)[2, 20, 31]
    np.testing.assert_allclose(made, [0.53605920, 0.49452144, 0.61380076, 0.20929742, 0.57971704], atol=1e-6)
    own = RGBX.with_shared(0.0)
    made = simulate_predictions(albedo, roughness, metallic, ids, 5, 1, 2, 2.0, shading, own)
    np.testing.assert_allclose(made[0, 3, 4], [0.18650749, 0.17144932, 0.09724295, 0.42745620, 0.47965142], atol=1e-6)
    np.testing.assert_allclose(made[4, 30, 50], [0.87301296, 0.81826830, 0.51357782, 0.37366217, 0.65504706], atol=1e-6)


# ---------------------------------------------------------------------------------------------------------- measured


def test_coding_is_undone():
    materials = np.random.default_rng(0).uniform(0.02, 1, (50, 5)).astype(np.float32)
    np.testing.assert_allclose(decoded(coded(materials)), materials, atol=1e-6)
    assert coded(np.array([[0.2, 0.1, 0.1, 0, 0]]))[0, 1] == pytest.approx(np.log(2))


def room_of(seed: int, views: int = 4, pixels: int = 300) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) on a wall and a floor that all views show at the same places but for a centimetre, and the views (n,)."""
    rng = np.random.default_rng([seed, 77])
    flat = rng.uniform(0, 4, (pixels, 2))
    wall = rng.random(pixels) < 0.5
    place = np.where(wall[:, None], np.c_[flat, np.zeros(pixels)], np.c_[flat[:, 0], np.zeros(pixels), flat[:, 1]])
    return np.concatenate([place + 0.005 * rng.normal(size=place.shape) for _ in range(views)]), np.repeat(
        np.arange(views), pixels
    )


def drawn_rooms(errors: ErrorBank, count: int) -> list[Sampled]:
    """Errors that are drawn for made-up rooms, whose wall and floor each have one of the true values of the bank."""
    out = []
    for seed in range(count):
        points, of_view = room_of(seed)
        rng = np.random.default_rng(seed)
        of_side = np.stack([rng.choice(np.unique(own), 2) for own in errors.truth], 1)
        truth = of_side[(points[:, 2] > points[:, 1]).astype(int)]
        scores = np.concatenate([errors.scores(points[of_view == v], v, seed) for v in range(of_view.max() + 1)])
        out.append(Sampled(of_view, points, truth, errors.errors(truth, scores)))
    return out


def test_drawn_errors_have_the_means_and_deviations_of_the_bank():
    """At unrelated places of many scenes, within five standard errors."""
    errors = bank()
    mean, deviation = errors.moments()
    scores = np.concatenate([errors.scores(spread(8, seed)[0], 1, seed) for seed in range(150)])
    n, alike = len(scores), 3  # the length of infinity makes the points of a scene alike
    assert np.abs(scores.mean(0)).max() < 5 * np.sqrt(alike / n)
    np.testing.assert_allclose(scores.std(0), 1, atol=5 * np.sqrt(alike / (2 * n)))
    for b in range(mean.shape[1]):
        found = errors.errors(np.repeat(errors.truth[None, :, b], n, 0), scores)  # (n, K, C)
        off = np.abs(found.mean(0).T - mean[:, b])
        assert (off < 5 * deviation[:, b] * np.sqrt(alike / n) + 1e-3).all()
        np.testing.assert_allclose(found.std(0).T, deviation[:, b], rtol=0.25, atol=5e-3)


def test_drawn_errors_have_the_correlations_that_were_measured(monkeypatch):
    """Over distance, within a view and between views, of a sample with itself and with others."""
    monkeypatch.setattr(residuals, "PAIRS", 3000)
    errors = bank()
    rooms = drawn_rooms(errors, 24)
    found = correlations(
        (residuals.standardised(errors, r).reshape(len(r.view), -1), r.points, r.view) for r in rooms
    ).of_channels()
    both = np.isfinite(found) & np.isfinite(errors.correlation)
    assert both.any((2, 3)).all()
    difference = np.where(both, found - errors.correlation, 0)
    assert np.abs(difference.mean((0, 1))).max() < 0.3  # of a channel in one class of distance
    assert np.sqrt((difference[both] ** 2).mean()) < 0.1


def test_a_bank_is_recovered_from_what_it_draws(monkeypatch):
    """Planted: two samples that share half of their variance, three quarters of it in fields of 0.4 m that all views share."""
    c = len(CHANNELS)
    half = np.sqrt(0.5)
    loadings = np.concatenate(
        [np.c_[half * np.eye(c), half * np.eye(c), np.zeros((c, c))], np.c_[half * np.eye(c), np.zeros((c, c)), half * np.eye(c)]]
    )
    table = np.tile(0.1 * SCORES, (c, 2, 2, 1)) + np.array([0.0, 0.5])[None, :, None, None]
    shares = np.sqrt([0.75, 0.15, 0.10])
    planted = ErrorBank(
        np.tile([0.0, 1.0], (c, 1)),
        table,
        np.array([0.4]),
        shares[0] * loadings[None],
        shares[1] * loadings[None],
        shares[2] * loadings,
        np.zeros(0),
        {},
    )
    monkeypatch.setattr(residuals, "SWEEPS", 60)
    found = fit(drawn_rooms(planted, 20), {})
    mean, deviation = found.moments()
    true_mean, true_deviation = planted.moments()
    np.testing.assert_allclose(mean[:4, [0, -1]], true_mean[:4], atol=0.04)
    np.testing.assert_allclose(deviation[:4, [0, -1]], true_deviation[:4], rtol=0.2)
    middle = (np.array(EDGES[1:]) + EDGES[:-1]) / 2
    shape = np.exp(-0.5 * (middle / 0.4) ** 2)[:, None]
    planted_correlation = np.array([[0.9, 0.45], [0.75, 0.375]])[..., None, None] * shape  # within and between views
    both = np.isfinite(found.correlation)
    assert both[:, :, 3:].all()
    assert np.abs(found.correlation - planted_correlation)[both].max() < 0.2
    assert np.abs((found.correlation - planted_correlation)[:, :, 3:].mean(3)).max() < 0.1
    total = sum((own @ own.swapaxes(1, 2)).sum(0) for own in (found.shared, found.own)) + found.pixel @ found.pixel.T
    np.testing.assert_allclose(np.diag(total), 1, atol=1e-6)
    shared = (found.shared @ found.shared.swapaxes(1, 2)).sum(0)
    np.testing.assert_allclose(np.diag(shared), 0.75, atol=0.1)


def test_measured_draws_depend_on_seed_view_and_place_alone():
    rng = np.random.default_rng(1)
    truth = rng.uniform(0.1, 0.9, (6, 9, 5))
    points = rng.uniform(0, 4, (6, 9, 3))
    points[0, 0] = np.nan
    first = draw_predictions(truth, points, 8, 4, 11)
    draw_predictions(truth, points, 8, 5, 11)
    again = draw_predictions(truth, points, 8, 4, 11)
    assert first.tobytes() == again.tobytes() and first.dtype == np.float32 and first.shape == (8, 6, 9, 5)
    assert first.min() >= 0 and first.max() <= 1
    np.testing.assert_allclose(draw_predictions(truth, points, 3, 4, 11), first[:3], atol=1e-6)
    for other in (draw_predictions(truth, points, 8, 5, 11), draw_predictions(truth, points, 8, 4, 12)):
        assert np.abs(other - first).mean() > 0.01
    np.testing.assert_allclose(draw_predictions(truth, points, 2, 4, 11, 0.0), np.stack([truth] * 2), atol=1e-7)
    weak = draw_predictions(truth, points, 8, 4, 11, 0.01)
    assert np.abs(weak - truth).max() < 0.05


def test_measured_refuses_what_it_cannot_draw():
    truth, points = np.full((2, 2, 5), 0.5), np.zeros((2, 2, 3))
    with refused(MEASURED_SAMPLES + 1, MEASURED_SAMPLES):
        draw_predictions(truth, points, MEASURED_SAMPLES + 1, 0, 0)
    with refused("(2, 2, 5)"):
        draw_predictions(truth * np.nan, points, 2, 0, 0)
    with refused("nowhere.npz", "lab.prior residuals"):
        bank(BANK.with_name("nowhere.npz"))


def test_the_bank_is_small_and_of_the_weights_that_ship():
    from workflow.models import prior_weights

    assert BANK.stat().st_size < 300_000
    assert bank().samples == MEASURED_SAMPLES
    assert bank().facts["weights"] == prior_weights.recipe()["sha256"]


# ----------------------------------------------------------------------------------------------------------- as a prior


class WithoutObjects(Capture):
    """A capture whose objects may not be read."""

    def given_instances(self, _):
        raise AssertionError("objects were read")

    def faces(self):
        raise AssertionError("objects were read")


@pytest.mark.parametrize("errors", ["fields", "measured"])
def test_the_new_errors_read_no_objects(errors):
    own = SimulatedPrior(kind="simulated", samples=3, errors=errors)
    maps = simulated.predict(view(), SimpleNamespace(prior=own), WithoutObjects(), 0)
    assert maps.shape == (3, HEIGHT, WIDTH, 5) and np.isfinite(maps).all()
    with pytest.raises(AssertionError):
        simulated.predict(view(), SimpleNamespace(prior=SimulatedPrior(kind="simulated")), WithoutObjects(), 0)


def test_the_bank_is_a_raw_input_of_measured_errors_alone():
    document = {"source": {"kind": "builtin"}, "prior": SimulatedPrior(kind="simulated", errors="measured").model_dump()}
    assert simulated.raw_inputs(document) == [BANK]
    document["prior"]["errors"] = "fields"
    assert simulated.raw_inputs(document) == []


@pytest.mark.parametrize("own", [{"good_share": 0.2}, {"shared": 2.0}, {"samples": 17}])
def test_settings_that_measured_errors_do_not_have_are_refused(own):
    with pytest.raises(ValueError, match=next(iter(own))):
        SimulatedPrior(kind="simulated", errors="measured", **own)
    SimulatedPrior(kind="simulated", errors="fields", **own)
