"""room: one page to walk through the recovered room and to switch its lamps (docs/guide/room.md)."""

from __future__ import annotations

from typing import Any

import numpy as np

from iif_core.errors import InputError
from iif_core.light.light_maps import to_half
from iif_core.numerics import color
from workflow.exporters.atlas import bake, encoded, read_parts
from workflow.exporters.glb import JPEG_QUALITY, glb_bytes
from workflow.exporters.object_table import object_rows
from workflow.exporters.surface import up_axis
from workflow.models.denoise import require_denoiser
from workflow.report import pictures
from workflow.room import build
from workflow.room.light import Lamps, find_lamps, lit_texels, trace_lamps
from workflow.room.pack import Blob, array_blob
from workflow.room.page import NOTES, Page, render_page
from workflow.room.unlit import unlit_picture
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_base_scene
from workflow.scene.normal_form import CaptureReader
from workflow.scene.recovered import Recovered, read_recovered

_SEEDS = 0x726F6F6D  # keeps the random streams of this stage apart from those of others
FILL = 0.6
"""Share of the texels of an atlas that have surface, about."""


def run(job: Job) -> None:
    """Write room.html, scene_unlit.glb and room.json."""
    capture, recovered = CaptureReader(job.read("capture")), read_recovered(job)
    wanted = job.settings.room
    if wanted.denoise:
        require_denoiser()
    with job.timed("textures"):
        parts = read_parts(job.read("unwrap"), recovered)
        uncertainty = job.read("affines").table("cells.parquet", ("uncertainty",))["uncertainty"]
        atlas = bake(parts, recovered, uncertainty, job.read("unwrap").json("unwrap.json")["size"])
        lamps = find_lamps(parts, recovered.emitter_radiance, recovered.light.environment)
        size = build.lightmap_size(wanted.lightmap_size, len(lamps.lamps), FILL, wanted.max_mb)
        texels = lit_texels(parts, size)
    job.log.info("%d lamps, light maps of %d x %d, %d texels with surface", len(lamps.lamps), size, size, len(texels.index))
    with job.timed("light"):
        seed = (job.seed << 32) | _SEEDS
        paths = (wanted.samples, wanted.max_bounces, seed, wanted.denoise)
        light = trace_lamps(
            parts, texels, recovered.surface, lamps, *paths, lambda done, total: job.progress(done, total, "points lit")
        )
    halves = to_half(light)
    poses = np.stack([view.world_from_camera for view in capture.views])
    up = np.asarray(capture.facts.get("up") or up_axis(poses), np.float64)
    frame = build.frame_of(parts, texels, up, poses[:, :3, 3])
    geometry, places, bounds = build.geometry_blobs(parts, frame)
    blobs = geometry | build.light_blobs(halves, texels) | {"lobes": build.lobe_blob(), "colours": build.colour_blob()}
    blobs |= build.picture_blobs(atlas, wanted.texture_size)
    exposure = build.base_exposure(atlas, texels, light, lamps)
    emission = _emission(job, recovered)
    document: dict[str, Any] = {
        "scene": job.scene,
        "bounds": bounds,
        "floor": frame.floor,
        "walkable": dict(zip(("low", "high"), (end.tolist() for end in build.walkable(frame)), strict=True)),
        "cut": float(frame.floor + 0.85 * max(frame.high[2] - frame.floor, 0.1)),
        "worldFromRoom": frame.turn.ravel().tolist(),  # columns of the inverse, as WebGL stores matrices
        "exposure": exposure,
        "brightest": _brightest(parts, lamps),
        "light": {"size": size},
        "lobes": {"cosines": 33, "roughnesses": build.ROUGHNESSES},
        "uncertainty": {"top": build.UNCERTAINTY_MOST, "shown": build.UNCERTAINTY_SHOWN},
        "notes": NOTES,
        "lamps": [
            {
                "name": lamp.name,
                "emitters": list(lamp.emitters),
                "color": lamp.color.tolist(),
                "radiance": lamp.radiance.tolist(),
                "scale": float(scale),
            }
            for lamp, scale in zip(lamps.lamps, halves.scale, strict=True)
        ],
        "parts": [_part(part, place, lamps, emission) for part, place in zip(parts, places, strict=True)],
        "objects": _objects(job, recovered),
        "environment": None,
    }
    if lamps.environment >= 0:
        surroundings = to_half(lamps.surroundings.reshape(-1, 1, 3))
        blobs["environment"] = array_blob(surroundings.value[:, 0].view(np.uint16))
        shape = list(lamps.surroundings.shape[:2])
        document["environment"] = {"lamp": lamps.environment, "shape": shape, "scale": float(surroundings.scale[0])}
    total = np.einsum("nlc,lc->nc", light, np.stack([lamp.color for lamp in lamps.lamps])) if lamps.lamps else light.sum(1)
    lit = unlit_picture(atlas, texels, total, exposure)
    provenance = {"scene": job.scene, "fingerprint": job.fingerprint, "exposure": exposure}
    shown = {"base_color": encoded(lit, JPEG_QUALITY)}
    job.writer.bytes("scene_unlit.glb", glb_bytes(parts, shown, up, provenance, capture.views, exposure))
    page, width = _fitting(job, capture, frame, document, blobs)
    job.writer.bytes("room.html", page)
    facts = {
        "megabytes": round(len(page) / 1e6, 2),
        "lamps": [lamp.name for lamp in lamps.lamps],
        "lightmap_size": size,
        "texels": len(texels.index),
        "texture_size": min(atlas.size, wanted.texture_size),
        "photograph_width": width,
        "exposure": exposure,
        "mean_light": light.mean((0, 2)).tolist() if len(light) else [],
    }
    job.writer.json("room.json", facts)
    job.log.info("room.html: %.1f MB, photographs of %s", len(page) / 1e6, f"{width} pixels" if width else "no size: left out")


def _fitting(
    job: Job, capture: CaptureReader, frame: build.Frame, document: dict[str, Any], blobs: dict[str, Blob]
) -> tuple[bytes, int]:
    """Render the page with photographs as wide as `room.max_mb` allows; returns it and their width, 0 = left out."""
    credit = job.settings.report.credit or str(capture.facts.get("credit", ""))
    allowed = job.settings.room.max_mb
    document["photographs"] = build.photograph_facts(capture.views, frame)
    document["start"] = build.start_of(document["photographs"], frame)
    sharp = [_photograph(capture, view) for view in capture.views]
    page, previous = b"", None
    for width in build.PHOTOGRAPH_WIDTHS:
        shown = min(width, max((picture.shape[1] for picture in sharp), default=0))
        if shown and shown == previous:
            continue
        previous = shown
        kept = sharp if width else []
        pictures_in = {f"photograph-{i}": build.photograph_blob(picture, width) for i, picture in enumerate(kept)}
        for facts in document["photographs"]:
            facts["picture"] = bool(width)
        page = render_page(Page(job.scene, credit, _about(job), document, blobs | pictures_in)).encode()
        if len(page) <= allowed * 1e6:
            return page, shown
    raise InputError(
        f"room.max_mb: the page has {len(page) / 1e6:.1f} MB without photographs, and {allowed:g} MB are allowed;"
        " raise room.max_mb, or lower room.texture_size, room.lightmap_size or export.max_faces_glb"
    )


def _photograph(capture: CaptureReader, view: Any) -> np.ndarray:
    """(H, W, 3) uint8: sensor values as they are, or radiance at its own exposure."""
    image, valid = capture.photo(view, held_out=True)
    return pictures.linear(image, color.key_exposure(image, valid)) if capture.is_hdr else pictures.encoded(image)


def _about(job: Job) -> list[str]:
    samples = job.settings.room.samples
    return [
        "Materials and lamps were recovered from photographs. The light of each lamp was traced once, with all reflections"
        f" ({samples} paths for each texel), and stored; the page adds the lamps up, so that strengths and colours are exact for"
        " diffuse light.",
        "Intervals are 95 % intervals of the fit; the interval of albedo is for its brightness.",
    ]


def _brightest(parts: Any, lamps: Lamps) -> float:
    """Largest radiance of what shines, with its colour as found."""
    found = [lamp.color * lamps.radiance[list(lamp.emitters)].max(0) for lamp in lamps.lamps if lamp.emitters]
    if lamps.environment >= 0:
        found.append(lamps.lamps[lamps.environment].color * lamps.surroundings.max((0, 1)))
    return float(max((one.max() for one in found), default=1.0))


def _part(part: Any, place: dict[str, Any], lamps: Lamps, emission: dict[int, list[dict[str, Any]]]) -> dict[str, Any]:
    emits = part.emitter_id >= 0
    lamp = int(lamps.of_emitter[part.emitter_id]) if emits else -1
    return {
        "name": part.name,
        "object": int(part.object_id),
        "emitter": int(part.emitter_id),
        "lamp": lamp,
        "radiance": lamps.radiance[part.emitter_id].tolist() if emits and lamp >= 0 else [0.0, 0.0, 0.0],
        "twoSided": bool(part.double_sided),
        "opacity": float(part.opacity),
        "emitted": emission.get(int(part.emitter_id), []),
        **place,
    }


def _emission(job: Job, recovered: Recovered) -> dict[int, list[dict[str, Any]]]:
    """Radiance of every emitter with its interval, with the light scale."""
    table, scale = job.read("emission").table("emitters.parquet"), recovered.light_scale
    out = {}
    for row, emitter in enumerate(table["emitter_id"]):
        out[int(emitter)] = [
            build.interval(f"radiance, {name}", *(scale * float(table[f"{kind}_{c}"][row]) for kind in ("radiance", "error")))
            for c, name in zip("rgb", ("red", "green", "blue"), strict=True)
        ]
    return out


def _objects(job: Job, recovered: Recovered) -> list[dict[str, Any]]:
    surface, base = recovered.surface, read_base_scene(job)
    fit, seen = job.read("affines").table("objects.parquet"), job.read("segmentation").table("objects.parquet")
    columns = object_rows(
        recovered.object_names, surface.cell_object, surface.cell_values, surface.object_values, base.object_values, fit, seen
    )
    return build.object_facts(columns)
