"""Figures by which a stage says where its arithmetic came close to its end (`numerics` in its JSON); the report warns of those
beyond their limits (docs/method/numerics.md#guards)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from iif_core.fusion.problem import LOWEST, FusionResult
from iif_core.surface.shading_cells import DiffuseShading

Figure = dict[str, Any]

CLAMPED = 0.2
"""Share of the cells with albedo at an end of its range."""
DROPPED = 0.1
"""Share of the predictions."""
CONDITION = 1e6
"""Of the normal matrix of the light, whose rows are in single precision."""
APART = 0.9
"""Difference of two halves of a cell's light over their sum from which a cell counts as a firefly."""
FIREFLIES = 0.01
"""Share of the cells."""
SINGULAR = 1e10
"""Condition of an object's block, from which eigenvalues are cut (docs/method/numerics.md#indefinite-normal-matrices)."""
DOWNWEIGHTED = 0.2
"""Share of the pixels with less than half of their weight."""


def figure(name: str, value: float, limit: float, says: str) -> Figure:
    """Return `{figure, value, limit, beyond, says}`; `says` what it means if the value is beyond the limit."""
    known = float(value) if np.isfinite(value) else 0.0
    return {"figure": name, "value": float(f"{known:.4g}"), "limit": limit, "beyond": bool(not value <= limit), "says": says}


def of_base(result: FusionResult, predictions: int) -> list[Figure]:
    """Return the figures of a texture that `predictions` predictions of all views were fused to."""
    albedo = result.value[result.coverage > 0, :3]
    ends = ((albedo <= LOWEST[:3]) | (albedo >= 1)).any(1)
    return [
        figure("albedo at an end of its range / share of the cells", float(ends.mean()) if len(ends) else 0.0, CLAMPED,
               "predictions are clipped, or their level is off; texture is lost there"),
        figure("predictions left out / share", len(result.dropped) / max(predictions, 1), DROPPED,
               "the prior failed for these photographs (prior/predictions.parquet says why)"),
    ]  # fmt: skip


def of_emission(condition: float, converged: bool) -> list[Figure]:
    """Return the figures of the least squares for the light."""
    return [
        figure("condition of the light's normal matrix", condition, CONDITION,
               "some emitters light the room alike; their sum is known, and each of them is close to its first estimate"),
        figure("light not at rest / 1 = yes", float(not converged), 0.0, "the last answers alternated; their mean was taken"),
    ]  # fmt: skip


def of_shading(found: DiffuseShading, asked: float) -> list[Figure]:
    """Return the figures of the diffuse light of the cells, whose noise was `asked` to be below a number."""
    first, second = found.diffuse.astype(np.float64).sum(-1)
    total = np.maximum(first + second, 1e-30)
    flies = (np.abs(first - second) > APART * total) & (first + second > 0)
    return [
        figure("fireflies / share of the cells", float(flies.mean()) if len(flies) else 0.0, FIREFLIES,
               "small bright lamps are met by chance; raise shading.samples"),
        figure("noise of the light", found.noise_last, max(2 * asked, asked + 0.1),
               "the light stayed noisier than asked (shading.noise); raise shading.samples"),
    ]  # fmt: skip


def of_affines(facts: Mapping[str, float], converged: bool) -> list[Figure]:
    """Return the figures of the fit of the materials: `condition` and `downweighted` of its facts."""
    return [
        figure("condition of an object's numbers", facts.get("condition", 1.0), SINGULAR,
               "photographs do not tell all numbers of some objects apart; what is assumed beforehand decides"),
        figure("pixels with little weight / share", facts.get("downweighted", 0.0), DOWNWEIGHTED,
               "the cached light of these pixels is too noisy; lower shading.noise"),
        figure("fit not at rest / 1 = yes", float(not converged), 0.0, "the materials may change in further steps"),
    ]  # fmt: skip


def warnings(documents: Iterable[tuple[str, Mapping[str, Any]]]) -> list[str]:
    """Return a sentence for each figure beyond its limit, from (stage, JSON document)."""
    return [
        f"{stage}: {item['figure']}: {item['value']:g} (up to {item['limit']:g}): {item['says']}"
        for stage, document in documents
        for item in document.get("numerics", [])
        if item["beyond"]
    ]
