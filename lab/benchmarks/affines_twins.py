"""What the direct solver and the paper's optimiser cost on the same caches, and where each leaves the paper's loss.

    python lab/benchmarks/affines_twins.py --output results/studies/affines_twins.parquet

The planted problem of `affines_coverage.py`. Process CPU seconds of one thread, compiled and warmed up before. `direct` is the
default fit, `direct, reference loss` the same solver on the reference loss alone, to its end and for 10 and 4 steps; `sgd` the
published schedule (three equal parts, rate 10, x 0.2 after each) of so many steps of 32,768 pixels (4,848 as published), `adam`
likewise.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from iif_core.camera.response import response
from iif_core.fitting.direct import fit_affines
from iif_core.fitting.problem import FitOptions, FitResult
from iif_core.reflectance.material import apply_affines
from lab.benchmarks.affines_coverage import planted
from lab.published.fitting.reference_loss import reference_loss, reference_options, reference_problem
from lab.published.fitting.sgd import SgdOptions, fit_affines_sgd


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--objects", type=int, default=80)
    parser.add_argument("--steps", type=int, nargs="*", default=[12, 120, 1200])
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    problem, truth = planted(0, arguments.objects)
    small, _ = planted(1, 2)
    start = response("gamma")
    fit_affines(small, start), fit_affines_sgd(small, start, SgdOptions(epochs=1))
    fit_affines(reference_problem(small, start), start, reference_options())
    batch = 32768

    def schedule(method: str, steps: int) -> Callable[[], FitResult]:
        # parts of equal length stand for the published epochs: the pixels are gone through as often as the steps need
        return lambda: fit_affines_sgd(problem, start, SgdOptions(method, batch=batch, steps=steps))

    runs: dict[str, Callable[[], FitResult]] = {
        "direct": lambda: fit_affines(problem, start, FitOptions()),
        "direct, reference loss": lambda: fit_affines(reference_problem(problem, start), start, reference_options()),
        "direct, the same, 4 steps": lambda: fit_affines(
            reference_problem(problem, start), start, reference_options(iterations=4)
        ),
    }
    runs |= {f"{method}, {steps} steps": schedule(method, steps) for method in ("sgd", "adam") for steps in arguments.steps}
    columns: dict[str, list[object]] = {name: [] for name in ("solver", "cpu_seconds", "reference_loss", "albedo_psnr", "pixels")}
    wanted = apply_affines(truth, problem.object_id, problem.base)[:, :3]
    for name, run in runs.items():
        begin = time.process_time()
        fit = run()
        seconds = time.process_time() - begin
        loss = reference_loss(problem, fit.affine, fit.response)
        albedo = apply_affines(fit.affine, problem.object_id, problem.base)[:, :3]
        psnr = -10 * np.log10(np.mean((albedo - wanted) ** 2))
        for column, entry in zip(columns.values(), (name, seconds, loss.total, psnr, len(problem.object_id)), strict=True):
            column.append(entry)
        print(
            f"{name:24s} {seconds:7.2f} CPU s  loss {loss.total:.6f} (data {loss.data:.6f})  albedo {psnr:.2f} dB  {fit.reason}",
            flush=True,
        )
    if arguments.output:
        import pandas

        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        pandas.DataFrame(columns).to_parquet(arguments.output)


if __name__ == "__main__":
    main()
