"""How the cost of each stage grows with what a study varies: exponents of a power law, and the table of costs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lab.studies.files import Study

if TYPE_CHECKING:
    import pandas as pd

MEASURES = {"cpu_seconds": ("CPU s", 1), "max_rss_mb": ("MB", 0)}
"""Cost -> its heading and its decimals."""


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Return the slope of the least-squares line through log(cost) over log(size); NaN for fewer than two sizes.

    >>> round(exponent([1, 2, 4], [3, 6, 12]), 3)
    1.0
    """
    x, y = np.log(np.asarray(sizes, np.float64)), np.log(np.asarray(costs, np.float64))
    if len(np.unique(x)) < 2:
        return float("nan")
    away = x - x.mean()
    return float((away * y).sum() / (away**2).sum())


def growth_lines(study: Study, shown: pd.DataFrame, scenes: list[str]) -> list[str]:
    """Return a block of Markdown for each scene and each thing that is varied.

    A row for each stage holds its cost at each size (mean over the seeds), the exponent over all sizes, and the exponent of the
    last step."""
    lines: list[str] = []
    for scene in scenes:
        own = shown[shown["scene"] == scene].drop_duplicates(["variant", "seed"])
        for what, size_of in study.growth.items():
            names = sorted((name for name in size_of if name in set(own["variant"])), key=size_of.__getitem__)
            sizes = [size_of[name] for name in names]
            for measure, (heading, decimals) in MEASURES.items():
                head = [f"stage, {heading}", *(f"{what} {size:g}" for size in sizes), "exponent", "last step"]
                lines += [
                    f"## {scene}: {heading} over {what}",
                    "",
                    f"| {' | '.join(head)} |",
                    "|---" + "|---:" * (len(head) - 1) + "|",
                ]
                for stage in study.costs:
                    costs = [_cost(own[own["variant"] == name], stage, measure) for name in names]
                    whole, last = exponent(sizes, costs), exponent(sizes[-2:], costs[-2:])
                    cells = [f"{cost:.{decimals}f}" for cost in costs]
                    lines.append(f"| {stage} | {' | '.join(cells)} | {whole:.2f} | {last:.2f} |")
                lines.append("")
    return lines


def _cost(rows: pd.DataFrame, stage: str, measure: str) -> float:
    """Mean over the seeds of one cost of one stage; NaN where a job did not record it."""
    found = [json.loads(text).get(stage, {}).get(measure) for text in rows["stage_costs"].dropna()]
    return float(np.mean([np.nan if value is None else value for value in found])) if found else float("nan")
