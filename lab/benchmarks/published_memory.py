"""Memory and time of the published material fit over the number of pixels, on made-up light (lab/docs/published.md#materials).

    python lab/benchmarks/published_memory.py [--pixels 1000000 5300000]

Each size runs in a separate process. Anonymous memory, the largest of samples every 20 ms, is what the process cannot give
back; the joined light is mapped from a file without a name in the working folder, whose pages the system takes back when
something else needs them. One pass over the pixels in steps of 32,768, and the loss of all of them at its end.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

OBJECTS, LEVELS, VIEW = 200, 6, 1 << 18


def anonymous_mb() -> float:
    """Anonymous memory of this process in MB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("RssAnon")) / 1024


def watch_memory(largest: list[float]) -> None:
    """Keep the largest anonymous memory of this process in `largest[0]`, for ever."""
    while True:
        largest[0] = max(largest[0], anonymous_mb())
        time.sleep(0.02)


def measured(pixels: int) -> str:
    """Return a row of the table for a problem of so many pixels."""
    from iif_core.camera.response import response
    from iif_core.fitting.problem import FitProblem
    from lab.published.fitting.descent import PublishedOptions, PublishedState, descend
    from lab.published.fitting.reference_loss import reference_loss
    from workflow.artifacts.scratch import Joined

    rng, here = np.random.default_rng(0), Path(".")
    base, diffuse, s0, s1 = (Joined(here) for _ in range(4))
    columns: list[list[np.ndarray]] = [[], [], []]
    for start in range(0, pixels, VIEW):
        n = min(VIEW, pixels - start)
        base.add(rng.random((n, 5), np.float32))
        diffuse.add(rng.random((n, 3), np.float32) + 0.2)
        for layer, scale in ((s0, 0.5), (s1, 0.02)):
            layer.add(scale * rng.random((n, LEVELS, 3), np.float32))
        columns[0].append(rng.integers(0, OBJECTS, n).astype(np.int32))
        columns[1].append(rng.random((n, 3), np.float32))
        columns[2].append(np.ones(n))
    owner, value, exposure = (np.concatenate(columns.pop(0)) for _ in range(3))
    saturated = np.zeros((pixels, 3), bool)
    problem = FitProblem(
        object_id=owner,
        n_objects=OBJECTS,
        base=base.array(),
        diffuse=(diffuse.array(),),
        s0=(s0.array(),),
        s1=(s1.array(),),
        levels=np.linspace(0.02, 1, LEVELS),
        value=value,
        exposure=exposure,
        saturated=saturated,
    )
    curve = response("srgb")
    options, largest = PublishedOptions(epochs=1), [0.0]
    threading.Thread(target=watch_memory, args=(largest,), daemon=True).start()
    begin = time.perf_counter()
    state = list(descend(problem, curve, PublishedState.start(OBJECTS, curve), options))[-1]
    seconds = (time.perf_counter() - begin) / state.step
    loss = reference_loss(problem, state.affine, curve).total
    whole = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return f"| {pixels / 1e6:.1f} | {largest[0]:.0f} | {whole:.0f} | {seconds:.3f} | {loss:.4f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pixels", type=int, nargs="+", default=[1_000_000, 5_300_000])
    parser.add_argument("--here", type=int, help="measure this size in this process")
    arguments = parser.parse_args()
    if arguments.here:
        print(measured(arguments.here))
        return
    print("| million pixels | anonymous MB | MB with mapped pages | s a step | loss |\n|---:|---:|---:|---:|---:|")
    for pixels in arguments.pixels:
        command = [sys.executable, __file__, "--here", str(pixels)]
        print(subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip(), flush=True)


if __name__ == "__main__":
    main()
