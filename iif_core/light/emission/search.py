"""Which emitters explain the photographs: lamps that no camera sees are added, and groups that are not needed are taken out
(docs/method/light.md#lamps-that-no-camera-sees)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from iif_core.light.emission.direct import EmissionPrior
from iif_core.light.emission.gains import BaseAlbedo, GainOptions
from iif_core.light.emission.problem import ROW_FLOOR, EmissionProblem
from iif_core.light.emission.pruning import WhiteSurface
from iif_core.light.emission.rows import light_of

Families = frozenset[int]

STEP = 0.05
"""Share of the misfit by which other emitters must explain the photographs better."""
PROMISING = 0.02
"""The same in the first look, on fewer pixels."""
NOTICEABLE = 0.005
"""The same if the light of a family is added and all else stays, from which it is looked at."""
HIDDEN_EXCESS = 4.0
"""Brightness of unseen surface relative to a white one in its place from which it is a lamp and not a reflector of light that the
model lacks."""
_ADDED, _SWAPPED = 3, 2  # families that are tried in addition to the others, and in place of one of them
_MISSED = 1.5  # growth of the misfit without a family from which nothing else can take its place
_CONFIRMED = 2  # proposals that are traced
_MAX_CHANGES = 4
_MISFITS = 1e-12, 1e12  # beyond which misfits are alike
_DARKEST = 0.02  # albedo by which what surface reflects is divided
QUICK = GainOptions(rounds=4)
"""Gains of objects while emitters are compared."""


class Proposal(NamedTuple):
    """Families that may shine instead of the present ones.

    Attributes:
        families: that shine.
        largest_growth: factor by which the misfit of the present ones may change for these to take their place.
        always: they are traced, whatever the first look says of them.
        alone: of these, the families that shine already may also do so with nothing in the place of those that go.
    """

    families: Families
    largest_growth: float = 1.0 - STEP
    always: bool = False
    alone: bool = True


class Look(NamedTuple):
    """What some families explain: their misfit; the problem with all columns, scaled by the gains, in which their light is
    cached (`lit`); and what white surface would show in the place of the pixels of all groups (n, 3)."""

    misfit: float
    lit: EmissionProblem
    white: np.ndarray


@dataclass(frozen=True)
class Candidates:
    """All groups in one problem, as a first look at which of them shine.

    Attributes:
        problem: rows of all G groups; the last may belong to the sky.
        reflecting: rows of the pixels that look at a group, as they are where it does not shine; of_group: group of each.
        prior: of the groups.
        family: (G,) int >= 0, groups that shine or do not shine together; -1 = sky, which always shines.
        hidden: (G,) bool, no camera sees the group.
        shown: (G, 3) radiance with which a group lights the scene that only reflects.
        white: what a white surface would show in the place of hidden groups.
        albedo: of the base.
        certain: brightness relative to a white surface from which a family shines for certain.
        weights: by number of the family, factor on the misfit if it shines: what is known of lamps before (`odds.LampOdds`).
    """

    problem: EmissionProblem
    reflecting: EmissionProblem
    of_group: np.ndarray
    prior: EmissionPrior
    family: np.ndarray
    hidden: np.ndarray
    shown: np.ndarray
    white: WhiteSurface
    albedo: BaseAlbedo
    certain: float
    weights: np.ndarray

    def weight(self, families: Families) -> float:
        """Return the factor on the misfit of the families."""
        return float(np.prod(self.weights[sorted(families)])) if families else 1.0

    def proposals(
        self,
        chosen: Families,
        doubtful: Families = frozenset(),
        suspects: Families = frozenset(),
        unlikely: Families = frozenset(),
    ) -> list[Proposal]:
        """Return sets of families that may explain the photographs better than `chosen`, the most promising first.

        Families are taken out, added, or put in the place of one of the chosen; added ones in the order of what their light alone
        would take off the misfit. Families that are `doubtful` are taken out if the misfit does not grow, and those that are no
        brighter than a white surface in their place unless it grows by half. Families that are `certain` times as bright as one
        stay. `suspects` may only seem to shine because the light of others was given to them; the first look is wrong while they
        do, so what could take their place is always traced, however bright they are. So is the set without all that are
        `unlikely`, if several are: each of several false lamps makes the others look needed.
        """
        now = self._look(chosen)
        misfit = now.misfit
        found: dict[Families, float] = {}
        largest: dict[Families, tuple[float, float]] = {}  # growth of the misfit, in this look and in a separate trace
        always: set[Families] = set()
        impossible: set[Families] = set()

        def with_added(families: Families, value: float, lit: EmissionProblem, most: int, out: int | None = None) -> None:
            for f in self._best_added(families, lit, NOTICEABLE * misfit)[:most]:
                added = self._look(families | {f})
                if added.misfit * self.weights[f] <= (1.0 - PROMISING) * value and not (
                    out is not None and self._must_shine(out, added.white)
                ):
                    found[families | {f}] = added.misfit

        with_added(chosen, misfit, now.lit, _ADDED)
        for out in sorted(chosen):
            rest = chosen - {out}
            left = self._look(rest)
            found[rest] = left.misfit
            if found[rest] <= _MISSED * misfit:
                with_added(rest, found[rest], left.lit, _SWAPPED, out)
            if out in suspects:
                instead = {rest | {f} for f in self._best_added(rest, left.lit, NOTICEABLE * misfit)[:_SWAPPED]}
                found |= {families: self._look(families).misfit for families in instead - set(found)}
                always |= instead
            # Fewer families are worth a trace of their own if they explain nearly as much. How bright saturated surface is that
            # only reflects is not known before that trace.
            look = _MISSED if self.is_saturated(out) else 1.0 + PROMISING
            # Of a likely lamp, saturated, the excess is a lower bound and speaks for nothing.
            reflects = bool(rest) and self.weights[out] >= 1.0 and self._excess(out, left.white) < 1.0
            largest[rest] = look, _MISSED if reflects else 1.0 if out in doubtful else 1.0 - STEP
            if (rest or (self.family < 0).any()) and self._must_shine(out, left.white):
                impossible.add(rest)
        likely = chosen - unlikely
        if len(chosen - likely) > 1 and (likely or (self.family < 0).any()):
            white = self._look(likely).white
            likely |= {f for f in chosen - likely if self._must_shine(f, white)}
            if len(chosen - likely) > 1:
                found[likely], largest[likely] = self._look(likely).misfit, (np.inf, 1.0)
                always.add(likely)
        order = sorted(
            found.keys() - impossible, key=lambda f: (found[f] * self.weight(f) * (1.0 + PROMISING) ** len(f), sorted(f))
        )
        growth = {families: largest.get(families, (1.0 - PROMISING, 1.0 - STEP)) for families in order}
        present = self.weight(chosen) * misfit
        worth = (f for f in order if f in always or self.weight(f) * found[f] <= growth[f][0] * present)
        return [Proposal(f, growth[f][1], f in always, f & chosen not in impossible) for f in worth]

    def needed(self, chosen: Families, kind: Callable[[int], Families]) -> dict[int, float]:
        """Return by how much the logarithm of the misfit grows without all of the `kind` of each of the `chosen` families, as
        one pane of a window is hardly needed where the others are; large if what is left cannot be, 0 if neither can."""
        present = np.log(np.clip(self._look(chosen).misfit, *_MISFITS))
        kinds = {kind(f) for f in chosen}
        growth = {own: float(np.log(np.clip(self._look(chosen - own).misfit, *_MISFITS)) - present) for own in kinds}
        return {f: growth[kind(f)] for f in sorted(chosen)}

    def _look(self, chosen: Families) -> Look:
        """What the families explain when they shine and the others reflect."""
        keep = np.isin(self.family, [*chosen, -1])
        # Pixels on groups that do not shine are rows like any others: light that falls on them must explain how bright they are.
        every = self.problem.beside(self.reflecting.take(~keep[self.of_group]))
        part, prior = every.columns(keep, self.shown), self.prior.only(keep)
        solved, gains = part.solve_object_gains(prior, self.albedo, len(self.albedo.mean), QUICK)
        radiance = prior.radiance(solved.rows, QUICK.rounds)
        light = self.shown.copy()
        light[keep] = radiance
        # Unseen surface that a white one could match is no lamp, unless it is a likely one: the rest of the light is wrong.
        doubted = self.hidden & keep & (np.append(self.weights, 1.0)[self.family] >= 1.0)
        reflects = (replace(self.white, seen=light).excess(light) < HIDDEN_EXCESS) & doubted
        misfit = np.inf if reflects.any() else solved.misfit(radiance)
        return Look(misfit, lit_problem(every.with_gains(gains), light), self._white(light))

    def _white(self, light: np.ndarray) -> np.ndarray:
        """(n, 3) what white surface would show in the place of the pixels of all groups that radiate `light` (G, 3)."""
        rows, owner = self.reflecting.rows, self.reflecting.owner
        shown = light_of(rows.matrices.mean(0), light) + rows.cached.sum(1).mean(0)
        albedo = np.where(owner[:, None] >= 0, self.albedo.mean[owner], 1.0)
        return shown / np.maximum(albedo, _DARKEST)

    def _excess(self, family: int, white: np.ndarray) -> float:
        """Brightness of what was seen of a family relative to `white` surface; infinite if it was not seen."""
        own = np.isin(self.of_group, np.flatnonzero(self.family == family))
        weight = self.reflecting.pixels[own] @ white[own].sum(1)
        return float(self.reflecting.pixels[own] @ self.reflecting.rows.observed[own].sum(1) / weight) if weight > 0 else np.inf

    def _must_shine(self, family: int, white: np.ndarray) -> bool:
        """A family was seen, and no light that falls on it could make `white` surface nearly as bright."""
        seen = bool(np.isin(self.of_group, np.flatnonzero(self.family == family)).any())
        return seen and self._excess(family, white) >= self.certain

    def is_saturated(self, family: int) -> bool:
        """Most of what was seen of a family is a lower bound."""
        own = np.isin(self.of_group, np.flatnonzero(self.family == family))
        return bool(own.any()) and bool(self.reflecting.rows.lower_bound[own].any(1).mean() > 0.5)

    def _best_added(self, chosen: Families, lit: EmissionProblem, least: float) -> list[int]:
        """Families, not chosen, whose light would take at least `least` off the misfit if all else stayed."""
        gain = {f: 0.0 for f in np.unique(self.family[self.family >= 0]).tolist() if f not in chosen}
        for family in gain:
            gain[family] = decrease(lit, lit.rows.matrices[:, :, self.family == family].sum(2))
        return [f for f in sorted(gain, key=lambda f: -gain[f]) if gain[f] > least]


def lit_problem(problem: EmissionProblem, light: np.ndarray) -> EmissionProblem:
    """The problem with `light` (G, 3) in what is cached; one lobe."""
    lit = light_of(problem.rows.matrices, light)[:, None]
    return replace(problem, rows=replace(problem.rows, cached=problem.rows.cached + lit))


def decrease(lit: EmissionProblem, column: np.ndarray) -> float:
    """Return by how much light through one more `column` (2, n, 3), as strong as is best, lowers the misfit, to first order.

    The gains of objects follow: what the column has in common with the light that an object receives already changes nothing.
    """
    rows, used = lit.rows, ~lit.anchor
    # The light of the chosen families is in `cached`, so a target is what they leave unexplained.
    residual, owner = rows.mean_target[used], lit.owner[used]
    predicted = np.maximum(rows.observed[used] - residual, 0.0)
    scale = 0.5 * (rows.observed[used] + predicted) + ROW_FLOOR * np.median(rows.observed[used].mean(1))
    # A bound that is met does not count.
    counts = (scale > 0) & ~(rows.lower_bound[used] & (residual < 0))
    weight = np.divide(lit.pixels[used, None], scale**2, out=np.zeros(scale.shape), where=counts & (scale**2 > 0))
    first, second = column[:, used]
    mean = 0.5 * (first + second)

    def of_objects(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(owner, weight[:, c] * values[:, c], int(owner.max(initial=-1)) + 1) for c in range(3)], 1)

    light = of_objects(predicted**2)
    # Projection of the column on the light that an object receives: the gain of the object can do as much.
    shared = np.divide(of_objects(mean * predicted), light, out=np.zeros(light.shape), where=light > 0)
    towards = (of_objects(mean * residual) - shared * of_objects(predicted * residual)).sum(0)
    # Noise can make <a_1 a_2>, and the difference in Eq. L.41, too small or negative. Both floors keep the quotient finite.
    own = of_objects(np.maximum(first * second, 0.3 * mean**2)).sum(0)
    curvature = np.maximum(own - (shared**2 * light).sum(0), 0.1 * own)
    decrease = np.divide(np.maximum(towards, 0.0) ** 2, curvature, out=np.zeros(3), where=curvature > 0)
    return float(decrease.mean() / max(lit.pixels[used].sum(), 1e-300))


def search(
    chosen: Families,
    proposals: Callable[[Families], list[Proposal]],
    misfit: Callable[[Families], float],
    weight: Callable[[Families], float] = lambda families: 1.0,
) -> tuple[Families, list[tuple[Families, float, float]]]:
    """Change the emitters as long as others explain the photographs better by `STEP`; of those that do, a family more must be
    worth as much. Families that are taken out although the misfit grows do not come back.

    Args:
        chosen: families to begin with.
        proposals: sets of families that look better than a given one, best first.
        misfit: of a set of families, from a separate trace; weight: factor on it, by which sets are compared.

    Returns:
        The families, and for each change: the families after it, and the misfit before and after.
    """
    changes: list[tuple[Families, float, float]] = []
    gone: Families = frozenset()
    for _ in range(_MAX_CHANGES):
        possible = [proposal for proposal in proposals(chosen) if not proposal.families & gone]
        tried = [proposal for place, proposal in enumerate(possible) if place < _CONFIRMED or proposal.always]
        # What takes the place of a family is compared with nothing in its place.
        known = {proposal.families for proposal in tried}
        rest = {p.families & chosen for p in tried if p.alone and not p.families >= chosen} - known
        tried += [Proposal(families) for families in sorted(rest, key=sorted)]
        if not tried:
            break
        before, after = misfit(chosen), [misfit(proposal.families) for proposal in tried]
        compared = [value * weight(proposal.families) for value, proposal in zip(after, tried, strict=True)]
        present = before * weight(chosen)
        better = [i for i, value in enumerate(compared) if value <= tried[i].largest_growth * present]
        if not better:
            break
        best = min(better, key=lambda i: compared[i] * (1.0 + STEP) ** len(tried[i].families))
        if after[best] > before:
            gone |= chosen - tried[best].families
        chosen = tried[best].families
        changes.append((chosen, before, after[best]))
    return chosen, changes
