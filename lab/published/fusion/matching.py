"""Affine maps that minimise the paper's loss for a given selection (lab/docs/published.md#distribution, Eqs. F.34, F.35).

Each step lowers the loss for the reference scale b_ref of the sweep, which is computed again every sweep. Neither its derivative
(docs/method/numerics.md#median-subgradient) nor clamps are followed, so the loss may rise a little between sweeps.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iif_core.reflectance.material import IDENTITY

REGULARISER = 100.0
"""Weight of the identity regulariser relative to the data term (Eq. F.16)."""


def identity_penalty(affine: NDArray) -> NDArray:
    """Return the regulariser of albedo maps (..., 3, 4), ||A - I||^2 + ||t||^2 + ||AA' - I||^2 (Eq. F.14)."""
    a, b = affine[..., :3], affine[..., 3]
    eye = np.eye(3)
    return ((a - eye) ** 2).sum((-1, -2)) + (b**2).sum(-1) + ((a @ np.swapaxes(a, -1, -2) - eye) ** 2).sum((-1, -2))


def penalised_affine(gram: NDArray, cross: NDArray, start: NDArray, strength: NDArray, steps: int = 4) -> NDArray:
    """Fit albedo maps: argmin of 1/2 sum_ch (t' G_ch t - 2 t' c_ch) + strength R(T), by Gauss-Newton on R (Eq. F.35).

    A step is halved up to three times where the objective would rise, and not taken if it still does.

    Args:
        gram: (S, 3, 4, 4) weighted second moments of [v; 1] per output channel.
        cross: (S, 3, 4) products with the target.
        start: (S, 3, 4) maps to start from; strength: (S,) > 0; steps: number of Gauss-Newton steps.

    Returns:
        (S, 3, 4) float64.
    """
    n = len(gram)
    # Block-diagonal matrix of the data term: the output channels couple through the regulariser alone.
    full = np.zeros((n, 12, 12))
    for c in range(3):
        full[:, 4 * c : 4 * c + 4, 4 * c : 4 * c + 4] = gram[:, c]
    right = cross.reshape(n, 12)
    identity = IDENTITY[:12]

    def objective(t: NDArray) -> NDArray:
        quadratic = 0.5 * np.einsum("si,sij,sj->s", t, full, t) - (t * right).sum(1)
        return quadratic + strength * identity_penalty(t.reshape(n, 3, 4))

    t = start.reshape(n, 12).astype(np.float64)
    value = objective(t)
    weight = 2 * strength[:, None, None]  # (S, 1, 1); the derivative of a square has a factor 2
    for _ in range(steps):
        # -------- Gauss-Newton matrix and gradient (Eq. F.35) --------
        # J'J replaces the second derivative of ||AA' - I||^2, which may be indefinite. The matrix is then at least 2 strength
        # times the identity, so the solve is well posed and the step descends.
        residual, jacobian = _quartic_jacobian(t)
        hessian = full + weight * (np.eye(12) + jacobian.swapaxes(1, 2) @ jacobian)
        gradient = np.einsum("sij,sj->si", full, t) - right
        gradient += weight[..., 0] * ((t - identity) + np.einsum("sji,sj->si", jacobian, residual))
        step = np.linalg.solve(hessian, gradient[..., None])[..., 0]
        # -------- step length of each segment: the objective is quartic, and a full step may overshoot --------
        length = np.ones(n)
        for _ in range(4):
            trial = t - length[:, None] * step
            rises = objective(trial) > value
            if not rises.any():
                break
            length = np.where(rises, 0.5 * length, length)
        better = objective(trial) <= value
        t = np.where(better[:, None], trial, t)
        value = objective(t)
    return t.reshape(n, 3, 4)


def _quartic_jacobian(t: NDArray) -> tuple[NDArray, NDArray]:
    """AA' - I as (S, 9) and its derivative (S, 9, 12) with respect to the entries of T."""
    n = len(t)
    a = t.reshape(n, 3, 4)[:, :, :3]
    # All nine entries, so that off-diagonal ones count twice, as they do in the Frobenius norm.
    residual = (a @ a.swapaxes(1, 2) - np.eye(3)).reshape(n, 9)
    jacobian = np.zeros((n, 3, 3, 3, 4))
    # (AA')_ij = A_i . A_j with the rows of A: its derivative is A_j in row i and A_i in row j, and both add up for i = j.
    for i in range(3):
        for j in range(3):
            jacobian[:, i, j, i, :3] += a[:, j]
            jacobian[:, i, j, j, :3] += a[:, i]
    return residual, jacobian.reshape(n, 9, 12)


def penalised_gain(gram: NDArray, cross: NDArray, strength: NDArray) -> NDArray:
    """Fit gain and offset (S, 2): argmin of 1/2 t'Gt - t'c + strength ((g - 1)^2 + o^2) (Eq. F.34)."""
    ridge = 2 * strength[:, None]
    return np.linalg.solve(gram + ridge[..., None] * np.eye(2), (cross + ridge * [1.0, 0.0])[..., None])[..., 0]
