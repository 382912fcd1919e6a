"""What room.html says of parts, lamps and objects, and the page as large as it may be."""

from __future__ import annotations

from typing import Any

import numpy as np

from iif_core.errors import InputError
from iif_core.numerics import color
from workflow.exporters.object_table import recovered_objects
from workflow.report import pictures
from workflow.room import build
from workflow.room.light import Lamps
from workflow.room.pack import Blob
from workflow.room.page import Page, render_page
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader, widest
from workflow.scene.recovered import Recovered


def page_that_fits(
    job: Job, capture: CaptureReader, frame: build.Frame, document: dict[str, Any], blobs: dict[str, Blob]
) -> tuple[bytes, int]:
    """Render the page with photographs as wide as `room.max_mb` allows; returns it and their width, 0 = left out."""
    credit = job.settings.report.credit or str(capture.facts.get("credit", ""))
    allowed = job.settings.room.max_mb
    document["photographs"] = build.photograph_facts(capture.views, frame)
    first = [view.name for view in capture.views].index(widest(capture).name)
    document["start"] = build.start_of(document["photographs"], frame, first)
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
        " raise room.max_mb, or lower room.lightmap_size or export.max_faces_glb"
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
        "Intervals are 95 % intervals; roughness that no photograph shows has 0 to 1.",
    ]


def brightest(parts: Any, lamps: Lamps) -> float:
    """Largest radiance of what shines, with its colour as found."""
    found = [lamp.color * lamps.radiance[list(lamp.emitters)].max(0) for lamp in lamps.lamps if lamp.emitters]
    if lamps.environment >= 0:
        found.append(lamps.lamps[lamps.environment].color * lamps.surroundings.max((0, 1)))
    return float(max((one.max() for one in found), default=1.0))


def facts_of_part(part: Any, place: dict[str, Any], lamps: Lamps, emission: dict[int, list[dict[str, Any]]]) -> dict[str, Any]:
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


def radiance_of_emitters(job: Job, recovered: Recovered) -> dict[int, list[dict[str, Any]]]:
    """Radiance of every emitter with its interval, with the light scale."""
    table, scale = job.read("emission").table("emitters.parquet"), recovered.light_scale
    out = {}
    for row, emitter in enumerate(table["emitter_id"]):
        out[int(emitter)] = [
            build.interval(f"radiance, {name}", *(scale * float(table[f"{kind}_{c}"][row]) for kind in ("radiance", "error")))
            for c, name in zip("rgb", ("red", "green", "blue"), strict=True)
        ]
    return out


def facts_of_objects(job: Job, recovered: Recovered) -> list[dict[str, Any]]:
    columns = recovered_objects(recovered, job.read("affines"), job.read("segmentation").table("objects.parquet"))
    surface = recovered.surface
    middle = build.middles(surface.vertices, surface.faces, surface.object_id, surface.areas)
    return build.object_facts(columns, middle)
