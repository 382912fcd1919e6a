"""How exactly 32 planted emitter groups come back, what it costs, and what the paper's descent makes of the same rows.

    python tests/benchmarks/emission_planted.py [--views 16] [--size 64] [--photo-samples 128] [--sgd]

A procedural room with true materials (tests/unit/planted_room.py). Median and largest relative error of the emission of a
group, largest false emission of the three surfaces that do not shine (true values are 3 to 20), process CPU seconds.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=16)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--photo-samples", type=int, default=128)
    parser.add_argument("--samples", type=int, nargs="+", default=[4, 16, 64], help="paths a pixel, over both halves")
    parser.add_argument("--sgd", action="store_true", help="the twin too")
    arguments = parser.parse_args()
    from iif_core import native

    native.prepare()
    import mitsuba

    mitsuba.set_variant("llvm_ad_rgb")
    native.limit_threads(1)
    from iif_core.emission.direct import solve_emission, solve_families
    from iif_core.emission.loss import reference_loss
    from iif_core.emission.sgd import SgdOptions, solve_emission_sgd
    from tests.unit.planted_room import PlantedScene, build_room, relative_errors

    scene = PlantedScene(build_room(), arguments.views, arguments.size)
    photographs, lit = scene.photographs(0, arguments.photo_samples), scene.room.truth.any(1)
    print("| photographs | paths | solver | median | max | false | loss | trace s | solve s |\n" + 9 * "|---" + "|")
    for samples in arguments.samples:
        start = time.process_time()
        halves = scene.halves(0, max(samples // 2, 1))
        traced = time.process_time() - start
        for kind in ("hdr", "hdr_hidden", "ldr", "ldr_one"):
            problem, initial = scene.problem(photographs, halves, kind)
            rows = problem.rows
            solvers = {
                "plain": lambda rows=rows, initial=initial: solve_emission(rows, initial, cross=False),
                "direct": lambda rows=rows, initial=initial: solve_families(rows, initial, scene.families()),
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
