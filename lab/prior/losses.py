"""Losses of the network (lab/docs/prior.md#losses).

The heads are alternatives: what counts is that one of them is right for an object in a view, as the fusion chooses one prediction
per segment. Each head bears a share of the loss of an object that falls with its error there. While training proceeds, the shares
go from equal to the best head alone (deterministic annealing), so that no head is left behind at the start.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

DARKEST = 0.01  # albedo whose logarithm is the lowest that counts
LOG_LIMIT, GRADIENT_LIMIT = 2.5, 1.5
"""Errors of log albedo, and of its gradient, beyond which no pixel pulls harder."""
ALBEDO_LOG, ALBEDO_LINEAR, ALBEDO_OF_VIEW, ALBEDO_OF_OBJECT, ROUGHNESS, METALLIC = 0.5, 2.0, 0.2, 0.4, 1.2, 0.5
GRADIENT, SCALE = 0.5, 0.05
"""Weights of the terms. They balance typical sizes: log albedo .3, linear albedo .08, roughness .1, cross-entropy of metal .1."""
AT_BORDER = 0.5
"""Weight of the gradient loss at borders of objects, where the mesh may be wrong."""
TEMPERATURE = (1.0, 0.02)
"""Difference of losses that divides a head's share by e, at the start and from the progress ANNEALED on."""
ANNEALED = 0.4
SCALE_FLOOR = 0.01
"""Added to a scale in its likelihood: smaller errors are those of eight bits, and one wrong pixel must not outweigh a batch."""
FLOOR = 0.04
"""Share of the loss that all heads bear together to the end."""
LOGGED = (
    *("loss", "log_albedo_best", "log_albedo_all", "albedo_best", "roughness_best", "roughness_all"),
    *("metallic_best", "metal_entropy", "gradient", "scales", "heads_used"),
)


@dataclass(frozen=True)
class Batch:
    """B crops.

    Attributes:
        inputs: (B, C, H, W).
        truth: (B, 5, H, W) linear albedo, roughness, metallic.
        counts: (B, 1, H, W) float, 1 = the pixel counts.
        group: (B, H, W) int64 object of each pixel, distinct over the batch and below `groups`.
        border: (B, 1, H, W) float, 1 = border of an object.
    """

    inputs: torch.Tensor
    truth: torch.Tensor
    counts: torch.Tensor
    group: torch.Tensor
    border: torch.Tensor
    groups: int


def temperature(progress: float, start: float = TEMPERATURE[0]) -> float:
    """Return the temperature of the shares at a progress of training in [0, 1]."""
    end = TEMPERATURE[1]
    return start * (end / start) ** min(progress / ANNEALED, 1.0)


def loss_of(predicted: torch.Tensor, batch: Batch, heat: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute the loss of a batch.

    Args:
        predicted: (B, M, 8, H, W), as `network.HEAD` names them.
        batch: inputs and truth.
        heat: temperature of the shares.

    Returns:
        The loss, and the numbers LOGGED (detached).
    """
    errors = _errors(predicted, batch)
    pixel = sum(weight * term for weight, term in errors.weighted) * batch.counts  # (B, M, H, W)
    mean, size = by_object(pixel.detach(), batch)  # (G, M), (G,)
    share = (1 - FLOOR) * torch.softmax(-mean / heat, 1) + FLOOR / mean.shape[1]
    weight = at_pixels(share, batch)
    count = batch.counts.sum().clamp(min=1)
    main = (weight * pixel).sum() / count
    gradient = _gradient(errors.difference, weight, batch) / count
    scales = _scale_likelihood(predicted[:, :, 5:8], errors, batch) / count
    total = main + GRADIENT * gradient + SCALE * scales
    with torch.no_grad():
        best = at_pixels(torch.nn.functional.one_hot(mean.argmin(1), mean.shape[1]).float(), batch)
        won = lambda term: (best * term * batch.counts).sum() / count  # noqa: E731
        every = lambda term: (term.mean(1, keepdim=True) * batch.counts).sum() / count  # noqa: E731
        used = torch.bincount(mean.argmin(1)[size > 0], minlength=mean.shape[1]) > 0
        log, linear, _, _, rough, entropy = (term for _, term in errors.weighted)
        numbers = [total, won(log), every(log), won(linear), won(rough), every(rough), won(errors.metal), won(entropy)]
        return total, torch.stack([*numbers, gradient, scales, used.sum().float()])


@dataclass(frozen=True)
class _Errors:
    """Errors of each pixel and head, (B, M, H, W).

    Attributes:
        weighted: pairs of a weight and a term of the loss.
        difference: (B, M, 3, H, W) of log albedo.
        metal: absolute error of metallic.
    """

    weighted: tuple[tuple[float, torch.Tensor], ...]
    difference: torch.Tensor
    metal: torch.Tensor


def _errors(predicted: torch.Tensor, batch: Batch) -> _Errors:
    """Absolute errors of albedo in log, linear, and in log up to a factor of the view and of the object, and of roughness;
    cross-entropy of metal."""
    albedo = batch.truth[:, None, :3]
    difference = predicted[:, :, :3] - torch.log(albedo.clamp(min=DARKEST))
    log = difference.abs().clamp(max=LOG_LIMIT).mean(2)
    linear = (torch.exp(predicted[:, :, :3]) - albedo).abs().mean(2)
    counts = batch.counts[:, None]
    scale = (difference * counts).sum((-2, -1), keepdim=True) / counts.sum((-2, -1), keepdim=True).clamp(min=1)
    of_view = (difference - scale.detach()).abs().clamp(max=LOG_LIMIT).mean(2)
    # The fit finds the brightness of each object; what it cannot mend is what varies inside of one.
    level = at_pixels(by_object(difference.detach().mean(2), batch)[0], batch)
    of_object = (difference - level[:, :, None]).abs().clamp(max=LOG_LIMIT).mean(2)
    rough = (predicted[:, :, 3] - batch.truth[:, None, 3]).abs()
    metal, true_metal = predicted[:, :, 4].clamp(1e-4, 1 - 1e-4), batch.truth[:, None, 4].expand_as(predicted[:, :, 4])
    entropy = -(true_metal * torch.log(metal) + (1 - true_metal) * torch.log1p(-metal))
    albedo_terms = (ALBEDO_LOG, log), (ALBEDO_LINEAR, linear), (ALBEDO_OF_VIEW, of_view), (ALBEDO_OF_OBJECT, of_object)
    return _Errors((*albedo_terms, (ROUGHNESS, rough), (METALLIC, entropy)), difference, (metal - true_metal).abs())


def by_object(values: torch.Tensor, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
    """Return means (G, M) of values (B, M, H, W) over the pixels of each object that count, and the number (G,) of those."""
    heads, flat = values.shape[1], batch.group.reshape(-1)
    counted = (values * batch.counts).permute(0, 2, 3, 1).reshape(-1, heads)
    total = torch.zeros(batch.groups, heads, device=values.device, dtype=counted.dtype).index_add_(0, flat, counted)
    size = torch.zeros(batch.groups, device=values.device, dtype=batch.counts.dtype).index_add_(0, flat, batch.counts.reshape(-1))
    return total / size.clamp(min=1)[:, None], size


def at_pixels(values: torch.Tensor, batch: Batch) -> torch.Tensor:
    """Return values (G, M) of objects at their pixels, (B, M, H, W)."""
    return values[batch.group.reshape(-1)].reshape(*batch.group.shape, -1).permute(0, 3, 1, 2)


def _gradient(difference: torch.Tensor, weight: torch.Tensor, batch: Batch) -> torch.Tensor:
    """Sum of the errors of the gradients of log albedo, less at borders of objects."""
    total = torch.zeros((), device=difference.device)
    for axis in (-1, -2):
        length = difference.shape[axis] - 1
        ends = lambda map_, axis=axis, length=length: (map_.narrow(axis, 0, length), map_.narrow(axis, 1, length))  # noqa: E731
        error = torch.diff(difference, dim=axis).abs().clamp(max=GRADIENT_LIMIT).mean(2)
        both = torch.minimum(*ends(batch.counts))
        inner = 1 - (1 - AT_BORDER) * torch.maximum(*ends(batch.border))
        total = total + (ends(weight)[1] * error * both * inner).sum()
    return total


def _scale_likelihood(scale: torch.Tensor, errors: _Errors, batch: Batch) -> torch.Tensor:
    """Sum over pixels of the Laplace likelihood of the log scales (B, M, 3, H, W), which does not move the predictions.

    All heads count alike, also where they are not the best: the mean of the heads is weighted by these scales, and nobody knows
    then which head is right.
    """
    (_, log), _, _, _, (_, rough), _ = errors.weighted
    error = torch.stack([log, rough, errors.metal], 2).detach()
    width = torch.exp(scale) + SCALE_FLOOR
    return ((error / width + torch.log(width)).mean((1, 2)) * batch.counts[:, 0]).sum()
