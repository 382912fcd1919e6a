"""Speed of the hash-grid texture against what else one could take: iterations per CPU second.

    python lab/benchmarks/hashgrid.py --output results/studies/hashgrid.parquet

An iteration is forward, loss, backward and Adam on a batch of points. Every option runs in a separate process, one
after another, on the same points; first iterations (compilation) are left out, numbers are medians. CPU seconds are
those of the whole process: on a machine with neighbours they say more than the clock.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [path for path in (str(ROOT), str(ROOT / "tests" / "benchmarks")) if path not in sys.path]

from hashgrid_options import OPTIONS, OURS  # noqa: E402

from lab.published.fusion.hashgrid.levels import HashGridOptions, layout, widths_of  # noqa: E402

SIZES = ((16, 17), (32, 19))  # levels, log2_entries
BATCH = 65_536
BATCHES = 4
ENOUGH = (2, 12)  # iterations: at least, at most
SECONDS = 4.0  # for the iterations of one row, once there are at least two


def room_points(n: int, random: np.random.Generator) -> np.ndarray:
    """Points (n, 3) float32 in [0, 1]^3, uniform on the walls of a room and on ten boxes in it."""
    low = np.concatenate([[[0.0, 0.0, 0.0]], random.uniform(0.05, 0.7, (10, 3))])
    size = np.concatenate([[[1.0, 1.0, 1.0]], random.uniform(0.05, 0.25, (10, 3))])
    area = np.stack([size[:, (axis + 1) % 3] * size[:, (axis + 2) % 3] for axis in range(3)], 1)
    face = random.choice(area.size, n, p=area.ravel() / area.sum())
    box, axis = face // 3, face % 3
    u = random.random((n, 3))
    u[np.arange(n), axis] = random.integers(0, 2, n)
    return (low[box] + size[box] * u).astype(np.float32)


def points_of(kind: str, n: int) -> list[np.ndarray]:
    """The batches of a row: "surfaces" of one room, or "uniform" in the cube."""
    if kind == "uniform":
        random = np.random.default_rng(1)
        return [random.random((n, 3), dtype=np.float32) for _ in range(BATCHES)]
    all_points = room_points(n * BATCHES, np.random.default_rng(0))
    return np.split(all_points, BATCHES)


def measure_option(option: str, levels: int, log2_entries: int, points: str, batch: int, threads: int) -> dict:
    """One row, in this process."""
    import torch

    torch.set_num_threads(threads)
    torch.manual_seed(0)
    batches = [torch.from_numpy(np.ascontiguousarray(u)) for u in points_of(points, batch)]
    iterate = OPTIONS[option](HashGridOptions(levels=levels, log2_entries=log2_entries), batches, threads)
    begin = time.perf_counter()
    iterate(0)
    first = time.perf_counter() - begin
    begin = time.perf_counter()
    iterate(1)  # some options compile or allocate once more
    slow = time.perf_counter() - begin > SECONDS
    wall, cpu = [], []
    while len(wall) < ENOUGH[0] or (not slow and len(wall) < ENOUGH[1] and sum(wall) < SECONDS):
        clock, process = time.perf_counter(), time.process_time()
        iterate(len(wall) % BATCHES)
        cpu.append(time.process_time() - process)
        wall.append(time.perf_counter() - clock)
    return {
        "option": option,
        "levels": levels,
        "log2_entries": log2_entries,
        "points": points,
        "batch": batch,
        "threads": threads,
        "iterations": len(wall),
        "first_seconds": first,
        "seconds": float(np.median(wall)),
        "cpu_seconds": float(np.median(cpu)),
        "it_per_cpu_second": float(1 / np.median(cpu)),
    }


def measure(
    sizes: Iterable[tuple[int, int]] = SIZES,
    options: Iterable[str] | None = None,
    batch: int = BATCH,
    threads: int = 2,
    time_limit: float = 300,
) -> list[dict]:
    """Rows of all options on surface points, and of ours on uniform points; `ratio`: ours over the option, in
    iterations per CPU second. An option that fails or outlasts `time_limit` seconds has NaN and says why in `note`."""
    names = list(OPTIONS) if options is None else [OURS, *(name for name in options if name != OURS)]
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads), "OMP_WAIT_POLICY": "PASSIVE", "OPENBLAS_NUM_THREADS": "1"}
    rows = []
    for levels, log2_entries in sizes:
        ours = None
        for option, points in [(OURS, "surfaces"), (OURS, "uniform"), *((name, "surfaces") for name in names if name != OURS)]:
            arguments = {"option": option, "levels": levels, "log2_entries": log2_entries}
            arguments |= {"points": points, "batch": batch, "threads": threads}
            command = [sys.executable, __file__, "--row", json.dumps(arguments)]
            row = {**arguments, "iterations": 0, "note": ""}
            row |= dict.fromkeys(("first_seconds", "seconds", "cpu_seconds", "it_per_cpu_second"), float("nan"))
            try:
                done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=time_limit)
                if done.returncode == 0:
                    row |= json.loads(done.stdout.splitlines()[-1])
                else:
                    row["note"] = (done.stderr.strip().splitlines() or [f"exit {done.returncode}"])[-1]
            except subprocess.TimeoutExpired:
                row["note"] = f"more than {time_limit:.0f} s"
            ours = ours or row["it_per_cpu_second"]
            row["ratio"] = ours / row["it_per_cpu_second"]
            rows.append(row)
            print(line(row), file=sys.stderr, flush=True)
    return rows


def line(row: dict) -> str:
    """A row of the printed table."""
    return (
        f"{row['levels']:3d} x 2^{row['log2_entries']}  {row['option']:33s} {row['points']:9s} {row['iterations']:3d} it "
        f"{row['seconds']:8.3f} s {row['cpu_seconds']:8.3f} cpu-s {row['it_per_cpu_second']:8.3f} it/cpu-s "
        f"{row['ratio']:7.1f} x  {row.get('note', '')}"
    )


def memory_bound(options: HashGridOptions, batch: int) -> tuple[float, float]:
    """Bytes that an iteration of ours must move, and what one core moves per second here.

    Parameters and two moments are read and written once; per sample: features written and read twice, hidden values
    written and read, slopes of the features written and read.
    """
    levels = layout(options)
    widths = widths_of(options, levels)
    inputs = widths[0]
    parameters = 2 * sum(level.entries for level in levels) + sum(a * b + b for a, b in zip(widths, widths[1:], strict=False))
    moved = 4 * 6 * parameters + 4 * batch * (5 * inputs + 2 * options.hidden * options.hidden_layers)
    array = np.zeros(32 << 20, np.float32)
    times = []
    for _ in range(6):
        begin = time.process_time()
        array += 1
        times.append(time.process_time() - begin)
    return moved, 2 * array.nbytes / min(times[1:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, help="Parquet file to write")
    parser.add_argument("--batch", type=int, default=BATCH)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--option", action="append", help=f"only these besides ours: {', '.join(OPTIONS)}")
    parser.add_argument("--size", action="append", metavar="LEVELS,LOG2", help="only these; e.g. 32,19")
    parser.add_argument("--row", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.row:
        print(json.dumps(measure_option(**json.loads(arguments.row))))
        return
    sizes = [tuple(map(int, size.split(","))) for size in arguments.size] if arguments.size else SIZES
    rows = measure(sizes, arguments.option, arguments.batch, arguments.threads)
    print("\n".join(map(line, rows)))
    for row in rows:
        if row["option"] == OURS and row["points"] == "surfaces":
            options = HashGridOptions(levels=row["levels"], log2_entries=row["log2_entries"])
            moved, rate = memory_bound(options, row["batch"])
            print(
                f"{row['levels']} x 2^{row['log2_entries']}: {moved / 1e9:.2f} GB per iteration at {rate / 1e9:.0f} GB/s of "
                f"one core: bound {moved / rate:.3f} cpu-s, ours {row['cpu_seconds'] / (moved / rate):.1f} times that"
            )
    if arguments.output:
        import pyarrow
        import pyarrow.parquet

        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        pyarrow.parquet.write_table(pyarrow.Table.from_pylist([{"note": "", **row} for row in rows]), arguments.output)


if __name__ == "__main__":
    main()
