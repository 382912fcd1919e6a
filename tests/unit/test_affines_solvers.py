"""The solvers on one problem, judged by one loss; patches; the settings of the scale."""

from dataclasses import replace

import numpy as np
import pytest

from iif_core.camera.response import response
from iif_core.fitting.clusters import patches
from iif_core.fitting.direct import fit_affines
from iif_core.fitting.problem import FitOptions
from iif_core.reflectance.material import IDENTITY
from tests.errors import misset
from tests.unit.planted_fit import problem_of
from workflow.settings.affines import Affines


def test_patches_are_neighbours():
    """Equal runs along a curve: a patch spans much less than its object; every object has some."""
    rng = np.random.default_rng(2)
    object_id = rng.integers(0, 3, 6000)
    position = np.c_[rng.uniform(0, 4, (6000, 2)), np.zeros(6000)]
    number = patches(object_id, position)
    for o in range(3):
        own = object_id == o
        sizes = np.bincount(number[own])
        assert 12 <= len(sizes) <= 200 and sizes.min() > 0 and np.ptp(sizes) <= 1
        spans = [np.ptp(position[own & (number == k)], axis=0)[:2].max() for k in range(len(sizes))]
        assert np.median(spans) < 1.2  # of 4
    assert patches(np.zeros(0, int), np.zeros((0, 3))).shape == (0,)
    assert len(np.unique(patches(np.zeros(5, int), np.zeros((5, 3))))) == 5


def test_covariance_sees_errors_that_neighbours_share():
    """One error for every 20 pixels: the claimed deviation grows as the true one does."""
    rng = np.random.default_rng(3)
    problem, _ = problem_of(rng, 1, 2000, truth=IDENTITY[None])
    opt = FitOptions(select=False, population=False, ridge=1e-9, robust_width=1e3, metallic_prior=2)
    gains, claimed = [], []

    for _ in range(30):
        shared = np.repeat(rng.normal(0, 0.05, (100, 3)), 20, 0)
        noisy = replace(problem, value=problem.value * np.exp(shared), cluster=np.repeat(np.arange(100), 20))
        fit = fit_affines(noisy, response("identity"), opt)
        gains.append(fit.affine[0, 0])
        claimed.append(np.sqrt(fit.covariance[0, 0, 0]))
    assert 0.7 < np.mean(claimed) / np.std(gains) < 1.5


@pytest.mark.parametrize(
    ("given", "key", "names"),
    [
        ({"white_patch": {"albedo": 0.9}}, "scale.white_patch", ("object", "view", "box")),
        (
            {"white_patch": {"object": "a", "view": "v", "box": [0, 0, 2, 2], "albedo": 0.9}},
            "scale.white_patch",
            ("object", "view"),
        ),
        ({"white_patch": {"view": "v", "albedo": 0.9}}, "scale.white_patch", ("object", "view", "box")),
        ({"lamp": {"emitter_id": 0, "radiance": [0, 0, 0]}}, "scale.lamp.radiance", ("[0.0, 0.0, 0.0]",)),
        ({}, "scale", ("white_patch, lamp, mean_albedo", "none")),
        ({"mean_albedo": 0.4, "lamp": {"emitter_id": 0, "radiance": [1, 1, 1]}}, "scale", ("white_patch", "lamp, mean_albedo")),
    ],
)
def test_known_scale_is_checked(given, key, names):
    with misset(key, "value_error", *names):
        Affines(scale=given)
    assert Affines(scale={"mean_albedo": 0.4}).scale.mean_albedo == 0.4
    assert Affines().scale == "found"
