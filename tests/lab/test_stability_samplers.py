"""What is drawn has the density that is reported, by the tests of the study with fewer draws; they find what is wrong."""

import numpy as np
import pytest

from lab.stability import caches, rows, samplers
from lab.stability.samplers import chi_squared


def test_draws_follow_their_densities(llvm):
    found = list(samplers.measure(1 << 17))
    assert len({one.sampler for one in found}) == 8
    assert min(one.probability for one in found) > samplers.threshold(len(found))
    assert all(row["in_order"] for row in rows.of_samplers(found))


def test_another_density_is_found():
    rng = np.random.default_rng(0)
    shares = rng.dirichlet(np.ones(100))
    counts = rng.multinomial(200_000, shares)
    cells, statistic, probability = chi_squared(counts, shares)
    assert cells <= 100 and statistic == pytest.approx(1, abs=0.6) and probability > 1e-3
    tilted = shares * np.linspace(0.9, 1.1, 100)
    assert chi_squared(counts, tilted / tilted.sum())[2] < 1e-6
    # A draw where there is no density is wrong, however rare; cells that expect few draws are pooled and count.
    shares[7], counts[7] = 0, 1
    assert chi_squared(counts, shares / shares.sum())[2] == 0
    rare = np.r_[0.5, 0.5 - 1e-4, np.full(100, 1e-6)]
    seen = np.r_[5000, 4900, np.r_[100, np.zeros(99)]].astype(int)
    assert chi_squared(seen, rare)[2] < 1e-6


def test_a_bias_of_a_cache_is_found():
    rng = np.random.default_rng(1)

    def runs(mean, count=8):
        return mean * np.exp(0.1 * rng.standard_normal((count, 4000)))

    fair = caches.compare("r", "c", "p", runs(1.0), runs(1.0), True)
    assert fair.sigmas < caches.LIMIT and fair.spread == pytest.approx(0.1, rel=0.2)
    wrong = caches.compare("r", "c", "p", runs(1.02), runs(1.0), True)
    assert wrong.bias == pytest.approx(0.02, abs=3e-3) and wrong.sigmas > caches.LIMIT
    judged = [row for row in rows.of_caches([fair, wrong]) if row["quantity"] == "bias / standard error"]
    assert [row["in_order"] for row in judged] == [True, False]
