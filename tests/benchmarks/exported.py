"""Whether other programs see what was recovered: the exported files of a finished scene, read again.

    python tests/benchmarks/exported.py kitchen [--quality draft] [--views 3] [--samples 64] [--replicates 12] [--json rows.json]

Run it in a working folder where the scene is finished. Prints, and adds to a JSON file: faults that Khronos' validator finds;
mean differences of `scene.glb`, read by trimesh, from `maps/` of the same views; and the radiance of `mitsuba/` by `render.py`
(the exact reflectance) and as stock `scene.xml`, over that of the workflow's own renderer: ratio of the means with its standard
error, and Sidak's test of all pixels.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np

from workflow.runtime import native

VALIDATOR = Path(__file__).resolve().parents[2] / ".node/node_modules/gltf-validator"
VALIDATE = """
const v = require(process.argv[1]), fs = require('fs');
v.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2]))).then(r => console.log(JSON.stringify(r.issues)));
"""
EDGE = 0.02
"""A pixel whose depth differs from that of the photograph's mesh by more than this share shows another surface."""


def validated(path: Path) -> dict[str, int]:
    """Errors and warnings of a glTF file."""
    done = subprocess.run(["node", "-e", VALIDATE, str(VALIDATOR), str(path)], capture_output=True, text=True, check=True)
    issues = json.loads(done.stdout)
    return {"errors": issues["numErrors"], "warnings": issues["numWarnings"]}


def chosen(views: list[Any], count: int) -> list[Any]:
    """Some views, spread evenly."""
    return [views[i] for i in np.unique(np.linspace(0, len(views) - 1, min(count, len(views))).round().astype(int))]


def round_trip(job: Any, capture: Any, views: list[Any]) -> dict[str, float]:
    """Mean absolute differences of the materials, over pixels that show the same surface."""
    from tests.oracles.exported import maps_of, read_back
    from workflow.artifacts.store import material_maps

    up = np.asarray(job.read("export").json("export.json")["up"])
    meshes = read_back(job.read("export").path("scene.glb"), up)
    sums, count, other, total = np.zeros(5), 0, 0, 0
    for view in views:
        found, points, of = maps_of(meshes, view)
        depth, face_id = capture.gbuffer(view)
        maps = material_maps(job.read("render").exr(f"maps/{view.name}.exr"))
        wanted = np.concatenate([maps["albedo"], maps["roughness"][..., None], maps["metallic"][..., None]], -1).reshape(-1, 5)
        z = (points - view.world_from_camera[:3, 3]) @ view.world_from_camera[:3, 2]
        hit = (face_id >= 0).ravel()
        same = hit & (of >= 0) & (np.abs(z / np.where(hit, depth.ravel(), 1) - 1) < EDGE)
        sums += np.abs(found - wanted)[same].sum(0)
        count, other, total = count + same.sum(), other + (hit & ~same).sum(), total + hit.sum()
    means = sums / count
    names = {"albedo": means[:3].mean(), "roughness": means[3], "metallic": means[4]}
    return {name: float(255 * value) for name, value in names.items()} | {"other_surface": float(other / total)}


def rendered(job: Any, views: list[Any], samples: int, replicates: int) -> dict[str, dict[str, float]]:
    """Radiance of the exported scene over that of our renderer, by the exact and by the stock materials."""
    import mitsuba as mi

    from iif_core.camera.pinhole import direction_derivatives, pixel_directions
    from iif_core.light.transport.render import render
    from iif_core.light.transport.scene import PathOptions, Scene
    from workflow.exporters import mitsuba_render
    from workflow.scene.recovered import read_recovered
    from workflow.stability.monte_carlo import compare

    folder = job.read("export").directory / "mitsuba"
    scenes = {"exact": mitsuba_render.load(folder), "stock": mi.load_file(str(folder / "scene.xml"))}
    recovered = read_recovered(job)
    geometry, material = recovered.surface.traceable(recovered.light.emits)
    world = Scene(geometry, material, recovered.light.emitters(geometry))
    out = {}
    for name, scene in scenes.items():
        sensors = {sensor.id(): sensor for sensor in scene.sensors()}

        def ours(seed: int) -> np.ndarray:
            pictures = []
            for view in views:
                pose = view.world_from_camera
                rays = pixel_directions(view.fx, view.fy, view.cx, view.cy, view.width, view.height, pose).reshape(-1, 3)
                jitter = direction_derivatives(view.fx, view.fy, pose)
                pictures.append(render(world, pose[:3, 3], rays, PathOptions(samples, 8, seed), jitter))
            return np.concatenate(pictures)

        def theirs(seed: int, scene: Any = scene, sensors: dict[str, Any] = sensors) -> np.ndarray:
            own = [mi.render(scene, sensor=sensors[f"view-{view.name}"], spp=samples, seed=seed) for view in views]
            return np.concatenate([np.array(picture)[..., :3].reshape(-1, 3) for picture in own])

        found = compare(name, theirs, ours, replicates)
        out[name] = found._asdict()
        print(
            f"{name}: {1 + found.bias:.4f} +- {found.error:.4f} of our radiance, p {found.smallest:.2g} of {found.threshold:.2g}"
        )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--views", type=int, default=3)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--replicates", type=int, default=12)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    native.process_environment()
    native.prepare()
    native.limit_threads(os.cpu_count() or 1)
    from workflow.runtime import device

    device.mitsuba()
    from workflow.runtime.job import Job
    from workflow.scene.normal_form import CaptureReader

    job = Job("publish", asked.scene, asked.quality, 2)
    capture = CaptureReader(job.read("capture"))
    glb = job.read("export").path("scene.glb")
    row: dict[str, Any] = {"scene": asked.scene, "mb": glb.stat().st_size / 1e6, "validator": validated(glb)}
    print(row)
    row["glb"] = round_trip(job, capture, chosen(capture.views, 12))
    print({name: round(value, 4) for name, value in row["glb"].items()}, "times 1/255; other_surface: share of pixels")
    row["mitsuba"] = rendered(job, chosen(capture.views[:16], asked.views), asked.samples, asked.replicates)
    if asked.json:
        rows = json.loads(asked.json.read_text()) if asked.json.is_file() else []
        rows = [other for other in rows if other["scene"] != asked.scene] + [row]
        asked.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
