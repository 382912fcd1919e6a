"""Probes: problems of at most 2,000 surface points that show, before any stage has run, which parts of the model a scene needs
(docs/method/plan.md). Photographs serve as the light: what a ray from a point meets has been photographed, was saturated, or
lies outside the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.requirements.evidence import FOLDS, NOTHING, Evidence, folds_of_blocks, held_out_evidence

MAX_POINTS = 2000
"""Largest number of surface points of a probe."""
STRENGTHS = np.concatenate([[0.0], np.geomspace(0.03, 1000, 16)])
"""Radiance that is tried for saturated surface and for the outside, in units of the median photographed radiance."""
GLOSSES = np.geomspace(0.25, 16, 7)
"""Strengths of a lobe that are tried, in units of a dielectric's."""
LEAST_PAIRS = 8
"""Pairs of photographs that a group needs to be given a lobe."""
_DARKEST = 1e-6  # of the mean light, which keeps the logarithm of a point without light finite


@dataclass(frozen=True)
class LightRows:
    """What n points and the rays from them show, channels averaged.

    Attributes:
        radiance: (n,) of the points, above 0.
        known: (n,) mean photographed radiance over the cosine-distributed rays of a point, 0 for rays that meet none.
        saturated: (n,) share of the rays that meet surface which was seen saturated only.
        escaping: (n,) share of the rays that leave the mesh.
        group: (n,) surface that has one level: an object, or a piece of one.
        block: (n,) what errs together.
    """

    radiance: np.ndarray
    known: np.ndarray
    saturated: np.ndarray
    escaping: np.ndarray
    group: np.ndarray
    block: np.ndarray


def _group_levels(values: np.ndarray, group: np.ndarray, fit: np.ndarray) -> np.ndarray:
    """Return (n,) the median of `values` over the rows in `fit` of the same group; the overall one where a group has none."""
    names, row = np.unique(group, return_inverse=True)
    order = np.lexsort((values, row))
    order = order[fit[order]]
    count = np.bincount(row[order], minlength=len(names))
    start = np.cumsum(count) - count
    level = np.full(len(names), np.median(values[fit]) if fit.any() else 0.0)
    some = np.flatnonzero(count)
    low, high = order[start[some] + (count[some] - 1) // 2], order[start[some] + count[some] // 2]
    level[some] = 0.5 * (values[low] + values[high])
    return level[row]


def light_evidence(rows: LightRows, seed: int) -> dict[str, Evidence]:
    """Return the evidence for light from outside and for emitters (Eq. N.4).

    log L = log a(group) + log(known + s saturated + e escaping) + r.  `environment` compares e = 0 with a free e, `emitters`
    s = 0 with a free s, the other strength free in both; all are fitted to one fold by least absolute residuals on a grid.

    Args:
        rows: of the probe.
        seed: of the folds.

    Returns:
        `environment`, `emitters` -> evidence.
    """
    n = len(rows.radiance)
    if n < 8:
        return {"environment": NOTHING, "emitters": NOTHING}
    fold = folds_of_blocks(rows.block, seed)
    unit = max(float(np.median(rows.radiance)), 1e-30)
    target = np.log(rows.radiance / unit)
    floor = _DARKEST * max(float(np.mean(rows.known)) / unit, 1.0)
    names = {"full": (True, True), "environment": (True, False), "emitters": (False, True)}
    residual = {name: np.full(n, np.nan) for name in names}
    for number in range(FOLDS):
        fit = fold != number
        best = {name: (np.inf, None) for name in names}
        for s in STRENGTHS if rows.saturated.any() else STRENGTHS[:1]:
            for e in STRENGTHS if rows.escaping.any() else STRENGTHS[:1]:
                light = np.log(np.maximum(rows.known / unit + s * rows.saturated + e * rows.escaping, floor))
                difference = target - light
                apart = difference - _group_levels(difference, rows.group, fit)
                loss = np.abs(apart[fit]).mean()
                for name, (free_s, free_e) in names.items():
                    if (free_s or s == 0) and (free_e or e == 0) and loss < best[name][0]:
                        best[name] = (loss, apart)
        for name, (_, apart) in best.items():
            residual[name][~fit] = apart[~fit]
    return {
        name: held_out_evidence(residual[name], residual["full"], fold, rows.block, rows.group)
        for name in ("environment", "emitters")
    }


@dataclass(frozen=True)
class GlossRows:
    """Pairs of photographs of n points, relative to the mean radiance of the two.

    Attributes:
        radiance: (n, 2) in the two photographs, in (0, 2).
        lobes: (n, 2, J) of what specular lobes of several roughnesses would reflect with the reflectance of a dielectric.
        view: (n, 2) numbers of the photographs.
        group: (n,) surface that has one gloss; block: (n,) what errs together.
    """

    radiance: np.ndarray
    lobes: np.ndarray
    view: np.ndarray
    group: np.ndarray
    block: np.ndarray


def _without_lobe(radiance: np.ndarray, lobes: np.ndarray, strength: np.ndarray | float) -> np.ndarray:
    """Return the differences of what a lobe leaves of the radiance (n, 2): a lobe is at most all of it."""
    left = radiance - np.minimum(strength * lobes, radiance)
    return left[..., 1] - left[..., 0]


def _lobe_of(radiance: np.ndarray, lobes: np.ndarray, offset: np.ndarray) -> tuple[float, int] | None:
    """Return strength and number of the lobe that explains pairs (n, 2) best, None = none is worth its two numbers."""
    if len(radiance) < LEAST_PAIRS:
        return None
    loss = np.array(
        [
            [np.abs(_without_lobe(radiance, lobes[:, :, j], k) - offset).sum() for j in range(lobes.shape[2])]
            for k in (0.0, *GLOSSES)
        ]
    )
    g, j = np.unravel_index(np.argmin(loss), loss.shape)
    # Twice the maximised log likelihood of Laplace residuals is -2 n log(sum |r|): Akaike's criterion for two numbers.
    worth = len(radiance) * np.log(loss[0, 0] / max(loss[g, j], 1e-30))
    return (float(GLOSSES[g - 1]), int(j)) if g and worth > 2.0 else None


def _view_offsets(difference: np.ndarray, view: np.ndarray, rounds: int = 5) -> np.ndarray:
    """Return (n,) how much brighter the second photograph of each pair is on the whole: robust gains of the views."""
    gain = np.zeros(int(view.max()) + 1)
    for _ in range(rounds):
        rest = difference - (gain[view[:, 1]] - gain[view[:, 0]])
        values, owner = np.concatenate([rest, -rest]), np.concatenate([view[:, 1], view[:, 0]])
        order = np.argsort(owner, kind="stable")
        for part in np.split(order, np.flatnonzero(np.diff(owner[order])) + 1):
            gain[owner[part[0]]] += 0.5 * np.median(values[part])
    return gain[view[:, 1]] - gain[view[:, 0]]


def gloss_evidence(rows: GlossRows, seed: int) -> tuple[Evidence, dict[int, float]]:
    """Return the evidence for specular lobes, and what is gained on each group (Eq. N.5).

    The simpler model is a matte surface: the same radiance from everywhere. The larger one adds k >= 0 times a lobe, with k and
    the roughness of the lobe fitted to each group by least absolute residuals.

    Args:
        rows: of the probe.
        seed: of the folds.

    Returns:
        The evidence, and nats a group; groups that are seen too little are absent.
    """
    n = len(rows.radiance)
    if n < 8:
        return NOTHING, {}
    fold = folds_of_blocks(rows.block, seed)
    matte = rows.radiance[:, 1] - rows.radiance[:, 0]
    offset = _view_offsets(matte, rows.view)
    matte = matte - offset
    apart = matte.copy()
    for name in np.unique(rows.group):
        own = rows.group == name
        for number in range(FOLDS):
            fit, held = own & (fold != number), own & (fold == number)
            choice = _lobe_of(rows.radiance[fit], rows.lobes[fit], offset[fit])
            if choice is not None:
                strength, j = choice
                apart[held] = _without_lobe(rows.radiance[held], rows.lobes[held][:, :, j], strength) - offset[held]
    evidence = held_out_evidence(matte, apart, fold, rows.block, rows.group)
    scale = max(float(np.abs(matte).mean()), 1e-6)
    gain = (np.abs(matte) - np.abs(apart)) / scale
    return evidence, {int(name): float(gain[rows.group == name].sum()) for name in np.unique(rows.group)}
