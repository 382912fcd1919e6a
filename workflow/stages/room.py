"""room: one page to walk through the recovered room and to switch its lamps (docs/guide/room.md)."""

from __future__ import annotations

from typing import Any

import numpy as np

from iif_core.light.emission.odds import DOUBTFUL
from iif_core.light.light_maps import to_half
from workflow.exporters.atlas import bake, encoded, read_parts
from workflow.exporters.glb import JPEG_QUALITY, glb_bytes
from workflow.exporters.joining import joined
from workflow.models.denoise import require_denoiser
from workflow.room import build
from workflow.room.contents import brightest, facts_of_objects, facts_of_part, page_that_fits, radiance_of_emitters
from workflow.room.light import backdrop, find_lamps, lit_texels, trace_lamps
from workflow.room.pack import array_blob
from workflow.room.page import NOTES
from workflow.room.unlit import unlit_picture
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_environment_seen
from workflow.scene.normal_form import CaptureReader
from workflow.scene.recovered import Recovered, read_recovered

MAX_BOUNCES = 16  # of a path
TEXTURE_SIZE = 2048  # largest side of the textures in the page, in texels
_SEEDS = 0x726F6F6D  # keeps the random streams of this stage apart from those of others
FILL = 0.6
"""Share of the texels of an atlas that have surface, about."""


def _called(job: Job, recovered: Recovered) -> list[str]:
    """Return the names of emitters as the page shows them: what is more likely surface than a lamp says so."""
    probability = job.read("emission").table("emitters.parquet").get("probability", ())
    doubtful = {name for name, p in zip(recovered.emitter_names, probability, strict=False) if 0 <= p < DOUBTFUL}
    return [f"{name} (doubtful)" if name in doubtful else name for name in recovered.emitter_names]


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
        lamps = find_lamps(parts, recovered.emitter_radiance, recovered.light.environment, _called(job, recovered))
        size = build.lightmap_size(wanted.lightmap_size, len(lamps.lamps), FILL, wanted.max_mb)
        texels = lit_texels(parts, size)
    job.log.info("%d lamps, light maps of %d x %d, %d texels with surface", len(lamps.lamps), size, size, len(texels.index))
    with job.timed("light"):
        seed = (job.seed << 32) | _SEEDS
        paths = (wanted.samples, MAX_BOUNCES, seed, wanted.denoise)
        light = trace_lamps(
            parts, texels, recovered.surface, lamps, *paths, lambda done, total: job.progress(done, total, "points lit")
        )
    halves = to_half(light)
    eyes = np.stack([view.world_from_camera[:3, 3] for view in capture.views])
    frame = build.frame_of(parts, texels, capture.up, eyes)
    geometry, places, bounds = build.geometry_blobs(parts, frame)
    blobs = geometry | build.light_blobs(halves, texels) | {"lobes": build.lobe_blob(), "colours": build.colour_blob()}
    blobs |= build.picture_blobs(atlas, TEXTURE_SIZE)
    exposure = build.base_exposure(atlas, texels, light, lamps)
    emission = radiance_of_emitters(job, recovered)
    document: dict[str, Any] = {
        "scene": job.scene,
        "bounds": bounds,
        "floor": frame.floor,
        "walkable": dict(zip(("low", "high"), (end.tolist() for end in build.walkable(frame)), strict=True)),
        "cut": float(frame.floor + 0.85 * max(frame.high[2] - frame.floor, 0.1)),
        "worldFromRoom": frame.turn.ravel().tolist(),  # columns of the inverse, as WebGL stores matrices
        "exposure": exposure,
        "brightest": brightest(parts, lamps),
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
        "parts": [facts_of_part(part, place, lamps, emission) for part, place in zip(parts, places, strict=True)],
        "objects": facts_of_objects(job, recovered),
        "environment": None,
    }
    if lamps.environment >= 0:
        behind = backdrop(lamps.surroundings, read_environment_seen(job))
        surroundings = to_half(behind.reshape(-1, 1, 3))
        blobs["environment"] = array_blob(surroundings.value[:, 0].view(np.uint16))
        shape = list(lamps.surroundings.shape[:2])
        document["environment"] = {"lamp": lamps.environment, "shape": shape, "scale": float(surroundings.scale[0])}
    total = np.einsum("nlc,lc->nc", light, np.stack([lamp.color for lamp in lamps.lamps])) if lamps.lamps else light.sum(1)
    lit = unlit_picture(atlas, texels, total, exposure)
    provenance = {"scene": job.scene, "fingerprint": job.fingerprint, "exposure": exposure}
    shown = {"base_color": encoded(lit, JPEG_QUALITY)}
    taken = joined(parts, job.settings.export.max_parts)
    job.writer.bytes("scene_unlit.glb", glb_bytes(taken, shown, capture.up, provenance, capture.views, exposure))
    page, width = page_that_fits(job, capture, frame, document, blobs)
    job.writer.bytes("room.html", page)
    facts = {
        "megabytes": round(len(page) / 1e6, 2),
        "lamps": [lamp.name for lamp in lamps.lamps],
        "lightmap_size": size,
        "texels": len(texels.index),
        "texture_size": min(atlas.size, TEXTURE_SIZE),
        "photograph_width": width,
        "exposure": exposure,
        "mean_light": light.mean((0, 2)).tolist() if len(light) else [],
    }
    job.writer.json("room.json", facts)
    job.log.info("room.html: %.1f MB, photographs of %s", len(page) / 1e6, f"{width} pixels" if width else "no size: left out")
