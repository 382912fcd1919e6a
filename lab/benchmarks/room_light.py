"""Whether room.html shows the light of every lamp as paths find it, how fast it opens, and how fast a slider answers.

    python lab/benchmarks/room_light.py kitchen modern-hall [--quality draft] [--views 12] [--samples 256]

Run it in a working folder where stage room of the scenes is finished. For each it opens the page in Chromium, which draws by
software, walks to the cameras of some photographs, and looks at a grid of pixels with one lamp on at a time, without gloss. The
exposure is chosen for each lamp so that few pixels are clipped; those are left out. The light of the lamp at the points under
the pixels is traced anew, on the mesh of the photographs and by the integrator of stage shading, times the diffuse reflectance
that the page has there. Single texels are compared with many whole paths. Rows are kept in lab/notebook/data/room_light.json,
and the tables of lab/notebook/exports.md are made anew.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np

from lab.benchmarks.exported import measure
from lab.benchmarks.room_light_tables import ROWS

STEP = 24
"""Pixels of the canvas between two that are looked at."""
BRIGHT = 0.9
"""Value on the screen, linear, of the brightest pixel but one in 500."""
CLIPPED = 254
"""Pixels with a channel of at least this are left out."""
EDGE = 0.01
"""Points are left out if their distance from the eye differs from the photographs' mesh by more than this share."""
DIM = 0.05
"""Errors of texels are relative to their light, or to this share of the mean if that is more."""
SLIDES = 12
"""Movements of a slider that are timed."""


def room_page(path: Path, views: int) -> dict[str, Any]:
    """Open the page and look at each lamp from some cameras.

    Returns:
        seconds until the page is ready, milliseconds until a moved slider is drawn, and of all pixels: part, uv (n, 2), point,
        normal (n, 3) and direction to the eye, and for each lamp the pixels (n, 3) uint8 and the exposure in stops.
    """
    from playwright.sync_api import sync_playwright

    from tests import browser

    look = """([points]) => { const p = room.pixels(), ratio = p.width / document.getElementById('view').clientWidth;
        return points.map(([x, y]) => { const at = 4 * ((p.height - 1 - Math.floor(y * ratio)) * p.width + Math.floor(x * ratio));
        return Array.from(p.data.slice(at, at + 3)); }); }"""
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=browser.executable(), args=[*browser.QUIET, *browser.SOFTWARE_GL])
        page = chromium.new_context(viewport=dict(zip(("width", "height"), browser.DESKTOP, strict=True))).new_page()
        begin = time.perf_counter()
        page.goto(path.resolve().as_uri())
        page.evaluate("room.ready")
        page.wait_for_selector("body.ready")
        opened = time.perf_counter() - begin
        slide = page.evaluate(  # until the browser has shown two more frames, of which the first has the new light
            """async n => { const times = []; for (let i = 0; i < n; i++) { const t = performance.now();
            room.setLamp(0, i % 2 ? 1 : 0.5); await new Promise((r) => requestAnimationFrame(() => requestAnimationFrame(r)));
            times.push(performance.now() - t); } room.setLamp(0, 1);
            return times.sort((a, b) => a - b)[Math.floor(n / 2)]; }""",
            SLIDES,
        )
        full = page.evaluate(
            """n => { const times = []; room.pixels(); for (let i = 0; i < n; i++) { const t = performance.now();
            room.setLamp(0, i % 2 ? 1 : 0.5); room.pixels(); times.push(performance.now() - t); } room.setLamp(0, 1);
            return times.sort((a, b) => a - b)[Math.floor(n / 2)]; }""",
            SLIDES,
        )
        lamps = page.evaluate("room.data.lamps.length")
        width, height = page.evaluate("(v => [v.clientWidth, v.clientHeight])(document.getElementById('view'))")
        grid = [[x + 0.5, y + 0.5] for y in range(STEP, height, STEP) for x in range(STEP, width, STEP)]
        page.evaluate("room.setGloss(false)")
        count = page.evaluate("room.data.photographs.length")
        places, pictures = [], []
        chosen = np.unique(np.linspace(0, count - 1, min(views, count)).round().astype(int)).tolist()
        for number in chosen:
            page.evaluate("i => { room.showPhotograph(i); room.showPhotograph(-1); }", number)
            hits = page.evaluate("points => points.map(([x, y]) => room.hit(x, y))", grid)
            kept = [(at, hit) for at, hit in zip(grid, hits, strict=True) if hit and hit["emitter"] < 0]
            eye = page.evaluate("room.camera().eye")
            places.append(([at for at, _ in kept], [hit for _, hit in kept], eye))
        stops = []
        for lamp in range(lamps):
            page.evaluate("only => room.data.lamps.forEach((_, l) => room.setLamp(l, l === only ? 1 : 0))", lamp)
            stops.append(_stops(page, chosen, places, look))
            page.evaluate("stops => room.setExposure(stops)", stops[-1])
            own = []
            for number, (points, _, _) in zip(chosen, places, strict=True):
                page.evaluate("i => { room.showPhotograph(i); room.showPhotograph(-1); }", number)
                own += page.evaluate(look, [points])
            pictures.append(np.array(own, np.uint8))
        chromium.close()
    facts = {name: np.array([hit[name] for _, hits, _ in places for hit in hits]) for name in ("uv", "point", "normal")}
    facts["eye"] = np.concatenate([np.tile(eye, (len(hits), 1)) for _, hits, eye in places])
    return {"opened": opened, "slide": slide, "full": full, "facts": facts, "pixels": pictures, "stops": stops}


def _stops(page: Any, chosen: list[int], places: list[Any], look: str) -> float:
    """Exposure, in stops, at which one pixel in 500 is brighter than BRIGHT."""
    from iif_core.numerics.color import linear_from_srgb

    low, high = page.evaluate("(e => [Number(e.min), Number(e.max)])(document.getElementById('exposure'))")
    stops = low
    for _ in range(2):  # from a dark picture to its right exposure, and once more for the digits
        page.evaluate("stops => room.setExposure(stops)", stops)
        values = []
        for number, (points, _, _) in zip(chosen, places, strict=True):
            page.evaluate("i => { room.showPhotograph(i); room.showPhotograph(-1); }", number)
            values += page.evaluate(look, [points])
        bright = np.quantile(linear_from_srgb(np.array(values).max(1) / 255), 0.998)
        stops = float(np.clip(stops + np.log2(BRIGHT / max(bright, 1e-3)), low, high))
    return stops


def traced(job: Any, document: dict[str, Any], facts: dict[str, np.ndarray], samples: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Which points (n,) are those of the photographs' mesh, and the diffuse light (n, 3) of each lamp there.

    Points are where rays from the eye meet the mesh: those of the page lie up to a millimetre behind it, because it stores
    positions in 16 bits, and what begins there sees the other side of a wall.
    """
    from iif_core.light.transport.geometry import trace
    from iif_core.light.transport.scene import PathOptions, Scene
    from iif_core.light.transport.shading import shading_caches
    from workflow.runtime import device
    from workflow.scene.recovered import read_recovered

    device.mitsuba()
    recovered = read_recovered(job)
    geometry, material = recovered.surface.traceable(recovered.light.emits)
    turn = np.reshape(document["worldFromRoom"], (3, 3))
    points, eye = (facts[name] @ turn for name in ("point", "eye"))
    distance = np.linalg.norm(points - eye, axis=1)
    way = (points - eye) / distance[:, None]
    face, reach = trace(geometry, eye, way)
    same = np.abs(reach / distance - 1) < EDGE
    points, normals = eye + np.where(same, reach, distance)[:, None] * way, geometry.normals[np.maximum(face, 0)]
    out = []
    for number, lamp in enumerate(document["lamps"]):
        lit = np.isin(recovered.emitter_id, lamp["emitters"])
        dark = np.zeros_like(recovered.light.environment)
        light = replace(
            recovered.light,
            radiance=np.where(lit[:, None], recovered.light.radiance, np.float32(0)),
            environment=dark if lamp["emitters"] else recovered.light.environment,
        )
        world = Scene(geometry, material, light.emitters(geometry))
        out.append(shading_caches(world, points, normals, eye - points, [], PathOptions(samples, 16, 31 + number))[0])
    return same, out


def texel_errors(job: Any, stored: Any, asked: argparse.Namespace) -> list[dict[str, float]]:
    """For each lamp, errors of the stored light of single texels that photographs show, against many whole paths there."""
    from iif_core.light.transport.lightmaps import light_maps
    from iif_core.light.transport.scene import PathOptions
    from workflow.exporters.atlas import bake, read_parts, texels_of
    from workflow.room.light import find_lamps, inside_solids, lit_scene, lit_texels
    from workflow.scene.recovered import read_recovered

    recovered = read_recovered(job)
    parts = read_parts(job.read("unwrap"), recovered)
    lamps = find_lamps(parts, recovered.emitter_radiance, recovered.light.environment, recovered.emitter_names)
    texels = lit_texels(parts, stored.document["light"]["size"])
    atlas = bake(parts, recovered, job.read("affines").table("cells.parquet")["uncertainty"], stored.document["light"]["size"])
    lit = lit_scene(parts, recovered.surface, lamps)
    two_sided = np.array([part.double_sided for part in parts])
    free = ~two_sided[texels.part] & ~inside_solids(lit.scene.geometry, texels, two_sided[lit.part_of_face], 1)
    free &= atlas.seen.ravel()[texels.index] & np.isin(texels.index, texels_of(parts, texels.size).index)
    rng = np.random.default_rng(5)
    some = np.sort(rng.choice(np.flatnonzero(free), min(asked.texels, int(free.sum())), replace=False))
    paths = PathOptions(asked.texel_samples, 16, 17)
    of = lit.lamp_of_face, len(lamps.lamps), paths, lamps.environment, some.astype(np.uint32)
    truth = light_maps(lit.scene, texels.points[some], texels.normals[some], *of).mean(2, dtype=np.float64)
    found = stored.light[np.searchsorted(stored.arrays["texels"][:, 0], texels.index[some])].mean(2)
    area = texels.edge[texels.part[some]][:, None] ** 2
    error = (found - truth) / np.maximum(truth, DIM * truth.mean(0))
    ratio = (area * found).sum(0) / (area * truth).sum(0)
    rms, rare = np.sqrt((error**2).mean(0)), np.quantile(np.abs(error), 0.999, axis=0)
    return [dict(zip(("ratio", "rms", "rare"), map(float, one), strict=True)) for one in zip(ratio, rms, rare, strict=True)]


def measured(scene: str, asked: argparse.Namespace) -> dict[str, Any]:
    """The row of one scene."""
    from iif_core.numerics.color import linear_from_srgb
    from tests.room_page import bilinear, read_room
    from workflow.runtime.job import Job

    job = Job("publish", scene, asked.quality, 2)
    path = job.read("room").path("room.html")
    stored = read_room(path)
    found = room_page(path, asked.views)
    uv = found["facts"]["uv"]
    base = bilinear(linear_from_srgb(stored.pictures["base"] / 255), uv)
    kd = base * (1 - bilinear(stored.pictures["surface"] / 255, uv)[:, 2:])
    row: dict[str, Any] = {"scene": scene, "mb": path.stat().st_size / 1e6, "points": len(uv), "samples": asked.samples}
    row |= {"opened_s": found["opened"], "slide_ms": found["slide"], "full_ms": found["full"], "lamps": []}
    texels = texel_errors(Job("room", scene, asked.quality, 2), stored, asked)
    same, paths = traced(job, stored.document, found["facts"], asked.samples)
    for number, (lamp, light) in enumerate(zip(stored.document["lamps"], paths, strict=True)):
        pixels = found["pixels"][number]
        kept = (pixels.max(1) < CLIPPED) & same
        gain = stored.document["exposure"] * 2.0 ** found["stops"][number]
        shown = linear_from_srgb(pixels / 255) / gain
        mapped = kd * bilinear(stored.picture_of(stored.light[:, number] * np.array(lamp["color"])), uv)
        expected = kd * light
        total = expected[kept].sum()
        row["lamps"].append(
            {
                "lamp": lamp["name"],
                "stops": found["stops"][number],
                "clipped": float((pixels.max(1) >= CLIPPED).mean()),
                "pixels": float(shown[kept].sum() / total),
                "maps": float(mapped[kept].sum() / total),
                "maps_of_all": float(mapped[same].sum() / expected[same].sum()),
                "median": float(np.median(np.abs(shown - expected)[kept].mean(1)) / expected[kept].mean()),
                "texels": texels[number],
            }
        )
        print(
            scene,
            {
                name: value if isinstance(value, str) else round(value, 4)
                for name, value in row["lamps"][-1].items()
                if name != "texels"
            },
        )
        print(texels[number])
    print(scene, {name: round(value, 3) for name, value in row.items() if isinstance(value, float)})
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--texels", type=int, default=2000)
    parser.add_argument("--texel-samples", type=int, default=2048)
    measure(parser.parse_args(), ROWS, measured)


if __name__ == "__main__":
    main()
