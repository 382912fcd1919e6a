"""Whether other programs see what was recovered: the exported files of a finished scene, read again.

    python lab/benchmarks/exported.py kitchen modern-hall [--quality draft] [--views 3] [--samples 64] [--replicates 12]

Run it in a working folder where the scenes are finished. For each it prints, and keeps in lab/notebook/data/exported.json:

* the faults that Khronos' validator finds;
* the mean differences of the textures in `scene.glb`, read by trimesh, from the values that were written, and of what the
  textures show from `maps/` of the same views;
* the radiance of `mitsuba/` by `render.py` (the exact reflectance) and as stock `scene.xml`, over the radiance of the workflow's
  own renderer: the ratio of the means with its standard error, and Sidak's test of all pixels.

It also makes the tables of lab/notebook/exports.md anew.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np

from workflow.runtime import native

VALIDATOR = Path(__file__).resolve().parents[2] / ".node/node_modules/gltf-validator"
ROWS, PAGE = Path("lab/notebook/data/exported.json"), Path("lab/notebook/exports.md")
LIGHT = {
    "exact": "render.py",
    "stock": "scene.xml",
    "cells": "render.py, surface cells for textures",
    "mesh": "the same, on the photographs' mesh",
}
VALIDATE = """
const v = require(process.argv[1]), fs = require('fs');
v.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2]))).then(r => console.log(JSON.stringify(r.issues)));
"""
EDGE = 0.02
"""A pixel whose depth differs from the depth of the photograph's mesh by more than this share shows another surface."""


def validated(path: Path) -> dict[str, int]:
    """Errors and warnings of a glTF file."""
    done = subprocess.run(["node", "-e", VALIDATE, str(VALIDATOR), str(path)], capture_output=True, text=True, check=True)
    issues = json.loads(done.stdout)
    return {"errors": issues["numErrors"], "warnings": issues["numWarnings"]}


def chosen(views: list[Any], count: int) -> list[Any]:
    """Some views, spread evenly."""
    return [views[i] for i in np.unique(np.linspace(0, len(views) - 1, min(count, len(views))).round().astype(int))]


def round_trip(job: Any, capture: Any, views: list[Any], read: Callable[[int, Any], tuple[Any, Any]]) -> dict[str, float]:
    """Mean absolute differences of the materials, over pixels that show the same surface.

    `read(number, view)` gives values (H W, 5) and depth along the camera's axis (H W,), nan or infinite where nothing is.
    """
    from workflow.artifacts.store import material_maps

    sums, count, other, total = np.zeros(5), 0, 0, 0
    for number, view in enumerate(views):
        found, z = read(number, view)
        depth, face_id = capture.gbuffer(view)
        maps = material_maps(job.read("render").exr(f"maps/{view.name}.exr"))
        wanted = np.concatenate([maps["albedo"], maps["roughness"][..., None], maps["metallic"][..., None]], -1).reshape(-1, 5)
        hit = (face_id >= 0).ravel()
        same = hit & np.isfinite(z) & (np.abs(z / np.where(hit, depth.ravel(), 1) - 1) < EDGE)
        sums += np.abs(found - wanted)[same].sum(0)
        count, other, total = count + same.sum(), other + (hit & ~same).sum(), total + hit.sum()
    means = sums / count
    names = {"albedo": means[:3].mean(), "roughness": means[3], "metallic": means[4]}
    return {name: float(255 * value) for name, value in names.items()} | {"other_surface": float(other / total)}


def by_trimesh(job: Any, capture: Any, views: list[Any]) -> tuple[dict[str, float], dict[str, float]]:
    """Differences that trimesh and rays see: as written, and by pixel."""
    from tests.oracles.exported import maps_of, read_back

    meshes = read_back(job.read("export").path("scene.glb"), np.asarray(job.read("export").json("export.json")["up"]))

    def read(number: int, view: Any) -> tuple[Any, Any]:
        found, points, of = maps_of(meshes, view)
        return found, np.where(of >= 0, (points - view.world_from_camera[:3, 3]) @ view.world_from_camera[:3, 2], np.inf)

    visuals = [visual.material for _, _, visual in meshes.values() if visual.material.baseColorTexture is not None]
    pictures = np.asarray(visuals[0].baseColorTexture), np.asarray(visuals[0].metallicRoughnessTexture)
    return written(job, *pictures), round_trip(job, capture, views, read)


def by_blender(job: Any, capture: Any, views: list[Any]) -> dict[str, Any]:
    """Differences that Blender sees: textures as written and by pixel, radiance of the lamps, and cameras."""
    from tests.oracles.blender import python_with_bpy, read_by_blender

    python = python_with_bpy()
    if python is None:
        raise SystemExit("no Blender: name a Python that has its module bpy in IIF_BPY_PYTHON (pip install bpy==4.5.*)")
    export = job.read("export")
    document = export.json("cameras.json")
    read = read_by_blender(python, export.path("scene.glb"), document, [view.name for view in views])
    if read.spaces["base_color"] != "sRGB" or read.spaces["surface"] != "Non-Color":
        raise SystemExit(f"Blender reads the textures in other colour spaces: {read.spaces}")
    row: dict[str, Any] = {"version": read.version}
    row["written"] = written(job, read.textures["base_color"], read.textures["surface"])
    row["maps"] = round_trip(job, capture, views, lambda number, view: (read.values[number], read.depth[number]))
    return row | {"lamps": lamps(export, read.emission), "cameras": cameras(document, read.cameras, capture.views)}


def by_browser(job: Any, capture: Any, views: list[Any]) -> dict[str, Any]:
    """What a viewer in a browser sees: differences by pixel, lamps, time and complaints. One picture of it is kept in
    results/studies/exported/."""
    from tests.oracles.gltf_viewer import available, open_in_browser

    if not available():
        raise SystemExit("no viewer: Chromium and three.js are needed (make node)")
    export = job.read("export")
    opened = open_in_browser(export.path("scene.glb"), views)
    picture = Path("results/studies/exported") / f"{job.scene}.png"
    picture.parent.mkdir(parents=True, exist_ok=True)
    picture.write_bytes(opened.picture)
    row: dict[str, Any] = {
        "maps": round_trip(job, capture, views, lambda number, view: (opened.values[number], opened.depth[number]))
    }
    row |= {"lamps": lamps(export, {name: np.asarray(value) for name, value in opened.facts["lamps"].items()})}
    row |= {"seconds": opened.seconds, "first": opened.first, "complaints": opened.complaints}
    return row | {"revision": opened.facts["revision"], "outside": [name for name in opened.requests if name.startswith("http")]}


def lamps(export: Any, emission: dict[str, np.ndarray]) -> dict[str, float]:
    """How many lamps a program has of the surface that shines, and the largest relative difference of their radiance."""
    table = export.table("emitters.parquet")
    radiance = np.stack([table[f"radiance_{c}"] for c in "rgb"], 1)
    own = np.flatnonzero(radiance.any(1) & (table["kind"] == "area"))  # glTF has no light from outside
    wanted = {int(table["emitter_id"][row]): radiance[row] for row in own}
    found = {int(name.rpartition(".emitter")[2]): value for name, value in emission.items()}
    both = sorted(wanted.keys() & found.keys())
    worst = max((float(np.abs(found[n] - wanted[n]).max() / wanted[n].max()) for n in both), default=0.0)
    return {"found": len(both), "extra": len(found.keys() - wanted.keys()), "wanted": len(wanted), "worst": worst}


def cameras(document: dict[str, Any], found: dict[str, Any], views: list[Any]) -> dict[str, float]:
    """The largest differences of position (m), direction and field of view (degrees) of the cameras in the file itself."""
    turn = np.asarray(document["blender"]["world_to_blender"])[:3, :3]
    away, turned, angle = [], [], []
    for view in views:
        own = found[f"view {view.name}"]
        pose, wanted = np.asarray(own["pose"]), turn @ view.world_from_camera[:3] @ np.diag([1.0, -1.0, -1.0, 1.0])
        away.append(np.linalg.norm(pose[:3, 3] - wanted[:, 3]))
        turned.append(np.linalg.norm(pose[:3, :3] - wanted[:, :3], 2))
        width, focal = (view.height, view.fy) if own["fit"] == "VERTICAL" else (view.width, view.fx)
        field = own["angle_y"] if own["fit"] == "VERTICAL" else own["angle_x"]
        angle.append(abs(field - 2 * np.arctan(0.5 * width / focal)))
    return {"m": float(max(away)), "degrees": float(np.degrees(max(turned))), "field": float(np.degrees(max(angle)))}


def written(job: Any, colour: np.ndarray, surface: np.ndarray) -> dict[str, float]:
    """Mean absolute differences of decoded textures (h, w, 3 or 4) uint8 from the values that were written; nan if smaller."""
    from iif_core.numerics.color import linear_from_srgb
    from workflow.artifacts.files import read_exr
    from workflow.artifacts.store import rgb

    colour, surface = (np.asarray(picture)[..., :3] / 255 for picture in (colour, surface))
    exact = {
        name: read_exr(job.read("export").path(f"mitsuba/textures/{name}.exr")) for name in ("albedo", "roughness", "metallic")
    }
    found = {"albedo": linear_from_srgb(colour), "roughness": surface[..., 1], "metallic": surface[..., 2]}
    out = {}
    for name, values in found.items():
        wanted = rgb(exact[name]) if name == "albedo" else exact[name]["Y"].astype(np.float32)
        out[name] = float(255 * np.abs(values - wanted).mean()) if values.shape == wanted.shape else float("nan")
    return out


def rendered(job: Any, unwrapped: Any, views: list[Any], samples: int, replicates: int) -> dict[str, dict[str, float]]:
    """Radiance of the exported scene over the radiance of our renderer, by the exact and by the stock materials.

    Two more renderings separate what the textures and the simpler mesh do: one by surface cells, and one by surface cells on the
    mesh of the photographs."""
    import mitsuba as mi

    from iif_core.camera.pinhole import direction_derivatives, pixel_directions
    from iif_core.light.transport.render import render
    from iif_core.light.transport.scene import PathOptions, Scene
    from lab.stability.monte_carlo import compare
    from tests.oracles.mitsuba_cells import load_with_cells, unsimplified
    from workflow.exporters import mitsuba_render
    from workflow.exporters.atlas import bake, read_parts
    from workflow.scene.recovered import read_recovered

    folder = job.read("export").directory / "mitsuba"
    recovered = read_recovered(job)
    parts = read_parts(unwrapped, recovered)
    small = bake(parts, recovered, np.zeros(len(recovered.cell_centres)), 64)  # nothing reads its textures
    scenes = {
        "exact": lambda: mitsuba_render.load(folder),
        "stock": lambda: mi.load_file(str(folder / "scene.xml")),
        "cells": lambda: load_with_cells(parts, small, views, recovered),
    }
    if any(part.simplified for part in parts):
        scenes["mesh"] = lambda: load_with_cells(unsimplified(parts, recovered), small, views, recovered)
    geometry, material = recovered.surface.traceable(recovered.light.emits)
    world = Scene(geometry, material, recovered.light.emitters(geometry))

    @lru_cache(None)
    def ours(seed: int) -> np.ndarray:
        pictures = []
        for view in views:
            pose = view.world_from_camera
            rays = pixel_directions(view.fx, view.fy, view.cx, view.cy, view.width, view.height, pose).reshape(-1, 3)
            jitter = direction_derivatives(view.fx, view.fy, pose)
            pictures.append(render(world, pose[:3, 3], rays, PathOptions(samples, 8, seed), jitter))
        return np.concatenate(pictures)

    out = {}
    for name, load in scenes.items():
        scene = load()
        sensors = {sensor.id(): sensor for sensor in scene.sensors()}

        def theirs(seed: int, scene: Any = scene, sensors: dict[str, Any] = sensors) -> np.ndarray:
            own = [mi.render(scene, sensor=sensors[f"view-{view.name}"], spp=samples, seed=seed) for view in views]
            return np.concatenate([np.array(picture)[..., :3].reshape(-1, 3) for picture in own])

        found = compare(name, theirs, ours, replicates)
        out[name] = found._asdict()
        print(
            f"{name}: {1 + found.bias:.4f} +- {found.error:.4f} of our radiance, p {found.smallest:.2g} of {found.threshold:.2g}",
            flush=True,
        )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--views", type=int, default=3)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--replicates", type=int, default=12)
    measure(parser.parse_args(), ROWS, measured)


def measure(asked: argparse.Namespace, place: Path, measured: Callable[[str, argparse.Namespace], dict[str, Any]]) -> None:
    """Measure each scene, keep its row in `place` as soon as it is there, and make the page anew."""
    native.process_environment()
    native.prepare()
    native.limit_threads(os.cpu_count() or 1)
    from workflow.runtime import device

    device.mitsuba()
    rows = json.loads(place.read_text()) if place.is_file() else []
    for scene in asked.scenes:
        row = measured(scene, asked)
        rows = sorted([other for other in rows if other["scene"] != scene] + [row], key=lambda row: row["scene"])
        place.write_text(json.dumps(rows, indent=1) + "\n")
    write_page()


def write_page() -> None:
    """Make all tables of the page anew, those of `room_light.py` too."""
    from lab.benchmarks import room_light_tables
    from workflow.report.blocks import fill

    rows, lit = (json.loads(path.read_text()) if path.is_file() else [] for path in (ROWS, room_light_tables.ROWS))
    PAGE.write_text(fill(PAGE.read_text(), tables(rows) | room_light_tables.tables(lit)))


def measured(scene: str, asked: argparse.Namespace) -> dict[str, Any]:
    """The row of one scene."""
    from workflow.artifacts.store import StageReader
    from workflow.runtime.job import Job
    from workflow.scene.normal_form import CaptureReader

    job = Job("publish", scene, asked.quality, 2)
    capture = CaptureReader(job.read("capture"))
    glb, unlit = job.read("export").path("scene.glb"), job.read("room").path("scene_unlit.glb")
    found = [validated(path) for path in (glb, unlit)]
    row: dict[str, Any] = {"scene": scene, "mb": glb.stat().st_size / 1e6}
    row["validator"] = {name: sum(of[name] for of in found) for name in ("errors", "warnings")}
    reader = StageReader(Path("results") / scene / "unwrap", "unwrap", scene)
    row |= {"faces": reader.json("unwrap.json")["faces"], "texture": job.read("export").json("export.json")["texture"]}
    print(scene, row)
    some = chosen(capture.views, 12)
    row["written"], row["maps"] = by_trimesh(job, capture, some)
    print({name: round(value, 4) for name, value in (row["written"] | row["maps"]).items()})
    row |= {"blender": by_blender(job, capture, some), "browser": by_browser(job, capture, some)}
    print(row["blender"], row["browser"])
    row["paths"] = {"samples": asked.samples, "replicates": asked.replicates}
    row["mitsuba"] = rendered(job, reader, chosen(capture.views[:16], asked.views), asked.samples, asked.replicates)
    return row


def tables(rows: list[dict[str, Any]]) -> dict[str, str]:
    """The tables of the page."""
    from workflow.report.blocks import markdown

    three = ("albedo", "roughness", "metallic")
    files, materials, others, light = [], [], [], []
    for row in rows:
        name, texture, blender, browser = row["scene"], row["texture"], row["blender"], row["browser"]
        faces = f"{row['faces']['mesh']:,} to {row['faces']['parts']:,}"
        size = f"{texture['size']} ({texture['format']})"
        lengths = [f"{1000 * texture[key]:.1f}" for key in ("texel_in_glb_m", "cell_m")]
        faults = f"{row['validator']['errors']} / {row['validator']['warnings']}"
        files.append([name, faces, size, *lengths, f"{row['mb']:.1f}", faults])
        for by, read in (
            ("trimesh", row),
            (f"Blender {blender['version']}", blender),
            (f"three.js r{browser['revision']}", browser),
        ):
            pairs = [f"{read['written'][q]:.2f}" if "written" in read else "" for q in three]
            pairs += [f"{read['maps'][q]:.2f}" for q in three]
            materials.append([name, by, *pairs, f"{100 * read['maps']['other_surface']:.2f} %"])
        at = blender["cameras"]
        others.append(
            [
                name,
                f"{blender['lamps']['found']} and {browser['lamps']['found']} of {blender['lamps']['wanted']}",
                *(f"{read['lamps']['worst']:.0e}" if read["lamps"]["found"] else "" for read in (blender, browser)),
                *(f"{value:.0e}" for value in (1000 * at["m"], at["degrees"], at["field"])),
                str(len(browser["complaints"])),
                f"{browser['seconds'] + browser['first']:.1f}",
            ]
        )
        for kind in (kind for kind in LIGHT if kind in row["mitsuba"]):
            one = row["mitsuba"][kind]
            sidak = f"{one['smallest']:.1g} of {one['threshold']:.1g}"
            by, ratio = LIGHT[kind], f"{1 + one['bias']:.4f} ± {one['error']:.4f}"
            light.append([name, by, f"{row['paths']['replicates']} x {row['paths']['samples']}", ratio, sidak])
    heads = {
        "files": ["scene", "faces", "texture", "texel, mm", "cell, mm", "scene.glb, MB", "errors / warnings"],
        "materials": [
            "scene",
            "read by",
            *(f"{q}, {of}" for of in ("as written", "by pixel") for q in three),
            "other surface",
        ],
        "others": [
            "scene",
            "lamps in Blender and three.js",
            "radiance, Blender",
            "radiance, three.js",
            "cameras: position, mm",
            "direction, degrees",
            "field of view, degrees",
            "complaints of the browser",
            "seconds to the first picture",
        ],
        "light": ["scene", "by", "renderings x paths", "radiance over ours", "smallest p, threshold"],
    }
    bodies = {"files": files, "materials": materials, "others": others, "light": light}
    words = {"files": 1, "materials": 2, "others": 2, "light": 2}
    return {name: "\n".join(markdown(head, bodies[name], words[name])) for name, head in heads.items()}


if __name__ == "__main__":
    main()
