"""Was the plan right? Every component against its opposite: what leaving out a kept one costs, and whether one that was left out
would have helped (docs/results/plan.md)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from iif_core.evaluation.catalogue import METRICS

if TYPE_CHECKING:
    import pandas as pd

    from workflow.settings.study_files import Opposite

CURRENCY = ("rgb_held_out", "psnr", "raw")
"""The score in which gains are counted, dB. Of residuals with a fitted scale, 1 dB is ln(10)/20 = 0.115 nats of log likelihood
for each value (equation N.2)."""
WITHIN = 2.0
"""Factor within which a gain has to be what was claimed."""
TOLERANCE = 0.01
"""Relative improvement that a component which was left out may bring."""
COSTS = ("cpu_seconds", "max_rss_mb", "disk_mb")


class Kept(NamedTuple):
    """A component that the plan kept in a room, against the same room without it.

    Attributes:
        component, scene: which.
        gain, error: of held-out photographs by it, dB: mean over the seeds, and two standard errors of it (NaN for one seed).
        claim: median of the gains in the other rooms where it was kept, dB; NaN where there is none.
        shares: of CPU seconds, peak memory and disk that it takes, in the order of `COSTS`, relative to the plan.
    """

    component: str
    scene: str
    gain: float
    error: float
    claim: float
    shares: tuple[float, float, float]

    @property
    def as_claimed(self) -> bool:
        return self.gain > 0 and self.claim > 0 and 1 / WITHIN <= self.gain / self.claim <= WITHIN


class LeftOut(NamedTuple):
    """A component that the plan left out in a room, against the same room with it.

    Attributes:
        component, scene: which.
        helped: (quantity, metric, protocol, relative improvement) of the scores that it improves by more than 1 % and by more
            than two standard errors.
        shares: of CPU seconds, peak memory and disk that it would add, relative to the plan.
    """

    component: str
    scene: str
    helped: tuple[tuple[str, str, str, float], ...]
    shares: tuple[float, float, float]


def judge(
    frame: pd.DataFrame, opposites: Mapping[str, Opposite], reference: str, scores: Sequence[tuple[str, str, str]]
) -> tuple[list[Kept], list[LeftOut]]:
    """Compare the plan with its opposites, seed by seed.

    A variant that forces what the plan does anyway has its scores, to the last digit, and says nothing.

    Args:
        frame: rows of the study (`workflow.studies.table.KEPT`).
        opposites: component -> variants that force it on and off.
        reference: the variant that leaves all to the plan.
        scores: (quantity, metric, protocol) that a component which was left out must not improve.
    """
    value_of = frame.set_index(["scene", "variant", "seed", "quantity", "metric", "protocol"])["value"].sort_index()
    cost_of = frame.groupby(["scene", "variant", "seed"])[list(COSTS)].first()
    kept, left_out = [], []
    for component, opposite in opposites.items():
        for scene in sorted(frame["scene"].unique()):
            for variant, removes in ((opposite.forced_out, True), (opposite.forced_in, False)):
                seeds = _seeds_that_differ(value_of, str(scene), reference, variant)
                if not seeds:
                    continue
                shares = _shares(cost_of, str(scene), reference, variant, seeds, -1 if removes else 1)
                if removes:
                    gains = _differences(value_of, str(scene), (reference, variant), seeds, CURRENCY)
                    kept.append(Kept(component, str(scene), *_mean_and_error(gains), math.nan, shares))
                else:
                    helped = _helped(value_of, str(scene), (variant, reference), seeds, scores)
                    left_out.append(LeftOut(component, str(scene), tuple(helped), shares))
    return [one._replace(claim=_claim(one, kept)) for one in kept], left_out


def _claim(one: Kept, kept: Iterable[Kept]) -> float:
    others = [other.gain for other in kept if other.component == one.component and other.scene != one.scene]
    return float(np.median(others)) if others else math.nan


def _seeds_that_differ(value_of: pd.Series, scene: str, reference: str, variant: str) -> list[int]:
    if not variant:
        return []
    index = value_of.index
    known = {int(seed) for room, name, seed in index.droplevel([3, 4, 5]).unique() if room == scene and name == variant}
    out = []
    for seed in sorted(known):
        if (scene, reference, seed) not in index.droplevel([3, 4, 5]):
            continue
        mine, theirs = value_of[scene, variant, seed], value_of[scene, reference, seed]
        if not mine.equals(theirs.reindex(mine.index)):
            out.append(seed)
    return out


def _differences(
    value_of: pd.Series, scene: str, pair: tuple[str, str], seeds: Iterable[int], score: tuple[str, str, str]
) -> list[float]:
    """Value of the first variant minus that of the second, seed by seed, where both have the score."""
    out = []
    for seed in seeds:
        both = [value_of.get((scene, variant, seed, *score), math.nan) for variant in pair]
        out.append(float(both[0] - both[1]))
    return [one for one in out if math.isfinite(one)]


def _mean_and_error(values: Sequence[float]) -> tuple[float, float]:
    """Return the mean, and two standard errors of it."""
    if not values:
        return math.nan, math.nan
    error = 2 * float(np.std(values, ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else math.nan
    return float(np.mean(values)), error


def _helped(
    value_of: pd.Series, scene: str, pair: tuple[str, str], seeds: list[int], scores: Iterable[tuple[str, str, str]]
) -> list[tuple[str, str, str, float]]:
    out = []
    for score in scores:
        better = METRICS[score[1]].higher_is_better
        moved = _differences(value_of, scene, pair, seeds, score)
        if better is None or not moved:
            continue
        gain, error = _mean_and_error([one if better else -one for one in moved])
        size = abs(float(np.mean([value_of.get((scene, pair[1], seed, *score), math.nan) for seed in seeds])))
        if gain > max(TOLERANCE * size, 0.0 if math.isnan(error) else error):
            out.append((*score, gain / size if size else math.inf))
    return out


def _shares(
    cost_of: pd.DataFrame, scene: str, reference: str, variant: str, seeds: list[int], sign: int
) -> tuple[float, float, float]:
    """Costs of a variant minus those of the reference, relative to the latter, in the median over the seeds, times `sign`."""
    pairs = [(cost_of.loc[(scene, variant, seed)], cost_of.loc[(scene, reference, seed)]) for seed in seeds]
    out = [sign * float(np.median([(other[name] - plan[name]) / plan[name] for other, plan in pairs])) for name in COSTS]
    return out[0] + 0.0, out[1] + 0.0, out[2] + 0.0  # no -0


def regret_lines(kept: Sequence[Kept], left_out: Sequence[LeftOut]) -> list[str]:
    """Return the verdicts as Markdown."""
    lines = ["## what was kept, against leaving it out", ""]
    lines += ["| component | scene | gain, held-out dB | of the other scenes | as claimed | CPU | memory | disk |"]
    lines += ["|---|---|---:|---:|---|---:|---:|---:|"]
    for one in kept:
        error = "" if math.isnan(one.error) else f" ± {one.error:.1f}"
        claim = "" if math.isnan(one.claim) else f"{one.claim:.1f}"
        shares = " | ".join(f"{100 * share:.0f} %" for share in one.shares)
        said = "yes" if one.as_claimed else "no"
        lines.append(f"| {one.component} | {one.scene} | {one.gain:.1f}{error} | {claim} | {said} | {shares} |")
    good = sum(one.as_claimed for one in kept)
    lines += ["", f"{good} of {len(kept)} within a factor {WITHIN:g} of the median of the other scenes.", ""]
    lines += ["## what was left out, against having it", ""]
    lines += ["| component | scene | scores that it improves | CPU | memory | disk |", "|---|---|---|---:|---:|---:|"]
    for other in left_out:
        better = ", ".join(f"{q} {m} ({protocol}) by {100 * share:.1f} %" for q, m, protocol, share in other.helped) or "none"
        shares = " | ".join(f"{100 * share:.0f} %" for share in other.shares)
        lines.append(f"| {other.component} | {other.scene} | {better} | {shares} |")
    quiet = sum(not other.helped for other in left_out)
    return [*lines, "", f"{quiet} of {len(left_out)} improve no score by more than 1 % and two standard errors.", ""]
