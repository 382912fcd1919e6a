"""Claimed errors of the material fit, and the parts of a step that are not summed anew."""

import numpy as np
import pytest

from iif_core.affines import FitOptions, fit_affines
from iif_core.affines.covariance import _grown
from iif_core.affines.pixels import evaluate, other_tone, prepare, restore, revise
from iif_core.response import response
from tests.benchmarks.affines_coverage import FAMILIES, planted
from tests.unit.planted_fit import problem_of


def _psd(rng, n, size, rank):
    a = rng.normal(size=(n, size, rank))
    return a @ a.transpose(0, 2, 1)


def test_leverage_is_given_back():
    """Scores of covariance H_k - H_k B H_k, which a fit leaves of errors in proportion to H_k, get the covariance H_k back."""
    rng = np.random.default_rng(0)
    whole = _psd(rng, 6, 17, 6)
    h = whole[:, :16, :16]
    inverse = np.linalg.inv(h.sum(0) + 0.1 * np.eye(16))
    for k in range(6):
        left = h[k] - h[k] @ inverse @ h[k]
        values, vectors = np.linalg.eigh(left)
        columns = (vectors * np.sqrt(np.maximum(values, 0))).T  # rows u with sum of u u' = left
        scores = np.c_[columns, np.zeros(16)]
        same = np.repeat(whole[k : k + 1], 16, 0)
        alone, _, lever = _grown(scores, same, inverse[None], np.zeros((1, 16, 1)), np.ones((1, 16), bool), np.zeros(16, int))
        np.testing.assert_allclose(alone.T @ alone, inverse @ h[k] @ inverse, atol=1e-6 * np.abs(inverse).max())
        assert lever[0] == pytest.approx(np.trace(h[k] @ inverse), rel=1e-6)


def test_leverage_of_the_response():
    """The rows of the response against the matrix function of the whole system, (1 - H B)^(-1/2) with no inverse in its place."""
    rng = np.random.default_rng(1)
    whole = _psd(rng, 12, 18, 5)
    inverse = np.linalg.inv(whole[:, :16, :16].sum(0) + 3.0 * np.eye(16))
    wide = np.zeros((18, 18))
    wide[:16, :16] = inverse
    coupling = rng.normal(size=(1, 16, 2))
    scores = rng.normal(size=(12, 18))
    alone, reduced, _ = _grown(scores, whole, inverse[None], coupling, np.ones((1, 16), bool), np.zeros(12, int))
    for k in range(12):
        values, vectors = np.linalg.eig(np.eye(18) - whole[k] @ wide)
        grown = (vectors @ np.diag(values**-0.5) @ np.linalg.inv(vectors) @ scores[k]).real
        np.testing.assert_allclose(alone[k], inverse @ grown[:16], rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(reduced[k], grown[16:] - coupling[0].T @ inverse @ grown[:16], rtol=1e-5, atol=1e-6)


def test_a_prior_that_decides_the_response_gives_it_its_error():
    problem, _ = planted(0, 3)
    mean, deviation = np.array([1.93]), 0.04
    options = FitOptions(response_prior=(mean, np.eye(1) / deviation**2), response_ridge=1e3)
    fit = fit_affines(problem, response("gamma", mean), options)
    assert fit.response.params.ravel() == pytest.approx(mean, abs=1e-3)
    assert np.sqrt(fit.response_covariance[0, 0]) == pytest.approx(deviation, rel=0.01)


def test_the_error_of_the_response_is_in_the_objects():
    problem, _ = planted(0, 3)
    claimed = []
    for deviation in (1e-4, 0.3):
        options = FitOptions(response_prior=(np.array([1.9]), np.eye(1) / deviation**2), response_ridge=1e3 * deviation**2)
        claimed.append(fit_affines(problem, response("gamma", [1.9]), options).covariance[:, 0, 0])
    assert (claimed[1] > 2 * claimed[0]).all()


def test_roughness_follows_the_response_that_its_profile_held():
    """The profile's response is that of a descent with one roughness for all; its error must not stay in everyone's roughness."""
    errors, responses = [], []
    for seed in (300, 301):
        problem, truth = planted(seed, 12, FAMILIES["room"])
        fit = fit_affines(problem, response("gamma"), FitOptions())
        errors.append((fit.affine[:, 12] * 0.5 + fit.affine[:, 13] - truth[:, 13]).mean())
        responses.append(fit.response.params.ravel()[0] - FAMILIES["room"].gamma)
    assert np.abs(errors).max() < 0.025 and np.abs(responses).max() < 0.02  # 0.04, 0.0125 on average without


def test_parts_of_a_step_equal_the_whole():
    problem, truth = problem_of(np.random.default_rng(2), 5, 90, noise=0.1, halves=2, value_of=response("gamma", [1.8]))
    options = FitOptions(threads=2)
    px, tone = prepare(problem, response("gamma"))
    other = tone.at(np.array([1.9]))
    here = truth
    there = here * 1.02
    first, second = evaluate(px, here, tone, options, True), evaluate(px, there, other, options, True)
    np.testing.assert_allclose(other_tone(first, px, other, options), evaluate(px, here, other, options, False).cost, rtol=1e-10)
    some = np.array([0, 1, 3])
    mixed = first.copy()
    revise(mixed, px, there, other, options, some)
    chosen = np.isin(np.arange(5), some)
    for name in ("cost", "data", "size", "h"):
        wanted = np.where(chosen.reshape(-1, *[1] * (getattr(first, name).ndim - 1)), getattr(second, name), getattr(first, name))
        assert getattr(mixed, name).tobytes() == wanted.tobytes(), name
    restore(mixed, first, px, chosen)
    for name in ("cost", "h", "scores", "shown"):
        assert getattr(mixed, name).tobytes() == getattr(first, name).tobytes(), name
