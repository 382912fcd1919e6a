"""Scores of a recovered room under new light against the source under the same light (lab/docs/evaluation.md#relighting).

Pictures are linear radiance (H, W, 3). The exposure follows from the true pictures alone and holds for every method. PSNR, SSIM,
FLIP and LPIPS are of sRGB(clip(exposure x radiance, 0, 1)), the relative error is of radiance.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from iif_core.errors import InputError
from iif_core.evaluation.catalogue import ProtocolName
from iif_core.evaluation.lpips import Weights
from iif_core.evaluation.metrics import Score, Target
from iif_core.numerics.color import tone_map

Array = np.ndarray

WHITE, SHARE = 0.8, 0.95
"""The exposure brings this quantile of the largest channel of the true pictures to this level."""
RELIT_PROTOCOLS: tuple[ProtocolName, ...] = ("raw", "gain", "scaled")
METRICS = ("l2", "psnr", "ssim", "flip", "lpips", "lpips_vgg")


def exposure_of(pictures: Iterable[ArrayLike], masks: Iterable[ArrayLike]) -> float:
    """Return the factor that brings the quantile `SHARE` of the largest channel of all counted pixels to `WHITE` (Eq. E.18).

    Raises:
        InputError: the pictures are black.
    """
    counted = [np.asarray(p, np.float64)[np.asarray(m, bool)].max(-1) for p, m in zip(pictures, masks, strict=True)]
    joined = np.concatenate(counted) if counted else np.zeros(0)
    brightest = float(np.quantile(joined, SHARE)) if len(joined) else 0.0
    if brightest <= 0:
        raise InputError("relit pictures are black: no light reaches what the cameras see")
    return WHITE / brightest


def best_gain(prediction: ArrayLike, truth: ArrayLike, mask: ArrayLike, exposure: float, by_channel: bool) -> Array:
    """Return the gains (3,) that bring a picture nearest to the truth in least squares of radiance (Eq. E.19).

    Only pixels count whose true radiance stays below white in every channel, because a picture does not show what lies above.
    A black picture, and one without such pixels, keeps the gain 1.

    Args:
        prediction, truth: (H, W, 3); mask: (H, W) bool.
        exposure: of `exposure_of`.
        by_channel: one gain for each channel; otherwise the three are equal.
    """
    p, t = np.asarray(prediction, np.float64), np.asarray(truth, np.float64)
    shown = np.asarray(mask, bool) & (exposure * t < 1).all(-1)
    p, t = p[shown], t[shown]
    across, square = (p * t).sum(0), (p * p).sum(0)
    if not by_channel:
        across, square = np.full(3, across.sum()), np.full(3, square.sum())
    return np.where((square > 0) & (across > 0), across / np.where(square > 0, square, 1.0), 1.0)


def relative_error(prediction: ArrayLike, truth: ArrayLike, mask: ArrayLike) -> float:
    """Return sum |p - t| / sum t over counted pixels and channels of radiance (Eq. E.20); 0 = same, 1 = as wrong as black."""
    on = np.asarray(mask, bool)
    p, t = np.asarray(prediction, np.float64)[on], np.asarray(truth, np.float64)[on]
    total = t.sum()
    return float(np.abs(p - t).sum() / total) if total > 0 else float("inf")


class RelitTarget:
    """A true picture under new light, prepared for scoring any number of methods.

    Args:
        truth: (H, W, 3) radiance; mask: (H, W) bool, pixels that count.
        exposure: of `exposure_of`, for all pictures under this light.
        networks: of LPIPS.
    """

    def __init__(self, truth: ArrayLike, mask: ArrayLike, exposure: float, networks: Mapping[str, Weights] | None = None):
        self.truth, self.mask, self.exposure = np.asarray(truth, np.float64), np.asarray(mask, bool), exposure
        self._shown = Target("rgb", tone_map(self.truth, exposure), self.mask, encoded=True, networks=networks)

    def under(self, prediction: ArrayLike, protocol: str) -> Array:
        """Return the radiance of a prediction after what the protocol forgives."""
        p = np.asarray(prediction, np.float64)
        if protocol == "raw":
            return p
        return p * best_gain(p, self.truth, self.mask, self.exposure, protocol == "scaled")

    def scores(self, prediction: ArrayLike, metrics: Sequence[str] = METRICS) -> Iterator[Score]:
        """Yield every score under every protocol: those of the shown picture, and `relative` of the radiance.

        Raises:
            InputError: shapes that do not match.
        """
        prediction = np.asarray(prediction)
        if prediction.shape != self.truth.shape:
            raise InputError(f"relit picture {prediction.shape}, truth {self.truth.shape}; they must have one shape")
        for protocol in RELIT_PROTOCOLS:
            if not np.isfinite(prediction[self.mask]).all():
                yield Score("psnr", protocol, None, "prediction is not finite")
                continue
            radiance = self.under(prediction, protocol)
            for score in self._shown.scores(tone_map(radiance, self.exposure), metrics):
                yield Score(score.metric, protocol, score.value, score.reason)
            yield Score("relative", protocol, relative_error(radiance, self.truth, self.mask))
