"""Emission from photographs by non-negative least squares (docs/method/light.md#least-squares).

Two independent traces of the transport remove the bias of its noise (Eq. L.21, L.22); directions whose reliability is lost in
noise go to the prior (Eq. L.24).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from iif_core.errors import InputError
from iif_core.light.emission.normal import NormalSums, NormalSystem, normal_system
from iif_core.light.emission.rows import EmissionRows
from iif_core.numerics.normal_tail import hazard

RIDGE = 1e-4
"""Weight of the initial value relative to the diagonal of the normal matrix."""
_DAMPED_AFTER = 6  # rounds of re-weighting after which steps are halved (docs/method/numerics.md#answers-that-alternate)
_CHUNK_BYTES = 1 << 24  # of float64 rows converted at a time
SINGLE_WIDTH = 5.0
"""Standard deviation of the radiance of a group around its initial value, relative to it."""
HIDDEN_WIDTH = 3000.0
"""The same of surface that no camera sees, around the median of what the photographs show, which says nothing about a lamp."""
FAMILY_WIDTH = 0.3
"""Standard deviation of the groups of one object around their common radiance, relative to it."""
OUTSIDE_WIDTH = 0.5
"""The same for the directions that stand for the outside of a mesh with large openings."""


@dataclass(frozen=True)
class EmissionSolution:
    """Result of `solve_emission`.

    Attributes:
        radiance: (G, 3) float64 >= 0.
        error: (G, 3) standard error (Eq. L.29 without the level).
        determined: (G,) in [0, 1]: share of the answer that comes from data rather than from the initial value.
        condition: largest / smallest eigenvalue of the lifted normal matrix at unit diagonal, of the worst channel.
        residual: weighted root mean square of target - A E, relative to the root mean square of the target.
        violated: number of lower bounds that the answer does not reach.
        iterations: rounds of re-weighting.
        converged: the answer came to rest.
    """

    radiance: np.ndarray
    error: np.ndarray
    determined: np.ndarray
    condition: float
    residual: float
    violated: int
    iterations: int
    converged: bool

    def with_level_error(self, level_error: float | np.ndarray) -> EmissionSolution:
        """Add the error of the logarithm of the light that groups share (a number or (G, 3)) to the error of each."""
        return replace(self, error=np.hypot(self.error, level_error * self.radiance))


@dataclass(frozen=True)
class EmissionPrior:
    """What is assumed of the radiance of every group before the rows are read.

    Attributes:
        initial: (G, 3) mean, >= 0.
        width: (G,) standard deviation relative to the mean.
        correlation: (G, G) positive definite; None = groups are independent.
    """

    initial: np.ndarray
    width: np.ndarray
    correlation: np.ndarray | None = None

    @classmethod
    def independent(cls, initial: np.ndarray, width: float = SINGLE_WIDTH) -> EmissionPrior:
        """Prior of unrelated groups of the same relative width."""
        return cls(initial, np.full(len(initial), width))

    def beside(self, other: EmissionPrior) -> EmissionPrior:
        """The prior of these groups followed by others that are independent of them."""
        n, m = len(self.initial), len(other.initial)
        related = np.eye(n + m)
        if self.correlation is not None:
            related[:n, :n] = self.correlation
        if other.correlation is not None:
            related[n:, n:] = other.correlation
        return EmissionPrior(np.concatenate([self.initial, other.initial]), np.concatenate([self.width, other.width]), related)

    def only(self, kept: np.ndarray) -> EmissionPrior:
        """The prior of a subset of the groups, a mask (G,)."""
        correlation = None if self.correlation is None else self.correlation[np.ix_(kept, kept)]
        return EmissionPrior(self.initial[kept], self.width[kept], correlation)

    def solve(self, rows: EmissionRows, max_rounds: int = 20) -> EmissionSolution:
        """Solve with this prior, see `solve_emission`."""
        return solve_emission(rows, self.initial, max_rounds=max_rounds, prior_width=self.width, correlation=self.correlation)

    def radiance(self, rows: EmissionRows, max_rounds: int = 20) -> np.ndarray:
        """Return (G, 3) the radiance of `solve` alone, for about half of its cost."""
        return self.radiance_and_light(rows, max_rounds)[0]

    def radiance_and_light(self, rows: EmissionRows, max_rounds: int = 20) -> tuple[np.ndarray, np.ndarray]:
        """Return `radiance`, and A E with the mean of the two traces, (n, 3)."""
        channels = _channels(rows, np.asarray(self.initial, np.float64), RIDGE, self.width, self.correlation)
        found = [channel.solve(max_rounds) for channel in channels]
        if not found:
            return self.initial.copy(), np.zeros(rows.observed.shape)
        return np.stack([channel.radiance for channel in found], 1), np.stack([channel.light for channel in found], 1)


def solve_emission(
    rows: EmissionRows,
    initial: np.ndarray,
    ridge: float = RIDGE,
    max_rounds: int = 20,
    prior_width: float | np.ndarray = SINGLE_WIDTH,
    family: np.ndarray | None = None,
    correlation: np.ndarray | None = None,
) -> EmissionSolution:
    """Solve for the radiance of every emitter group: weighted non-negative least squares with one-sided rows (Eq. L.20).

    Saturated rows are as sharp as the noise of the rows (Eq. L.26). Their weights, the residual variance and the prior are
    updated until the answer comes to rest.

    Args:
        rows: the system (see `block_rows`).
        initial: (G, 3) E0 >= 0, where the answer stays when the data do not determine it (unseen group, noise, duplicate
            columns).
        ridge: weight of E0 relative to the diagonal of the normal matrix.
        max_rounds: of the re-weighting.
        prior_width: number or (G,), standard deviation of E relative to E0; infinity switches the prior off.
        family: (G,) int, groups whose common initial value was itself found from the data; None = each for itself.
        correlation: (G, G) of the prior, positive definite; None = none.

    Returns:
        The solution, always finite.

    Raises:
        InputError: `initial` of the wrong shape, negative or non-finite; non-finite rows.
    """
    groups, initial = rows.groups, np.asarray(initial, np.float64)
    found, errors = [], []
    for channel in _channels(rows, initial, ridge, prior_width, correlation):
        found.append(channel.solve(max_rounds))
        errors.append(channel.uncertainty(found[-1].radiance, found[-1].variance, family))
    if not found:
        return EmissionSolution(initial.copy(), initial.copy(), np.zeros(groups), 1.0, 0.0, 0, 0, True)
    error, shares = zip(*errors, strict=True)
    square, square_target = sum(f.square for f in found), sum(f.square_target for f in found)
    residual = float(np.sqrt(square / square_target)) if square_target > 0 else 0.0
    return EmissionSolution(
        np.stack([f.radiance for f in found], 1),
        np.stack(error, 1),
        np.stack(shares, 1).min(1),
        max([1.0, *(f.system.condition for f in found if f.system is not None)]),
        residual,
        sum(f.violated for f in found),
        max(f.rounds for f in found),
        all(f.converged for f in found),
    )


def _channels(
    rows: EmissionRows,
    initial: np.ndarray,
    ridge: float,
    prior_width: float | np.ndarray,
    correlation: np.ndarray | None,
) -> Iterator[_ChannelRows]:
    """The checked system of each channel, one after the other so that only one is held; none without groups or rows."""
    groups = rows.groups
    if initial.shape != (groups, 3) or not np.isfinite(initial).all() or (initial < 0).any():
        raise InputError(f"emission: initial radiance of shape {initial.shape}, needed ({groups}, 3), finite and >= 0")
    for name in ("matrix", "observed", "cached", "weight"):
        if not np.isfinite(getattr(rows, name)).all():
            raise InputError(f"emission rows: {name} holds non-finite values; drop those pixels first")
    if groups == 0 or len(rows.observed) == 0:
        return
    matrices, targets = rows.matrices, rows.targets
    cluster = np.full(len(rows.observed), -1) if rows.cluster is None else rows.cluster
    for c in range(3):
        prior = initial[:, c], _width(initial[:, c], prior_width), ridge, correlation
        both = (np.ascontiguousarray(a[:, :, c]) for a in matrices)
        data = *both, *(t[:, c] for t in targets), rows.weight[:, c], rows.lower_bound[:, c]
        yield _ChannelRows(*data, cluster, rows.noise, *prior)


def solve_families(
    rows: EmissionRows, prior: EmissionPrior, family: np.ndarray, width: float | np.ndarray = FAMILY_WIDTH
) -> EmissionSolution:
    """Solve in two steps: groups of one object first share one radiance, then deviate from it (Eq. L.30).

    The triangles of a window light the room almost alike, so only their sum is well known.

    Args:
        rows: the system.
        prior: of the groups. Those of larger families must not be correlated with others.
        family: (G,) int, groups with the same number are parts of one object.
        width: number or (G,), relative standard deviation of groups around the radiance that they share.

    Returns:
        The solution of the second step.
    """
    number, first, members = np.unique(family, return_index=True, return_inverse=True)
    size = np.bincount(members, minlength=len(number))
    if not len(family) or size.max() == 1:
        return prior.solve(rows)

    # -------- first step: one radiance for each family --------
    initial, correlation = prior.initial, prior.correlation
    joint = np.zeros((len(number), 3))
    np.add.at(joint, members, initial)
    joint /= size[:, None]
    # Groups of equal radiance act as one group whose column is the sum of theirs.
    matrix = np.zeros((*rows.matrix.shape[:3], len(number), 3), np.float32)
    for group, member in enumerate(members):
        matrix[:, :, :, member] += rows.matrix[:, :, :, group]
    shared = replace(rows, matrix=matrix)
    # Groups of larger families are not correlated with any other, so the first member can stand for its family.
    of_first = None if correlation is None else correlation[np.ix_(first, first)]
    start = EmissionPrior(joint, prior.width[first], of_first).radiance(shared)[members]

    # -------- second step: every group around the radiance of its family (Eq. L.30) --------
    together = size[members] > 1
    start = np.where(together[:, None], np.maximum(start, 0.1 * initial), initial)
    return solve_emission(rows, start, prior_width=np.where(together, width, prior.width), family=family, correlation=correlation)


def _censored(difference: np.ndarray, bound: np.ndarray, scale: np.ndarray | None, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Saturated rows as equalities of the next step: share of their weight, and what is added to their target.

    One Newton step on the likelihood of saturation at noise sigma (Tobin 1958; Eq. L.25, L.26). For sigma -> 0 rows below
    their bound count fully and the others not at all.
    """
    # -------- hard bounds: the limit sigma -> 0, and the first round --------
    # `difference` is bound - prediction: a row counts while it is positive.
    share, shift = np.ones(len(difference)), np.zeros(len(difference))
    missed = bound & (difference > 0)
    share[bound] = missed[bound]
    if scale is None or noise <= 0:
        return share, shift

    # -------- soft bounds: one Newton step on -log Phi(-z) --------
    # z > 0 where the prediction is below the bound. From 29 standard deviations on the bound is hard (`far`).
    sigma = noise * scale[bound]
    z = np.clip(difference[bound] / sigma, -30.0, 30.0)
    ratio, excess = hazard(z)
    # delta = lambda (lambda - z) lies in (0, 1). It falls towards 0 where a bound is met with room to spare; such rows drop out.
    delta = np.clip(ratio * excess, 0.0, 1.0)
    far = np.abs(difference[bound]) >= 29.0 * sigma
    soft = ~far & (delta > 1e-4)
    share[bound] = np.where(far, missed[bound], np.where(soft, delta, 0.0))
    # Target mu + sigma lambda / delta of Eq. L.26, less the target that the row has already.
    shift[bound] = np.where(soft, sigma * ratio / np.maximum(delta, 1e-4) - difference[bound], 0.0)
    return share, shift


def _width(initial: np.ndarray, relative: float | np.ndarray) -> np.ndarray:
    """Standard deviation of the prior; infinite without any initial brightness, which would be its scale."""
    largest = float(initial.max(initial=0.0))
    if largest <= 0:
        return np.full(len(initial), np.inf)
    return relative * np.maximum(initial, 0.1 * largest)


@dataclass(frozen=True)
class _Channel:
    """Answer of one channel: radiance and variance of a row of weight 1 (G,), light A E (n,), and the last system; rounds,
    violated bounds, and sums of squares of residual and target."""

    radiance: np.ndarray
    light: np.ndarray
    variance: np.ndarray
    system: NormalSystem | None
    violated: int
    rounds: int
    converged: bool
    square: float
    square_target: float


@dataclass(frozen=True)
class _ChannelRows:
    """The rows of one colour channel and the prior of its answer.

    Attributes:
        first, second: (n, G) float32, contiguous; target, target_second, weight: (n,); bound: (n,) bool.
        cluster: (n,) int; noise: (n,) or None.
        initial, width: (G,) mean and standard deviation of the prior; ridge, correlation: as in `solve_emission`.
    """

    first: np.ndarray
    second: np.ndarray
    target: np.ndarray
    target_second: np.ndarray
    weight: np.ndarray
    bound: np.ndarray
    cluster: np.ndarray
    noise: np.ndarray | None
    initial: np.ndarray
    width: np.ndarray
    ridge: float
    correlation: np.ndarray | None = None

    @property
    def mean_target(self) -> np.ndarray:
        return 0.5 * (self.target + self.target_second)

    @property
    def sure(self) -> np.ndarray:
        """Weights without the bounds: a bound that is reached says where the answer stops, not how far off it is."""
        return np.where(self.bound, 0.0, self.weight)

    def chunks(self) -> list[slice]:
        """Slices of rows that are converted to float64 at a time."""
        step = max(1, _CHUNK_BYTES // (8 * max(self.first.shape[1], 1)))
        return [slice(start, start + step) for start in range(0, len(self.target), step)]

    def normal(self, weight: np.ndarray, shift: np.ndarray) -> NormalSums:
        """Sums over the rows; `weight` and `shift` (n,) of the targets differ from those of `sure` for bounds alone."""
        own = np.flatnonzero(self.bound & (weight > 0))
        bounds = self._sums(own, weight[own], shift[own])
        return NormalSums(*(a + b for a, b in zip(self._equalities, bounds, strict=True)))

    @cached_property
    def _equalities(self) -> tuple[np.ndarray, ...]:
        """The sums over rows that are no bounds, which stay while bounds are re-weighted."""
        own = np.flatnonzero(~self.bound & (self.weight > 0))
        return self._sums(own, self.weight[own], np.zeros(len(own)))

    def _sums(self, rows: np.ndarray, weight: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, ...]:
        """H, K, M and b of some rows."""
        groups = self.first.shape[1]
        h, k, m, b = np.zeros((groups, groups)), np.zeros((groups, groups)), np.zeros((groups, groups)), np.zeros(groups)
        step = max(1, _CHUNK_BYTES // (8 * max(groups, 1)))
        for start in range(0, len(rows), step):
            part = rows[start : start + step]
            w, extra = weight[start : start + step], shift[start : start + step]
            a1, a2 = self.first[part].astype(np.float64), self.second[part].astype(np.float64)
            mean = 0.5 * (a1 + a2)
            t1, t2 = self.target[part] + extra, self.target_second[part] + extra
            # M contains the noise of the traces (Eq. L.23).
            m += mean.T @ (w[:, None] * mean)
            # Every product takes one factor from either trace. Their noise is independent, so it has no part in the expectation
            # (Eq. L.22).
            b += 0.5 * (a1.T @ (w * t2) + a2.T @ (w * t1))
            # The symmetric part is H. The antisymmetric part K is noise alone.
            product = a1.T @ (w[:, None] * a2)
            h += 0.5 * (product + product.T)
            k += 0.5 * (product - product.T)
        return h, k, m, b

    def scores(self, answer: np.ndarray) -> np.ndarray:
        """S of Eq. L.27, over clusters of rows that are no bounds: (G, G)."""
        from scipy.sparse import csr_matrix

        parts, weight = [], self.sure
        for part in self.chunks():
            w = weight[part, None]
            a1, a2 = self.first[part].astype(np.float64), self.second[part].astype(np.float64)
            r1, r2 = self.target[part] - a1 @ answer, self.target_second[part] - a2 @ answer
            # Score of a row: one trace times the residual of the other (Eq. L.27).
            parts.append(0.5 * w * (a1 * r2[:, None] + a2 * r1[:, None]))
        single = np.concatenate(parts)
        alone = self.cluster < 0
        number = np.unique(self.cluster[~alone], return_inverse=True)[1]
        shape = int(number.max(initial=-1)) + 1, len(number)
        # Rows of a cluster may err together, so their scores are added before the outer product.
        together = csr_matrix((np.ones(len(number)), (number, np.arange(len(number)))), shape) @ single[~alone]
        return single[alone].T @ single[alone] + together.T @ together

    def system(self, weight: np.ndarray, shift: np.ndarray, variance: np.ndarray) -> NormalSystem | None:
        """Normal equations with the given weights and shifts; `variance` (G,) of a row of weight 1 weighs the prior. None when no
        row responds to any group."""
        return normal_system(self.normal(weight, shift), self.width, variance, self.ridge, self.correlation)

    def solve(self, max_rounds: int) -> _Channel:
        """Solve and re-weight until the answer rests, then once more with the prior weighed by the design effect."""
        # -------- start: hard bounds, and no prior --------
        bound, weight, target = self.bound, self.weight, self.mean_target
        mean_a = (0.5 * (self.first + self.second)).astype(np.float64)
        bounded = bool(np.isfinite(self.width).any())
        answer, last = self.initial.copy(), None
        rounds, converged, weighed, noise = 0, False, not bounded, 0.0
        light = mean_a @ answer
        difference = target - light
        # Variance 0 gives the prior no weight: before the first round there is no residual to weigh it with.
        variance, effect = np.zeros(len(answer)), np.ones(len(answer))
        while rounds < max_rounds and not (converged and weighed):
            # -------- at rest: weigh the prior by the design effect (Eq. L.28), then carry on --------
            if converged and not weighed:
                weighed, effect = True, self._design_effect(answer, variance)
                variance = variance * effect

            # -------- one non-negative least-squares problem --------
            rounds += 1
            before = answer
            share, shift = _censored(difference, bound, self.noise, noise)
            system = self.system(weight * share, shift, variance)
            if system is not None:
                answer, last = self._completed(system.solve(self.initial), system.known), system
            if rounds > _DAMPED_AFTER:  # two answers may alternate: take the one between them
                answer = 0.5 * (before + answer)

            # -------- weights of the next round --------
            light = mean_a @ answer
            difference = target - light
            # v: a bound that is met leaves no residual.
            used = np.where(bound & (difference <= 0), 0.0, weight)
            residual = float((used * difference**2).sum() / max(np.count_nonzero(used), 1))
            variance = effect * residual if bounded else variance
            plain = ~bound & (weight > 0)
            # sigma of Eq. L.26, without the factor nu: weighted root mean square of the residuals of equalities.
            noise = float(np.sqrt((weight[plain] * difference[plain] ** 2).mean())) if plain.any() else 0.0
            # The first round does not count: it has neither prior nor soft bounds.
            change = np.abs(answer - before).max(initial=0.0)
            converged = rounds > 1 and bool(change <= 1e-3 * max(answer.max(initial=0.0), 1e-300))
        counted = np.where(bound & (difference < 0), 0.0, weight)
        return _Channel(
            answer,
            light,
            variance,
            last,
            int((bound & (difference > 1e-6 * np.abs(target))).sum()),
            rounds,
            converged,
            float((counted * difference**2).sum()),
            float((np.where(bound, counted, weight) * target**2).sum()),
        )

    def _completed(self, answer: np.ndarray, known: np.ndarray) -> np.ndarray:
        """Groups to which no row responds take what the prior expects of them, given the others (kriging)."""
        if self.correlation is None or known.all() or not np.isfinite(self.width).all():
            return answer
        # How many standard deviations the known groups lie from their means; the correlation carries this over to the others.
        away = (answer - self.initial)[known] / np.maximum(self.width[known], 1e-300)
        expected = self.correlation[np.ix_(~known, known)] @ np.linalg.solve(self.correlation[np.ix_(known, known)], away)
        out = answer.copy()
        out[~known] = np.maximum(self.initial[~known] + self.width[~known] * expected, 0.0)
        return out

    def _design_effect(self, answer: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """(G,) >= 1, variance of the answer relative to its variance if the rows erred independently (Kish 1965; Eq. L.28)."""
        effect = np.ones(len(answer))
        system = self.system(self.sure, np.zeros(len(self.target)), variance)
        if system is not None:
            known, inverse = system.known, np.linalg.inv(system.matrix)
            # Variance by the sandwich, and the one that independent errors of the rows would give.
            real = np.diag(inverse @ self._score_covariance(system, answer) @ inverse)
            claimed = variance[known] * np.diag(inverse)
            effect[known] = np.maximum(np.divide(real, claimed, out=np.ones(len(real)), where=claimed > 0), 1.0)
        return effect

    def _score_covariance(self, system: NormalSystem, answer: np.ndarray) -> np.ndarray:
        """`scores` of the known groups in units of the system's scale."""
        return self.scores(answer)[np.ix_(system.known, system.known)] / np.outer(system.scale, system.scale)

    def uncertainty(self, answer: np.ndarray, variance: np.ndarray, family: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """(standard error of Eq. L.29 without the level, share of the answer that comes from data), both (G,)."""
        error, share = self.initial.copy(), np.zeros(len(answer))
        system = self.system(self.sure, np.zeros(len(self.target)), variance)
        if system is None:
            return error, share
        known, scale, initial = system.known, system.scale, self.initial[system.known]
        inverse = np.linalg.inv(system.matrix)
        response = inverse @ system.lifted  # d answer / d initial
        # Effect of an error of each initial value on each group, second term of Eq. L.29. The error is at most the value itself.
        prior_part = response * np.minimum(self.width[known], np.maximum(initial, 1e-300)) * scale
        if family is not None:
            # A common initial value was found from the data, so what moves a whole family alike is no error of the prior.
            member = family[known][:, None] == np.unique(family)
            size = member.sum(0)
            mean = prior_part @ (member / np.maximum(size, 1))
            prior_part = prior_part - np.where(size > 1, mean, 0.0) @ member.T
        data_part = np.clip(np.diag(inverse @ self._score_covariance(system, answer) @ inverse), 0, None)
        share[known] = 1.0 - np.clip(np.diag(response), 0.0, 1.0)
        # Errors of correlated initial values add up accordingly: diagonal of P C P'.
        related = prior_part if self.correlation is None else prior_part @ self.correlation[np.ix_(known, known)]
        error[known] = np.sqrt(data_part + np.clip((prior_part * related).sum(1), 0, None)) / scale
        return error, share
