"""Where the time of every stage goes: imports, hashing, EXR and Parquet files, compiling and running kernels, and the rest; how
near its rays come to the rate at which the mesh can be traced at all, and its loops over pixels to the bandwidth of memory.

    python lab/benchmarks/stage_profile.py kitchen [--quality draft] [--threads 2] [--stages base emission] [--rays] [--loops]

Run it in a working folder where the scene is finished. Each stage runs again, in a separate process, and writes the same files.
Prints a table for lab/notebook/performance.md. Seconds of wall time under Python's profiler, which slows Python code by
some ten percent; CPU seconds are those of the process. Start: the interpreter and the imports before the stage begins.

With `--rays` each stage that traces runs once more to count its rays, nearest hits and tests of visibility alike. The rate of its
kernels is compared with the rate of rays of random directions from visible surface, traced without anything else.

With `--loops` the compiled loops of the direct solvers of `base` and `affines` are timed on one thread, the first call of each
left out, because it loads compiled code. The size of the arrays that a call is given over its time, relative to the rate at
which a large array is copied, is the largest share of the bound of memory that the loop can have: `sums` and `fit_albedo` are
given all pixels, and late in a fit read those of some objects alone. What is far below 100 % is bound by arithmetic or by waiting
for single values.
"""

from __future__ import annotations

import argparse
import cProfile
import json
import os
import pstats
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import lab  # noqa: F401  for the sources of the laboratory
from workflow.registry import STAGES
from workflow.runtime import native

PARTS = {
    "hashing": (("files.py", "sha256_of"),),
    "EXR": (("files.py", "read_exr"), ("files.py", "write_exr")),
    "Parquet": (("files.py", "read_parquet"), ("files.py", "write_parquet")),
    "imports": (("<frozen importlib._bootstrap>", "_find_and_load"),),
}
"""Part -> functions (end of the file's name, function). Their time, with everything below, is the time of the part."""
COLUMNS = ("seconds", "cpu", "start", *PARTS, "compiling", "kernels", "rest")
TRACING = ("capture", "emission", "shading", "render")
BARE_RAYS = 1 << 20
LOOPS = {"base": ("iif_core.fusion.kernels",), "affines": ("iif_core.fitting.kernels", "iif_core.fitting.profile_kernels")}
SHOWN_SHARE = 0.02
"""Loops that take less than this share of all loops of a stage are left out of the table."""


def profiled(stage: str, scene: str, quality: str, threads: int) -> dict[str, float]:
    """Run a stage in this process; return the seconds of its parts."""
    run_stage = _prepared(stage, scene, threads)
    started = time.time() - float(os.environ["STAGE_PROFILE_STARTED"])
    profile, wall = cProfile.Profile(), time.perf_counter()
    history = _record_kernels()
    profile.runcall(run_stage, stage, scene, quality, threads)
    seconds = time.perf_counter() - wall
    found = {"seconds": seconds + started, "cpu": time.process_time(), "start": started}
    stats = pstats.Stats(profile).stats
    of_part = {part: [key for key in stats if any(key[0].endswith(f) and key[2] == n for f, n in PARTS[part])] for part in PARTS}
    for part, keys in of_part.items():
        found[part] = sum(stats[key][3] for key in keys)
    for key in of_part["imports"]:  # a file that is the first of its kind imports the library that reads it
        for caller, (*_, seconds_of_call) in stats[key][4].items():
            for part, keys in of_part.items():
                found[part] -= seconds_of_call if part != "imports" and caller in keys else 0.0
    kernels = history()
    found["compiling"] = sum(k.get("codegen_time", 0.0) + k.get("backend_time", 0.0) for k in kernels) / 1e3
    found["kernels"] = sum(k.get("execution_time", 0.0) for k in kernels) / 1e3
    found["rest"] = seconds - sum(found[name] for name in (*PARTS, "compiling", "kernels"))
    return found


def _prepared(stage: str, scene: str, threads: int):
    native.process_environment()
    native.prepare()
    native.limit_threads(threads)
    from workflow.runtime.job import configure_logging, run_stage

    configure_logging(Path("results") / scene / "logs" / f"{stage}.profile.log")
    return run_stage


def counted(stage: str, scene: str, quality: str, threads: int) -> dict[str, float]:
    """Run a stage once more and count its rays; also measure the rate of rays on the mesh of the scene, in rays a second."""
    run_stage = _prepared(stage, scene, threads)
    from workflow.runtime import device

    device.mitsuba()
    import drjit as dr
    import mitsuba as mi

    from iif_core.light.transport.geometry import Geometry

    count = dr.zeros(mi.UInt64, 1)

    def counting(method):
        def traced(self, origin, direction, *rest, **named):
            active = mi.Bool(named.get("active", rest[1 if method.__name__ == "occluded" else 0]))
            dr.scatter_add(count, mi.UInt64(1), mi.UInt32(0), active)
            return method(self, origin, direction, *rest, **named)

        return traced

    originals = Geometry.nearest, Geometry.occluded
    Geometry.nearest, Geometry.occluded = (counting(method) for method in originals)
    run_stage(stage, scene, quality, threads)
    dr.eval(count)
    rays = int(count[0])
    Geometry.nearest, Geometry.occluded = originals
    return {"rays": rays, "bare": _bare_rate(scene, quality)}


def _bare_rate(scene: str, quality: str) -> float:
    """Rays a second from visible surface of the scene into the half of all directions on the camera's side, the best of five."""
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    from iif_core.light.transport.arrays import vectors
    from iif_core.light.transport.geometry import build_geometry
    from workflow.artifacts.store import StageReader
    from workflow.runtime import fingerprint
    from workflow.scene.normal_form import CaptureReader

    home = fingerprint.home("capture", scene, quality)
    capture = CaptureReader(StageReader(Path("results") / home / "capture", "capture", home))
    vertices, faces = capture.mesh()
    geometry = build_geometry(vertices, faces, np.zeros(len(faces), np.int32))
    view = capture.views[0]
    depth, face = capture.gbuffer(view)[:2]
    points = capture.points(view, depth)[face >= 0]
    rng = np.random.default_rng(0)
    origin, eye = points[rng.integers(0, len(points), BARE_RAYS)], view.world_from_camera[:3, 3]
    direction = rng.normal(size=(BARE_RAYS, 3))
    direction *= np.sign(((eye - origin) * direction).sum(1, keepdims=True)) / np.linalg.norm(direction, axis=1, keepdims=True)
    rays = vectors(mi.Point3f, (origin + 1e-3 * direction).astype(np.float32)), vectors(mi.Vector3f, direction.astype(np.float32))
    best = np.inf
    for _ in range(6):  # the first compiles
        begin = time.perf_counter()
        dr.eval(geometry.nearest(*rays, mi.Bool(True)))
        dr.sync_thread()
        best = min(best, time.perf_counter() - begin)
    return BARE_RAYS / best


def timed_loops(stage: str, scene: str, quality: str) -> dict[str, list[float]]:
    """Run a stage once more on one thread; return calls, seconds and bytes of the arrays of each compiled loop, by its name."""
    run_stage = _prepared(stage, scene, 1)
    import importlib

    from numba.core.dispatcher import Dispatcher

    modules = [importlib.import_module(name) for name in LOOPS[stage]]
    compiled = [(module, name, loop) for module in modules for name, loop in vars(module).items() if isinstance(loop, Dispatcher)]
    inner = {name for _, _, loop in compiled for name in loop.py_func.__code__.co_names}
    found: dict[str, list[float]] = {}
    warm: set[str] = set()

    def timing(name, loop):
        def timed(*arguments, **named):
            started = time.perf_counter()
            result = loop(*arguments, **named)
            seconds = time.perf_counter() - started
            sizes = {key: size for value in (*arguments, *named.values(), result) for key, size in _arrays(value)}
            if name in warm:
                total = found.setdefault(name, [0, 0.0, 0.0])
                total[:] = total[0] + 1, total[1] + seconds, total[2] + sum(sizes.values())
            warm.add(name)
            return result

        return timed

    for module, name, loop in compiled:
        if name not in inner:  # loops that others call are part of their time
            setattr(module, name, timing(f"{module.__name__.split('.')[1]}.{name}", loop))
    run_stage(stage, scene, quality, 1)
    return found


def _arrays(value):
    """(address, bytes) of every array in a value."""
    import numpy as np

    if isinstance(value, np.ndarray):
        yield value.ctypes.data, value.nbytes
    elif isinstance(value, tuple | list):
        for part in value:
            yield from _arrays(part)


def _bandwidth() -> float:
    """Bytes read and written a second while an array of 256 MB is copied by one thread, the best of five."""
    import numpy as np

    source = np.ones(1 << 25)
    target, best = np.zeros_like(source), np.inf
    for _ in range(5):
        begin = time.perf_counter()
        np.copyto(target, source)
        best = min(best, time.perf_counter() - begin)
    return 2 * source.nbytes / best


def _record_kernels():
    """Have Dr.Jit record its kernels (times in ms); return what gives them."""
    import drjit as dr

    dr.set_flag(dr.JitFlag.KernelHistory, True)
    return lambda: dr.kernel_history([dr.KernelType.JIT]) if hasattr(dr, "kernel_history") else []


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--stages", nargs="+", default=[name for name, stage in STAGES.items() if not stage.on_demand])
    parser.add_argument("--rays", action="store_true", help="count the rays of each stage, too")
    parser.add_argument("--loops", action="store_true", help="time the compiled loops of base and affines, too")
    parser.add_argument("--time-loops", help="the same of one stage, in this process, as JSON")
    parser.add_argument("--here", help="run this stage in this process and print JSON")
    parser.add_argument("--count", help="the same, and count its rays")
    arguments = parser.parse_args()
    if arguments.here or arguments.count:
        work = profiled if arguments.here else counted
        print(json.dumps(work(arguments.here or arguments.count, arguments.scene, arguments.quality, arguments.threads)))
        return
    if arguments.time_loops:
        print(json.dumps(timed_loops(arguments.time_loops, arguments.scene, arguments.quality)))
        return
    common = [arguments.scene, "--quality", arguments.quality, "--threads", str(arguments.threads)]
    total = dict.fromkeys(COLUMNS, 0.0)
    print(f"| stage | {' | '.join(COLUMNS)} |\n|---{'|---:' * len(COLUMNS)}|")
    seconds_of_kernels = {}
    for stage in arguments.stages:
        found = _in_own_process(stage, "--here", common)
        seconds_of_kernels[stage] = found["kernels"]
        total = {name: total[name] + found[name] for name in COLUMNS}
        print(f"| {stage} | {' | '.join(f'{found[name]:.1f}' for name in COLUMNS)} |", flush=True)
    print(f"| all | {' | '.join(f'{total[name]:.1f}' for name in COLUMNS)} |")
    share = sum(total[name] for name in ("start", "imports", "hashing")) / max(total["cpu"], 1e-9)
    print(f"\nStart, imports and hashing, which use one core: {share:.1%} of the CPU seconds.\n")
    tracing = [stage for stage in arguments.stages if stage in TRACING]
    if arguments.rays and tracing:
        print("| stage | million rays | million rays a second of its kernels | share of the bare rate |\n|---|---:|---:|---:|")
        for stage in tracing:
            found = _in_own_process(stage, "--count", common)
            rate = found["rays"] / max(seconds_of_kernels[stage], 1e-9)
            print(f"| {stage} | {found['rays'] / 1e6:.1f} | {rate / 1e6:.2f} | {rate / found['bare']:.0%} |", flush=True)
        print(f"\nBare rate: {found['bare'] / 1e6:.2f} million rays a second.")
    looping = [stage for stage in arguments.stages if stage in LOOPS]
    if arguments.loops and looping:
        copied = _bandwidth()
        print("| stage | loop | calls | seconds | GB a second | share of the bandwidth |\n|---|---|---:|---:|---:|---:|")
        for stage in looping:
            loops = _in_own_process(stage, "--time-loops", common)
            whole = sum(seconds for _, seconds, _ in loops.values())
            for name, (calls, seconds, size) in sorted(loops.items(), key=lambda item: -item[1][1]):
                if seconds >= SHOWN_SHARE * whole:
                    rate = size / seconds
                    print(f"| {stage} | `{name}` | {calls} | {seconds:.2f} | {rate / 1e9:.2f} | {rate / copied:.0%} |")
        print(f"\nBandwidth of one thread: {copied / 1e9:.1f} GB a second.")


def _in_own_process(stage: str, flag: str, common: list[str]) -> dict[str, float]:
    environment = {**os.environ, "STAGE_PROFILE_STARTED": str(time.time())}
    command = [sys.executable, __file__, *common, flag, stage]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    if done.returncode:
        sys.exit(f"{stage}: {done.stderr.strip().splitlines()[-1] if done.stderr.strip() else 'failed'}")
    return json.loads(done.stdout.strip().splitlines()[-1])


if __name__ == "__main__":
    main()
