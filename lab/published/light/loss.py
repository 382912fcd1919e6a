"""One loss that judges every solver of emission."""

from __future__ import annotations

import numpy as np

from iif_core.light.emission.rows import EmissionRows


def reference_loss(rows: EmissionRows, radiance: np.ndarray, cross: bool = True) -> float:
    """Return the mean of w r^2 over rows and channels, relative to the mean of w t^2 (Eq. L.48).

    With `cross` the square is the product of the residuals of the two traces, whose noise is independent, so that an answer that
    is shrunk to reduce the noise is not favoured; the loss can then be slightly negative. A bound counts only where the mean
    prediction is below it (docs/method/numerics.md#clamped-loss).

    radiance: (G, 3).
    """
    radiance = np.asarray(radiance, np.float64)
    first, second = (t - np.einsum("ngc,gc->nc", a, radiance) for a, t in zip(rows.matrices, rows.targets, strict=True))
    mean = 0.5 * (first + second)
    square = np.where(rows.lower_bound, np.maximum(mean, 0.0) ** 2, first * second if cross else mean**2)
    total = float((rows.weight * rows.mean_target**2).sum())
    return float((rows.weight * square).sum()) / total if total > 0 else 0.0
