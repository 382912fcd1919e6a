"""Prior `simulated`: the truth of a capture, spoiled; nothing without truth."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from lab.simulated import prior as simulated
from tests.errors import refused
from tests.unit.test_priors import HEIGHT, WIDTH, Capture, view


def test_simulated_spoils_the_truth():
    prior = SimpleNamespace(samples=3, strength=1.0, shared=1.0, errors="objects", good_share=0.4, length=0.5)
    maps = simulated.predict(view(), SimpleNamespace(prior=prior), Capture(), 0)
    assert maps.shape == (3, HEIGHT, WIDTH, 5) and np.isfinite(maps).all()
    prior.strength = 0.0
    exact = simulated.predict(view(), SimpleNamespace(prior=prior), Capture(), 0)
    np.testing.assert_allclose(exact[2, ..., :3], Capture().truth(None).albedo, atol=1e-7)
    with refused("prior: {kind: simulated}", "prior: {kind: files}"):
        simulated.predict(view(), SimpleNamespace(prior=prior), Capture(False), 0)
