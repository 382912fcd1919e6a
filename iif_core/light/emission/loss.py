"""One loss for every solver of emission."""

from __future__ import annotations

import numpy as np

from iif_core.light.emission.rows import EmissionRows


def reference_loss(rows: EmissionRows, radiance: np.ndarray, cross: bool = True) -> float:
    """Mean over rows and channels of w r^2, relative to that of w t^2; a bound counts only where it is not reached.

    METHOD 7a: the published loss with a defect less: a prediction above the saturation level keeps its gradient (H32).
    With `cross` the square is the product of the residuals of the two traces, whose noise is independent: its
    expectation is that of exact transport, so it does not favour an answer that is shrunk to make the noise small.
    It can then be slightly negative. Bounds use the mean residual.

    Args:
        radiance: (G, 3).
    """
    radiance = np.asarray(radiance, np.float64)
    first = rows.target - np.einsum("ngc,gc->nc", rows.first, radiance)
    second = rows.target_second - np.einsum("ngc,gc->nc", rows.second, radiance)
    mean = 0.5 * (first + second)
    square = np.where(rows.lower_bound, np.maximum(mean, 0.0) ** 2, first * second if cross else mean**2)
    total = float((rows.weight * rows.mean_target**2).sum())
    return float((rows.weight * square).sum()) / total if total > 0 else 0.0
