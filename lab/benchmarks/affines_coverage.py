"""How often the claimed 68 % intervals of the material fit contain the truth, over seeds of a planted problem.

    python lab/benchmarks/affines_coverage.py --seeds 20 --family other --output results/studies/affines_coverage.parquet

Objects with drawn affines, roughness and metalness under room-like light, photographed through an unknown gamma. Errors: noise of
the cached shading, one per surface cell and half, shared by all lobes and by the pixels of the cell; noise of the photograph per
pixel and its rounding to 8 bits; and an error of the light that neighbours share, which both halves have. Clusters are the
patches of neighbours. Families: `room`, which the formulae were made on, and `other`, which they were tried on: larger objects,
other sizes of every error, light that errs in squares instead of rows, another curve, a calibration's prior drawn around it, and
textured roughness. A row per group of numbers: share of intervals that contain the truth, and the ratio of root-mean-square error
to claimed error.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from iif_core.camera.response import response
from iif_core.fitting.clusters import patches
from iif_core.fitting.direct import fit_affines
from iif_core.fitting.problem import FitOptions, FitProblem, FitResult
from iif_core.reflectance.material import BIASES, CROSS_TERMS, GAINS, IDENTITY, apply_affines
from tests.unit.planted_fit import LEVELS, radiance_of, shading_of


@dataclass(frozen=True)
class Family:
    """Side of an object in cells, pixels of a cell, relative noise of a half of the cache, noise of a photograph in sensor units,
    relative error of the light and the cells that share it; the curve's gamma, standard deviation of its calibration (0: none);
    gain of the roughness texture."""

    side: int = 10
    pixels: int = 5
    cache: float = 0.15
    photo: float = 0.01
    light: float = 0.03
    shared: tuple[int, int] = (4, 1)
    gamma: float = 1.9
    calibration: float = 0.0
    texture: float = 0.0


FAMILIES = {
    "room": Family(),
    "other": Family(14, 4, 0.08, 0.02, 0.05, (2, 2), 2.35, 0.03, 0.6),
}


def planted(seed: int, objects: int, family: Family = FAMILIES["room"]) -> tuple[FitProblem, np.ndarray]:
    """The problem and the true affines (O, 16)."""
    rng = np.random.default_rng([0x636F76, seed])
    cells = family.side**2
    n_cells = objects * cells
    cell = np.repeat(np.arange(n_cells), family.pixels)
    obj = cell // cells
    n = len(cell)
    base = np.c_[rng.uniform(0.15, 0.6, (n_cells, 3)), rng.uniform(0.45, 0.55, n_cells), rng.uniform(0.4, 0.6, n_cells)][cell]
    truth = np.tile(IDENTITY, (objects, 1))
    truth[:, GAINS] = rng.normal(1.2, 0.12, (objects, 3))
    truth[:, BIASES] = rng.normal(0, 0.03, (objects, 3))
    truth[:, CROSS_TERMS] = rng.normal(0, 0.05, (objects, 6))
    truth[:, 12] = family.texture
    truth[:, 13] = np.clip(rng.normal(0.5, 0.15, objects), 0.15, 0.9) - 0.5 * family.texture
    truth[:, 14], truth[:, 15] = 0.0, rng.random(objects) < 0.1
    at = np.arange(n_cells) % cells
    place = np.stack([at % family.side, at // family.side, np.zeros(n_cells)], 1)
    across, down = (-(-family.side // step) for step in family.shared)
    group = (np.arange(n_cells) // cells * down + place[:, 1] // family.shared[1]) * across + place[:, 0] // family.shared[0]
    light = rng.normal(0, family.light, (objects * across * down, 1))[group.astype(int)][cell]
    shading = shading_of(rng, n)
    shown = radiance_of(
        apply_affines(truth, obj, base), [part * np.exp(light).reshape(-1, *[1] * (part.ndim - 1)) for part in shading]
    )
    value = response("gamma", [family.gamma])(0.5 * shown) + rng.normal(0, family.photo, (n, 3))
    value = np.rint(255.0 * np.clip(value, 0.0, 1.0)) / 255.0
    halves = []
    for _ in range(2):
        noise = np.exp(rng.normal(0, family.cache, (n_cells, 3)) - 0.5 * family.cache**2)[cell]
        halves.append([shading[0] * noise, shading[1] * noise[:, None], shading[2] * noise[:, None]])
    diffuse, s0, s1 = (tuple(np.asarray(h[i], np.float32) for h in halves) for i in range(3))
    saturated = value >= 0.99
    cluster = patches(obj, place[cell])
    value = np.minimum(value, 0.99)
    problem = FitProblem(
        object_id=obj,
        n_objects=objects,
        base=base,
        diffuse=diffuse,
        s0=s0,
        s1=s1,
        levels=LEVELS,
        value=value,
        exposure=np.full(n, 0.5),
        saturated=saturated,
        cluster=cluster,
    )
    return problem, truth


def fitted(seed: int, problem: FitProblem, family: Family) -> FitResult:
    """From a calibration that errs by what it says, or from nothing."""
    if not family.calibration:
        return fit_affines(problem, response("gamma"), FitOptions())
    mean = np.random.default_rng([0x70, seed]).normal(family.gamma, family.calibration, 1)
    prior = (mean, np.eye(1) / family.calibration**2)
    return fit_affines(problem, response("gamma", mean), FitOptions(response_prior=prior))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--objects", type=int, default=12)
    parser.add_argument("--family", choices=tuple(FAMILIES), default="room")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    z: dict[str, list[np.ndarray]] = {name: [] for name in ("gain", "bias", "cross", "albedo", "roughness level", "response")}
    family = FAMILIES[arguments.family]
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        problem, truth = planted(seed, arguments.objects, family)
        fit = fitted(seed, problem, family)
        spread = np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2))
        right_kind = fit.affine[:, 15] == truth[:, 15]
        error = (fit.affine - truth)[right_kind]
        for name, columns in (("gain", GAINS), ("bias", BIASES), ("cross", CROSS_TERMS)):
            z[name].append((error[:, columns] / np.maximum(spread[right_kind][:, columns], 1e-12)).ravel())
        mean = np.stack([problem.base[problem.object_id == o].mean(0) for o in range(arguments.objects)])[right_kind]
        covariance = fit.covariance[right_kind]
        one = np.c_[mean[:, :3], np.ones(len(mean))]
        for c in range(3):
            rows = slice(4 * c, 4 * c + 4)
            deviation = np.sqrt(np.einsum("oi,oij,oj->o", one, covariance[:, rows, rows], one))
            z["albedo"].append((one * error[:, rows]).sum(1) / np.maximum(deviation, 1e-12))
        level = np.c_[mean[:, 3], np.ones(len(mean))]
        deviation = np.sqrt(np.einsum("oi,oij,oj->o", level, covariance[:, 12:14, 12:14], level))
        z["roughness level"].append((level * error[:, 12:14]).sum(1) / np.maximum(deviation, 1e-12))
        z["response"].append((fit.response.params.ravel() - family.gamma) / np.sqrt(np.diagonal(fit.response_covariance)))
    columns: dict[str, list[object]] = {"quantity": [], "intervals": [], "coverage_68": [], "error_over_claimed": []}
    for name, parts in z.items():
        values = np.concatenate(parts)
        row = (
            name,
            len(values),
            float(np.mean(np.abs(values) <= 1)),
            float(np.sqrt(np.mean(np.minimum(np.abs(values), 10) ** 2))),
        )
        for column, entry in zip(columns.values(), row, strict=True):
            column.append(entry)
        print(f"{name:16s} {row[1]:5d} intervals, {100 * row[2]:.0f} % contain the truth, error / claimed {row[3]:.2f}")
    if arguments.output:
        import pandas

        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        pandas.DataFrame(columns).to_parquet(arguments.output)


if __name__ == "__main__":
    main()
