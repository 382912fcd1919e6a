"""Light transport and the networks of the learned priors on the CPU and on a CUDA device: the same light? how fast?

    python lab/benchmarks/device.py transport [--devices cpu cuda] [--threads 2] [--repeats 5] [--json FILE]
    python lab/benchmarks/device.py priors [--devices cpu cuda] [--json FILE]

`transport` traces the built-in kitchen on each device, in a separate process with an empty cache of kernels. It calls the
functions that the stages call: bare rays, pictures (`render`), cached shading at six roughness levels (`shading`), light maps
(`room`) and the transport matrix (`emission`). Seconds are those of whole calls, with the copies between NumPy and the device;
the first call compiles. On CUDA every call is also made with more lanes at once than the CPU has (`chunk`). Then both devices
compute the same values in independent replicates, which are compared as the study of stability compares renderings, and once with
the same random numbers.

`priors` runs random checkpoints of the architectures of RGB-X and Marigold in single and half precision, and measures a U-Net of
RGB-X's size (866 million random weights).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from workflow.runtime import device, native

SIZE, SAMPLES, BOUNCES = 256, 64, 6
LEVELS = [0.02, 0.1, 0.25, 0.45, 0.7, 1.0]
POINTS, POINT_SAMPLES = 8192, 128
BARE_RAYS = 1 << 22
MORE_LANES = (20, 22)
"""Logarithms of the numbers of lanes at once that are tried on CUDA; the default is 18 (`iif_core.light.transport.arrays`)."""
REPLICATES, EVERY, FEW_SAMPLES = 16, 16, 32
"""Replicates of the comparison, which has every 16th ray or point."""
CLOSE = 1e-3
"""Relative difference up to which two values count as equal: float32 over a path of some reflections."""


class Work(NamedTuple):
    """A computation of the project: `run(every, samples, seed, chunk)` -> values (n, ...), and the number of paths of a call of
    full size; 0 samples = as many as that call has."""

    run: Callable[[int, int, int, int | None], np.ndarray]
    paths: int


# -------------------------------------------------------------------------------------------------------------- transport


def kitchen() -> dict[str, Work]:
    """Build the built-in kitchen on the device of this process; return what is computed in it."""
    from iif_core.camera.pinhole import direction_derivatives, pixel_directions
    from iif_core.light.transport.emitters import Emitters
    from iif_core.light.transport.geometry import build_geometry, trace
    from iif_core.light.transport.lightmaps import light_maps
    from iif_core.light.transport.matrix import transport_matrix
    from iif_core.light.transport.render import render
    from iif_core.light.transport.scene import EmitterColumns, PathOptions, Scene, ShadingPoints
    from iif_core.light.transport.shading import shading_caches
    from lab import rooms

    room = rooms.build("kitchen")
    geometry = build_geometry(room.vertices, room.faces, room.object_id)
    front = np.ones(len(room.faces), np.int8)
    scene = Scene(geometry, room.materials.drjit(), Emitters(geometry, room.emission, front))
    shining = room.emission.any(1)
    lamps, lamp = np.unique(room.object_id[shining], return_inverse=True)
    lamp_of_face = np.full(len(room.faces), -1, np.int32)
    lamp_of_face[shining] = lamp

    pose = room.cameras(8)[0]
    focal = 0.5 * SIZE / np.tan(np.radians(room.field_of_view / 2))
    ways = pixel_directions(focal, focal, SIZE / 2, SIZE / 2, SIZE, SIZE, pose).reshape(-1, 3)
    steps = direction_derivatives(focal, focal, pose)
    face, depth = trace(geometry, pose[:3, 3], ways)
    matte = np.flatnonzero((face >= 0) & ~shining[np.maximum(face, 0)])
    pick = matte[np.linspace(0, len(matte) - 1, POINTS).astype(int)]
    points, wo = pose[:3, 3] + depth[pick, None] * ways[pick], -ways[pick]
    normals = geometry.normals[face[pick]]
    normals = np.where((normals * wo).sum(1, keepdims=True) < 0, -normals, normals)
    albedo, roughness, metallic = room.materials.numpy(points, room.object_id[face[pick]])

    rng = np.random.default_rng(0)
    start = rng.integers(0, POINTS, BARE_RAYS)
    away = normals[start] + 0.999 * (lambda v: v / np.linalg.norm(v, axis=1, keepdims=True))(rng.normal(size=(BARE_RAYS, 3)))
    from_here = (points[start] + 1e-3 * normals[start]).astype(np.float32)

    def paths(samples: int, full: int, seed: int, chunk: int | None) -> PathOptions:
        return PathOptions(samples or full, BOUNCES, seed, chunk)

    def bare(every: int, samples: int, seed: int, chunk: int | None) -> np.ndarray:
        return trace(geometry, from_here[::every], away[::every].astype(np.float32), chunk or 1 << 20)[1]

    def picture(every: int, samples: int, seed: int, chunk: int | None) -> np.ndarray:
        return render(scene, pose[:3, 3], ways[::every], paths(samples, SAMPLES, seed, chunk), steps)

    def shading(every: int, samples: int, seed: int, chunk: int | None) -> np.ndarray:
        own = paths(samples, POINT_SAMPLES, seed, chunk)
        diffuse, s0, s1 = shading_caches(scene, points[::every], normals[::every], wo[::every], LEVELS, own)
        return np.concatenate([diffuse[:, None], s0, s1], 1)

    def maps(every: int, samples: int, seed: int, chunk: int | None) -> np.ndarray:
        own = paths(samples, POINT_SAMPLES, seed, chunk)
        return light_maps(scene, points[::every], normals[::every], lamp_of_face, len(lamps), own)

    def matrix(every: int, samples: int, seed: int, chunk: int | None) -> np.ndarray:
        own = paths(samples, POINT_SAMPLES, seed, chunk)
        rows = (points, normals, wo, albedo, roughness, metallic)
        at = ShadingPoints(*(part[::every] for part in rows))
        return transport_matrix(scene, at, EmitterColumns(lamp_of_face, len(lamps), front), own)[0]

    of_points = POINTS * POINT_SAMPLES
    return {
        "bare rays": Work(bare, BARE_RAYS),
        "picture": Work(picture, SIZE * SIZE * SAMPLES),
        "shading": Work(shading, of_points),
        "light maps": Work(maps, of_points),
        "transport matrix": Work(matrix, of_points),
    }


def traced(kind: str, threads: int, repeats: int, folder: Path) -> dict[str, Any]:
    """Time everything on a device in this process; write the values to compare to `folder`/<device>.npz."""
    os.environ["DRJIT_CACHE_DIR"] = tempfile.mkdtemp(prefix="kernels-")
    native.prepare()
    chosen = device.use(kind)
    variant = device.mitsuba().variant()
    native.limit_threads(threads)
    begin = time.perf_counter()
    works = kitchen()
    found: dict[str, Any] = {"device": str(chosen), "variant": variant, "threads": threads}
    found["seconds to build the room"] = time.perf_counter() - begin
    values: dict[str, np.ndarray] = {}
    for name, work in works.items():
        found[name] = {"paths": work.paths, **_timed(lambda: work.run(1, 0, 1, None), repeats)}  # noqa: B023  called at once
        for power in MORE_LANES if chosen.kind == "cuda" else ():
            more = _timed(lambda: work.run(1, 0, 1, 1 << power), repeats)  # noqa: B023
            found[name] |= {f"2^{power} lanes": more["seconds"], f"2^{power} lanes, kernels": more["kernels"]}
        first = work.run(EVERY, FEW_SAMPLES, 7, None)
        found[name]["same bytes again"] = first.tobytes() == work.run(EVERY, FEW_SAMPLES, 7, None).tobytes()
        found[name]["same bytes in chunks"] = first.tobytes() == work.run(EVERY, FEW_SAMPLES, 7, 4096).tobytes()
        values[f"{name}: same"] = first
        # Seeds of the devices differ, so that the replicates are independent.
        seeds = range(1000 * (1 + list(device.VARIANTS).index(chosen.kind)), 100_000)[:REPLICATES]
        if name != "bare rays":
            values[f"{name}: replicates"] = np.stack([work.run(EVERY, FEW_SAMPLES, seed, None).reshape(-1, 3) for seed in seeds])
        print(f"{chosen.kind}: {name}: {json.dumps(found[name])}", file=sys.stderr, flush=True)
    np.savez(folder / f"{chosen.kind}.npz", **values)
    return found


def _timed(call: Callable[[], Any], repeats: int) -> dict[str, float]:
    """Seconds of the first call, of compiling in it, of later calls (median) and of the kernels of one later call."""
    first, compiled, _ = _with_history(call)
    later = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        later.append(time.perf_counter() - begin)
    return {"first": first, "compiling": compiled, "seconds": float(np.median(later)), "kernels": _with_history(call)[2]}


def _with_history(call: Callable[[], Any]) -> tuple[float, float, float]:
    import drjit as dr

    dr.kernel_history_clear()
    begin = time.perf_counter()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        call()
        seconds = time.perf_counter() - begin
        history = dr.kernel_history()
    compiling = sum(k.get("codegen_time", 0.0) + k.get("backend_time", 0.0) for k in history) / 1e3
    return seconds, compiling, sum(k.get("execution_time", 0.0) for k in history) / 1e3


def compared(folder: Path) -> dict[str, Any]:
    """Compare what both devices computed."""
    from lab.stability.monte_carlo import compare

    cpu, cuda = (np.load(folder / f"{kind}.npz") for kind in ("cpu", "cuda"))
    found: dict[str, Any] = {}
    for key in cpu.files:
        name, what = key.split(": ")
        a, b = cpu[key].astype(np.float64), cuda[key].astype(np.float64)
        if what == "same":
            both = np.isfinite(a) & np.isfinite(b)
            near = np.abs(a - b) <= CLOSE * np.maximum(np.abs(a), np.abs(b))
            found[name] = {
                "values within 1e-3": float(near[both].mean()),
                "finite alike": bool((np.isfinite(a) == np.isfinite(b)).mean() > 0.9999),
                "difference of the means": float(b[both].mean() / a[both].mean() - 1),
            }
            continue
        test = compare(name, lambda seed: a[seed // 2], lambda seed: b[seed // 2], len(a))  # noqa: B023
        whole = {"bias": test.bias, "standard error": test.error, "sigmas": test.sigmas}
        found[name] |= {**whole, "tests": test.tests, "smallest p": test.smallest, "threshold": test.threshold}
    return found


def transport(arguments: argparse.Namespace) -> dict[str, Any]:
    """Measure each device in a separate process, and compare them."""
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for kind in arguments.devices:
            command = [sys.executable, __file__, "transport", "--child", folder, "--devices", kind]
            command += ["--threads", str(arguments.threads), "--repeats", str(arguments.repeats)]
            child = subprocess.run(command, stdout=subprocess.PIPE, text=True)
            if child.returncode:
                found[kind] = {"failed": child.returncode}
            else:
                found[kind] = json.loads(child.stdout.splitlines()[-1])
        if all((Path(folder) / f"{kind}.npz").is_file() for kind in ("cpu", "cuda")):
            found["comparison"] = compared(Path(folder))
    return found


# ----------------------------------------------------------------------------------------------------------------- priors


def priors(arguments: argparse.Namespace) -> dict[str, Any]:
    """Samples of random checkpoints on each device and in each precision, against the CPU; the rate of a large U-Net."""
    import torch

    from tests.unit import tiny_diffusion
    from workflow import settings as settings_module
    from workflow.priors import marigold, rgbx
    from workflow.priors.diffusion import load_model, predict_maps

    os.environ["HF_HUB_OFFLINE"] = "1"
    modes = [("cpu", "float32")]
    if "cuda" in arguments.devices:
        modes += [("cuda", "float32"), ("cuda", "float16"), ("cuda", "bfloat16")]
    rng = np.random.default_rng(0)
    photo = np.kron(rng.random((10, 14, 3)), np.ones((8, 8, 1))).astype(np.float32)
    found: dict[str, Any] = {"torch": torch.__version__}
    with tempfile.TemporaryDirectory() as folder:
        for kind, module in (("rgbx", rgbx), ("marigold", marigold)):
            checkpoint = tiny_diffusion.make(Path(folder) / kind, kind)
            reference, found[kind] = None, {}
            for where, precision in modes:
                document = {"kind": kind, "checkpoint": str(checkpoint), "accept_license": True, "samples": 8, "longest_side": 64}
                document |= {"device": where, "precision": precision, "steps": 10}
                sections = []
                for batch in (4, 4, 1):
                    section = settings_module.UNIONS["prior"][kind].model_validate(document | {"batch": batch})
                    sections.append(SimpleNamespace(**section.model_dump(mode="json")))
                load_model.cache_clear()
                maps = [predict_maps(module.RECIPE, section, photo, 64, 10, 0) for section in sections]
                reference = maps[0] if reference is None else reference
                away = maps[0] - reference
                found[kind][f"{where}, {precision}"] = {
                    "root mean square difference from cpu": float(np.sqrt(np.mean(away**2))),
                    "largest": float(np.abs(away).max()),
                    "spread of the samples": float(maps[0].std(0).mean()),
                    "same bytes again": maps[0].tobytes() == maps[1].tobytes(),
                    "largest difference from samples alone": float(np.abs(maps[0] - maps[2]).max()),
                }
                print(f"{kind}: {where}, {precision}: {found[kind][f'{where}, {precision}']}", file=sys.stderr, flush=True)
    if "cuda" in arguments.devices:
        found["U-Net of RGB-X's size"] = _large_unet()
    return found


def _large_unet() -> dict[str, Any]:
    """Evaluations a second at 512 x 512 pixels (64 x 64 latents), batches of 4 and 16, and how far half precision is away."""
    import diffusers
    import torch

    from workflow.models.loading import deterministic

    where = torch.device("cuda")
    torch.manual_seed(0)
    with where:
        unet = diffusers.UNet2DConditionModel(
            sample_size=64, in_channels=8, out_channels=4, block_out_channels=(320, 640, 1280, 1280),
            attention_head_dim=[5, 10, 20, 20], cross_attention_dim=1024, use_linear_projection=True,
        ).eval().requires_grad_(False)  # fmt: skip
        noisy, text = torch.randn(16, 8, 64, 64), torch.randn(16, 77, 1024)
    found: dict[str, Any] = {"weights": sum(weight.numel() for weight in unet.parameters())}
    reference = None
    for precision in (torch.float32, torch.float16, torch.bfloat16):
        unet = unet.to(precision)
        name = str(precision).removeprefix("torch.")
        with deterministic(where):
            for batch in (4, 16):
                inputs = noisy[:batch].to(precision), torch.tensor(500, device=where), text[:batch].to(precision)
                seconds = []
                for _ in range(7):
                    torch.cuda.synchronize()
                    begin = time.perf_counter()
                    out = unet(*inputs).sample.float()
                    torch.cuda.synchronize()
                    seconds.append(time.perf_counter() - begin)
                found[f"{name}, batch {batch}: evaluations a second"] = batch / float(np.median(seconds[2:]))
                if batch == 4:
                    reference = out if reference is None else reference
                    found[f"{name}: relative difference"] = float((out - reference).norm() / reference.norm())
    found["peak GB"] = torch.cuda.max_memory_allocated() / 1e9
    return found


def main() -> None:
    """Measure, print, and keep as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["transport", "priors"])
    parser.add_argument("--devices", nargs="+", choices=["cpu", "cuda"], default=["cpu", "cuda"])
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1, help="of the CPU")
    parser.add_argument("--repeats", type=int, default=5, help="timed calls, after the first")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        print(json.dumps(traced(arguments.devices[0], arguments.threads, arguments.repeats, arguments.child)))
        return
    found = transport(arguments) if arguments.what == "transport" else priors(arguments)
    text = json.dumps(found, indent=1)
    print(text)
    if arguments.json:
        arguments.json.write_text(text)


if __name__ == "__main__":
    main()
