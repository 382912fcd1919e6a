"""How exactly 32 planted emitter groups come back, what it costs, and what the paper's descent makes of the same rows.

    python lab/benchmarks/emission_planted.py [--views 16] [--size 64] [--photo-samples 128] [--room 0] [--seed 0] [--limit]

A procedural room with true materials (tests/unit/planted_room.py). Median and largest relative error of the emission of a
group, largest false emission of the three surfaces that do not shine (true values are 3 to 20), process CPU seconds.
`--sgd`: the twin too. `--limit`: what no unbiased estimator can be better than, from the noise as it is (`information_limit`).
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))


def information_limit(scene, photographs: np.ndarray, photo_paths: int, paths: list[int]) -> list[tuple[str, float]]:
    """Median relative error of the best unbiased estimate (Cramer-Rao) that knows emitters by their light alone.

    Rows are the means of (object, view, tile), A of 1024 paths a pixel. Variance of a row from the scatter of its pixels about
    A E, and of A E from two halves, pooled over rows of one object and like brightness (raw, it would be taken for knowledge).
    """
    from iif_core.light.emission.rows import EmissionRows, block_rows

    truth, group = scene.room.truth, scene.room.group[scene.face]
    own = (group >= 0) & truth[group].any(1)
    halves = sum(scene.transport(1000 + i, 128).matrix[:, 0] for i in range(4)) / 4
    shown = [np.einsum("ngc,gc->nc", a, truth) for a in halves]
    # A E has noise, too. The numbers of paths give the share of the variance that belongs to the photographs alone.
    square = (photographs - 0.5 * (shown[0] + shown[1])) ** 2 / (1 + photo_paths / 1024)
    key = np.stack([scene.room.object_id[scene.face], scene.view, scene.tile], 1)[~own]
    number, block = np.unique(key, axis=0, return_inverse=True)

    def means(values: np.ndarray) -> np.ndarray:
        empty, ones, free = np.zeros((2, 1, len(key), 0, 3), np.float32), np.ones((len(key), 3)), np.zeros((len(key), 3), bool)
        rows = EmissionRows(empty, values[~own], np.zeros((2, 1, len(key), 3)), ones, free)
        return block_rows(rows, block.ravel())[0].observed

    size = np.bincount(block.ravel())[:, None]
    matrix = np.stack([means(0.5 * (halves[0][:, g] + halves[1][:, g])) for g in range(len(truth))], 1)
    first, second = means(shown[0]), means(shown[1])
    level = 0.5 * (first + second).mean(1)
    pool = number[:, 0] * 20 + np.digitize(level, np.quantile(level, np.linspace(0.05, 0.95, 19)))
    scale = (level[:, None] + 0.05 * np.median(level)) ** 2

    def pooled(variance: np.ndarray) -> np.ndarray:
        member = np.unique(pool, return_inverse=True)[1]
        mean = np.stack([np.bincount(member, v) / np.bincount(member) for v in (variance / scale).T], 1)
        return np.maximum(mean[member], 1e-9) * scale

    photo, trace = pooled(means(square) / size), pooled(0.25 * (first - second) ** 2)
    limits = []
    for name, factor in [("exact", 0.0), *((str(n), 1024 / n) for n in paths)]:
        variance = photo + factor * trace
        spread = [np.diag(np.linalg.inv((a.T / v) @ a)) for a, v in zip(np.moveaxis(matrix, 2, 0), variance.T, strict=True)]
        error = np.sqrt(sum(spread)) / np.maximum(truth.sum(1), 1e-9)
        limits.append((name, float(0.6745 * np.median(error[truth.any(1)]))))  # median |x| of a normal x
    return limits


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=16)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--photo-samples", type=int, default=128)
    parser.add_argument("--samples", type=int, nargs="+", default=[4, 16, 64], help="paths a pixel, over both halves")
    parser.add_argument("--room", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", action="store_true", help="the information limit of light alone, too")
    parser.add_argument("--sgd", action="store_true", help="the twin too")
    arguments = parser.parse_args()
    from workflow.runtime import native

    native.prepare()
    import mitsuba

    mitsuba.set_variant("llvm_ad_rgb")
    native.limit_threads(1)
    from iif_core.light.emission.direct import EmissionPrior, solve_emission, solve_families
    from lab.published.light.loss import reference_loss
    from lab.published.light.sgd import SgdOptions, solve_emission_sgd
    from tests.unit.planted_room import PlantedScene, averaged, build_room, relative_errors

    scene = PlantedScene(build_room(arguments.room), arguments.views, arguments.size)
    photographs, lit = scene.photographs(arguments.seed, arguments.photo_samples), scene.room.truth.any(1)
    limits = information_limit(scene, photographs, arguments.photo_samples, arguments.samples) if arguments.limit else []
    for name, limit in limits:
        print(f"no unbiased estimate from light alone is better than {limit:.3f} ({name} paths)", flush=True)
    print("| photographs | paths | solver | median | max | false | loss | trace s | solve s |\n" + 9 * "|---" + "|")
    for samples in arguments.samples:
        start = time.process_time()
        transport = scene.transport(arguments.seed, max(samples // 2, 1))
        traced = time.process_time() - start
        for kind in ("hdr", "hdr_hidden", "ldr", "ldr_one"):
            problem, initial = scene.problem(photographs, transport, kind)
            rows = problem.rows
            solvers = {
                "plain": lambda rows=rows, initial=initial: solve_emission(averaged(rows), initial),
                "direct": lambda rows=rows, initial=initial: solve_families(
                    rows, EmissionPrior.independent(initial), scene.families()
                ),
            }
            if arguments.sgd:
                solvers["sgd safe"] = lambda rows=rows, initial=initial: solve_emission_sgd(rows, initial)
                paper = SgdOptions("paper", 6464, 8192, ((100, 0.0), (1000, 0.05)))
                solvers["sgd paper"] = lambda rows=rows, initial=initial, o=paper: solve_emission_sgd(rows, initial, o)
            for name, solve in solvers.items():
                start = time.process_time()
                found = solve()
                spent = time.process_time() - start
                error, loss = relative_errors(scene.room, found.radiance), reference_loss(rows, found.radiance)
                numbers = f"{np.median(error):.3f} | {error.max():.3f} | {found.radiance[~lit].max():.2f} | {loss:.5f}"
                print(f"| {kind} | {samples} | {name} | {numbers} | {traced:.1f} | {spent:.2f} |", flush=True)


if __name__ == "__main__":
    main()
