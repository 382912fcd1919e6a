"""The cross entropy of the selection (Eq. F.12) over all usable pixels, in float64."""

import numpy as np

from iif_core.fusion.problem import LOWEST, usable_pixels


def label_loss(problem, value, corrections, log_weight, temperature):
    """Label loss of a texture (n_cells, 5), maps (albedo, roughness, metallic) and log weights (S, K, 3).

    It is infinite where alpha is 0 and q of Eq. F.11 is not (docs/method/numerics.md#cold-temperatures).
    """
    total, pixels = 0.0, 0
    for view in range(len(problem.cell_of_pixel)):
        found = usable_pixels(problem, view, problem.view(view))
        k = np.flatnonzero(found.usable)
        values = problem.view(view)[k][:, found.pixel].astype(np.float64)
        albedo, roughness, metallic = (np.asarray(c, np.float64)[found.segment][:, k].swapaxes(0, 1) for c in corrections)
        corrected = np.empty_like(values)
        corrected[..., :3] = np.einsum("knij,knj->kni", albedo[..., :3], values[..., :3]) + albedo[..., 3]
        for channel, gain in ((3, roughness), (4, metallic)):
            corrected[..., channel] = gain[..., 0] * values[..., channel] + gain[..., 1]
        error = np.abs(np.clip(corrected, LOWEST.astype(np.float64), 1.0) - value[found.cell].astype(np.float64))
        e = np.stack([error[..., :3].mean(-1), error[..., 3], error[..., 4]], -1)
        q = np.exp(-(e - e.min(0)) / temperature)
        q /= q.sum(0)
        part = np.where(q > 0, q * log_weight[found.segment][:, k].swapaxes(0, 1), 0.0)  # 0 log 0 = 0
        total, pixels = total - part.sum() / 3, pixels + len(found.pixel)
    return total / pixels
