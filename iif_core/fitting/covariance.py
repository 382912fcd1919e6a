"""Covariance of every fitted number and of the response: a sandwich over clusters of pixels that share errors (Eq. M.38 to M.40).

Clusters are corrected for having drawn the fit towards themselves (Bell and McCaffrey 2002, "CR2"). Errors of light and geometry
that all clusters of an object share are not in it.
"""

from __future__ import annotations

import numpy as np

from iif_core.fitting.descent import Arrowhead, DescentState, GaussianPrior, ResponsePrior
from iif_core.fitting.pixels import Pixels, evaluate_clusters
from iif_core.fitting.problem import FitOptions
from iif_core.fitting.tone import Tone
from iif_core.reflectance.material import NUMBERS

_MAX_LEVERAGE = 0.95
"""Largest share of one cluster in a direction (docs/method/numerics.md#leverage-near-one)."""


def sandwich_covariance(
    px: Pixels,
    state: DescentState,
    system: Arrowhead,
    prior: GaussianPrior,
    curve_prior: ResponsePrior,
    tone: Tone,
    opt: FitOptions,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariances of the objects' numbers (O, 16, 16) and of the response (P, P).

    Args:
        px: pixels; state: the solution; system: undamped, at the solution.
        prior: of the objects; curve_prior: of the response; tone: curve at the solution; opt: options.

    Returns:
        Both float64; 0 for numbers that were not free.
    """
    free, own_share, schur = state.free, system.by_response, system.schur
    # T_o of Eq. M.40: an object follows the response also through the centre of its prior. What the error of that centre does to
    # the response goes through B C alone: the response was fitted with the centre held.
    by_response = own_share if prior.drift is None else own_share - system.inverse @ prior.drift

    # -------- what each cluster k moves: B v_k, and the response by d_k --------
    # Errors of different clusters are taken as independent, so their products add up.
    owner = np.repeat(np.arange(px.n_objects), np.diff(px.first))
    alone, reduced = np.zeros((len(owner), NUMBERS)), np.zeros((len(owner), len(schur)))
    leverage = np.zeros(len(owner))
    for part, scores, h in evaluate_clusters(px, state.affine, tone, opt):
        corrected = _correct_leverage(scores, h, system.inverse, system.coupling, free, owner[part])
        alone[part], reduced[part], leverage[part] = corrected
    moved = reduced @ schur

    # -------- covariance of the response: clusters, priors of the objects, prior of the response (Eq. M.40) --------
    prior_scatter = np.zeros((px.n_objects, NUMBERS, NUMBERS))
    if prior.scatter is not None:
        prior_scatter = np.where(free[:, :, None] & free[:, None, :], prior.scatter, 0.0)
    # Covariance that the prior of each object causes in the response.
    of_priors = schur @ own_share.transpose(0, 2, 1) @ prior_scatter @ own_share @ schur
    total = moved.T @ moved + of_priors.sum(0) + schur @ curve_prior.scatter @ schur

    # -------- covariance of each object: its clusters, its prior, and the response as everything else moves it --------
    out = np.zeros((px.n_objects, NUMBERS, NUMBERS))
    for o in np.flatnonzero(np.diff(px.first)):
        part = slice(px.first[o], px.first[o + 1])
        d = moved[part]
        # The object's clusters move it directly and through the response. Both movements are added before they are multiplied,
        # and `others` leaves out what the same clusters and the object's prior do to the response.
        p = alone[part] - d @ by_response[o].T
        both = system.inverse[o] + by_response[o] @ schur @ own_share[o].T
        others = total - d.T @ d - of_priors[o]
        # Eq. M.39: few clusters say little about their own scatter, so the covariance is enlarged.
        few = (leverage[part] ** 2).sum() / max(leverage[part].sum() ** 2, 1e-100)  # 1 / nu
        out[o] = (1.0 + 0.5 * few) ** 2 * p.T @ p + both @ prior_scatter[o] @ both.T + by_response[o] @ others @ by_response[o].T
    i = np.arange(NUMBERS)
    out[:, i, i] = np.maximum(out[:, i, i], 0.0)  # products of matrices round variances of nothing below 0
    return out, total


def _correct_leverage(
    scores: np.ndarray, h: np.ndarray, inverse: np.ndarray, coupling: np.ndarray, free: np.ndarray, owner: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return B v_k (c, 16), the gradient of the reduced response (c, P) and l_k (c,) of each cluster.

    With B = R R and M = R H_k R, B v_k = R (1 - M)^(-1/2) R u_k. The part of the gradient that belongs to the response gains
    C_k' R g(M) R u_k with g(x) = ((1 - x)^(-1/2) - 1) / x.
    """
    # R, the symmetric root of B. R H_k R has the eigenvalues of H_k B and is symmetric, so its eigenvectors are orthogonal.
    values, vectors = np.linalg.eigh(inverse)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]) @ vectors.transpose(0, 2, 1)
    own = np.where(free[owner], scores[:, :NUMBERS], 0.0)
    r = root[owner]
    leverage, basis = np.linalg.eigh(r @ h[:, :NUMBERS, :NUMBERS] @ r)
    # The lower limit keeps g(x) from 0 / 0; H_k of two halves may also have negative eigenvalues.
    leverage = np.clip(leverage, 1e-9, _MAX_LEVERAGE)
    enlarge = 1.0 / np.sqrt(1.0 - leverage)
    inner = np.einsum("kji,kj->ki", basis, np.einsum("kij,kj->ki", r, own))

    def out(factor: np.ndarray) -> np.ndarray:
        return np.einsum("kij,kj->ki", r, np.einsum("kij,kj->ki", basis, factor * inner))

    lost = np.einsum("kip,ki->kp", h[:, :NUMBERS, NUMBERS:], out((enlarge - 1.0) / leverage))
    alone = out(enlarge)
    reduced = scores[:, NUMBERS:] + lost - np.einsum("kip,ki->kp", coupling[owner], alone)
    return alone, reduced, leverage.sum(1)
