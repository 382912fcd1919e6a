"""Albedo gains of objects that go with the light: the base texture is off by a factor per object."""

from __future__ import annotations

import numpy as np

from .direct import solve_emission
from .rows import EmissionRows, scale_rows

_AHEAD = 4


def object_gains(
    rows: EmissionRows,
    observed: np.ndarray,
    owner: np.ndarray,
    initial: np.ndarray,
    pinned: bool,
    cross: bool = True,
    rounds: int = 15,
    shrink: float = 0.05,
) -> np.ndarray:
    """Albedo gain of each object and channel that goes with the light: (n_objects, 3).

    The base texture is off by a factor per object, and light solved with wrong albedos comes out wrong where an object
    faces one emitter more than another. y = g_o (A E + h) is solved by turns for E (non-negative least squares)
    and for g (a ratio per object, pulled to what all have in common). Where neither an emitter is seen unsaturated nor
    photographed light (h) shares in what is reflected, only the product g E is known: the mean of log g over the rows
    stays 0 then, as the prior has it.

    Args:
        rows, observed, initial, cross: as in `scale_rows` and `solve_emission`.
        owner: (n,) object of each row, -1 = not reflected light (a pixel on an emitter).
        pinned: E has a scale of its own.
        rounds: of the alternation.
        shrink: pull of g to the common one (not `pinned`: to 1) relative to the rows.
    """
    count = int(owner.max(initial=-1)) + 1
    gain = np.ones((count, 3))
    known = owner >= 0
    if not known.any() or rows.groups == 0:
        return gain
    index, own = np.flatnonzero(known), owner[known]
    weight = np.where(rows.lower_bound[known], 0.0, rows.weight[known])
    y, a1, a2 = observed[known], rows.first[known], rows.second[known]
    h1, h2 = y - rows.target[known], y - rows.target_second[known]
    share = np.stack([np.bincount(own, weight[:, c] * y[:, c] ** 2, count) for c in range(3)], 1)
    moved = np.zeros(3)
    for turn in range(rounds):
        of_row = np.ones(observed.shape)
        of_row[index] = gain[own]
        radiance = solve_emission(scale_rows(rows, observed, of_row), initial, cross, max_rounds=5).radiance
        p1 = np.einsum("ngc,gc->nc", a1, radiance) + h1
        p2 = np.einsum("ngc,gc->nc", a2, radiance) + h2
        new = np.ones_like(gain)
        for c in range(3):
            square = p1[:, c] * p2[:, c] if cross else (0.5 * (p1[:, c] + p2[:, c])) ** 2
            top = np.bincount(own, weight[:, c] * y[:, c] * 0.5 * (p1[:, c] + p2[:, c]), count)
            bottom = np.bincount(own, weight[:, c] * square, count)
            floor = 1e-9 * max(float(bottom.max()), 1e-300)
            pull = shrink * np.maximum(bottom, 0.0) + floor
            common = float(np.clip((top.sum() + floor) / max(bottom.sum() + floor, 1e-300), 0.1, 10.0)) if pinned else 1.0
            new[:, c] = np.clip((top + pull * common) / np.maximum(bottom + pull, 1e-300), 0.1, 10.0)
        if not pinned:
            new /= np.exp((share * np.log(new)).sum(0) / np.maximum(share.sum(0), 1e-300))
        done = np.abs(np.log(new / gain)).max() < 1e-3
        if pinned:
            # The level that all objects share settles by a fixed part a turn: now and then to where that leads (Aitken 1926).
            before, moved = moved, (share * np.log(new / gain)).sum(0) / np.maximum(share.sum(0), 1e-300)
            rate = np.clip(np.divide(moved, before, out=np.zeros(3), where=before != 0), 0.0, 0.95)
            if turn % _AHEAD == _AHEAD - 1:
                new = np.clip(new * np.exp(moved * rate / (1.0 - rate)), 0.1, 10.0)
        gain = new
        if done:
            break
    return gain
