"""Screening of many settings with few runs: elementary effects after Morris, by SALib.

A design has factors with levels 0 ... p - 1 from cheap to dear. A run is a string of digits, the level of every factor. A
trajectory changes one factor after the other, so that every step shows the effect of one of them at other values of the rest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from iif_core.errors import InputError
from lab.studies.files import MORRIS_LEVELS as LEVELS
from lab.studies.files import load_study

CANDIDATES = 20
"""Random trajectories of which the most different ones are taken (Campolongo, Cariboni and Saltelli 2007)."""


class Effect(NamedTuple):
    """Effect of one factor on one score, over its whole range: from its cheapest level to its dearest.

    Attributes:
        mean: of the elementary effects, with their signs.
        mean_size: of their absolute values (mu*), by which factors are ranked.
        error: half of the 95 per cent interval of `mean_size` (bootstrap).
        spread: standard deviation of the effects (sigma): large where the effect depends on the other settings.
    """

    mean: float
    mean_size: float
    error: float
    spread: float


def trajectories(factors: Sequence[str], count: int, seed: int = 0) -> list[str]:
    """Choose the runs of `count` trajectories: count x (factors + 1) strings of levels, some of which may be equal."""
    from SALib.sample import morris

    if not 2 <= count < CANDIDATES:
        raise InputError(f"{count} trajectories: needed are 2 to {CANDIDATES - 1}")

    points = morris.sample(_problem(factors), CANDIDATES, LEVELS, optimal_trajectories=count, seed=seed)
    return ["".join(str(round(x * (LEVELS - 1))) for x in point) for point in points]


def runs(study: str, seed: int) -> list[str]:
    """Choose the runs of the screening that a study describes.

    Raises:
        InputError: it describes none.
    """
    design = load_study(study).design
    if design is None or not design.trajectories:
        raise InputError(f"lab/config/studies/{study}.yaml: no `design` with `trajectories`, as tradeoff_screening.yaml has")
    return trajectories(list(design.factors), design.trajectories, seed)


def elementary_effects(factors: Sequence[str], runs: Sequence[str], values: Sequence[float]) -> dict[str, Effect]:
    """Compute the effect of every factor from the values of all runs of all trajectories, in their order.

    Args:
        factors: names.
        runs: as `trajectories` returned them.
        values: a score of each run; NaN where it is not known.

    Returns:
        Factor -> effect. Trajectories with an unknown value are left out; without any left, the effects are NaN.
    """
    from SALib.analyze import morris

    length = len(factors) + 1
    groups = np.asarray(values, np.float64).reshape(-1, length)
    kept = np.isfinite(groups).all(1)
    if not kept.any():
        return {factor: Effect(*[float("nan")] * 4) for factor in factors}
    levels = np.array([[int(digit) for digit in run] for run in runs], np.float64).reshape(-1, length, len(factors))
    points = levels[kept].reshape(-1, len(factors)) / (LEVELS - 1)
    found = morris.analyze(_problem(factors), points, groups[kept].ravel(), num_levels=LEVELS, seed=0)
    columns = (found[name] for name in ("mu", "mu_star", "mu_star_conf", "sigma"))
    return {factor: Effect(*map(float, row)) for factor, row in zip(factors, zip(*columns, strict=True), strict=True)}


def ranked(effects: Mapping[str, Effect]) -> list[tuple[str, Effect]]:
    """Return factors and effects, the largest first."""
    return sorted(effects.items(), key=lambda item: -np.nan_to_num(item[1].mean_size))


def _problem(factors: Sequence[str]) -> dict[str, object]:
    return {"num_vars": len(factors), "names": list(factors), "bounds": [[0.0, 1.0]] * len(factors)}
