"""How wrong the computed light is, judged with the true materials (lab/docs/evaluation.md#error-of-the-light), or by what is
saturated in photographs (docs/method/shading.md#re-rendering)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

DARK = 0.5
"""Part of the radiance that saturates, below which a re-rendering is dark there."""
SMALLEST_SHARE = 0.01
"""Share of the pixels from which an object counts."""


def dark_where_saturated(
    photo: NDArray, shown: NDArray, valid: NDArray, radiance: Callable[[NDArray], NDArray], saturation: float
) -> tuple[int, int]:
    """Return how many pixels of a photograph are saturated in all channels, and how many of these the re-rendering shows with
    less than `DARK` of the radiance that saturates, in all channels: where they are lamps, these are missing.

    Args:
        photo, shown: (..., 3) sensor values in [0, 1] of the photograph and of its re-rendering.
        valid: (...) bool, pixels that count.
        radiance: of sensor values (n, 3); saturation: sensor value from which a pixel is saturated.
    """
    saturated = valid & (photo >= saturation).all(-1)
    limit = DARK * radiance(np.full((1, 3), saturation))
    dark = saturated & (radiance(np.clip(shown, 0.0, saturation)) < limit).all(-1)
    return int(saturated.sum()), int(dark.sum())


class LightSpread:
    """Spread over objects of the error of the light (Eq. E.16).

    L is the true radiance, and P is the radiance of the true materials under the computed light. The error of an object o is
    e_o = log(sum L / sum P), with sums over its pixels and channels. The spread is the standard deviation of e_o over objects of
    more than `SMALLEST_SHARE` of the pixels. It ignores a factor that all objects share.
    """

    def __init__(self) -> None:
        self.sums = np.zeros((0, 3))  # pixels, L, P

    def add(self, true: NDArray, predicted: NDArray, object_id: NDArray, shown: NDArray | None = None) -> None:
        """Add pixels of one view: linear radiance (n, 3) and (n, 3), object (n,) int >= 0; non-finite pixels are left out of
        the sums.

        shown: (k,) objects of all pixels of the view, where light is known for some of them alone; None = `object_id`.
        """
        use = np.isfinite(true).all(-1) & np.isfinite(predicted).all(-1)
        own = np.asarray(object_id, np.int64)[use]
        every = own if shown is None else np.asarray(shown, np.int64)
        count = max(len(self.sums), int(own.max(initial=-1)) + 1, int(every.max(initial=-1)) + 1)
        sums = np.zeros((count, 3))
        sums[: len(self.sums)] = self.sums
        sums[:, 0] += np.bincount(every, minlength=count)
        for i, values in enumerate((true[use].mean(-1, dtype=np.float64), predicted[use].mean(-1, dtype=np.float64)), 1):
            sums[:, i] += np.bincount(own, values, count)
        self.sums = sums

    def finish(self) -> float | None:
        """Return the spread; None if fewer than two objects count."""
        pixels, true, predicted = self.sums.T
        use = (pixels > SMALLEST_SHARE * pixels.sum()) & (true > 0) & (predicted > 0)
        return float(np.std(np.log(true[use] / predicted[use]))) if use.sum() > 1 else None
