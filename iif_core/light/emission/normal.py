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

        # Minimising x'Qx - 2 c'x over x >= 0 is the least-squares problem |L'x - L^-1 c|^2 with Q = L L', which is the form that
        # the solver of Lawson and Hanson takes. Q has a Cholesky factor because `_definite` lifts what is not positive. c is the
        # right-hand side of Eq. L.24.
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
        ridge: added to the diagonal, relative to the diagonal of M.
        correlation: (G, G) of the prior, positive definite; None = none.

    Returns:
        The system, or None when no row responds to any group.
    """
    # A column to which no row responds has no curvature; its group stays out of the system.
    diagonal = np.diag(normal.m)
    known = diagonal > 1e-12 * max(diagonal.max(), 1e-300)
    if not known.any():
        return None
    # In units of unit diagonal, groups that light many rows and groups that light few are comparable, and one ridge suits all.
    scale = np.sqrt(diagonal[known])
    unit, pick = np.outer(scale, scale), np.ix_(known, known)
    scaled = NormalSums(normal.h[pick] / unit, normal.k[pick] / unit, normal.m[pick] / unit, normal.b[known] / scale)
    matrix, lifted = _definite(scaled, ridge)
    # Root of v_g / sigma_g^2 in these units. It is 0 for an infinite width.
    each = np.sqrt(variance[known]) / (width[known] * scale)
    prior = np.diag(each**2)
    if correlation is not None:
        prior = each[:, None] * np.linalg.inv(correlation[pick]) * each
    return NormalSystem(known, scale, matrix + prior, lifted + prior, scaled.b, matrix, ridge)


def _definite(normal: NormalSums, ridge: float) -> tuple[np.ndarray, np.ndarray]:
    """(H lifted, the lift), in units in which the diagonal of M is 1 (Eq. L.24)."""
    # M^(1/2) and M^(-1/2). The floor on the eigenvalues keeps the latter finite where columns are alike and M is singular.
    values, vectors = np.linalg.eigh(normal.m)
    values = np.maximum(values, 1e-9 * values[-1])
    root, inverse = (vectors * np.sqrt(values)) @ vectors.T, (vectors / np.sqrt(values)) @ vectors.T
    # Reliabilities rho_j, at most 1 because M - H is positive semidefinite (Eq. L.23), and their directions u_j.
    share, directions = np.linalg.eigh(inverse @ normal.h @ inverse)
    # nu: the expectation of K is 0, so its spectral norm shows how much noise alone moves a reliability.
    noise = float(np.linalg.norm(inverse @ normal.k @ inverse, 2)) if normal.k.any() else 0.0
    # A lifted direction has the curvature of M, of which the lifted part belongs to the initial value.
    lift = np.where(share < max(TRUSTED_RELIABILITY * noise, 1e-6), 1.0 - share, 0.0)
    whole = root @ directions
    lifted = (whole * lift) @ whole.T + ridge * np.eye(len(values))
    return normal.h + lifted, lifted
