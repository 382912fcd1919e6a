"""Losses of the laboratory against loops over pixels and objects in float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from iif_core.priors.features import CHANNELS
from lab.prior import losses, network
from tests.errors import refused
from workflow.priors.network import PriorNetwork

HEADS = 3


@pytest.fixture
def batch() -> losses.Batch:
    """Two crops of 6 x 5 pixels with three objects each; a few pixels do not count."""
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(2, 5, 6, 5, generator=generator, dtype=torch.float64)
    truth[:, 4] = (truth[:, 4] > 0.7).double()
    group = torch.randint(3, (2, 6, 5), generator=generator) + 3 * torch.arange(2)[:, None, None]
    counts = (torch.rand(2, 1, 6, 5, generator=generator) > 0.2).double()
    border = (torch.rand(2, 1, 6, 5, generator=generator) > 0.7).double()
    return losses.Batch(torch.zeros(2, 4, 6, 5), truth, counts, group, border, 8)


@pytest.fixture
def predicted() -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    out = torch.rand(2, HEADS, 9, 6, 5, generator=generator, dtype=torch.float64)
    out[:, :, :3] = torch.log(out[:, :, :3].clamp(min=0.05))
    return out


def test_a_perfect_prediction_loses_nothing_but_its_scales(batch):
    perfect = torch.zeros(2, HEADS, 8, 6, 5, dtype=torch.float64)
    perfect[:, :, :3] = torch.log(batch.truth[:, None, :3].clamp(min=losses.DARKEST))
    perfect[:, :, 3:5] = batch.truth[:, None, 3:5]
    batch.truth[:, :3].clamp_(min=losses.DARKEST)
    total, numbers = losses.loss_of(perfect, batch, 0.02)
    named = dict(zip(losses.LOGGED, numbers.tolist(), strict=True))
    assert float(total) - losses.SCALE * named["scales"] == pytest.approx(0, abs=1e-3)
    assert named["log_albedo_best"] == pytest.approx(0, abs=1e-6)
    assert named["gradient"] == pytest.approx(0, abs=1e-6)


def test_the_loss_is_what_loops_compute(batch, predicted):
    heat = 0.1
    errors = losses._errors(predicted, batch)
    _, m, h, w = 2, HEADS, 6, 5
    truth, counts, p = batch.truth.numpy(), batch.counts.numpy()[:, 0] > 0, predicted.numpy()
    pixel = np.zeros((2, m, h, w))
    for b in range(2):
        for k in range(m):
            d = p[b, k, :3] - np.log(np.maximum(truth[b, :3], losses.DARKEST))
            shift = d[:, counts[b]].mean(1)
            group = batch.group.numpy()[b]
            for y in range(h):
                for x in range(w):
                    log = np.minimum(np.abs(d[:, y, x]), 2.5).mean()
                    linear = np.abs(np.exp(p[b, k, :3, y, x]) - truth[b, :3, y, x]).mean()
                    of_view = np.minimum(np.abs(d[:, y, x] - shift), 2.5).mean()
                    same = counts[b] & (group == group[y, x])
                    level = d[:, same].mean() if same.any() else 0.0
                    of_object = np.minimum(np.abs(d[:, y, x] - level), 2.5).mean()
                    q, t = np.clip(p[b, k, 4, y, x], 1e-4, 1 - 1e-4), truth[b, 4, y, x]
                    entropy = -(t * np.log(q) + (1 - t) * np.log(1 - q))
                    rough = abs(p[b, k, 3, y, x] - truth[b, 3, y, x])
                    pixel[b, k, y, x] = 0.5 * log + 2 * linear + 0.2 * of_view + 0.4 * of_object + 1.2 * rough + 0.5 * entropy
    ours = sum(weight * term for weight, term in errors.weighted).numpy()
    assert np.allclose(ours, pixel)
    total = 0.0
    for g in range(6):
        own = (batch.group.numpy() == g) & counts
        if own.any():
            of_head = np.array([pixel[:, k][own] for k in range(m)])
            share = np.exp(-of_head.mean(1) / heat)
            share = 0.96 * share / share.sum() + 0.04 / m
            total += (share[:, None] * of_head).sum()
    mean, _ = losses.by_object(torch.as_tensor(pixel) * batch.counts, batch)
    weight = losses.at_pixels(0.96 * torch.softmax(-mean / heat, 1) + 0.04 / m, batch)
    assert float((weight * torch.as_tensor(pixel) * batch.counts).sum()) == pytest.approx(total)


def test_one_right_head_is_enough_at_the_end_and_not_at_the_start(batch):
    heads = torch.zeros(2, HEADS, 8, 6, 5, dtype=torch.float64)
    heads[:, :, :3] = torch.log(batch.truth[:, None, :3].clamp(min=losses.DARKEST))
    heads[:, :, 3:5] = batch.truth[:, None, 3:5]
    heads[:, 1:, :3] -= 1.0  # two heads are too dark
    batch.truth[:, :3].clamp_(min=losses.DARKEST)
    late, early = (float(losses.loss_of(heads, batch, losses.temperature(at))[1][0]) for at in (1.0, 0.0))
    assert late + 0.3 < early


def test_the_temperature_falls_to_its_end():
    values = [losses.temperature(p) for p in (0, 0.1, 0.2, losses.ANNEALED, 0.7, 1)]
    assert values[0] == pytest.approx(losses.TEMPERATURE[0]) and values[3:] == pytest.approx([losses.TEMPERATURE[1]] * 3)
    assert all(a >= b for a, b in zip(values[:-1], values[1:], strict=True))


def test_gradients_agree_with_finite_differences(batch, predicted):
    predicted = predicted[:, :, :8].clone().requires_grad_(True)
    # The shares are constants of the objects: gradients flow through the errors alone.
    share = torch.softmax(torch.rand(8, HEADS, dtype=torch.float64), 1)
    weight = losses.at_pixels(share, batch)

    def value(p):
        errors = losses._errors(p, batch)
        pixel = sum(w * term for w, term in errors.weighted) * batch.counts
        return (weight * pixel).sum() + losses._gradient(errors.difference, weight, batch)

    value(predicted).backward()
    # `free` is relative to a scale that is held fixed, so roughness and metallic are compared.
    with torch.no_grad():
        for index in [(0, 1, 3, 2, 2), (1, 0, 4, 3, 1), (1, 2, 3, 0, 4)]:
            step = torch.zeros_like(predicted)
            step[index] = 1e-6
            numeric = float(value(predicted + step) - value(predicted - step)) / 2e-6
            assert float(predicted.grad[index]) == pytest.approx(numeric, rel=1e-4, abs=1e-6)


def test_scales_learn_the_mean_error_of_every_head(batch, predicted):
    scale = torch.zeros(2, HEADS, 3, 6, 5, dtype=torch.float64, requires_grad=True)
    errors = losses._errors(predicted, batch)
    mean = torch.stack([errors.weighted[0][1], errors.weighted[3][1], errors.metal], 2)
    optimum = (mean - losses.SCALE_FLOOR).clamp(min=1e-9).log()
    losses._scale_likelihood(scale, errors, batch).backward()
    low = losses._scale_likelihood(optimum, errors, batch)
    for shift in (-0.5, 0.5):
        assert losses._scale_likelihood(optimum + shift, errors, batch) > low
    assert not scale.grad[(batch.counts[:, None] == 0).expand_as(scale)].any()


def test_weights_of_other_layers_are_refused():
    own = PriorNetwork(len(CHANNELS), (8, 16), 2)
    for widths, layer in (((8, 16, 16), "down.2.c1.weight"), ((8, 8), "down.1.skip.weight")):
        other = PriorNetwork(len(CHANNELS), widths, 2)
        with refused(layer, kind=ValueError):
            network.load_weights(own, other.state_dict())
    with refused("out.bias", kind=ValueError):
        network.load_weights(own, {name: array for name, array in own.state_dict().items() if name != "out.bias"})
    other = PriorNetwork(len(CHANNELS), (8, 16), 2)
    network.load_weights(other, {name: array.half() for name, array in own.state_dict().items()})
    assert torch.allclose(other.out.weight, own.out.weight, atol=1e-3)
