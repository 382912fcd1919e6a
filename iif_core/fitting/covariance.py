"""Covariance of every fitted number and of the response: a sandwich over clusters of pixels that share errors.

With u_k the gradient of cluster k, H the normal matrix, W the pull and B = (H + W)^-1, an object's numbers have the covariance

    B (sum_k v_k v_k' + W S W) B,    v_k = (1 - H_k B)^(-1/2) u_k,

where S is the covariance of the pull's centre: the pull is an observation that errs by that much. A cluster has pulled the fit
towards itself, which makes its gradient too small; v_k has the size that errors in proportion to H_k would have had (Bell and
McCaffrey 2002, "CR2"). What the few clusters of an object say about their own scatter is uncertain too: the first term is larger
by (1 + 1 / (2 nu))^2, so that one standard deviation either way holds Student's t of nu degrees of freedom 68 % of the time;
nu = (sum_k l_k)^2 / sum_k l_k^2, l_k = trace(H_k B).

The response, shared by all objects, is eliminated as in the descent: cluster k moves it by d_k, and every object by
-B (C - W c) d_k on top of its own move, c how the pull's centre moves with the response; so do the errors of every pull, and that
of the response's own prior. What is not in it: errors of light and geometry that all clusters of an object share.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from iif_core.fitting.descent import Arrowhead, Pull, ResponsePrior, State
from iif_core.fitting.pixels import Pixels, evaluate
from iif_core.fitting.problem import PARAMETERS, FitOptions
from iif_core.fitting.tone import Tone

_CLUSTERS = 1000  # whose systems are held at once
_LEVER = 0.95  # largest share that one cluster is taken to have in a direction


def sandwich(
    px: Pixels, state: State, system: Arrowhead, pull: Pull, prior: ResponsePrior, tone: Tone, opt: FitOptions
) -> tuple[np.ndarray, np.ndarray]:
    """(O, 16, 16) of the objects and (P, P) of the response.

    Args:
        system: undamped, at the solution `state`; tone: there.
    """
    free, through, schur = state.free, system.through, system.schur
    if pull.drift is not None:
        through = through - system.inverse @ pull.drift
    owner = np.repeat(np.arange(px.n_objects), np.diff(px.first))
    alone, reduced = np.zeros((len(owner), PARAMETERS)), np.zeros((len(owner), len(schur)))
    lever = np.zeros(len(owner))
    for part, scores, h in _clusters(px, state, tone, opt):
        alone[part], reduced[part], lever[part] = _grown(scores, h, system.inverse, system.coupling, free, owner[part])
    moved = reduced @ schur
    leaned = np.zeros((px.n_objects, PARAMETERS, PARAMETERS))
    if pull.scatter is not None:
        leaned = np.where(free[:, :, None] & free[:, None, :], pull.scatter, 0.0)
    # what each object's pull moves the response by
    swayed = schur @ through.transpose(0, 2, 1) @ leaned @ through @ schur
    total = moved.T @ moved + swayed.sum(0) + schur @ prior.scatter @ schur
    out = np.zeros((px.n_objects, PARAMETERS, PARAMETERS))
    for o in np.flatnonzero(np.diff(px.first)):
        part = slice(px.first[o], px.first[o + 1])
        d = moved[part]
        p = alone[part] - d @ through[o].T
        both = system.inverse[o] + through[o] @ schur @ through[o].T
        others = total - d.T @ d - swayed[o]
        few = (lever[part] ** 2).sum() / max(lever[part].sum() ** 2, 1e-100)  # 1 / nu
        out[o] = (1.0 + 0.5 * few) ** 2 * p.T @ p + both @ leaned[o] @ both + through[o] @ others @ through[o].T
    return out, total


def _clusters(px: Pixels, state: State, tone: Tone, opt: FitOptions) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
    """Clusters of some objects at a time: which, their gradients (c, 16 + P) and systems (c, 16 + P, 16 + P)."""
    low = 0
    while low < px.n_objects:
        high = max(low + 1, int(np.searchsorted(px.first, px.first[low] + _CLUSTERS, side="right")) - 1)
        some = px.only(np.arange(low, high))
        count = len(some.starts) - 1
        each = np.repeat(np.arange(count), np.diff(some.starts))
        affine = np.repeat(state.affine[low:high], np.diff(some.first), 0)
        terms = evaluate(replace(some, obj=each, first=np.arange(count + 1)), affine, tone, opt, True)
        yield slice(px.first[low], px.first[high]), terms.g, terms.h
        low = high


def _grown(
    scores: np.ndarray, h: np.ndarray, inverse: np.ndarray, coupling: np.ndarray, free: np.ndarray, owner: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """B v_k (c, 16), the cluster's gradient of the reduced response (c, P) and its l_k (c,).

    B = R R, M = R H_k R: B v_k = R (1 - M)^(-1/2) R u_k. The response's part of the gradient has lost C_k' R g(M) R u_k with
    g(x) = ((1 - x)^(-1/2) - 1) / x.
    """
    values, vectors = np.linalg.eigh(inverse)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]) @ vectors.transpose(0, 2, 1)
    own = np.where(free[owner], scores[:, :PARAMETERS], 0.0)
    r = root[owner]
    lever, basis = np.linalg.eigh(r @ h[:, :PARAMETERS, :PARAMETERS] @ r)
    lever = np.clip(lever, 1e-9, _LEVER)
    grow = 1.0 / np.sqrt(1.0 - lever)
    inner = np.einsum("kji,kj->ki", basis, np.einsum("kij,kj->ki", r, own))

    def out(factor: np.ndarray) -> np.ndarray:
        return np.einsum("kij,kj->ki", r, np.einsum("kij,kj->ki", basis, factor * inner))

    lost = np.einsum("kip,ki->kp", h[:, :PARAMETERS, PARAMETERS:], out((grow - 1.0) / lever))
    alone = out(grow)
    reduced = scores[:, PARAMETERS:] + lost - np.einsum("kip,ki->kp", coupling[owner], alone)
    return alone, reduced, lever.sum(1)
