"""Covariance of every fitted number and of the response: a sandwich over clusters of pixels that share errors.

With u_k the gradient of cluster k, H the normal matrix and W the pull, an object's numbers have the covariance

    (H + W)^-1 (sum_k u_k u_k' + W S W) (H + W)^-1,

where S is the spread of the population: the pull is an observation of the population's mean that errs by that much. The
response, shared by all objects, is eliminated as in the descent: cluster k moves it by d_k, and every object by
-(H + W)^-1 C d_k on top of its own move; so do the errors of every pull, and that of the response's own prior. What is not in
it: errors of light and geometry that all clusters of an object share.
"""

from __future__ import annotations

import numpy as np

from iif_core.affines.descent import Arrowhead, Pull, ResponsePrior
from iif_core.affines.pixels import Pixels, Terms
from iif_core.affines.problem import PARAMETERS


def sandwich(
    px: Pixels, terms: Terms, system: Arrowhead, free: np.ndarray, pull: Pull, prior: ResponsePrior
) -> tuple[np.ndarray, np.ndarray]:
    """(O, 16, 16) of the objects and (P, P) of the response.

    Args:
        system: undamped, at the solution; free: (O, 16).
    """
    size = terms.scores.shape[1] - PARAMETERS
    filled = np.diff(px.starts) > 0
    owner = np.repeat(np.arange(px.n_objects), np.diff(px.first))
    clusters = np.bincount(owner[filled], minlength=px.n_objects)
    own = np.where(free[owner], terms.scores[:, :PARAMETERS], 0.0)
    mean = (
        np.stack([np.bincount(owner, own[:, i], px.n_objects) for i in range(PARAMETERS)], 1) / np.maximum(clusters, 1)[:, None]
    )
    centred = np.where(filled[:, None], own - mean[owner], 0.0)
    # A cluster's own pull on the fit makes its score too small: the usual correction, bounded for few clusters.
    numbers = free.sum(1)
    left = np.maximum(clusters - numbers, 0.5 * clusters)
    swell = np.sqrt(clusters / np.maximum(left, 1))
    centred *= swell[owner][:, None]
    alone = np.einsum("kij,kj->ki", system.inverse[owner], centred)
    moved = np.zeros((len(owner), size))
    if size and system.schur.any():
        reduced = terms.scores[:, PARAMETERS:] - np.einsum("kip,ki->kp", system.through[owner], own)
        moved = (reduced * swell[owner][:, None]) @ system.schur
    fitted = bool(size and system.schur.any())
    through, schur = system.through, system.schur
    leaned = np.zeros((px.n_objects, PARAMETERS, PARAMETERS))
    if pull.scatter is not None:
        leaned = np.where(free[:, :, None] & free[:, None, :], pull.scatter, 0.0)
    # what each object's pull moves the response by
    swayed = schur @ through.transpose(0, 2, 1) @ leaned @ through @ schur
    total = moved.T @ moved + swayed.sum(0) + (schur @ prior.scatter @ schur if fitted else 0.0)
    out = np.zeros((px.n_objects, PARAMETERS, PARAMETERS))
    for o in np.flatnonzero(clusters):
        part = slice(px.first[o], px.first[o + 1])
        d = moved[part]
        p = alone[part] - d @ through[o].T
        both = system.inverse[o] + through[o] @ schur @ through[o].T
        others = total - d.T @ d - swayed[o]
        out[o] = p.T @ p + both @ leaned[o] @ both + through[o] @ others @ through[o].T
    return out, total
