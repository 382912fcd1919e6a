"""Groups that do not shine are recognised by the solve and dropped (METHOD 2.5, 8)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .direct import EmissionSolution, solve_emission
from .rows import EmissionRows


@dataclass(frozen=True)
class PrunedEmission:
    """Result of `prune_groups`: the solution with dropped groups at 0, which were kept, and why not."""

    solution: EmissionSolution
    kept: np.ndarray
    reason: list[str]


def prune_groups(
    rows: EmissionRows,
    initial: np.ndarray,
    area: np.ndarray,
    observed: np.ndarray,
    protected: np.ndarray,
    share: float = 0.01,
    residual_change: float = 1e-3,
    emitted_share: float = 0.3,
    cross: bool = True,
) -> PrunedEmission:
    """Solve, then drop groups that do not shine and solve again (METHOD 8).

    A group goes when it carries less than `share` of the total power area x sum E and the residual grows by less than
    `residual_change` without it (its own pixels apart), or when less than `emitted_share` of what was seen of it is its own
    (it reflects).

    Args:
        rows, initial, cross: as in `solve_emission`.
        area: (G,) m^2; observed: (G, 3) mean radiance seen on the group, 0 = not seen or only bounded.
        protected: (G,) bool, never dropped (environment).
    """
    groups = rows.groups
    kept, reason = np.ones(groups, bool), [""] * groups
    solution = solve_emission(rows, initial, cross)
    for _ in range(groups):
        power = area * solution.radiance.sum(1) * ~protected
        seen = observed.sum(1)
        reflects = kept & ~protected & (seen > 0) & (solution.radiance.sum(1) < emitted_share * seen)
        weak = kept & ~protected & ~reflects & (power < share * max(power.sum(), 1e-300))
        dark = kept & ~protected & (solution.radiance.sum(1) <= 0)
        drop = reflects | dark
        for g in np.flatnonzero(drop):
            reason[g] = "no emission is left for it" if dark[g] else "reflects: little of its brightness is its own"
        if not drop.any() and weak.any():
            trial = _solve_subset(rows, initial, kept & ~weak, cross)
            # A surface that is brighter than its albedo says explains its own pixels; what counts is what it lights.
            elsewhere = rows.first[:, weak].max(axis=(1, 2), initial=0.0) < 1.0
            before, after = (_misfit(rows, s.radiance, elsewhere) for s in (solution, trial))
            if after <= before * (1 + residual_change) + 1e-12:
                drop = weak
                for g in np.flatnonzero(weak):
                    reason[g] = f"below {share:.1%} of the power and not missed"
        if not drop.any():
            break
        kept &= ~drop
        solution = _solve_subset(rows, initial, kept, cross)
    return PrunedEmission(solution, kept, reason)


def _misfit(rows: EmissionRows, radiance: np.ndarray, mask: np.ndarray) -> float:
    """Weighted root sum of squares of some rows; bounds that are met do not count."""
    mean = 0.5 * (rows.first[mask] + rows.second[mask])
    difference = rows.mean_target[mask] - np.einsum("ngc,gc->nc", mean, radiance)
    counted = np.where(rows.lower_bound[mask] & (difference < 0), 0.0, rows.weight[mask])
    return float(np.sqrt((counted * difference**2).sum()))


def _solve_subset(rows: EmissionRows, initial: np.ndarray, kept: np.ndarray, cross: bool) -> EmissionSolution:
    """Solution over all groups, 0 outside `kept`."""
    part = solve_emission(rows.columns(kept), initial[kept], cross)
    radiance, error = np.zeros(initial.shape), np.zeros(initial.shape)
    determined = np.zeros(len(initial))
    radiance[kept], error[kept], determined[kept] = part.radiance, part.error, part.determined
    return replace(part, radiance=radiance, error=error, determined=determined)
