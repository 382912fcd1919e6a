"""Was the plan right? Every component against its opposite: what leaving out a kept one costs, and whether one that was left out
would have helped (lab/notebook/plan.md)."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from iif_core.errors import InputError
from iif_core.evaluation.catalogue import METRICS
from lab.studies.files import Opposite, Study
from workflow.artifacts.files import write_atomically

if TYPE_CHECKING:
    import pandas as pd

TABLE = Path("lab/notebook/data/regret.csv")
"""The rows from which the claims of the plan are made."""
CURRENCY = ("rgb_held_out", "psnr", "raw")
"""The score in which gains are counted, dB. Of residuals with a fitted scale, 1 dB is ln(10)/20 = 0.115 nats of log likelihood
for each value (equation N.2)."""
WITHIN = 2.0
"""Factor within which a gain has to be what was claimed."""
TOLERANCE = 0.01
"""Relative improvement that a component which was left out may bring."""
COSTS = {"cpu_seconds": "CPU", "max_rss_mb": "memory", "disk_mb": "disk"}
"""Columns of the table that are compared -> their names in the verdicts."""


class Kept(NamedTuple):
    """A component that the plan kept in a room, against the same room without it.

    Attributes:
        component, scene: which.
        gain, error: of held-out photographs by it, dB: mean over the seeds, and two standard errors of it (NaN for one seed).
        claim: median of the gains in the other rooms where it was kept, dB; NaN where there is none.
        claimed: smallest and largest of these gains.
        helped: (quantity, metric, protocol, relative improvement) of the scores that are better with it by more than 1 % and by
            more than two standard errors.
        shares: of each of `COSTS` that was recorded, what it takes relative to the plan.
    """

    component: str
    scene: str
    gain: float
    error: float
    claim: float
    claimed: tuple[float, float]
    helped: tuple[tuple[str, str, str, float], ...]
    shares: Mapping[str, float]

    @property
    def as_claimed(self) -> bool:
        """Whether the gain is within a factor of two of the median."""
        return self.gain > 0 and self.claim > 0 and 1 / WITHIN <= self.gain / self.claim <= WITHIN

    @property
    def in_range(self) -> bool:
        """Whether the gain is within a factor of two of the range, up to two standard errors of the gain."""
        low, high = self.claimed
        low *= 1 / WITHIN if low > 0 else WITHIN
        high *= WITHIN if high > 0 else 1 / WITHIN
        error = 0.0 if math.isnan(self.error) else self.error
        return low - error <= self.gain <= high + error


class LeftOut(NamedTuple):
    """A component that the plan left out in a room, against the same room with it.

    Attributes:
        component, scene: which.
        gain, error: of held-out photographs with it, dB: mean over the seeds, and two standard errors of it (NaN for one seed).
        helped: (quantity, metric, protocol, relative improvement) of the scores that it improves by more than 1 % and by more
            than two standard errors.
        shares: the same, what it would add.
    """

    component: str
    scene: str
    gain: float
    error: float
    helped: tuple[tuple[str, str, str, float], ...]
    shares: Mapping[str, float]


def judge(
    frame: pd.DataFrame, opposites: Mapping[str, Opposite], reference: str, scores: Sequence[tuple[str, str, str]]
) -> tuple[list[Kept], list[LeftOut]]:
    """Compare the plan with its opposites, seed by seed.

    A variant that forces what the plan does anyway has its scores, to the last digit, and says nothing.

    Args:
        frame: rows of the study (`lab.studies.table.KEPT`).
        opposites: component -> variants that force it on and off.
        reference: the variant that leaves all to the plan.
        scores: (quantity, metric, protocol) that a component which was left out must not improve.
    """
    value_of = frame.set_index(["scene", "variant", "seed", "quantity", "metric", "protocol"])["value"].sort_index()
    recorded = [name for name in COSTS if name in frame and frame[name].notna().any()]
    cost_of = frame.groupby(["scene", "variant", "seed"])[recorded].first()
    kept, left_out = [], []
    for component, opposite in opposites.items():
        for scene in sorted(frame["scene"].unique()):
            for variant, removes in ((opposite.forced_out, True), (opposite.forced_in, False)):
                seeds = _seeds_that_differ(value_of, str(scene), reference, variant)
                if not seeds:
                    continue
                shares = _shares(cost_of, str(scene), reference, variant, seeds, -1 if removes else 1)
                pair = (reference, variant) if removes else (variant, reference)
                gain = _mean_and_error(_differences(value_of, str(scene), pair, seeds, CURRENCY))
                helped = tuple(_helped(value_of, str(scene), pair, seeds, scores))
                if removes:
                    kept.append(Kept(component, str(scene), *gain, math.nan, (math.nan, math.nan), helped, shares))
                else:
                    left_out.append(LeftOut(component, str(scene), *gain, helped, shares))
    return [_with_claim(one, kept) for one in kept], left_out


def _with_claim(one: Kept, kept: Iterable[Kept]) -> Kept:
    others = [other.gain for other in kept if other.component == one.component and other.scene != one.scene]
    return one._replace(claim=float(np.median(others)), claimed=(min(others), max(others))) if others else one


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
    """Value of the first variant minus the value of the second, seed by seed, where both have the score."""
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


def _shares(cost_of: pd.DataFrame, scene: str, reference: str, variant: str, seeds: list[int], sign: int) -> dict[str, float]:
    """Costs of a variant minus those of the reference, relative to the latter, in the median over the seeds, times `sign`."""
    pairs = [(cost_of.loc[(scene, variant, seed)], cost_of.loc[(scene, reference, seed)]) for seed in seeds]

    def share(name: str) -> float:
        return sign * float(np.median([(other[name] - plan[name]) / plan[name] for other, plan in pairs])) + 0.0  # no -0

    return {name: share(name) for name in cost_of.columns}


def regret_lines(kept: Sequence[Kept], left_out: Sequence[LeftOut]) -> list[str]:
    """Return the verdicts as Markdown."""
    lines = ["## what was kept, against leaving it out", ""]
    costs = " | ".join(COSTS.values())
    lines += [f"| component | scene | gain, held-out dB | of the other scenes | as claimed | scores that it improves | {costs} |"]
    lines += ["|---|---|---:|---:|---|---|---:|---:|---:|"]
    for one in kept:
        claim = "" if math.isnan(one.claim) else f"{one.claim:.1f} ({one.claimed[0]:.1f} to {one.claimed[1]:.1f})"
        said = "yes" if one.as_claimed else "in the range" if one.in_range else "no"
        better = ", ".join(dict.fromkeys(f"{q} {m}" for q, m, _, _ in one.helped)) or "none"
        lines.append(f"| {one.component} | {one.scene} | {_gain(one)} | {claim} | {said} | {better} | {_percent(one.shares)} |")
    good, near = (sum(getattr(one, name) for one in kept) for name in ("as_claimed", "in_range"))
    lines += [
        "",
        f"{good} of {len(kept)} within a factor {WITHIN:g} of the median of the other scenes, {near} within that of their range;"
        f" {sum(bool(one.helped) for one in kept)} improve a score by more than 1 % and two standard errors.",
        "",
    ]
    lines += ["## what was left out, against having it", ""]
    lines += ["| component | scene | gain, held-out dB | scores that it improves | CPU | memory | disk |"]
    lines += ["|---|---|---:|---|---:|---:|---:|"]
    for other in left_out:
        better = ", ".join(f"{q} {m} ({protocol}) by {100 * share:.1f} %" for q, m, protocol, share in other.helped) or "none"
        shares = _percent(other.shares)
        lines.append(f"| {other.component} | {other.scene} | {_gain(other)} | {better} | {shares} |")
    quiet = sum(not other.helped for other in left_out)
    return [*lines, "", f"{quiet} of {len(left_out)} improve no score by more than 1 % and two standard errors.", ""]


def _percent(shares: Mapping[str, float]) -> str:
    return " | ".join(f"{round(100 * shares[name])} %" if name in shares else "" for name in COSTS)


def _gain(one: Kept | LeftOut) -> str:
    return f"{one.gain:.1f}" + ("" if math.isnan(one.error) else f" ± {one.error:.1f}")


def claims(kept: Sequence[Kept], left_out: Sequence[LeftOut]) -> dict[str, dict[str, dict[str, float | list[float]]]]:
    """Return component -> `included` or `left_out` -> what is to be expected of having it in another room: the gain in held-out
    dB (median, smallest and largest of the rooms), and the median shares of CPU seconds, memory and disk."""
    out: dict[str, dict[str, dict[str, float | list[float]]]] = {}
    for name, judged in (("included", kept), ("left_out", left_out)):
        for component in dict.fromkeys(one.component for one in judged):
            own = [one for one in judged if one.component == component and math.isfinite(one.gain)]
            if not own:
                continue
            gains = [one.gain for one in own]
            costs = [name for name in COSTS if all(name in one.shares for one in own)]
            shares = {name: round(float(np.median([one.shares[name] for one in own])), 3) for name in costs}
            out.setdefault(component, {})[name] = {
                "held_out_db": [round(float(value), 2) for value in (np.median(gains), min(gains), max(gains))],
                **shares,
                "rooms": len(own),
            }
    return out


def write_claims(study: Study, table: Path, path: Path) -> None:
    """Write what the plan says about its components (`workflow.decisions.expected`) from the kept rows of the study."""
    import pandas as pd

    if not table.is_file():
        raise InputError(f"{table}: not found; `python -m lab study regret --keep {table}` makes it from a run of the study")
    if not study.opposites:
        raise InputError("lab/config/studies/regret.yaml: no `opposites`, so nothing says what its variants force")
    scores = [(*key.split("/"), protocol) for key in study.show for protocol in study.protocols]
    kept, left_out = judge(pd.read_csv(table, dtype={"variant": str}), study.opposites, study.reference, scores)
    text = json.dumps(claims(kept, left_out), indent=1) + "\n"
    write_atomically(path, lambda temporary: temporary.write_text(text))
    logging.getLogger("claims").info("%s\n%s", path, "\n".join(regret_lines(kept, left_out)))
