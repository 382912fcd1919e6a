"""The reference loss: closed forms, an independent loop over pixels, invariances, and pixels that are left out."""

from dataclasses import replace

import numpy as np
import pytest

from iif_core.fusion.problem import LOWEST, FusionProblem, usable_pixels
from lab.published.fusion.reference_loss import identity_regulariser, reference_loss
from tests.errors import refused
from tests.oracles.label_loss import label_loss

LOW = LOWEST.astype(np.float64)


def random_state(seed=0, views=3, k=5, n=40, cells=20, spread=0.1):
    """A problem with two segments per view, a texture, maps near the identity and soft weights."""
    rng = np.random.default_rng(seed)
    segment = [np.repeat([2 * v, 2 * v + 1], n // 2).astype(np.int32) for v in range(views)]
    problem = FusionProblem(
        predictions=[rng.random((k, n, 5)) for _ in range(views)],
        cell_of_pixel=[rng.integers(0, cells, n).astype(np.int32) for _ in range(views)],
        segment_of_pixel=segment,
        n_cells=cells,
        object_of_cell=np.zeros(cells, np.int32),
        object_of_segment=np.zeros(2 * views, np.int32),
        weight=[rng.uniform(0.1, 1, n) for _ in range(views)],
    )
    s = 2 * views
    albedo = np.eye(3, 4) + spread * rng.standard_normal((s, k, 3, 4))
    roughness, metallic = ([1.0, 0.0] + spread * rng.standard_normal((s, k, 2)) for _ in range(2))
    weight = rng.dirichlet(np.ones(k), (s, 3)).swapaxes(1, 2)
    value, scale = rng.random((cells, 5)), rng.uniform(0.001, 0.4, (cells, 5))
    return problem, value, scale, (albedo, roughness, metallic), weight


def by_pixel(problem, value, scale, corrections, weight, temperature=None):
    """Data, label and regulariser of each property, pixel by pixel from Eqs. F.1 to F.15."""
    albedo, roughness, metallic = corrections
    data = label = total = 0.0
    penalty = np.zeros(3)
    for view, maps in enumerate(problem.predictions):
        for n in range(maps.shape[1]):
            s, x = problem.segment_of_pixel[view][n], problem.cell_of_pixel[view][n]
            if s < 0 or x < 0 or problem.weight[view][n] == 0:
                continue
            v = np.stack(
                [
                    np.r_[albedo[s, k] @ np.r_[m[n, :3], 1], roughness[s, k] @ [m[n, 3], 1], metallic[s, k] @ [m[n, 4], 1]]
                    for k, m in enumerate(maps)
                ]
            )
            v = np.clip(v, LOW, 1)
            mu_ref = (weight[s][:, [0, 0, 0, 1, 2]] * v).sum(0)
            b_r = np.maximum(np.sort(np.abs(mu_ref - v), 0)[(len(v) - 1) // 2], 0.01)
            b_p, d = np.maximum(scale[x], 0.01), np.abs(mu_ref - value[x])
            data += np.mean(np.log(b_p / b_r) + d / b_p + b_r / b_p * np.exp(-d / b_r) - 1)
            for k in range(len(v)):
                a, b = albedo[s, k, :, :3], albedo[s, k, :, 3]
                r_a = np.sum((a - np.eye(3)) ** 2) + np.sum(b**2) + np.sum((a @ a.T - np.eye(3)) ** 2)
                rest = [(t[0] - 1) ** 2 + t[1] ** 2 for t in (roughness[s, k], metallic[s, k])]
                penalty += np.array([r_a, *rest]) / len(v)
            if temperature:
                off = np.abs(v - value[x])
                e = np.stack([off[:, :3].mean(1), off[:, 3], off[:, 4]], 1)
                q = np.exp(-e / temperature) / np.exp(-e / temperature).sum(0)
                label -= (q * np.log(weight[s])).sum() / 3
            total += 1
    return data / total, label / total, penalty / total


@pytest.mark.parametrize("k", [1, 2, 5])
def test_equals_the_definition_pixel_by_pixel(k):
    problem, value, scale, corrections, weight = state = random_state(k=k)
    expected, label, penalty = by_pixel(*state, 0.2)
    found = reference_loss(*state)
    assert found.data == pytest.approx(expected, rel=1e-12)
    assert label_loss(problem, value, corrections, np.log(weight), 0.2) == pytest.approx(label, rel=1e-12)
    assert [found.regulariser_albedo, found.regulariser_roughness, found.regulariser_metallic] == pytest.approx(
        penalty, rel=1e-12
    )
    assert found.total == pytest.approx(expected + 100 * penalty.sum(), rel=1e-12)


def test_a_planted_optimum_has_loss_zero():
    """All predictions equal to the texture, scales at the floor: KL = 0, T = identity."""
    problem, value, _, _, weight = random_state()
    value = np.clip(value, 0.02, 1)
    problem = replace(problem, predictions=[np.repeat(value[c][None], 5, 0) for c in problem.cell_of_pixel])
    identity = (np.tile(np.eye(3, 4), (6, 5, 1, 1)), np.tile([1.0, 0.0], (6, 5, 1)), np.tile([1.0, 0.0], (6, 5, 1)))
    found = reference_loss(problem, value, np.full((20, 5), 0.001), identity, weight)
    assert found.total == pytest.approx(0, abs=1e-14)


def test_known_divergence():
    """KL(d = 0.3, b_r = 0.1, b_p = 0.2) = 1.2180407 (Eq. F.7): three predictions 0.1 about 0.5, texture 0.8."""
    predictions = [np.repeat(np.array([0.4, 0.5, 0.6])[:, None, None], 5, 2)]
    zero = np.zeros(1, np.int32)
    problem = FusionProblem(
        predictions=predictions,
        cell_of_pixel=[zero],
        segment_of_pixel=[zero],
        n_cells=1,
        object_of_cell=zero,
        object_of_segment=zero,
    )
    identity = (np.eye(3, 4)[None, None].repeat(3, 1), np.tile([1.0, 0.0], (1, 3, 1)), np.tile([1.0, 0.0], (1, 3, 1)))
    # weights so that mu_ref = 0.5 and the distances are 0.1, 0, 0.1: the lower median is 0.1
    found = reference_loss(problem, np.full((1, 5), 0.8), np.full((1, 5), 0.2), identity, np.full((1, 3, 3), 1 / 3))
    assert found.data == pytest.approx(1.2180407, abs=1e-7)


def test_order_of_predictions_does_not_matter():
    problem, value, scale, corrections, weight = random_state()
    order = np.random.default_rng(3).permutation(5)
    permuted = replace(problem, predictions=[p[order] for p in problem.predictions])
    a = reference_loss(problem, value, scale, corrections, weight)
    b = reference_loss(permuted, value, scale, tuple(c[:, order] for c in corrections), weight[:, order])
    assert b.total == pytest.approx(a.total, rel=1e-13)


def test_predictions_may_be_a_callable():
    problem, value, scale, corrections, weight = random_state()
    a = reference_loss(problem, value, scale, corrections, weight)
    shared = replace(problem, predictions=lambda view: problem.predictions[view].astype(np.float32))
    assert reference_loss(shared, value, scale, corrections, weight).total == pytest.approx(a.total, rel=1e-6)


def test_pieces_of_a_view_sum_to_the_whole(monkeypatch):
    from lab.published.fusion import reference_loss as module

    state = random_state()
    a = reference_loss(*state)
    monkeypatch.setattr(module, "_ENTRIES", 35)  # 7 pixels at a time
    assert reference_loss(*state).total == pytest.approx(a.total, rel=1e-13)


def test_one_hot_weights_have_infinite_label_loss_unless_the_votes_agree():
    problem, value, scale, corrections, _ = random_state()
    weight = np.zeros((6, 5, 3))
    weight[:, 2] = 1
    with np.errstate(divide="ignore"):
        log_weight = np.log(weight)
    assert np.isfinite(reference_loss(problem, value, scale, corrections, weight).data)
    assert label_loss(problem, value, corrections, log_weight, 1.0) == np.inf
    agree = [np.repeat(p[:1], 5, 0) for p in problem.predictions]
    for p in agree:
        p[[0, 1, 3, 4]] = 0
    problem = replace(problem, predictions=agree)
    texture = np.ones((20, 5))
    identity = (np.tile(np.eye(3, 4), (6, 5, 1, 1)), np.tile([1.0, 0.0], (6, 5, 1)), np.tile([1.0, 0.0], (6, 5, 1)))
    # q is 0 exactly where alpha is (docs/method/numerics.md#cold-temperatures)
    assert label_loss(problem, texture, identity, log_weight, 1e-9) == 0


def test_regulariser_near_identity():
    rng = np.random.default_rng(0)
    delta, b = 1e-5 * rng.standard_normal((3, 3)), 1e-5 * rng.standard_normal(3)
    albedo = np.c_[np.eye(3) + delta, b][None, None]
    other = np.array([[[1.0, 0.0]]])
    found = identity_regulariser((albedo, other, other))[0, 0]
    symmetric, skew = (delta + delta.T) / 2, (delta - delta.T) / 2
    assert found[0] == pytest.approx(5 * (symmetric**2).sum() + (skew**2).sum() + (b**2).sum(), rel=1e-4)
    assert found[1] == found[2] == 0
    scaled = np.c_[1.3 * np.eye(3), np.zeros(3)][None, None]
    expected = 3 * 0.3**2 + 3 * (1.3**2 - 1) ** 2
    assert identity_regulariser((scaled, other, other))[0, 0, 0] == pytest.approx(expected, rel=1e-12)


def test_pixels_that_do_not_count_are_left_out():
    problem, value, scale, corrections, weight = random_state()
    problem.cell_of_pixel[0][3], problem.segment_of_pixel[1][5], problem.weight[2][7] = -1, -1, 0
    found = reference_loss(problem, value, scale, corrections, weight)
    assert found.data == pytest.approx(by_pixel(problem, value, scale, corrections, weight)[0], rel=1e-12)


def test_predictions_that_are_not_finite_are_left_out():
    problem, value, scale, corrections, weight = random_state()
    problem.predictions[0][2] = np.nan
    problem.predictions[1][4, 9, 1] = np.inf  # 1 of 40 pixels: the prediction is dropped
    found = usable_pixels(problem, 0)
    assert found.usable.tolist() == [True, True, False, True, True] and len(found.pixel) == 40
    assert [(d.view, d.k) for d in found.dropped] == [(0, 2)]
    weight[:2, 2] = 0
    weight[2:4, 4] = 0
    full = reference_loss(problem, value, scale, corrections, weight)
    assert np.isfinite(full.total)
    keep = [[0, 1, 3, 4], [0, 1, 2, 3]]
    parts = [  # each view by itself, without the bad prediction
        by_pixel(
            replace(
                problem,
                predictions=[problem.predictions[v][keep[v]]],
                cell_of_pixel=[problem.cell_of_pixel[v]],
                segment_of_pixel=[problem.segment_of_pixel[v]],
                weight=[problem.weight[v]],
            ),
            value,
            scale,
            tuple(c[:, keep[v]] for c in corrections),
            weight[:, keep[v]],
        )[0]
        for v in (0, 1)
    ]
    only = replace(
        problem,
        predictions=problem.predictions[:2],
        cell_of_pixel=problem.cell_of_pixel[:2],
        segment_of_pixel=problem.segment_of_pixel[:2],
        weight=problem.weight[:2],
    )
    assert reference_loss(only, value, scale, corrections, weight).data == pytest.approx(np.mean(parts), rel=1e-12)


def test_nothing_usable_is_an_error():
    problem, value, scale, corrections, weight = random_state()
    with refused("reference loss", "cell", "segment", "weight"):
        reference_loss(replace(problem, weight=[0 * w for w in problem.weight]), value, scale, corrections, weight)
