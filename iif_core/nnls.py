"""Emission from photographs: light is linear in emission, so the emitters follow from non-negative least squares.

With materials and geometry fixed, pixel p shows L_p = h_p + sum_g A_pg E_g in each colour channel (METHOD 7a). A
is traced, so it is noisy, and a plain normal matrix E[A'A] = A'A + noise shrinks the answer (errors in variables):
50 % noise turns (5, 10, 20) into (7.3, 9.8, 14.8). Two independent traces A1, A2 remove that: H = (A1' W A2 + A2'
W A1) / 2. H may then be indefinite; its antisymmetric part (A1' W A2 - A2' W A1) / 2 is nothing but noise of the
same size, so directions of H below that size are handed to the prior instead of being inverted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iif_core.errors import InputError

_CHUNK = 1 << 24  # bytes of float64 rows converted at a time


@dataclass(frozen=True)
class EmissionRows:
    """Rows of the linear system; G groups, three channels that decouple.

    Attributes:
        first, second: (n, G, 3) float32, two independent estimates of A (`second` may be `first` when A is exact).
        target, target_second: (n, 3) observed radiance minus h of the same two estimates. h and A of one trace
            share their noise, so the right-hand side crosses them too: b = (A1' W t2 + A2' W t1) / 2.
        weight: (n, 3) >= 0, weight of the squared residual.
        lower_bound: (n, 3) bool: the sensor was saturated, the target is a lower bound and only a prediction below
            it counts.
    """

    first: np.ndarray
    second: np.ndarray
    target: np.ndarray
    target_second: np.ndarray
    weight: np.ndarray
    lower_bound: np.ndarray

    def __post_init__(self) -> None:
        n, groups = self.first.shape[:2]
        shapes = {"first": (n, groups, 3), "second": (n, groups, 3)}
        shapes |= dict.fromkeys(("target", "target_second", "weight", "lower_bound"), (n, 3))
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InputError(f"emission rows: {name} has shape {getattr(self, name).shape}, needed {shape}")

    @property
    def groups(self) -> int:
        return self.first.shape[1]

    @property
    def mean_target(self) -> np.ndarray:
        return 0.5 * (self.target + self.target_second)

    def columns(self, keep: np.ndarray) -> EmissionRows:
        """The system of a subset of the groups."""
        return replace(self, first=self.first[:, keep], second=self.second[:, keep])


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


def block_rows(rows: EmissionRows, block: np.ndarray) -> EmissionRows:
    """Averages of the rows of each block: the answer is the same, the noise of A falls with the block's size.

    Args:
        rows: pixel rows.
        block: (n,) int; pixels of one block should see one object in one small tile of one view (rows of different
            objects
            must not be averaged: they differ for a reason). Lower bounds and equalities never mix.

    Returns:
        Rows in order of block number; weight is the sum of the weights, target and A are weighted means per channel.
    """
    if not len(block):
        return rows
    code = rows.lower_bound @ np.array([1, 2, 4])
    order = np.lexsort((code, block))
    key = np.asarray(block, np.int64)[order] * 8 + code[order]
    starts = np.flatnonzero(np.r_[True, np.diff(key) != 0])
    size = np.diff(np.r_[starts, len(key)])
    omega = rows.weight[order].astype(np.float64)
    total = np.add.reduceat(omega, starts, 0)
    # A block whose weights are all 0 keeps weight 0; its mean is then a plain one.
    share = np.where(np.repeat(total > 0, size, 0), omega / np.maximum(np.repeat(total, size, 0), 1e-300), 0.0)
    share = share.astype(np.float32)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(values[order] * (share[:, None] if values.ndim == 3 else share), starts, 0)

    return EmissionRows(
        mean(rows.first),
        mean(rows.second),
        mean(rows.target),
        mean(rows.target_second),
        total,
        rows.lower_bound[order][starts],
    )


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


def scale_rows(rows: EmissionRows, observed: np.ndarray, gain: np.ndarray) -> EmissionRows:
    """The system for materials that reflect `gain` times as much: A and h are scaled, the observation is not.

    Args:
        observed: (n, 3) radiance y, so that h = y - target; gain: (n, 3) > 0.
    """
    factor = gain[:, None].astype(np.float32)
    return replace(
        rows,
        first=rows.first * factor,
        second=rows.second * factor,
        target=observed - gain * (observed - rows.target),
        target_second=observed - gain * (observed - rows.target_second),
    )


def object_gains(
    rows: EmissionRows,
    observed: np.ndarray,
    owner: np.ndarray,
    initial: np.ndarray,
    pinned: bool,
    cross: bool = True,
    rounds: int = 15,
    shrink: float = 0.05,
) -> np.ndarray:
    """Albedo gain of each object and channel that goes with the light: (n_objects, 3).

    The base texture is off by a factor per object, and light solved with wrong albedos comes out wrong where an object
    faces one emitter more than another. y = g_o (A E + h) is solved by turns for E (non-negative least squares)
    and for g (a ratio per object, pulled to 1). Where no emitter is seen unsaturated only the product g E is
    known: the mean of log g over the rows stays 0 then, as the prior has it.

    Args:
        rows, observed, initial, cross: as in `scale_rows` and `solve_emission`.
        owner: (n,) object of each row, -1 = not reflected light (a pixel on an emitter).
        pinned: E has a scale of its own.
        rounds: of the alternation.
        shrink: pull of g to 1 relative to the rows.
    """
    count = int(owner.max(initial=-1)) + 1
    gain = np.ones((count, 3))
    known = owner >= 0
    if not known.any() or rows.groups == 0:
        return gain
    index, own = np.flatnonzero(known), owner[known]
    weight = np.where(rows.lower_bound[known], 0.0, rows.weight[known])
    y, a1, a2 = observed[known], rows.first[known], rows.second[known]
    h1, h2 = y - rows.target[known], y - rows.target_second[known]
    share = np.stack([np.bincount(own, weight[:, c] * y[:, c] ** 2, count) for c in range(3)], 1)
    for _ in range(rounds):
        of_row = np.ones(observed.shape)
        of_row[index] = gain[own]
        radiance = solve_emission(scale_rows(rows, observed, of_row), initial, cross, max_rounds=5).radiance
        p1 = np.einsum("ngc,gc->nc", a1, radiance) + h1
        p2 = np.einsum("ngc,gc->nc", a2, radiance) + h2
        new = np.ones_like(gain)
        for c in range(3):
            square = p1[:, c] * p2[:, c] if cross else (0.5 * (p1[:, c] + p2[:, c])) ** 2
            top = np.bincount(own, weight[:, c] * y[:, c] * 0.5 * (p1[:, c] + p2[:, c]), count)
            bottom = np.bincount(own, weight[:, c] * square, count)
            pull = shrink * np.maximum(bottom, 0.0) + 1e-9 * max(float(bottom.max()), 1e-300)
            new[:, c] = np.clip((top + pull) / np.maximum(bottom + pull, 1e-300), 0.1, 10.0)
        if not pinned:
            new /= np.exp((share * np.log(new)).sum(0) / np.maximum(share.sum(0), 1e-300))
        done = np.abs(np.log(new / gain)).max() < 1e-3
        gain = new
        if done:
            break
    return gain


@dataclass(frozen=True)
class PrunedEmission:
    """Result of `prune_groups`: the solution with dropped groups at 0, which were kept, and why not."""

    solution: EmissionSolution
    kept: np.ndarray
    reason: list[str]


def prune_groups(
    rows: EmissionRows,
    initial: np.ndarray,
    area: np.ndarray,
    observed: np.ndarray,
    protected: np.ndarray,
    share: float = 0.01,
    residual_change: float = 1e-3,
    emitted_share: float = 0.3,
    cross: bool = True,
) -> PrunedEmission:
    """Solve, then drop groups that do not shine and solve again (METHOD 8).

    A group goes when it carries less than `share` of the total power area x sum E and the residual grows by less than
    `residual_change` without it (its own pixels apart), or when less than `emitted_share` of what was seen of it is its own
    (it reflects).

    Args:
        rows, initial, cross: as in `solve_emission`.
        area: (G,) m^2; observed: (G, 3) mean radiance seen on the group, 0 = not seen or only bounded.
        protected: (G,) bool, never dropped (environment).
    """
    groups = rows.groups
    kept, reason = np.ones(groups, bool), [""] * groups
    solution = solve_emission(rows, initial, cross)
    for _ in range(groups):
        power = area * solution.radiance.sum(1) * ~protected
        seen = observed.sum(1)
        reflects = kept & ~protected & (seen > 0) & (solution.radiance.sum(1) < emitted_share * seen)
        weak = kept & ~protected & ~reflects & (power < share * max(power.sum(), 1e-300))
        dark = kept & ~protected & (solution.radiance.sum(1) <= 0)
        drop = reflects | dark
        for g in np.flatnonzero(drop):
            reason[g] = "no emission is left for it" if dark[g] else "reflects: little of its brightness is its own"
        if not drop.any() and weak.any():
            trial = _solve_subset(rows, initial, kept & ~weak, cross)
            # A surface that is brighter than its albedo says explains its own pixels; what counts is what it lights.
            elsewhere = rows.first[:, weak].max(axis=(1, 2), initial=0.0) < 1.0
            before, after = (_misfit(rows, s.radiance, elsewhere) for s in (solution, trial))
            if after <= before * (1 + residual_change) + 1e-12:
                drop = weak
                for g in np.flatnonzero(weak):
                    reason[g] = f"below {share:.1%} of the power and not missed"
        if not drop.any():
            break
        kept &= ~drop
        solution = _solve_subset(rows, initial, kept, cross)
    return PrunedEmission(solution, kept, reason)


def _misfit(rows: EmissionRows, radiance: np.ndarray, mask: np.ndarray) -> float:
    """Weighted root sum of squares of some rows; bounds that are met do not count."""
    mean = 0.5 * (rows.first[mask] + rows.second[mask])
    difference = rows.mean_target[mask] - np.einsum("ngc,gc->nc", mean, radiance)
    counted = np.where(rows.lower_bound[mask] & (difference < 0), 0.0, rows.weight[mask])
    return float(np.sqrt((counted * difference**2).sum()))


def _solve_subset(rows: EmissionRows, initial: np.ndarray, kept: np.ndarray, cross: bool) -> EmissionSolution:
    """Solution over all groups, 0 outside `kept`."""
    part = solve_emission(rows.columns(kept), initial[kept], cross)
    radiance, error = np.zeros(initial.shape), np.zeros(initial.shape)
    determined = np.zeros(len(initial))
    radiance[kept], error[kept], determined[kept] = part.radiance, part.error, part.determined
    return replace(part, radiance=radiance, error=error, determined=determined)
