"""Emission from photographs: light is linear in emission, so the emitters follow from non-negative least squares.

With materials and geometry fixed, pixel p shows L_p = h_p + sum_g A_pg E_g in each colour channel (METHOD 7a). A
is traced, so it is noisy, and a plain normal matrix E[A'A] = A'A + noise shrinks the answer (errors in variables):
50 % noise turns (5, 10, 20) into (7.3, 9.8, 14.8). Two independent traces A1, A2 remove that: H = (A1' W A2 + A2'
W A1) / 2. H may then be indefinite; its antisymmetric part (A1' W A2 - A2' W A1) / 2 is nothing but noise of the
same size, so directions of H below that size are handed to the prior instead of being inverted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from .rows import EmissionRows

_CHUNK = 1 << 24  # bytes of float64 rows converted at a time


@dataclass(frozen=True)
class EmissionSolution:
    """Result of `solve_emission`.

    Attributes:
        radiance: (G, 3) float64 >= 0.
        error: (G, 3) standard error: sandwich estimate from the residuals, widened by the initial value in as far
            as the data leave a group to it.
        determined: (G,) in [0, 1]: share of the answer that comes from data rather than from the initial value.
        condition: largest / smallest eigenvalue of the normal matrix scaled to unit diagonal (worst channel), cut
            at the noise level.
        residual: weighted root mean square of target - A E, relative to that of the target.
        violated: number of lower bounds that the answer does not reach.
        iterations: rounds of the active set; `converged` says whether it came to rest.
    """

    radiance: np.ndarray
    error: np.ndarray
    determined: np.ndarray
    condition: float
    residual: float
    violated: int
    iterations: int
    converged: bool


def solve_emission(
    rows: EmissionRows,
    initial: np.ndarray,
    cross: bool = True,
    ridge: float = 1e-4,
    max_rounds: int = 20,
    prior_width: float = 5.0,
) -> EmissionSolution:
    """Radiance of every emitter group: weighted non-negative least squares with one-sided rows (METHOD 7a).

    min over E >= 0 of  sum_equal w (t - A E)^2 + sum_bound w (t - A E)_+^2 + ridge |E - E0|^2 (in units of the
    diagonal)
                        + v sum_g (E_g - E0_g)^2 / (prior_width E0_g)^2,  v = residual variance of a row of weight 1.
    Bounds that are violated join as equalities until the set rests.

    Args:
        rows: the system (see `block_rows`).
        initial: (G, 3) E0 >= 0: where the answer stays when the data say nothing (unseen group, noise, duplicate
            columns).
        cross: normal matrix from both estimates of A (unbiased); False: from their mean (biased low, always definite).
        ridge: pull towards E0 relative to the diagonal of the normal matrix.
        max_rounds: of the active set.
        prior_width: standard deviation of E relative to E0 before looking at what it lights; keeps small groups
            whose light reaches few pixels from taking any value at all. Infinity switches it off.

    Returns:
        `EmissionSolution`; always finite.

    Raises:
        InputError: `initial` of the wrong shape, negative or non-finite; non-finite rows.
    """
    groups = rows.groups
    initial = np.asarray(initial, np.float64)
    if initial.shape != (groups, 3) or not np.isfinite(initial).all() or (initial < 0).any():
        raise InputError(f"emission: initial radiance of shape {initial.shape}, needed ({groups}, 3), finite and >= 0")
    for name in ("first", "second", "target", "target_second", "weight"):
        if not np.isfinite(getattr(rows, name)).all():
            raise InputError(f"emission rows: {name} holds non-finite values; drop those pixels first")
    radiance, error, shares = initial.copy(), initial.copy(), np.zeros((groups, 3))
    condition, violated, iterations, converged = 1.0, 0, 0, True
    if groups == 0 or len(rows.target) == 0:
        return EmissionSolution(radiance, error, shares.min(1) if groups else np.zeros(0), 1.0, 0.0, 0, 0, True)
    square, square_target = 0.0, 0.0
    for c in range(3):
        channel = _solve_channel(rows, c, initial[:, c], cross, ridge, max_rounds, prior_width)
        radiance[:, c], error[:, c], shares[:, c] = channel.radiance, channel.error, channel.share
        condition = max(condition, channel.condition)
        violated += channel.violated
        iterations = max(iterations, channel.rounds)
        converged &= channel.converged
        square += channel.square
        square_target += channel.square_target
    residual = float(np.sqrt(square / square_target)) if square_target > 0 else 0.0
    return EmissionSolution(radiance, error, shares.min(1), condition, residual, violated, iterations, converged)


@dataclass(frozen=True)
class _Channel:
    radiance: np.ndarray
    error: np.ndarray
    share: np.ndarray
    condition: float
    violated: int
    rounds: int
    converged: bool
    square: float
    square_target: float


def _normal(rows: EmissionRows, c: int, active: np.ndarray, cross: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """H, the noise part K, b and the plain diagonal, summed in float64 over chunks."""
    groups = rows.groups
    h, k = np.zeros((groups, groups)), np.zeros((groups, groups))
    b, diagonal = np.zeros(groups), np.zeros(groups)
    step = max(1, _CHUNK // (8 * groups))
    for start in range(0, len(rows.target), step):
        part = slice(start, start + step)
        w = np.where(active[part], rows.weight[part, c], 0.0)[:, None]
        a1 = rows.first[part, :, c].astype(np.float64)
        a2 = rows.second[part, :, c].astype(np.float64)
        mean = 0.5 * (a1 + a2)
        t1, t2 = rows.target[part, c], rows.target_second[part, c]
        diagonal += (w * mean * mean).sum(0)
        if cross:
            b += 0.5 * (a1.T @ (w[:, 0] * t2) + a2.T @ (w[:, 0] * t1))
            product = a1.T @ (w * a2)
            h += 0.5 * (product + product.T)
            k += 0.5 * (product - product.T)
        else:
            b += mean.T @ (w[:, 0] * 0.5 * (t1 + t2))
            h += mean.T @ (w * mean)
    return h, k, b, diagonal


def _definite(h: np.ndarray, k: np.ndarray, ridge: float, prior: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """H with every eigenvalue lifted above the noise level and the ridge; the lift, prior (diagonal) included; the
    condition number of H."""
    values, vectors = np.linalg.eigh(h)
    noise = float(np.linalg.norm(k, 2)) if k.any() else 0.0
    floor = max(noise, ridge, 1e-10)
    lift = np.maximum(floor - values, 0.0) + ridge
    lifted = (vectors * lift) @ vectors.T + np.diag(prior)
    return h + lifted, lifted, float(values[-1] / max(values[0], floor))


def _solve_channel(
    rows: EmissionRows, c: int, initial: np.ndarray, cross: bool, ridge: float, max_rounds: int, prior_width: float
) -> _Channel:
    from scipy.linalg import solve_triangular
    from scipy.optimize import nnls

    bound = rows.lower_bound[:, c]
    mean_a = 0.5 * (rows.first[:, :, c] + rows.second[:, :, c])
    target, weight = rows.mean_target[:, c], rows.weight[:, c]
    answer, error, share, condition = initial.copy(), initial.copy(), np.zeros(len(initial)), 1.0
    joined = bound & (mean_a @ answer < target)
    seen: list[bytes] = []
    rounds, converged, variance = 0, False, 0.0
    largest = float(initial.max(initial=0.0))
    # Without any initial brightness there is no scale for the prior, and it is left out.
    width = prior_width * np.maximum(initial, 0.1 * largest) if largest > 0 else np.full(len(initial), np.inf)
    while rounds < max_rounds and not converged:
        rounds += 1
        active = ~bound | joined
        h, k, b, diagonal = _normal(rows, c, active, cross)
        known = diagonal > 1e-12 * max(diagonal.max(), 1e-300)
        if known.any():
            scale = np.sqrt(diagonal[known])
            unit = np.outer(scale, scale)
            scaled_h, scaled_k = h[np.ix_(known, known)] / unit, k[np.ix_(known, known)] / unit
            matrix, lifted, condition = _definite(scaled_h, scaled_k, ridge, variance / (width[known] * scale) ** 2)
            start = initial[known] * scale
            right = b[known] / scale + lifted @ start
            lower = np.linalg.cholesky(matrix)
            solved = nnls(lower.T, solve_triangular(lower, right, lower=True), maxiter=50 * len(scale) + 50)[0]
            answer = initial.copy()
            answer[known] = solved / scale
            inverse = np.linalg.inv(matrix)
            rows_a = mean_a[:, known] / scale
            meat_w = np.where(active, weight * (target - mean_a @ answer), 0.0)[:, None] * rows_a
            covariance = inverse @ (meat_w.T @ meat_w) @ inverse
            prior_part = np.clip(np.diag(inverse @ lifted), 0.0, 1.0)
            error, share = initial.copy(), np.zeros(len(initial))
            share[known] = 1.0 - prior_part
            error[known] = np.sqrt(np.clip(np.diag(covariance), 0, None) + (prior_part * start) ** 2) / scale
        difference = target - mean_a @ answer
        now = bound & (difference > 0)
        # The first round has no residual to weigh the prior with.
        converged = rounds > 1 and bool((now == joined).all())
        used = np.where(bound & ~now, 0.0, weight)
        variance = float((used * difference**2).sum() / max(np.count_nonzero(used), 1)) if np.isfinite(prior_width) else 0.0
        joined = now
        mark = np.packbits(now).tobytes()
        if rounds > 1 and mark in seen and not converged:  # a cycle between two sets: both are within a rounding of the optimum
            break
        seen.append(mark)
    difference = target - mean_a @ answer
    counted = np.where(bound & (difference < 0), 0.0, weight)
    return _Channel(
        answer,
        error,
        share,
        condition,
        int(joined.sum()),
        rounds,
        converged,
        float((counted * difference**2).sum()),
        float((np.where(bound, counted, weight) * target**2).sum()),
    )
