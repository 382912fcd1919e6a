"""Where the time of every stage goes: imports, hashing, EXR and Parquet files, compilation and execution of kernels, the rest.

    python tests/benchmarks/stage_profile.py kitchen [--quality draft] [--threads 2] [--stages base emission]

Run it in a working folder where the scene is finished; each stage is made again, in a process of its own, and writes the same
files. Prints a table for docs/results/performance.md. Seconds of wall time under Python's profiler, which slows Python code by
some ten percent; CPU seconds are those of the process. Start: the interpreter and the imports before the stage begins.
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

from workflow.registry import STAGES
from workflow.runtime import native

PARTS = {
    "hashing": (("files.py", "sha256_of"),),
    "EXR": (("files.py", "read_exr"), ("files.py", "write_exr")),
    "Parquet": (("files.py", "read_parquet"), ("files.py", "write_parquet")),
    "imports": (("<frozen importlib._bootstrap>", "_find_and_load"),),
}
"""Part -> functions (end of the file's name, function) whose time with everything below is that of the part."""
COLUMNS = ("seconds", "cpu", "start", *PARTS, "compiling", "kernels", "rest")


def profiled(stage: str, scene: str, quality: str, threads: int) -> dict[str, float]:
    """Run a stage in this process; return the seconds of its parts."""
    started = time.time() - float(os.environ["STAGE_PROFILE_STARTED"])
    native.process_environment()
    native.prepare()
    native.limit_threads(threads)
    from workflow.runtime.job import configure_logging, run_stage

    configure_logging(Path("results") / scene / "logs" / f"{stage}.profile.log")
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
    parser.add_argument("--here", help="run this stage in this process and print JSON")
    arguments = parser.parse_args()
    if arguments.here:
        print(json.dumps(profiled(arguments.here, arguments.scene, arguments.quality, arguments.threads)))
        return
    common = [arguments.scene, "--quality", arguments.quality, "--threads", str(arguments.threads)]
    total = dict.fromkeys(COLUMNS, 0.0)
    print(f"| stage | {' | '.join(COLUMNS)} |\n|---{'|---:' * len(COLUMNS)}|")
    for stage in arguments.stages:
        environment = {**os.environ, "STAGE_PROFILE_STARTED": str(time.time())}
        command = [sys.executable, __file__, *common, "--here", stage]
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        if done.returncode:
            sys.exit(f"{stage}: {done.stderr.strip().splitlines()[-1] if done.stderr.strip() else 'failed'}")
        found = json.loads(done.stdout.strip().splitlines()[-1])
        total = {name: total[name] + found[name] for name in COLUMNS}
        print(f"| {stage} | {' | '.join(f'{found[name]:.1f}' for name in COLUMNS)} |", flush=True)
    print(f"| all | {' | '.join(f'{total[name]:.1f}' for name in COLUMNS)} |")


if __name__ == "__main__":
    main()
