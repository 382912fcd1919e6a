"""How the constants of the calibrated uncertainty were fitted (Eq. F.48; lab/notebook/fusion.md)."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from iif_core.fusion.uncertainty import NOMINAL_COVERAGES, Calibration, _features, interval


def fit_calibration(samples: list[tuple[NDArray, NDArray, NDArray, NDArray, int]]) -> Calibration:
    """Fit the law of one property to several runs, each (error, b, viewpoints, pixels, predictions) with arrays (n,).

    The exponents maximise the likelihood for beta = 1 (Eq. F.48) by Nelder-Mead. Then c and beta minimise the largest
    deviation of the observed coverage from `NOMINAL_COVERAGES` over all runs.
    """
    errors = [np.abs(np.asarray(sample[0], np.float64)) for sample in samples]
    features = [_features(*sample[1:]) for sample in samples]
    e, x = np.concatenate(errors), np.concatenate(features)

    def cost(exponents: NDArray) -> float:
        log_s = x @ exponents
        return float(np.log(np.mean(e * np.exp(-log_s)) + 1e-30) + log_s.mean())

    exponents = minimize(cost, [0.6, 0.6, 0.3, 0.1], method="Nelder-Mead", options={"maxiter": 2000, "xatol": 1e-3}).x
    ratios = [np.sort(a * np.exp(-(b @ exponents))) for a, b in zip(errors, features, strict=True)]
    k = np.log2([sample[4] for sample in samples])
    around = np.sqrt(np.mean(np.concatenate(ratios) ** 2)) * np.linspace(0.7, 1.4, 71)
    best = (np.inf, 0.0, 1.0, 0.0)
    for beta_1 in np.linspace(0.7, 2.2, 16):
        for beta_2 in np.linspace(0, 0.35, 8) if np.ptp(k) > 0 else [0.0]:
            worst = np.zeros(len(around))
            for ratio, log_k in zip(ratios, k, strict=True):
                widths = around[:, None] * interval(np.float64(NOMINAL_COVERAGES), beta_1 + beta_2 * log_k)
                off = np.abs(np.searchsorted(ratio, widths, "right") / len(ratio) - NOMINAL_COVERAGES).max(1)
                worst = np.maximum(worst, off)
            i = int(worst.argmin())
            best = min(best, (float(worst[i]), float(around[i]), float(beta_1), float(beta_2)))
    return Calibration(best[1], *(float(v) for v in exponents), best[2], best[3])
