"""How the direct solver's cost grows with pixels and with predictions: is it linear over 8x?

    python lab/benchmarks/base_cost.py --output results/studies/base_cost.parquet

A wall of textured objects seen by eight views, predictions in half precision. Process CPU seconds of one thread, median of
`--repeats` runs, compiled and warmed up before. The exponent is the slope of log(seconds) over log(size); 1 = linear.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from iif_core.fusion.direct import solve_direct
from iif_core.fusion.options import FusionOptions
from iif_core.fusion.problem import FusionProblem

VIEWS = 8
OBJECTS = 64


def wall(pixels: int, k: int, seed: int = 0) -> FusionProblem:
    """`pixels` in all over `VIEWS` views, each a window over a wall with 1.5 cells a pixel; K predictions, half of them bad."""
    rng = np.random.default_rng(seed)
    side = int(np.sqrt(pixels / VIEWS))
    size = int(1.5 * side)
    y, x = np.mgrid[:size, :size]
    objects = (y * 8 // size * 8 + x * 8 // size).astype(np.int32)
    texture = (0.5 + 0.3 * np.sin(0.7 * x + 0.3 * y)[..., None] * rng.uniform(0.5, 1, 5)).astype(np.float32)
    cells, segments, predictions = [], [], []
    for view in range(VIEWS):
        dy, dx = rng.integers(0, size - side + 1, 2)
        window = np.s_[dy : dy + side, dx : dx + side]
        cells.append((y[window] * size + x[window]).astype(np.int32).ravel())
        segments.append((objects[window] + OBJECTS * view).ravel())
        gain = rng.normal(1, 0.15, (k, OBJECTS, 5)).astype(np.float32)[:, objects[window].ravel()]
        noise = np.where(np.arange(k) % 2, 0.1, 0.01)[:, None, None] * rng.standard_normal((k, side * side, 5))
        predictions.append(np.clip(gain * texture[window].reshape(-1, 5) + noise, 0.01, 0.99).astype(np.float16))
    of_segment = np.tile(np.arange(OBJECTS, dtype=np.int32), VIEWS)
    return FusionProblem(
        predictions=predictions,
        cell_of_pixel=cells,
        segment_of_pixel=segments,
        n_cells=size * size,
        object_of_cell=objects.ravel(),
        object_of_segment=of_segment,
    )


def measure(repeats: int = 3) -> list[dict[str, Any]]:
    """One row a size: what varies, pixels, k, cpu_seconds, and the exponent of its series."""
    series = {"pixels": [(1 << p, 8) for p in (17, 18, 19, 20)], "predictions": [(1 << 18, k) for k in (4, 8, 16, 32)]}
    solve_direct(wall(1 << 14, 4))  # compiles
    rows: list[dict[str, Any]] = []
    for varied, sizes in series.items():
        own = []
        for pixels, k in sizes:
            problem = wall(pixels, k)
            seconds = []
            for _ in range(repeats):
                start = time.process_time()
                solve_direct(problem, FusionOptions(), threads=1)
                seconds.append(time.process_time() - start)
            own.append({"varied": varied, "pixels": pixels, "predictions": k, "cpu_seconds": float(np.median(seconds))})
        size = np.log([row[varied] for row in own])
        exponent = float(np.polyfit(size, np.log([row["cpu_seconds"] for row in own]), 1)[0])
        rows += [{**row, "exponent": exponent} for row in own]
    return rows


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """CPU seconds over size, log-log, with the fitted lines."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), constrained_layout=True)
    for axis, varied in zip(axes, ("pixels", "predictions"), strict=True):
        own = [row for row in rows if row["varied"] == varied]
        size, seconds = (np.array([row[name] for row in own]) for name in (varied, "cpu_seconds"))
        slope, level = np.polyfit(np.log(size), np.log(seconds), 1)
        axis.loglog(size, seconds, "o", color="#1f6f8b")
        axis.loglog(size, np.exp(level) * size**slope, "-", color="#1f6f8b", label=f"exponent {slope:.2f}")
        fixed = "8 predictions" if varied == "pixels" else "262,144 pixels"
        axis.set(xlabel=f"{varied} ({fixed})", ylabel="CPU seconds, one thread")
        axis.grid(True, which="both", alpha=0.3)
        axis.legend(frameon=False)
    figure.suptitle("Direct base solver: cost against size")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Measure, print, and write the table and the picture next to it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    import pandas as pd

    rows = measure(arguments.repeats)
    frame = pd.DataFrame(rows)
    print(frame.to_string(index=False))
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    frame.to_parquet(arguments.output)
    draw(rows, arguments.output.with_suffix(".png"))


if __name__ == "__main__":
    main()
