"""The currency of every decision: the gain of held-out log likelihood over its standard error (docs/method/plan.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

FOLDS = 2
AGAINST = 2.0
"""Standard errors below zero from which a part of the model is left out: missing it costs accuracy, having it costs time."""
SHRINKAGE = 5.0
"""Rows of the common scale that each group gets in addition to its own rows."""
_SMALLEST_SCALE = 1e-6  # of the residuals, so that an exact model has a finite likelihood


@dataclass(frozen=True)
class Evidence:
    """What a larger model gains on data that it was not fitted to.

    Attributes:
        gain: sum over the held-out residuals of log p(larger) - log p(simpler), nats.
        error: its standard error; residuals of one block err together.
        rows: number of residuals.
    """

    gain: float
    error: float
    rows: int

    @property
    def pays(self) -> bool:
        """Whether the larger model is taken: it gains more than one standard error."""
        return self.rows > 0 and self.gain > self.error

    @property
    def speaks_against(self) -> bool:
        """Whether the larger model is clearly worse: it loses `AGAINST` standard errors, or gains nothing whatever."""
        return self.rows > 0 and self.gain <= -AGAINST * self.error


NOTHING = Evidence(0.0, 0.0, 0)
"""Evidence without data: the simpler model wins."""


def laplace_log_likelihood(residual: np.ndarray, scale: np.ndarray | float) -> np.ndarray:
    """Return log p = -log(2 b) - |r| / b of residuals (n,) under Laplace distributions of scale b, nats (Eq. N.1)."""
    b = np.maximum(scale, _SMALLEST_SCALE)
    return -np.log(2 * b) - np.abs(residual) / b


def folds_of_blocks(block: np.ndarray, seed: int) -> np.ndarray:
    """Assign whole blocks to folds: block (n,) ids -> (n,) fold, 0 ... FOLDS - 1."""
    names, row = np.unique(block, return_inverse=True)
    fold = np.random.default_rng(seed).permutation(len(names)) % FOLDS
    return fold[row]


def held_out_evidence(
    simple: np.ndarray, full: np.ndarray, fold: np.ndarray, block: np.ndarray, group: np.ndarray | None = None
) -> Evidence:
    """Compare two models by their residuals on data that each was not fitted to (Eq. N.2, N.3).

    The Laplace scale of a fold is the mean absolute residual of the other folds, for each model and group by itself; groups of
    few rows are drawn towards the mean of all. The error is sqrt(B) times the standard deviation of the B sums over the blocks.

    Args:
        simple, full: (n,) held-out residuals; rows that are not finite in either are left out.
        fold: (n,) as `folds_of_blocks` gives it; the residuals of a fold come from a fit to the others.
        block: (n,) ids of what errs together.
        group: (n,) ids of what has its own scale; None = all rows share one.

    Returns:
        The evidence; `NOTHING` with fewer than two blocks.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> noise, block = rng.laplace(size=400), np.repeat(np.arange(40), 10)
        >>> held_out_evidence(2 * noise, noise, folds_of_blocks(block, 0), block).pays
        True
        >>> held_out_evidence(noise, noise, folds_of_blocks(block, 0), block).pays
        False
    """
    use = np.isfinite(simple) & np.isfinite(full)
    simple, full, fold, block = simple[use], full[use], fold[use], block[use]
    kind = np.zeros(len(simple), int) if group is None else np.unique(group[use], return_inverse=True)[1]
    difference = np.zeros(len(simple))
    for number in range(FOLDS):
        inside, outside = fold == number, fold != number
        if not (inside.any() and outside.any()):
            return NOTHING
        # log p of the larger model, then of the simpler one; both scales come from the other fold.
        models = (
            laplace_log_likelihood(r[inside], _scales(np.abs(r[outside]), kind[outside], int(kind.max()) + 1)[kind[inside]])
            for r in (full, simple)
        )
        difference[inside] = np.subtract(*models)
    names, row = np.unique(block, return_inverse=True)
    if len(names) < 2:
        return NOTHING
    # Residuals of a block err together, so a block is one observation (Eq. N.3).
    sums = np.bincount(row, difference)
    return Evidence(float(sums.sum()), float(np.sqrt(len(sums)) * sums.std(ddof=1)), len(difference))


def _scales(size: np.ndarray, kind: np.ndarray, kinds: int) -> np.ndarray:
    """Return (kinds,) mean of the sizes (n,) of each kind, with SHRINKAGE rows of the mean of all."""
    total, count = np.bincount(kind, size, kinds), np.bincount(kind, minlength=kinds)
    return (total + SHRINKAGE * size.mean()) / (count + SHRINKAGE)
