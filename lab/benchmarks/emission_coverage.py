"""How often the claimed 68 % intervals of emission contain the truth, with photographs and traces drawn anew.

    python lab/benchmarks/emission_coverage.py [--seeds 20] [--views 8] [--size 40] [--photo-samples 64] [--samples 32]

Two planted rooms (tests/unit/planted_room.py) with true materials; `hdr_hidden` and `ldr_one`, in which emitters are known
by their light alone. Nothing is fitted to the rooms: the errors are the sandwich of `iif_core.light.emission.direct`.
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
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--size", type=int, default=40)
    parser.add_argument("--photo-samples", type=int, default=64)
    parser.add_argument("--samples", type=int, default=32)
    parser.add_argument("--fine", action="store_true", help="32 groups, most of which only their family determines")
    arguments = parser.parse_args()
    from workflow.runtime import native

    native.prepare()
    import mitsuba

    mitsuba.set_variant("llvm_ad_rgb")
    native.limit_threads(1)
    from iif_core.light.emission.direct import EmissionPrior, solve_families
    from tests.unit.planted_room import PlantedScene, build_room

    print("| room | photographs | inside 68 % | inside 95 % | rms of (E - truth) / error | median relative error | cpu s |")
    print(7 * "|---" + "|")
    for variant in range(2):
        scene = PlantedScene(build_room(variant, not arguments.fine), arguments.views, arguments.size)
        lit = scene.room.truth.any(1)
        ratios: dict[str, list[np.ndarray]] = {}
        relative: dict[str, list[np.ndarray]] = {}
        start = time.process_time()
        for seed in range(arguments.seeds):
            photographs = scene.photographs(seed, arguments.photo_samples)
            transport = scene.transport(seed, arguments.samples // 2)
            for kind in ("hdr_hidden", "ldr_one"):
                problem, initial = scene.problem(photographs, transport, kind)
                found = solve_families(problem.rows, EmissionPrior.independent(initial), scene.families())
                off = (found.radiance - scene.room.truth)[lit]
                ratios.setdefault(kind, []).append(off / found.error[lit])
                relative.setdefault(kind, []).append(np.abs(off) / scene.room.truth[lit])
        spent = time.process_time() - start
        for kind, values in ratios.items():
            z = np.abs(values)
            inside = f"{(z < 1).mean():.2f} | {(z < 2).mean():.2f} | {np.sqrt((z**2).mean()):.2f}"
            print(f"| {variant} | {kind} | {inside} | {np.median(relative[kind]):.3f} | {spent:.0f} |", flush=True)


if __name__ == "__main__":
    main()
