"""Which emitters explain the photographs: lamps that no camera sees are added, and groups that are not needed are taken out
(docs/method/light.md#lamps-that-no-camera-sees)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from iif_core.light.emission.direct import EmissionPrior
from iif_core.light.emission.gains import GainOptions
from iif_core.light.emission.problem import ROW_FLOOR, EmissionProblem
from iif_core.light.emission.pruning import WhiteSurface

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
QUICK = GainOptions(rounds=4)
"""Gains of objects while emitters are compared."""


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
        albedo: (n_objects, 3) mean base albedo that no gain brings above 1, or None; n_objects.
    """

    problem: EmissionProblem
    reflecting: EmissionProblem
    of_group: np.ndarray
    prior: EmissionPrior
    family: np.ndarray
    hidden: np.ndarray
    shown: np.ndarray
    white: WhiteSurface
    albedo: np.ndarray | None
    n_objects: int

    def proposals(self, chosen: Families) -> list[Families]:
        """Return sets of families that may explain the photographs better than `chosen`, the most promising first.

        Families are taken out, added, or put in the place of one of the chosen; added ones in the order of what their light alone
        would take off the misfit.
        """
        misfit, lit = self._look(chosen)
        found: dict[Families, float] = {}

        def with_added(families: Families, value: float, lit: EmissionProblem, most: int) -> None:
            for f in self._best_added(families, lit, NOTICEABLE * misfit)[:most]:
                added = self._look(families | {f})[0]
                if added <= (1.0 - PROMISING) * value:
                    found[families | {f}] = added

        with_added(chosen, misfit, lit, _ADDED)
        for out in sorted(chosen):
            rest = chosen - {out}
            found[rest], lit = self._look(rest)
            if found[rest] <= _MISSED * misfit:
                with_added(rest, found[rest], lit, _SWAPPED)
        order = sorted(found, key=lambda f: found[f] * (1.0 + PROMISING) ** len(f))
        # Fewer families are worth a trace of their own if they explain nearly as much.
        return [f for f in order if found[f] <= misfit * (1.0 + PROMISING if len(f) < len(chosen) else 1.0 - PROMISING)]

    def _look(self, chosen: Families) -> tuple[float, EmissionProblem]:
        """Misfit of the families, and the problem with all columns, scaled by the gains, in which their light is cached."""
        keep = np.isin(self.family, [*chosen, -1])
        every = self.problem.beside(self.reflecting.take(~keep[self.of_group]))
        part, prior = every.columns(keep, self.shown), self.prior.only(keep)
        solved, gains = part.solve_object_gains(prior, self.albedo, self.n_objects, QUICK)
        radiance = prior.solve(solved.rows, QUICK.rounds).radiance
        light = self.shown.copy()
        light[keep] = radiance
        # Unseen surface that a white one could match is no lamp: the rest of the light is wrong.
        reflects = (replace(self.white, seen=light).excess(light) < HIDDEN_EXCESS) & self.hidden & keep
        return np.inf if reflects.any() else solved.misfit(radiance), lit_problem(every.with_gains(gains), light)

    def _best_added(self, chosen: Families, lit: EmissionProblem, least: float) -> list[int]:
        """Families, not chosen, whose light would take at least `least` off the misfit if all else stayed."""
        gain = {f: 0.0 for f in np.unique(self.family[self.family >= 0]).tolist() if f not in chosen}
        for family in gain:
            gain[family] = decrease(lit, lit.rows.matrices[:, :, self.family == family].sum(2))
        return [f for f in sorted(gain, key=lambda f: -gain[f]) if gain[f] > least]


def lit_problem(problem: EmissionProblem, light: np.ndarray) -> EmissionProblem:
    """The problem with `light` (G, 3) in what is cached; one lobe."""
    lit = np.einsum("kngc,gc->knc", problem.rows.matrices, light)[:, None]
    return replace(problem, rows=replace(problem.rows, cached=problem.rows.cached + lit))


def decrease(lit: EmissionProblem, column: np.ndarray) -> float:
    """Return by how much light through one more `column` (2, n, 3), as strong as is best, lowers the misfit, to first order.

    The gains of objects follow: what the column has in common with the light that an object receives already changes nothing.
    """
    rows, used = lit.rows, ~lit.anchor
    residual, owner = rows.mean_target[used], lit.owner[used]
    predicted = np.maximum(rows.observed[used] - residual, 0.0)
    scale = 0.5 * (rows.observed[used] + predicted) + ROW_FLOOR * np.median(rows.observed[used].mean(1))
    counts = (scale > 0) & ~(rows.lower_bound[used] & (residual < 0))
    weight = np.divide(lit.pixels[used, None], scale**2, out=np.zeros(scale.shape), where=counts & (scale**2 > 0))
    first, second = column[:, used]
    mean = 0.5 * (first + second)

    def of_objects(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(owner, weight[:, c] * values[:, c], int(owner.max(initial=-1)) + 1) for c in range(3)], 1)

    light = of_objects(predicted**2)
    shared = np.divide(of_objects(mean * predicted), light, out=np.zeros(light.shape), where=light > 0)
    towards = (of_objects(mean * residual) - shared * of_objects(predicted * residual)).sum(0)
    own = of_objects(np.maximum(first * second, 0.3 * mean**2)).sum(0)
    curvature = np.maximum(own - (shared**2 * light).sum(0), 0.1 * own)
    decrease = np.divide(np.maximum(towards, 0.0) ** 2, curvature, out=np.zeros(3), where=curvature > 0)
    return float(decrease.mean() / max(lit.pixels[used].sum(), 1e-300))


def search(
    chosen: Families,
    proposals: Callable[[Families], list[Families]],
    misfit: Callable[[Families], float],
    doubtful: Families = frozenset(),
) -> tuple[Families, list[tuple[Families, float, float]]]:
    """Change the emitters as long as others explain the photographs better by `STEP`; of those that do, a family more must be
    worth as much.

    Args:
        chosen: families to begin with.
        proposals: sets of families that look better than a given one, best first.
        misfit: of a set of families, from a trace of its own.
        doubtful: families that are taken out if the misfit does not grow.

    Returns:
        The families, and for each change: the families after it, and the misfit before and after.
    """
    changes: list[tuple[Families, float, float]] = []
    for _ in range(_MAX_CHANGES):
        tried = proposals(chosen)[:_CONFIRMED]
        # What takes the place of a family is compared with nothing in its place.
        tried = list(dict.fromkeys([*tried, *(families & chosen for families in tried if not families >= chosen)]))
        if not tried:
            break
        before, after = misfit(chosen), [misfit(families) for families in tried]
        fewer = [families < chosen and chosen - families <= doubtful for families in tried]
        better = [i for i, value in enumerate(after) if value < (1.0 - STEP) * before or (fewer[i] and value <= before)]
        if not better:
            break
        best = min(better, key=lambda i: after[i] * (1.0 + STEP) ** len(tried[i]))
        chosen = tried[best]
        changes.append((chosen, before, after[best]))
    return chosen, changes
