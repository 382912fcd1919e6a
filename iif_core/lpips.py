"""LPIPS v0.1, the learned distance of image patches (Zhang et al. 2018), from weights that the caller gives.

    d(x, y) = sum_l mean_p sum_c w_lc (f_lc(x, p) - f_lc(y, p))^2

f_l: activations of layer l of a classification network, scaled to unit length per pixel p; w_l >= 0: the learned head.
torch is imported where it is used; how many threads it takes is the caller's choice (`torch.set_num_threads`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from .errors import InputError

Array = np.ndarray
Weights = Mapping[str, Array]
"""`conv<i>.weight` (out, in, height, width), `conv<i>.bias` (out,), `head<l>` (channels,): float16 or float32."""

MIN_SIZE = 64
"""Pixels each way; below, the deepest layer has no more than a few of them (METHOD H38)."""

# Of each network: the convolutions in order as (stride, padding) with "pool" between them, the size of the pooling window
# (its stride is 2), and the convolutions whose activations are compared.
_ALEX = ((4, 2), "pool", (1, 2), "pool", (1, 1), (1, 1), (1, 1))
_VGG = ((1, 1),) * 2 + ("pool",) + ((1, 1),) * 2 + ("pool",) + (((1, 1),) * 3 + ("pool",)) * 2 + ((1, 1),) * 3
NETWORKS: dict[str, tuple[tuple[Any, ...], int, tuple[int, ...]]] = {
    "alex": (_ALEX, 3, (0, 1, 2, 3, 4)),
    "vgg": (_VGG, 2, (1, 3, 6, 9, 12)),
}

# Means and deviations of the training images, for inputs in [-1, 1].
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_EPSILON = 1e-10  # of the unit length; black activations stay 0


def lpips(prediction: Array, truth: Array, weights: Weights, mask: Array | None = None, network: str = "alex") -> Array:
    """LPIPS of one or several predictions against one truth; 0 = same, about 0.7 = unrelated.

    Pixels outside `mask` get the truth on both sides, and each layer's map of distances is averaged with the mask, reduced
    to the layer's size by area, as weight: without a mask, or with a full one, it is the published number.

    Args:
        prediction: (H, W, 3) or (H, W), or (n, ...) of either; values are clamped to [0, 1] and taken as they are, linear or
            encoded. One channel is repeated to three.
        truth: (H, W, 3) or (H, W).
        weights: of `network`.
        mask: (H, W) bool, not empty.
        network: `alex` or `vgg`.

    Returns:
        () or (n,) float64.

    Raises:
        InputError: unknown network, fewer than 64 pixels each way, empty mask, shapes that do not match, values that are not
            finite.
    """
    import torch

    if network not in NETWORKS:
        raise InputError(f"LPIPS network {network!r}: unknown; allowed: {', '.join(NETWORKS)}")
    truth = np.asarray(truth)
    several = np.ndim(prediction) > truth.ndim
    images = np.asarray(prediction) if several else np.asarray(prediction)[None]
    if images.shape[1:] != truth.shape or truth.ndim not in (2, 3) or (truth.ndim == 3 and truth.shape[2] != 3):
        raise InputError(f"LPIPS: prediction {np.shape(prediction)}, truth {truth.shape}; needed (H, W, 3) or (H, W) of both")
    height, width = truth.shape[:2]
    if min(height, width) < MIN_SIZE:
        raise InputError(f"LPIPS of a {width}x{height} image: at least {MIN_SIZE} pixels are needed each way")
    mask = np.ones((height, width), bool) if mask is None else np.asarray(mask, bool)
    if mask.shape != (height, width) or not mask.any():
        raise InputError(f"LPIPS: mask {mask.shape} with {np.count_nonzero(mask)} pixels; needed {(height, width)}, not empty")
    truth, images = (a if truth.ndim == 3 else np.repeat(a[..., None], 3, -1) for a in (truth, images))
    truth = np.where(mask[..., None], truth, np.nan_to_num(truth, posinf=1.0))
    images = np.where(mask[..., None], images, truth)
    if not (np.isfinite(truth).all() and np.isfinite(images).all()):
        raise InputError("LPIPS: an image is not finite where the mask counts it")
    parts = _as_torch(weights, network)
    with torch.inference_mode():
        counted = torch.from_numpy(mask[None, None].astype(np.float32))
        reference = _activations(_input(truth[None]), parts, network)
        # One image after the other: batches would be no faster on a CPU, only larger.
        out = [_distance(_activations(_input(image[None]), parts, network), reference, parts, counted) for image in images]
    return np.array(out, np.float64) if several else np.float64(out[0])


def _as_torch(weights: Weights, network: str) -> dict[str, Any]:
    import torch

    layers, _, taps = NETWORKS[network]
    convolutions = sum(layer != "pool" for layer in layers)
    names = [f"conv{i}.{part}" for i in range(convolutions) for part in ("weight", "bias")]
    names += [f"head{i}" for i in range(len(taps))]
    missing = [name for name in names if name not in weights]
    if missing:
        raise InputError(f"LPIPS weights of {network}: {missing[0]} is missing ({len(missing)} of {len(names)})")
    return {name: torch.from_numpy(np.asarray(weights[name]).astype(np.float32)) for name in names}


def _input(images: Array) -> Any:
    """(n, H, W, 3) in [0, 1] -> (n, 3, H, W) as the networks were trained on."""
    import torch

    scaled = (np.clip(images, 0, 1) * 2 - 1 - np.array(_SHIFT)) / np.array(_SCALE)
    return torch.from_numpy(np.ascontiguousarray(scaled.transpose(0, 3, 1, 2), np.float32))


def _activations(x: Any, parts: dict[str, Any], network: str) -> list[Any]:
    """Activations of the compared layers, each (n, channels, h, w) of unit length per pixel."""
    import torch.nn.functional as functional

    layers, window, taps = NETWORKS[network]
    out, i = [], 0
    for layer in layers:
        if layer == "pool":
            x = functional.max_pool2d(x, window, 2)
            continue
        stride, padding = layer
        x = functional.relu(functional.conv2d(x, parts[f"conv{i}.weight"], parts[f"conv{i}.bias"], stride, padding))
        if i in taps:
            out.append(x / (x.square().sum(1, keepdim=True).sqrt() + _EPSILON))
        i += 1
    return out


def _distance(prediction: list[Any], truth: list[Any], parts: dict[str, Any], counted: Any) -> float:
    import torch.nn.functional as functional

    total = 0.0
    for i, (p, t) in enumerate(zip(prediction, truth, strict=True)):
        distance = ((p - t).square() * parts[f"head{i}"].view(1, -1, 1, 1)).sum(1, keepdim=True)
        weight = functional.adaptive_avg_pool2d(counted, distance.shape[2:])
        total += float((distance.double() * weight.double()).sum() / weight.double().sum())
    return total
