"""The paper's objective minimised directly, for a given selection (METHOD 2.3.3-2.3.7, 7c).

With one prediction chosen per segment and property, the reference loss

    (1 / 5N) sum_n sum_ch KL(u_n, b_ref || mu, b)  +  (100 / NK) sum_i n_i R(T_ik)

is minimised by majorisation: the divergence lies below a quadratic of weight `laplace.kl_weight` that touches it at the
present distance, so that

1. T: one linear system per segment; the quartic ||AA' - I||^2 of R by Gauss-Newton (12 unknowns for albedo, 2 and 2);
2. texture: weighted mean of the chosen corrected predictions in each cell;
3. Laplace scale of the cell: closed form.

Each step lowers the loss for the reference scale b_ref of the sweep. b_ref depends on T and is renewed every sweep but its
slope is not followed (METHOD H3: the median's subgradient moves one arbitrary prediction); clamps are not followed
either. The sum of the terms may therefore rise a little in a sweep (by 1e-4 of itself). An optimiser that does follow the
median's slope gets below, by moving predictions that are not chosen: see docs/base.md. Predictions that are not chosen stay
at the identity, where the regulariser has its minimum.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

REGULARISER = 100.0
"""Weight of the identity regulariser against the data term (METHOD 2.3.8)."""


def identity_penalty(affine: NDArray) -> NDArray:
    """R of albedo corrections (..., 3, 4): ||A - I||^2 + ||b||^2 + ||AA' - I||^2 (METHOD 2.3.7)."""
    a, b = affine[..., :3], affine[..., 3]
    eye = np.eye(3)
    return ((a - eye) ** 2).sum((-1, -2)) + (b**2).sum(-1) + ((a @ np.swapaxes(a, -1, -2) - eye) ** 2).sum((-1, -2))


def penalised_affine(gram: NDArray, cross: NDArray, start: NDArray, strength: NDArray, steps: int = 4) -> NDArray:
    """Albedo corrections (S, 3, 4): argmin of 1/2 sum_ch (t' G_ch t - 2 t' c_ch) + strength R(T).

    Args:
        gram: (S, 3, 4, 4) weighted second moments of [v; 1] per output channel; cross: (S, 3, 4) with the target.
        start: (S, 3, 4); strength: (S,) > 0.

    Gauss-Newton on R with halved steps where the objective would rise.
    """
    n = len(gram)
    full = np.zeros((n, 12, 12))
    for c in range(3):
        full[:, 4 * c : 4 * c + 4, 4 * c : 4 * c + 4] = gram[:, c]
    right = cross.reshape(n, 12)
    identity = np.eye(3, 4).ravel()

    def objective(t: NDArray) -> NDArray:
        quadratic = 0.5 * np.einsum("si,sij,sj->s", t, full, t) - (t * right).sum(1)
        return quadratic + strength * identity_penalty(t.reshape(n, 3, 4))

    t = start.reshape(n, 12).astype(np.float64)
    value = objective(t)
    weight = 2 * strength[:, None, None]
    for _ in range(steps):
        residual, jacobian = _quartic_jacobian(t)
        hessian = full + weight * (np.eye(12) + jacobian.swapaxes(1, 2) @ jacobian)
        gradient = np.einsum("sij,sj->si", full, t) - right
        gradient += weight[..., 0] * ((t - identity) + np.einsum("sji,sj->si", jacobian, residual))
        step = np.linalg.solve(hessian, gradient[..., None])[..., 0]
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
    """AA' - I as (S, 9) and its derivative (S, 9, 12) by the entries of T."""
    n = len(t)
    a = t.reshape(n, 3, 4)[:, :, :3]
    residual = (a @ a.swapaxes(1, 2) - np.eye(3)).reshape(n, 9)
    jacobian = np.zeros((n, 3, 3, 3, 4))
    for i in range(3):
        for j in range(3):
            jacobian[:, i, j, i, :3] += a[:, j]
            jacobian[:, i, j, j, :3] += a[:, i]
    return residual, jacobian.reshape(n, 9, 12)


def penalised_gain(gram: NDArray, cross: NDArray, strength: NDArray) -> NDArray:
    """(S, 2) gain and bias: argmin of 1/2 t'Gt - t'c + strength ((g - 1)^2 + h^2)."""
    ridge = 2 * strength[:, None]
    return np.linalg.solve(gram + ridge[..., None] * np.eye(2), (cross + ridge * [1.0, 0.0])[..., None])[..., 0]
