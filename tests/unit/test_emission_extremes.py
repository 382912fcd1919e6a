"""Emission at the extremes: every answer is finite, bounded and says what it is."""

import numpy as np
import pytest

from iif_core.light.emission.candidates import emitter_candidates, face_statistics, radiance_threshold
from iif_core.light.emission.direct import EmissionPrior, solve_emission, solve_families
from iif_core.light.emission.groups import group_emitters
from iif_core.light.emission.pixels import EmissionPixels
from iif_core.light.emission.problem import assemble, initial_radiance, white_surface
from iif_core.light.emission.pruning import _reason, prune_groups
from iif_core.surface.segments import face_adjacency
from tests.unit.emission_systems import rows_of, transport_of


def _rows(a, target, bound=None):
    return rows_of(a, observed=target, bound=bound)


def _matrix(n=300, groups=3, seed=0):
    return np.random.default_rng(seed).random((n, groups, 3))


def _solutions(rows, initial):
    yield solve_emission(rows, initial)
    yield solve_families(rows, EmissionPrior.independent(initial), np.zeros(len(initial), int))


CASES = {
    "black": (_matrix(), np.zeros((300, 3)), None),
    "all saturated": (_matrix(), np.full((300, 3), 0.5), np.ones((300, 3), bool)),
    "a million": (_matrix() * [[[1e-6], [1], [1]]], _matrix().sum(1) + 1.0, None),
    "tiny": (_matrix() * 1e-12, np.full((300, 3), 1e-12), None),
    "one row": (_matrix(1), np.ones((1, 3)), None),
    "twins": (np.repeat(_matrix(300, 1), 3, 1), np.ones((300, 3)), None),
    "no light reaches anything": (np.zeros((300, 3, 3)), np.ones((300, 3)), None),
}


@pytest.mark.parametrize("case", CASES)
def test_every_solver_stays_finite(case):
    a, target, bound = CASES[case]
    rows = _rows(a, target, bound)
    for found in _solutions(rows, np.ones((3, 3))):
        assert np.isfinite(found.radiance).all() and (found.radiance >= 0).all() and np.isfinite(found.error).all()
        assert np.isfinite(found.residual)


def _strip(n):
    x = np.arange(n + 1)
    quads = [(i, i + 1, i + n + 2, i, i + n + 2, i + n + 1) for i in range(n)]
    return np.array(quads).reshape(-1, 3), np.concatenate([np.stack([x, np.full(n + 1, y), 0 * x], 1) for y in (0.0, 1.0)])


@pytest.mark.parametrize("everything", [True, False])
def test_a_saturated_or_black_view(everything):
    """All pixels of one view (or of all views) are saturated, another view is black."""
    faces, _ = _strip(4)
    face = np.tile(np.repeat(np.arange(8), 10), 3)
    view = np.repeat(np.arange(3), 80)
    value = np.where((view == 0) | everything, 1.0, np.where(view == 1, 0.0, 0.3))[:, None] * np.ones(3)
    bound = ((view == 0) | everything)[:, None] & np.ones(3, bool)
    stats = face_statistics(face, value, np.ones(240, bool), 8, bound)
    threshold = radiance_threshold(stats)
    found = emitter_candidates(stats, face_adjacency(faces), np.ones(8), threshold)
    assert found.all() == everything and found.any() == everything
    assert np.isfinite(stats.low).all() and np.isfinite(stats.mean).all()
    groups = group_emitters(found, stats, face_adjacency(faces), np.tile([0.0, 0, 1], (8, 1)), np.ones(8))
    assert groups.size == int(everything)


def test_coincident_and_flipped_faces():
    """A lamp modelled twice, once with flipped faces: two groups of opposite side share light that cannot be separated."""
    faces, _ = _strip(2)
    both = np.concatenate([faces, faces[:, ::-1] + 6])
    stats = face_statistics(
        np.repeat(np.arange(8), 10), np.ones((80, 3)) * 9.0, np.repeat([True, False], 40), 8, np.zeros((80, 3), bool)
    )
    normals = np.repeat([[0.0, 0, 1], [0, 0, -1]], 4, 0)
    groups = group_emitters(np.ones(8, bool), stats, face_adjacency(both), normals, np.ones(8))
    assert groups.size == 2 and set(groups.side) == {1, -1}
    a = np.repeat(_matrix(300, 1), 2, 1)
    found = solve_families(_rows(a, 6.0 * a[:, 0]), EmissionPrior.independent(np.full((2, 3), 9.0)), np.array([0, 1]))
    np.testing.assert_allclose(found.radiance.sum(0), 6.0, rtol=0.02)
    assert (found.determined < 0.9).all()


@pytest.mark.parametrize("objects", [1, 5000])
def test_one_object_and_five_thousand(objects):
    rng = np.random.default_rng(7)
    n, truth = 10_000, np.array([3.0, 8.0])[:, None] * np.ones(3)
    a = rng.random((n, 2, 3))
    gain = np.exp(0.2 * rng.standard_normal(objects))
    owner = np.arange(n) % objects
    y = gain[owner][:, None] * np.einsum("ngc,gc->nc", a, truth)
    group = np.where(np.arange(n) < 200, np.arange(n) % 2, -1)
    y[:200] = truth[group[:200]]
    pixels = EmissionPixels(
        radiance=y, bound=np.zeros((n, 3), bool), object_id=owner, view=np.zeros(n, int), tile=np.arange(n) // 5, group=group
    )
    initial = initial_radiance(pixels, np.ones((2, 3)), True)
    problem, _ = assemble(pixels, transport_of(a), 2).solve_object_gains(EmissionPrior.independent(initial))
    np.testing.assert_allclose(solve_emission(problem.rows, initial).radiance, truth, rtol=0.02)


def test_emitter_that_is_never_seen_is_left_to_its_light():
    """It has no pixels, so there is no white surface to compare with, and no reason to drop it while it has power."""
    a, truth = _matrix(1000, 2), np.array([5.0, 4.0])[:, None] * np.ones(3)
    y = np.einsum("ngc,gc->nc", a, truth)
    group = np.where(np.arange(1000) < 50, 0, -1)
    y[:50] = truth[0]
    pixels = EmissionPixels(
        radiance=y,
        bound=np.zeros((1000, 3), bool),
        object_id=np.zeros(1000, int),
        view=np.zeros(1000, int),
        tile=np.arange(1000) // 4,
        group=group,
    )
    white = transport_of(np.zeros((50, 2, 3), np.float32), 0.1)
    seen = initial_radiance(pixels, np.full((2, 3), 2.0), True)
    trial = assemble(pixels, transport_of(a.astype(np.float32)), 2, white)
    evidence = white_surface(pixels, seen, white)
    out = prune_groups(trial.rows, EmissionPrior.independent(seen), np.arange(2), evidence, ~trial.anchor, np.zeros(2, bool))
    assert out.kept.all() and np.isinf(out.excess[1])
    np.testing.assert_allclose(out.radiance, truth, rtol=0.05)


@pytest.mark.parametrize("excess, said", [(2.0, "2.0 times"), (0.99, "101%"), (0.5, "200%"), (1e-12, "ten"), (0.0, "ten")])
def test_reasons_are_numbers_that_people_read(excess, said):
    reason = _reason(False, True, excess, 0.01)
    assert said in reason and "0000" not in reason
