"""Probes: problems of at most 2,000 surface points that show, before any stage has run, which parts of the model a scene needs
(docs/method/plan.md). Photographs serve as the light: what a ray from a point meets has been photographed, was saturated, or
lies outside the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.numerics.rows import Rows
from iif_core.requirements.evidence import FOLDS, NOTHING, Evidence, folds_of_blocks, held_out_evidence

MAX_POINTS = 2000
"""Largest number of surface points of a probe."""
STRENGTHS = np.concatenate([[0.0], np.geomspace(0.03, 1000, 16)])
"""Radiance that is tried for saturated surface and for the outside, in units of the median photographed radiance."""
GLOSSES = np.geomspace(0.25, 16, 7)
"""Strengths of a lobe that are tried, in units of a dielectric's."""
LEAST_PAIRS = 8
"""Pairs of photographs that a group needs to be given a lobe."""
LEAST_ROWS = 8
"""Rows below which a probe says nothing."""
_DARKEST = 1e-3  # of the mean light: a point in the dark is no evidence without bound


@dataclass(frozen=True, kw_only=True)
class LightRows(Rows):
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
    """Return (n,) the median of `values` over the rows in `fit` of the same group; NaN where a group has none."""
    names, row = np.unique(group, return_inverse=True)
    # Sorted by group and value, the rows of a group are one run. Its middle one, or the two around the middle, give the median.
    order = np.lexsort((values, row))
    order = order[fit[order]]
    count = np.bincount(row[order], minlength=len(names))
    start = np.cumsum(count) - count
    level = np.full(len(names), np.nan)
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
    if n < LEAST_ROWS or len(np.unique(rows.block)) < FOLDS:
        return {"environment": NOTHING, "emitters": NOTHING}
    fold = folds_of_blocks(rows.block, seed)
    unit = max(float(np.median(rows.radiance)), 1e-30)
    target = np.log(rows.radiance / unit)
    # In units of the median radiance, as is everything below.
    floor = _DARKEST * max(float(np.mean(rows.known)) / unit, 1.0)
    names = {"full": (True, True), "environment": (True, False), "emitters": (False, True)}
    residual = {name: np.full(n, np.nan) for name in names}
    for number in range(FOLDS):
        fit = fold != number
        best = {name: (np.inf, None) for name in names}
        # All pairs of strengths. A model with a fixed strength only looks at pairs in which that strength is 0.
        for s in STRENGTHS if rows.saturated.any() else STRENGTHS[:1]:
            for e in STRENGTHS if rows.escaping.any() else STRENGTHS[:1]:
                light = np.log(np.maximum(rows.known / unit + s * rows.saturated + e * rows.escaping, floor))
                difference = target - light
                # Levels come from the rows of the fit alone, and residuals of all rows are kept: the held-out ones are judged.
                apart = difference - _group_levels(difference, rows.group, fit)
                loss = np.abs(apart[fit]).mean()
                for name, (free_s, free_e) in names.items():
                    if (free_s or s == 0) and (free_e or e == 0) and loss < best[name][0]:
                        best[name] = (loss, apart)
        for name, (_, apart) in best.items():
            residual[name][~fit] = apart[~fit]
    found = {}
    for name, share in (("environment", rows.escaping), ("emitters", rows.saturated)):
        enough = np.count_nonzero(share) >= LEAST_ROWS
        found[name] = held_out_evidence(residual[name], residual["full"], fold, rows.block, rows.group) if enough else NOTHING
    return found


@dataclass(frozen=True, kw_only=True)
class GlossRows(Rows):
    """Pairs of photographs of n points, relative to the mean radiance of the two.

    Attributes:
        radiance: (n, 2) in the two photographs, in (0, 2).
        lobes: (n, 2, J) of what specular lobes of several roughnesses would reflect with the reflectance of a dielectric.
        view: (n, 2) numbers of the photographs; point: (n,) numbers of the points, which have several pairs.
        group: (n,) surface that has one gloss; block: (n,) what errs together.
    """

    radiance: np.ndarray
    lobes: np.ndarray
    view: np.ndarray
    point: np.ndarray
    group: np.ndarray
    block: np.ndarray


def _without_lobe(radiance: np.ndarray, lobes: np.ndarray, strength: np.ndarray | float) -> np.ndarray:
    """Return the differences of what a lobe leaves of the radiance (n, 2): a lobe is at most all of it."""
    left = radiance - np.minimum(strength * lobes, radiance)
    return left[..., 1] - left[..., 0]


def _lobe_of(radiance: np.ndarray, lobes: np.ndarray, offset: np.ndarray, points: int) -> tuple[float, int] | None:
    """Return strength and number of the lobe that explains pairs (n, 2) of some `points` best; None = none is worth its two
    numbers."""
    if len(radiance) < LEAST_PAIRS:
        return None
    loss = np.array(
        [
            [np.abs(_without_lobe(radiance, lobes[:, :, j], k) - offset).sum() for j in range(lobes.shape[2])]
            for k in (0.0, *GLOSSES)
        ]
    )
    g, j = np.unravel_index(np.argmin(loss), loss.shape)
    # Twice the maximised log likelihood of n Laplace residuals is -2 n log(sum |r|): Akaike's criterion for two numbers. The
    # pairs of a point share one of their two photographs, so that points count.
    worth = points * np.log(loss[0, 0] / max(loss[g, j], 1e-30))
    return (float(GLOSSES[g - 1]), int(j)) if g and worth > 2.0 else None


def _view_gains(difference: np.ndarray, view: np.ndarray, count: int, rounds: int = 5) -> np.ndarray:
    """Return (count,) how much brighter each photograph is than others on the same surface: medians, repeated."""
    gain = np.zeros(count)
    for _ in range(rounds):
        rest = difference - (gain[view[:, 1]] - gain[view[:, 0]])
        # Each pair speaks for both of its photographs, with opposite signs, and each of the two takes half of the difference.
        values, owner = np.concatenate([rest, -rest]), np.concatenate([view[:, 1], view[:, 0]])
        order = np.argsort(owner, kind="stable")
        for part in np.split(order, np.flatnonzero(np.diff(owner[order])) + 1):
            gain[owner[part[0]]] += 0.5 * np.median(values[part])
    return gain


def gloss_evidence(rows: GlossRows, seed: int) -> Evidence:
    """Return the evidence for specular lobes (Eq. N.5).

    The simpler model is matte surface: the same radiance from everywhere, up to a gain of each photograph. The larger one adds
    k >= 0 times a lobe, with k and the roughness of the lobe fitted to each group by least absolute residuals.

    Args:
        rows: of the probe.
        seed: of the folds.
    """
    if len(rows.radiance) < LEAST_ROWS or len(np.unique(rows.block)) < FOLDS:
        return NOTHING
    fold = folds_of_blocks(rows.block, seed)
    difference = rows.radiance[:, 1] - rows.radiance[:, 0]
    matte, apart = np.empty((2, len(difference)))
    for number in range(FOLDS):
        fit, held = fold != number, fold == number
        gain = _view_gains(difference[fit], rows.view[fit], int(rows.view.max()) + 1)
        offset = gain[rows.view[:, 1]] - gain[rows.view[:, 0]]
        # Without a lobe both models agree, so a group that has none adds no evidence.
        matte[held] = apart[held] = difference[held] - offset[held]
        for name in np.unique(rows.group[held]):
            own = rows.group == name
            used, judged = own & fit, own & held
            points = len(np.unique(rows.point[used]))
            choice = _lobe_of(rows.radiance[used], rows.lobes[used], offset[used], points)
            if choice is not None:
                strength, j = choice
                apart[judged] = _without_lobe(rows.radiance[judged], rows.lobes[judged][:, :, j], strength) - offset[judged]
    return held_out_evidence(matte, apart, fold, rows.block, rows.group)
