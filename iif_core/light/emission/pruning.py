"""Groups that only reflect are recognised by the solve and dropped (docs/method/light.md#groups-that-only-reflect, Eq. L.31).

A dropped group continues to light the scene with the radiance that was seen on it, which the radiance cache will hold.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iif_core.light.emission.direct import EmissionPrior
from iif_core.light.emission.rows import EmissionRows, light_of

CERTAIN_EXCESS = 2.0
"""Brightness relative to a white surface from which a group shines for certain; more than 1, since the light that the white
surface would reflect is known only as well as the other emitters."""
CERTAIN_EXCESS_OPEN = 8.0
"""The same where much of the light comes through large openings of the mesh: surface below a lamp that no camera sees is much
brighter than a white surface under the mean light."""
POSSIBLE_EXCESS = 1.0
"""The same from which a dropped group may shine after all: its light may have been attributed to other groups, and saturated
surface shows only a bound of its brightness."""
MAX_RESIDUAL_GROWTH = 0.03
"""Growth of the residual from which the scene needs a group; with albedos that are only predicted, one more free column always
explains something."""
SIGNIFICANT = 2.0
"""Standard errors of its radiance that an emitter must exceed."""
_TRIAL_ROUNDS = 6  # of re-weighting in a trial, which only says which groups are needed


@dataclass(frozen=True)
class WhiteSurface:
    """What groups show, and what a white diffuse surface would show in their place.

    Attributes:
        seen: (G, 3) radiance seen on each group, 0 = not seen.
        matrix: (G, G, 3) mean of A over the pixels of each group (first axis) if they were white.
        cached: (G, 3) the same of h.
        coverage: (G, G) mean share of the pixels of each group (first axis) in which they see each group; None = themselves.
    """

    seen: np.ndarray
    matrix: np.ndarray
    cached: np.ndarray
    coverage: np.ndarray | None = None

    def shown(self, radiance: np.ndarray) -> np.ndarray:
        """Return (G, 3) what each group itself shows: without the light of others that share its pixels."""
        if self.coverage is None:
            return self.seen
        own = np.diag(self.coverage)
        beside = (self.coverage - np.diag(own)) @ radiance
        return np.where(own[:, None] > 0, np.maximum(self.seen - beside, 0.0) / np.maximum(own, 1e-9)[:, None], self.seen)

    def excess(self, radiance: np.ndarray) -> np.ndarray:
        """Return (G,) brightness of each group relative to the white surface under the light of the others (Eq. L.31); infinite
        without light, 0 where the group was not seen."""
        # A group does not light itself.
        others = self.matrix * (1.0 - np.eye(len(self.seen)))[:, :, None]
        white = (np.einsum("ghc,hc->gc", others, radiance) + self.cached).sum(1)
        seen = self.shown(radiance).sum(1)
        return np.where(seen > 0, np.divide(seen, white, out=np.full(len(seen), np.inf), where=white > 0), 0.0)


@dataclass(frozen=True)
class PrunedEmission:
    """Result of `prune_groups`: radiance (G, 3) with dropped groups at 0, which were kept, why others were dropped, `excess` (G,)
    of the last round in which a group took part, and `power` (G,), the share of the light that its family would give if it
    shone as bright as it was seen."""

    radiance: np.ndarray
    kept: np.ndarray
    reason: list[str]
    excess: np.ndarray
    power: np.ndarray

    def may_shine(self, certain: float, share: float) -> np.ndarray:
        """Return the groups, (G,) bool, among which emitters are to be looked for: those that were kept, those that are brighter
        than `certain` white surfaces, and those brighter than one whose light would be at least a `share` of all."""
        doubtful = (self.excess >= POSSIBLE_EXCESS) & (self.power >= share)
        return self.kept | (self.excess >= certain) | doubtful


def prune_groups(
    rows: EmissionRows,
    prior: EmissionPrior,
    family: np.ndarray,
    white: WhiteSurface,
    elsewhere: np.ndarray,
    protected: np.ndarray,
    share: float = 0.01,
    certain: float = CERTAIN_EXCESS,
) -> PrunedEmission:
    """Solve, then drop groups that do not shine, the least credible first, and solve again.

    A group is dropped when no emission is left for it; and, unless the residual elsewhere grows by more than
    `MAX_RESIDUAL_GROWTH` without it (Eq. L.32), when it is not brighter than `certain` white surfaces, or when its family gives
    less than `share` of the light that the other rows show.

    Args:
        rows: the system; prior: of the groups.
        family: (G,) int, groups of one object; a curtain is one lamp however many folds it has.
        white: what the groups show, and what a white surface would show.
        elsewhere: (n,) bool, rows that are not a group's own pixels: what its light does, not what it looks like.
        protected: (G,) bool, never dropped (environment).
        share: of the light on the rows `elsewhere`.
        certain: brightness relative to a white surface from which a group shines for certain.

    Returns:
        The radiance of the groups that remain.
    """
    members = np.unique(family, return_inverse=True)[1]
    kept, reason = np.ones(rows.groups, bool), [""] * rows.groups
    excess, missed, singly = np.full(rows.groups, np.inf), np.zeros(rows.groups, bool), False
    possible = np.bincount(members, _light_shares(rows, white.seen, elsewhere))[members]
    radiance = prior.radiance(rows, _TRIAL_ROUNDS)
    while True:
        # -------- which groups are open to doubt --------
        emission = radiance.sum(1)
        power = np.bincount(members, _light_shares(rows, radiance, elsewhere))[members]
        # A dropped group lights the scene with what was seen of it.
        shown = np.where(kept[:, None], radiance, white.seen)
        excess = np.where(kept, white.excess(shown), excess)
        dark = kept & ~protected & (emission <= 0)
        open_ = kept & ~protected & ~dark & ~missed
        reflecting, weak = open_ & (excess < certain), open_ & (power < share)

        # -------- which of them to try --------
        if dark.any():
            drop = dark
        elif reflecting.any():
            # The least credible first: the light of a false emitter makes its neighbours look like reflectors.
            drop = reflecting & (excess <= 1.1 * excess[reflecting].min())
        elif weak.any():
            drop = weak
        else:
            break
        if singly and not dark.any():
            # One by one, the weakest first.
            drop &= power <= power[drop].min()

        # -------- solve without them, and drop them unless they are missed (Eq. L.32) --------
        trial = _solve_subset(rows, prior, kept & ~drop, white.seen)
        before = _misfit(rows, shown, elsewhere)
        after = _misfit(rows, np.where((kept & ~drop)[:, None], trial, white.seen), elsewhere)
        if not dark.any() and after > before * (1 + MAX_RESIDUAL_GROWTH) + 1e-12:
            # One lamp that is needed must not keep the groups that were tried together with it.
            if drop.sum() > 1 and not singly:
                singly = True
            else:
                missed |= drop
            continue
        for g in np.flatnonzero(drop):
            reason[g] = _reason(dark[g], bool(reflecting[g]), excess[g], power[g])
        kept, radiance = kept & ~drop, trial
    return PrunedEmission(radiance, kept, reason, excess, possible)


def _reason(dark: bool, reflecting: bool, excess: float, power: float) -> str:
    if dark:
        return "no emission is left for it"
    if reflecting:
        if excess > 1.0:
            return f"no clear lamp: {excess:.1f} times as bright as a white surface in its place, and not missed"
        white = f"{1 / excess:.0%} of" if excess > 0.1 else "more than ten times"
        return f"reflects: a white surface in its place would have {white} its brightness"
    return f"{power:.2%} of the light, and not missed"


def _light_shares(rows: EmissionRows, radiance: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(G,) share of each group in the light that some rows show: weighted means of A_g E_g and y over their product with y."""
    weight = np.where(rows.lower_bound[mask], 0.0, rows.weight[mask]) * rows.observed[mask]
    given = np.einsum("nc,ngc->gc", weight, rows.matrices[:, mask].mean(0)) * radiance
    return given.sum(1) / max(float((weight * rows.observed[mask]).sum()), 1e-300)


def _misfit(rows: EmissionRows, radiance: np.ndarray, mask: np.ndarray) -> float:
    """Weighted root sum of squares of some rows; bounds that are met do not count."""
    mean = rows.matrices[:, mask].mean(0)
    difference = rows.mean_target[mask] - light_of(mean, radiance)
    counted = np.where(rows.lower_bound[mask] & (difference < 0), 0.0, rows.weight[mask])
    return float(np.sqrt((counted * difference**2).sum()))


def _solve_subset(rows: EmissionRows, prior: EmissionPrior, kept: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Radiance of all groups (G, 3), 0 outside `kept`; the others light the scene with what they show, as the cache will."""
    radiance = np.zeros(prior.initial.shape)
    radiance[kept] = prior.only(kept).radiance(without_groups(rows, kept, shown), _TRIAL_ROUNDS)
    return radiance


def without_groups(rows: EmissionRows, kept: np.ndarray, shown: np.ndarray) -> EmissionRows:
    """Return the system of the `kept` groups (G,) bool; the light of the others, `shown` (G, 3), is added to what is cached."""
    light = light_of(rows.matrix[:, :, :, ~kept], shown[~kept])
    return replace(rows.columns(kept), cached=rows.cached + light)


def insignificant(
    radiance: np.ndarray, error: np.ndarray, level_error: np.ndarray, area: np.ndarray, family: np.ndarray
) -> np.ndarray:
    """Return the groups that radiate less than `SIGNIFICANT` standard errors, (G,) bool
    (docs/method/light.md#groups-that-only-reflect).

    The error of the level is left out: it is one factor on all light and does not say whether a group shines. Groups of a family
    are judged together, by the sums of their power and of its errors.

    Args:
        radiance, error: (G, 3) of the solution; level_error: (G, 3) the part of the error, as a logarithm, that groups share.
        area: (G,) m^2; family: (G,) int.
    """
    own = np.sqrt(np.maximum(error**2 - (level_error * radiance) ** 2, 0.0))
    member = np.unique(family, return_inverse=True)[1]
    # Sums over the groups of a family and the channels, in units of power up to the factor pi.
    power, spread = (np.bincount(member, area * values.sum(1)) for values in (radiance, own))
    return (power < SIGNIFICANT * spread)[member] if len(member) else np.zeros(0, bool)
