"""What flushing costs a stage: `python lab/benchmarks/flushing.py <folder on the disk>` prints milliseconds, medians of runs.

A stage of 60 rasters and 3 tables in 4 folders is written as it is; without flushing folders; with one flush of the folder for
each file; and without any flush.
"""

import os
import shutil
import sys
import time
from pathlib import Path

import numpy as np

from workflow.artifacts import StageWriter
from workflow.artifacts import files as io

RASTER = {name: np.random.default_rng(0).random((128, 128)).astype(np.float16) for name in "RGB"}
RUNS = 9


def perform(folder: Path) -> float:
    shutil.rmtree(folder, ignore_errors=True)
    began = time.perf_counter()
    writer = StageWriter(folder, {"scene": "s", "stage": "base", "fingerprint": "f"})
    for number in range(60):
        writer.exr(f"{('maps', 'truth', 'gbuffer')[number % 3]}/{number}.exr", RASTER)
    for number in range(3):
        writer.table(f"{number}.parquet", {"a": np.arange(1000)})
    writer.finish()
    return 1000 * (time.perf_counter() - began)


def main() -> None:
    folder = Path(sys.argv[1]) / "flushing"
    flush, fsync, write = io.flush_folder, os.fsync, io.write_atomically

    def each(path, content, *_):
        write(path, content, True)

    ways = {
        "as it is": {},
        "folders not flushed": {"flush_folder": lambda path: None},
        "a folder flushed for each file": {"write_atomically": each},
        "nothing flushed": {"flush_folder": lambda path: None, "fsync": lambda handle: None},
    }
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(RUNS):
        for name, changes in ways.items():
            io.flush_folder = changes.get("flush_folder", flush)
            io.write_atomically = changes.get("write_atomically", write)
            os.fsync = changes.get("fsync", fsync)
            times[name].append(perform(folder))
    os.fsync = fsync
    shutil.rmtree(folder)
    for name, found in times.items():
        print(f"{name}: {np.median(found):.0f} ms ({min(found):.0f} to {max(found):.0f})")


if __name__ == "__main__":
    main()
