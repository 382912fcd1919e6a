"""The loss of free cells: data, regulariser, propagation within parts, distance from a prior (Eq. M.50 to M.53)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from iif_core.errors import InputError
from iif_core.reflectance.brdf import F0_DIELECTRIC as F0
from iif_core.reflectance.brdf import R_MIN
from lab.baselines.problem import CellProblem

_PART_FLOOR = 1e-4
"""Added to the weight of a cell in the means of its part (Eq. M.52)."""


@dataclass(frozen=True)
class CellOptions:
    """Weights of the loss; the defaults are FIPT's.

    Attributes:
        regulariser: of |r - 1| + m.
        propagation: of |r - r_o| + |m - m_o|, with r_o, m_o weighted means of the cells of object o.
        part_weight: weight of a cell in these means: `specular` radiance (FIPT) or `gloss`, 1 - r (IRIS).
        prior: of |s a - a_o|^2, a_o the mean predicted albedo of the object and s one scale for all (IRIS: 1e-2).
    """

    regulariser: float = 5e-4
    propagation: float = 5e-3
    part_weight: str = "specular"
    prior: float = 0.0

    def __post_init__(self) -> None:
        if self.part_weight not in ("specular", "gloss"):
            raise InputError(f"cells: part_weight {self.part_weight!r}; allowed: specular, gloss")


FIPT = CellOptions()
IRIS = CellOptions(part_weight="gloss", prior=1e-2)


@dataclass(frozen=True)
class CellFit:
    """Fitted cells.

    Attributes:
        value: (C, 5) albedo, roughness, metallic; unknown cells hold 0.
        known: (C,) bool, see `CellProblem.known`.
        scale: s of the prior term.
        history: loss after each step, mean over the pixels.
    """

    value: np.ndarray
    known: np.ndarray
    scale: float = 1.0
    history: list[float] = field(default_factory=list)


def bracket(levels: np.ndarray, roughness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the level below each roughness, and the share of the level above."""
    j = np.clip(np.searchsorted(levels, roughness, side="right") - 1, 0, len(levels) - 2)
    return j, np.clip((roughness - levels[j]) / (levels[j + 1] - levels[j]), 0.0, 1.0)


def lobes_at(problem: CellProblem, roughness: np.ndarray) -> np.ndarray:
    """Return the sums at one roughness for each cell, interpolated between levels, (C, 5, 3)."""
    j, share = bracket(problem.levels, roughness)
    cell, t = np.arange(len(j)), share[:, None, None]
    return (1.0 - t) * problem.lobes[cell, j] + t * problem.lobes[cell, j + 1]


def data_loss(dd: np.ndarray, lobes: np.ndarray, albedo: np.ndarray, metallic: np.ndarray) -> np.ndarray:
    """Return the squared error of sensor values, summed over the pixels of each cell (Eq. M.50).

    Args:
        dd: (..., 3); lobes: (..., 5, 3) sums of the cells at their roughness.
        albedo: (..., 3); metallic: (..., 1).

    Returns:
        (..., 3).
    """
    k_d, k_s = (1.0 - metallic) * albedo, F0 * (1.0 - metallic) + metallic * albedo
    ss, sd, sz, dz, zz = (lobes[..., i, :] for i in range(5))
    return k_d * k_d * dd + k_s * k_s * ss + 2.0 * (k_d * k_s * sd - k_d * dz - k_s * sz) + zz


def best_albedo(
    dd: np.ndarray, lobes: np.ndarray, metallic: np.ndarray, weight: np.ndarray | float, target: np.ndarray | float
) -> np.ndarray:
    """Return the albedo that minimises `data_loss` + weight (a - target)^2 (Eq. M.53).

    Args:
        dd: (..., 3); lobes: (..., 5, 3) sums of the cells; metallic: (..., 1).
        weight, target: of the prior term.

    Returns:
        (..., 3) in [0, 1]; 0 where nothing determines it.
    """
    k_0 = F0 * (1.0 - metallic)
    ss, sd, sz, dz = (lobes[..., i, :] for i in range(4))
    rest = 1.0 - metallic
    square = rest * rest * dd + metallic * metallic * ss + 2.0 * metallic * rest * sd + weight
    cross = rest * (dz - k_0 * sd) + metallic * (sz - k_0 * ss) + weight * target
    return np.clip(np.divide(cross, square, out=np.zeros_like(cross), where=square > 0), 0.0, 1.0)


def part_means(problem: CellProblem, value: np.ndarray, options: CellOptions) -> np.ndarray:
    """Return weighted mean roughness and metallic of each object, (O, 2); 1 and 0 where no cell is known."""
    weight = np.where(problem.known, part_weights(problem, value, options), 0.0)
    total = np.bincount(problem.object_id, weight, problem.n_objects)
    means = [np.bincount(problem.object_id, weight * value[:, c], problem.n_objects) for c in (3, 4)]
    mean = np.stack(means, 1) / np.maximum(total, 1e-300)[:, None]
    return np.where((total > 0)[:, None], mean, [1.0, 0.0])


def part_weights(problem: CellProblem, value: np.ndarray, options: CellOptions) -> np.ndarray:
    """Return the weight of each cell in the means of its part (Eq. M.52), (C,)."""
    if options.part_weight == "gloss":
        return problem.pixels * (1.0 - value[:, 3] + _PART_FLOOR)
    j, share = bracket(problem.levels, value[:, 3])
    cell, t = np.arange(len(j)), share[:, None]
    s0, s1 = ((1.0 - t) * problem.specular[cell, j] + t * problem.specular[cell, j + 1]).T
    k_s = F0 * (1.0 - value[:, 4]) + value[:, 4] * value[:, :3].mean(1)
    return np.maximum(k_s * s0 + s1, 0.0) + _PART_FLOOR * problem.pixels


def prior_scale(problem: CellProblem, value: np.ndarray, prior: np.ndarray) -> float:
    """Return the scale s that minimises sum |s a - prior|^2 over the pixels (Eq. M.52); 1 for black cells."""
    weight = np.where(problem.known, problem.pixels, 0.0)[:, None]
    square = float((weight * value[:, :3] ** 2).sum())
    return float((weight * value[:, :3] * prior).sum() / square) if square > 0 else 1.0


def losses(
    problem: CellProblem, value: np.ndarray, options: CellOptions, prior: np.ndarray | None = None, scale: float | None = None
) -> np.ndarray:
    """Return the loss of each object, summed over its pixels, by which all solvers are judged (Eq. M.51).

    Args:
        problem: the cells; value: (C, 5) materials; options: weights.
        prior: (C, 3) albedo of each cell's object, needed if `options.prior` is not 0.
        scale: s if it is held; None: its value for these cells.

    Returns:
        (O,) float64.
    """
    r, m = np.clip(value[:, 3], R_MIN, 1.0), value[:, 4]
    cost = data_loss(problem.dd, lobes_at(problem, r), value[:, :3], m[:, None]).mean(1)
    means = part_means(problem, value, options)[problem.object_id]
    away = np.abs(r - means[:, 0]) + np.abs(m - means[:, 1])
    cost = cost + problem.pixels * (options.regulariser * (1.0 - r + m) + options.propagation * away)
    if options.prior and prior is not None:
        s = prior_scale(problem, value, prior) if scale is None else scale
        cost += options.prior * problem.pixels * ((s * value[:, :3] - prior) ** 2).mean(1)
    return np.bincount(problem.object_id, np.where(problem.known, cost, 0.0), problem.n_objects)


def checked_prior(problem: CellProblem, options: CellOptions, prior: np.ndarray | None) -> np.ndarray:
    """Return the prior albedo, (C, 3); zeros if the loss has no such term.

    Raises:
        InputError: the loss has the term, and the prior is missing, not finite or of another shape.
    """
    if not options.prior:
        return np.zeros((len(problem.pixels), 3))
    if prior is None or prior.shape != (len(problem.pixels), 3) or not np.isfinite(prior).all():
        found = "none" if prior is None else f"shape {prior.shape}"
        raise InputError(f"cells: prior albedo: found {found}, needed ({len(problem.pixels)}, 3), finite")
    return prior.astype(np.float64)


def object_means(problem: CellProblem, value: np.ndarray, unseen: np.ndarray) -> np.ndarray:
    """Return the mean of the known cells of each object over their pixels, (O, 5); `unseen` (O, 5) where there is none."""
    weight = np.where(problem.known, problem.pixels, 0.0)
    total = np.bincount(problem.object_id, weight, problem.n_objects)
    sums = [np.bincount(problem.object_id, weight * value[:, c], problem.n_objects) for c in range(5)]
    return np.where((total > 0)[:, None], np.stack(sums, 1) / np.maximum(total, 1e-300)[:, None], unseen)


def fill_unknown(fit: CellFit, problem: CellProblem, unseen: np.ndarray) -> np.ndarray:
    """Return materials (C, 5) in which unknown cells have the mean of their object, or `unseen` (O, 5) where it has none."""
    return np.where(fit.known[:, None], fit.value, object_means(problem, fit.value, unseen)[problem.object_id])


def albedo_deviation(problem: CellProblem, value: np.ndarray) -> np.ndarray:
    """Return the standard error of the cells' albedo, sigma / sqrt(sum w^2 G^2), mean over the channels and at most 1, (C,).

    sigma^2 is the squared error of a pixel over all cells, with one degree of freedom spent for each cell and channel. Roughness
    and metallic are taken as known, so it is a lower bound. Unknown cells have 1.
    """
    known, metal = problem.known, value[:, 4:5]
    lobes = lobes_at(problem, np.clip(value[:, 3], R_MIN, 1.0))
    error = np.maximum(data_loss(problem.dd, lobes, value[:, :3], metal), 0.0)[known].sum(0)
    variance = error / max(float(problem.pixels[known].sum()) - int(known.sum()), 1.0)
    rest = 1.0 - metal
    square = rest * rest * problem.dd + metal * metal * lobes[:, 0] + 2.0 * metal * rest * lobes[:, 1]
    deviation = np.sqrt(variance / np.maximum(square, 1e-300)).clip(0.0, 1.0).mean(1)
    return np.where(known, deviation, 1.0)
