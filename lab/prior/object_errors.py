"""How predictions err over whole objects, as `iif_core.fitting.predictions.PredictionErrors` tells it to the fit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize
from scipy.special import logit

from iif_core.fitting.object_levels import relative_error_of_base
from iif_core.fitting.predictions import DEGREES_OF_FREEDOM, PredictionErrors

FEWEST_PIXELS = 50
"""Objects of fewer pixels, over all views of a room, are left out."""
_DARKEST = 0.01  # brightness below which an albedo counts as this
_CLIP = 1e-3  # of the mean metallic


class ObjectSums:
    """Sums over the pixels of each object of each room: predicted and true brightness, roughness and metallic."""

    def __init__(self) -> None:
        self.rooms: list[dict[int, np.ndarray]] = [{}]

    def begin(self) -> None:
        """Begin another room."""
        self.rooms.append({})

    def add(self, group: np.ndarray, predicted: np.ndarray, true: np.ndarray) -> None:
        """Add pixels of the present room: object (n,), and albedo, roughness, metallic (n, 5) predicted and true."""
        rows, place = np.unique(group, return_inverse=True)
        values = np.concatenate([np.ones((len(group), 1)), _of_interest(predicted), _of_interest(true)], 1)
        sums = np.stack([np.bincount(place, column, len(rows)) for column in values.T], 1)
        own = self.rooms[-1]
        for row, total in zip(rows, sums, strict=True):
            own[int(row)] = own.get(int(row), 0.0) + total

    def errors(self) -> PredictionErrors | None:
        """Fit the errors; None where no room has two objects of two kinds."""
        level, rows = [], []
        for room in self.rooms:
            sums = np.array([own for own in room.values() if own[0] >= FEWEST_PIXELS]).reshape(-1, 7)
            if not len(sums):
                continue
            level.append(np.log(sums[:, 1].sum() / max(sums[:, 4].sum(), _DARKEST)))
            means = sums[:, 1:] / sums[:, :1]
            bright = np.log(np.maximum(means[:, 0], _DARKEST) / np.maximum(means[:, 3], _DARKEST)) - level[-1]
            weight = np.sqrt(sums[:, 0]) / np.sqrt(sums[:, 0]).sum()
            rows.append(np.column_stack([weight, bright / relative_error_of_base(means[:, 0]), means[:, [1, 4, 2, 5]]]))
        if not rows:
            return None
        weight, bright, rough, true_rough, metal, true_metal = np.concatenate(rows).T
        is_metal = true_metal >= 0.5
        if not 0 < is_metal.sum() < len(is_metal):
            return None
        brightness = _scale_of_t(bright - _weighted_median(bright, weight), weight)
        return PredictionErrors(
            float(np.sqrt(np.mean(np.square(level)))),
            brightness,
            _line(rough, true_rough, weight),
            _odds(metal, is_metal, weight),
        )


def _of_interest(values: np.ndarray) -> np.ndarray:
    return np.column_stack([values[:, :3].mean(1), values[:, 3], values[:, 4]])


def _weighted_median(x: np.ndarray, weight: np.ndarray) -> float:
    order = np.argsort(x)
    return float(x[order][np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())])


def _log_t(x: np.ndarray, scale: float) -> np.ndarray:
    return -0.5 * (DEGREES_OF_FREEDOM + 1) * np.log1p((x / scale) ** 2 / DEGREES_OF_FREEDOM) - np.log(scale)


def _likeliest(log_likelihood: Callable[[np.ndarray], np.ndarray], start: list[float], weight: np.ndarray) -> np.ndarray:
    return minimize(lambda q: -float(weight @ log_likelihood(q)) / float(weight.sum()), start, method="Nelder-Mead").x


def _scale_of_t(x: np.ndarray, weight: np.ndarray) -> float:
    return float(np.exp(_likeliest(lambda q: _log_t(x, np.exp(q[0])), [-1.0], weight)[0]))


def _line(predicted: np.ndarray, true: np.ndarray, weight: np.ndarray) -> tuple[float, float, float, float]:
    """(x, r, b, tau): true = r + b (predicted - x) with residuals of root mean square tau, x the mean prediction. Least squares
    give the mean truth at each prediction."""
    share = weight / weight.sum()
    x, r = share @ predicted, share @ true
    b = max(float(share @ ((predicted - x) * (true - r)) / max(share @ (predicted - x) ** 2, 1e-12)), 0.0)
    return float(x), float(r), b, float(np.sqrt(share @ (true - r - b * (predicted - x)) ** 2))


def _odds(predicted: np.ndarray, is_metal: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """(a, b): log likelihood ratio a + b logit(predicted), by logistic regression less the odds of a metal before."""
    x = logit(np.clip(predicted, _CLIP, 1 - _CLIP))
    a, b = _likeliest(lambda q: is_metal * (q[0] + q[1] * x) - np.logaddexp(0.0, q[0] + q[1] * x), [0.0, 1.0], weight)
    share = float(weight @ is_metal / weight.sum())
    return float(a - logit(share)), float(b)
