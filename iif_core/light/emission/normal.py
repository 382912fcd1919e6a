"""Normal equations of emission, lifted where noise of the transport hides a direction, and their non-negative solution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

TRUSTED_RELIABILITY = 1.5
"""Reliability of a direction, relative to the noise of reliabilities, from which the data alone decide it."""


@dataclass(frozen=True)
class NormalSums:
    """H, its noise part K, M and b of one channel (Eq. L.22, L.23): (G, G) three times and (G,), float64."""

    h: np.ndarray
    k: np.ndarray
    m: np.ndarray
    b: np.ndarray


@dataclass(frozen=True)
class NormalSystem:
    """Normal equations of the groups to which some row responds, scaled to unit diagonal of M.

    Attributes:
        known: (G,) bool; scale: of the unknowns; matrix: lifted H plus prior; lifted: the part of it that belongs to the
            prior; right: b; data: lifted H alone; ridge: what was added to its diagonal.
    """

    known: np.ndarray
    scale: np.ndarray
    matrix: np.ndarray
    lifted: np.ndarray
    right: np.ndarray
    data: np.ndarray
    ridge: float

    @property
    def condition(self) -> float:
        """Condition number of the lifted H."""
        spectrum = np.linalg.eigvalsh(self.data)
        return float(spectrum[-1] / max(spectrum[0] - self.ridge, 1e-10))

    def solve(self, initial: np.ndarray) -> np.ndarray:
        """Non-negative least squares; groups that are not known stay at `initial` (G,)."""
        from scipy.linalg import solve_triangular
        from scipy.optimize import nnls

        lower = np.linalg.cholesky(self.matrix)
        right = solve_triangular(lower, self.right + self.lifted @ (initial[self.known] * self.scale), lower=True)
        answer = initial.copy()
        answer[self.known] = nnls(lower.T, right, maxiter=50 * len(self.scale) + 50)[0] / self.scale
        return answer


def normal_system(
    normal: NormalSums, width: np.ndarray, variance: np.ndarray, ridge: float, correlation: np.ndarray | None = None
) -> NormalSystem | None:
    """Make the system of the groups to which some row responds, with the prior (Eq. L.24).

    Args:
        normal: sums over the rows.
        width: (G,) standard deviation of the prior; infinity switches it off.
        variance: (G,) of a row of weight 1, which weighs the prior.
        ridge: added to the diagonal, relative to that of M.
        correlation: (G, G) of the prior, positive definite; None = none.

    Returns:
        The system, or None when no row responds to any group.
    """
    diagonal = np.diag(normal.m)
    known = diagonal > 1e-12 * max(diagonal.max(), 1e-300)
    if not known.any():
        return None
    scale = np.sqrt(diagonal[known])
    unit, pick = np.outer(scale, scale), np.ix_(known, known)
    scaled = NormalSums(normal.h[pick] / unit, normal.k[pick] / unit, normal.m[pick] / unit, normal.b[known] / scale)
    matrix, lifted = _definite(scaled, ridge)
    each = np.sqrt(variance[known]) / (width[known] * scale)
    prior = np.diag(each**2)
    if correlation is not None:
        prior = each[:, None] * np.linalg.inv(correlation[pick]) * each
    return NormalSystem(known, scale, matrix + prior, lifted + prior, scaled.b, matrix, ridge)


def _definite(normal: NormalSums, ridge: float) -> tuple[np.ndarray, np.ndarray]:
    """(H lifted, the lift), in units in which the diagonal of M is 1 (Eq. L.24)."""
    values, vectors = np.linalg.eigh(normal.m)
    values = np.maximum(values, 1e-9 * values[-1])
    root, inverse = (vectors * np.sqrt(values)) @ vectors.T, (vectors / np.sqrt(values)) @ vectors.T
    share, directions = np.linalg.eigh(inverse @ normal.h @ inverse)
    noise = float(np.linalg.norm(inverse @ normal.k @ inverse, 2)) if normal.k.any() else 0.0
    lift = np.where(share < max(TRUSTED_RELIABILITY * noise, 1e-6), 1.0 - share, 0.0)
    whole = root @ directions
    lifted = (whole * lift) @ whole.T + ridge * np.eye(len(values))
    return normal.h + lifted, lifted
