"""Predictions from the heads of the learned prior (docs/method/priors.md#learned)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iif_core.errors import InputError

SPREAD = 0.5
"""How far the predictions lie from their weighted mean, relative to the heads: single heads are trained to be right only where
they are the best."""
DARKEST_ALBEDO = 0.01
_PROPERTIES = ((slice(0, 3), 5), (slice(3, 4), 6), (slice(4, 5), 7))  # values of a head, and its log scale


@dataclass(frozen=True)
class Hypotheses:
    """K predictions of a view.

    Attributes:
        maps: (K, H, W, 5) float32 linear albedo, perceptual roughness, metallic.
        scale: (H, W, 3) float32 Laplace scales of their weighted mean, in units of albedo, roughness and metallic.
    """

    maps: NDArray
    scale: NDArray


def combined(
    heads: NDArray, samples: int, spread: float = SPREAD, calibration: tuple[float, ...] = (1.0, 1.0, 1.0)
) -> Hypotheses:
    """Turn heads into predictions: each is moved towards the mean of all, in log albedo.

    The mean has the weights 1 / scale^2, so that at each pixel those heads count that are sure of themselves (Eq. P.26).

    Args:
        heads: (M, H, W, 8) log albedo, roughness, metallic, log scales of log albedo, roughness and metallic.
        samples: K, at most M; a single prediction is the mean itself.
        spread: 0 = all predictions are the mean, 1 = they are the heads.
        calibration: factors on the three scales.

    Raises:
        InputError: samples < 1 or more than there are heads.
    """
    if not 1 <= samples <= len(heads):
        raise InputError(f"prior learned: {samples} predictions asked for, 1 to {len(heads)} are there; set `prior.samples`")
    out = np.empty((samples, *heads.shape[1:3], 5), np.float32)
    scale = np.empty((*heads.shape[1:3], 3), np.float32)
    for number, (values, own) in enumerate(_PROPERTIES):
        # (M, H, W, 3 or 1) and (M, H, W, 1)
        maps, log_scale = heads[..., values], heads[..., own : own + 1]
        # 1 / s^2 relative to the surest head of each pixel (Eq. P.26): its weight is 1, so nothing overflows and no total is 0.
        weight = np.exp(-2 * (log_scale - log_scale.min(0)))
        total = weight.sum(0)
        middle = (weight * maps).sum(0) / total
        share = spread if samples > 1 else 0.0  # a single head is right only where it wins
        out[..., values] = middle + share * (maps[:samples] - middle)  # Eq. P.27
        scale[..., number] = calibration[number] * (np.exp(log_scale) * weight).sum(0)[..., 0] / total[..., 0]
    out[..., :3] = np.exp(out[..., :3])
    # d albedo = albedo d(log albedo)
    scale[..., 0] *= out[..., :3].mean((0, -1))
    np.clip(out, (DARKEST_ALBEDO,) * 3 + (0, 0), 1, out=out)
    return Hypotheses(out, scale)
