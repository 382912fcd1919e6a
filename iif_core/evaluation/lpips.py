"""LPIPS v0.1, the learned distance of image patches (Zhang et al. 2018), with weights that the caller supplies (Eq. E.7).

torch is imported where it is used; the caller chooses its number of threads (`torch.set_num_threads`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from iif_core.errors import InputError

Array = np.ndarray
Weights = Mapping[str, Array]
"""`conv<i>.weight` (out, in, height, width), `conv<i>.bias` (out,), `head<l>` (channels,): float16 or float32."""

MIN_SIZE = 64
"""Smallest width and height in pixels (docs/method/numerics.md#small-images)."""

# For each network: the convolutions in order as (stride, padding) with "pool" between them, the size of the pooling window
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
_EPSILON = 1e-10  # added to the length of activations; black activations stay 0


class Lpips:
    """LPIPS against one truth, which passes through the network once: 0 = same, about 0.7 = unrelated.

    Pixels outside `mask` get the truth on both sides. The map of distances of each layer is averaged with the mask, reduced to
    the size of the layer by area, as weight; without a mask the result is the published number.

    Args:
        truth: (H, W, 3) or (H, W), as every prediction, linear or encoded; values are clamped to [0, 1]. One channel is
            repeated to three.
        weights: of `network`.
        mask: (H, W) bool, not empty.
        network: `alex` or `vgg`.

    Raises:
        InputError: unknown network, fewer than 64 pixels each way, empty mask, shapes that do not match, values that are not
            finite.
    """

    def __init__(self, truth: Array, weights: Weights, mask: Array | None = None, network: str = "alex"):
        import torch

        if network not in NETWORKS:
            raise InputError(f"LPIPS network {network!r}: unknown; allowed: {', '.join(NETWORKS)}")
        truth = np.asarray(truth)
        if truth.ndim not in (2, 3) or (truth.ndim == 3 and truth.shape[2] != 3):
            raise InputError(f"LPIPS: truth {truth.shape}; needed (H, W, 3) or (H, W)")
        height, width = truth.shape[:2]
        if min(height, width) < MIN_SIZE:
            raise InputError(f"LPIPS of a {width}x{height} image: at least {MIN_SIZE} pixels are needed each way")
        mask = np.ones((height, width), bool) if mask is None else np.asarray(mask, bool)
        if mask.shape != (height, width) or not mask.any():
            raise InputError(
                f"LPIPS: mask {mask.shape} with {np.count_nonzero(mask)} pixels; needed {(height, width)}, not empty"
            )
        self.network, self.mask, self._shape = network, mask, truth.shape
        self.parts = _as_torch(weights, network)
        truth = _three(truth)
        self.truth = np.where(mask[..., None], truth, np.nan_to_num(truth, posinf=1.0))
        with torch.inference_mode():
            self.counted = torch.from_numpy(mask[None, None].astype(np.float32))
            self.reference = self._activations(self.truth)

    def _activations(self, image: Array) -> list[Any]:
        if not np.isfinite(image).all():
            raise InputError("LPIPS: an image is not finite where the mask counts it")
        return _activations(_input(image[None]), self.parts, self.network)

    def __call__(self, prediction: Array) -> float:
        import torch

        prediction = np.asarray(prediction)
        if prediction.shape != self._shape:
            raise InputError(f"LPIPS: prediction {prediction.shape}, truth {self._shape}; needed (H, W, 3) or (H, W) of both")
        image = np.where(self.mask[..., None], _three(prediction), self.truth)
        with torch.inference_mode():
            return _distance(self._activations(image), self.reference, self.parts, self.counted)


def _three(image: Array) -> Array:
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, -1)


def _as_torch(weights: Weights, network: str) -> dict[str, Any]:
    import torch

    layers, _, taps = NETWORKS[network]
    convolutions = sum(layer != "pool" for layer in layers)
    names = [f"conv{i}.{part}" for i in range(convolutions) for part in ("weight", "bias")]
    names += [f"head{i}" for i in range(len(taps))]
    missing = [name for name in names if name not in weights]
    if missing:
        raise InputError(f"LPIPS weights of {network}: {missing[0]} is missing ({len(missing)} of {len(names)})")
    parts = {name: torch.from_numpy(np.array(weights[name], np.float32)) for name in names}
    # This memory layout is faster on CPUs.
    return {name: p.contiguous(memory_format=torch.channels_last) if p.ndim == 4 else p for name, p in parts.items()}


def _input(images: Array) -> Any:
    """Convert (n, H, W, 3) in [0, 1] to (n, 3, H, W) with the normalisation of the training images."""
    import torch

    scale, shift = np.array(_SCALE), np.array(_SHIFT)
    scaled = np.clip(images, 0, 1) * (2 / scale) - (1 + shift) / scale
    return torch.from_numpy(scaled.astype(np.float32)).permute(0, 3, 1, 2)  # in memory the channels stay last


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
