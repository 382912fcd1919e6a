"""export: the recovered scene for other programs (glTF, USD, Mitsuba)."""

from __future__ import annotations

from typing import Any

import numpy as np

from iif_core.light.environment import as_map, solid_angles
from iif_core.reflectance.material import CHANNELS
from workflow.artifacts.store import split_rgb
from workflow.exporters import camera_files
from workflow.exporters.atlas import TexturedPart, bake, base_color_picture, encoded, read_parts, surface_picture
from workflow.exporters.glb import fitting_glb
from workflow.exporters.mitsuba_scene import mitsuba_files
from workflow.exporters.normal_map import normal_picture
from workflow.exporters.object_table import csv_bytes, object_rows
from workflow.exporters.surface import up_axis
from workflow.exporters.usd import BASE_COLOR, SURFACE, usd_bytes
from workflow.relighting.inventory import Inventory
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_base
from workflow.scene.normal_form import CaptureReader
from workflow.scene.picture_facts import view_attributes
from workflow.scene.recovered import Recovered, read_recovered, read_response

MAX_SENSORS = 16
MASK = "textures/seen.png"


def run(job: Job) -> None:
    """Write scene.glb, scene.usdc, textures/, mitsuba/, the tables, cameras, photographs and export.json."""
    capture = CaptureReader(job.read("capture"))
    recovered = read_recovered(job)
    unwrapped = job.read("unwrap").json("unwrap.json")
    parts = read_parts(job.read("unwrap"), recovered)
    atlas = bake(parts, recovered, job.read("affines").table("cells.parquet", ("uncertainty",))["uncertainty"], unwrapped["size"])
    up = _up(capture)
    provenance = {"scene": job.scene, "fingerprint": job.fingerprint, "units": "metres, linear radiance"}
    environment = recovered.light.environment
    wanted, notes = job.settings.export, provenance | _environment_note(environment)
    bumpy = wanted.normal_map and any(part.simplified for part in parts)
    normals = normal_picture(parts, recovered, atlas.size) if bumpy else None
    data, texture = fitting_glb(parts, atlas, up, notes, capture.views, wanted.max_mb, normals)
    job.writer.bytes("scene.glb", data)
    job.log.info("scene.glb: %.1f MB, textures of %d x %d as %s", texture["mb"], *2 * (texture["size"],), texture["format"])
    if not texture["fits"]:
        job.log.warning(
            "scene.glb has %.1f MB, export.max_mb allows %g: the meshes alone are larger; lower export.max_faces_glb",
            texture["mb"],
            wanted.max_mb,
        )
    job.writer.bytes(BASE_COLOR, encoded(base_color_picture(atlas)))
    job.writer.bytes(SURFACE, encoded(surface_picture(atlas)))
    job.writer.bytes(MASK, encoded(np.where(atlas.seen, 255, 0).astype(np.uint8)))
    job.writer.bytes("scene.usdc", usd_bytes(parts, up, environment, capture.views, provenance))
    for name, data in mitsuba_files(parts, atlas, capture.views[:MAX_SENSORS], environment).items():
        job.writer.bytes(f"mitsuba/{name}", data)
    _emitter_table(job, recovered)
    job.writer.bytes("objects.csv", _object_table(job, recovered))
    _camera_files(job, capture, environment, up)
    facts = {
        "up": up.tolist(),
        "parts": len(parts),
        "faces": sum(len(part.faces) for part in parts),
        "double_sided": [part.name for part in parts if part.double_sided],
        "light_scale": recovered.light_scale,
        "texture": texture | _texture_facts(job, parts, atlas.seen & atlas.covered, atlas.covered, texture["size"]),
    }
    job.writer.json("export.json", facts)


def _up(capture: CaptureReader) -> np.ndarray:
    up = capture.facts.get("up")
    return np.asarray(up, np.float64) if up else up_axis(np.stack([view.world_from_camera for view in capture.views]))


def _texture_facts(job: Job, parts: list[TexturedPart], seen: np.ndarray, covered: np.ndarray, size: int) -> dict[str, Any]:
    """What the textures lost: the sizes of a texel and of a surface cell, and how much surface the photographs show."""
    unwrapped, table = job.read("unwrap").json("unwrap.json"), job.read("unwrap").table("parts.parquet")
    shown = [p for p, part in enumerate(parts) if part.emitter_id < 0]
    density = np.asarray(table["texels_per_m"])[shown]
    weight = density**2 * np.asarray(table["area_m2"])[shown]
    order = np.argsort(density)
    middle = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum()) if len(shown) else 0
    texel = 1 / density[order][min(middle, len(shown) - 1)] if len(shown) else 0.0
    return {
        "atlas_size": unwrapped["size"],
        "texel_m": texel,
        "texel_in_glb_m": texel * unwrapped["size"] / size,
        "cell_m": unwrapped["cell_edge_m"],
        "seen_share": float(seen.sum() / max(covered.sum(), 1)),
    }


def _environment_note(environment: np.ndarray) -> dict[str, Any]:
    """Return mean radiance and map of the environment for `asset.extras`, because glTF has no light from outside."""
    if not environment.any():
        return {}
    radiance = as_map(environment)
    mean = np.average(radiance, (0, 1), np.repeat(solid_angles(*radiance.shape[:2])[..., None], 3, -1))
    note: dict[str, Any] = {"mean_radiance": [round(float(value), 6) for value in mean]}
    return {"environment": note | ({"map": "mitsuba/environment.exr"} if environment.ndim == 3 else {})}


def _camera_files(job: Job, capture: CaptureReader, environment: np.ndarray, up: np.ndarray) -> None:
    """Write cameras.json, photos/, blender_import.py, the table of the response (LDR) and the map of the environment."""
    names = camera_files.photo_names(capture.views, capture.is_hdr)
    for view, name in zip(capture.views, names, strict=True):
        photo, valid = capture.photo(view, held_out=True)  # nothing is fitted to it here
        if capture.is_hdr:
            job.writer.exr(name, split_rgb(photo), "relative", attributes=view_attributes(view, 1.0))
        else:
            job.writer.bytes(name, camera_files.photograph_png(photo, valid))
    response = None if capture.is_hdr else "camera_response.cube"
    if response:
        job.writer.bytes(response, camera_files.response_cube(read_response(job.read("affines"))))
    note = _environment_note(environment).get("environment")
    if note and environment.ndim == 3:
        note = note | {"map": "environment.exr"}
        job.writer.exr("environment.exr", split_rgb(camera_files.environment_picture(environment)), "relative")
    gains = job.read("emission").json("emission.json")["gain"]
    job.writer.bytes("cameras.json", camera_files.cameras_json(capture.views, names, np.asarray(gains), up, note, response))
    job.writer.bytes(camera_files.SCRIPT, camera_files.script())


def _object_table(job: Job, recovered: Recovered) -> bytes:
    """Return objects.csv."""
    surface, affines, base = (
        recovered.surface,
        job.read("affines").table("objects.parquet"),
        read_base(job).table("objects.parquet"),
    )
    before = surface.object_values.astype(np.float64).copy()
    before[base["object_id"]] = np.stack([base[name] for name in CHANNELS], 1)
    seen = job.read("segmentation").table("objects.parquet")
    rows = object_rows(
        recovered.object_names, surface.cell_object, surface.cell_values, surface.object_values, before, affines, seen
    )
    return csv_bytes(rows)


def _emitter_table(job: Job, recovered: Recovered) -> None:
    """Write the emitters times the light scale of the fit, which goes with the albedo, and the objects that they are on."""
    table = dict(job.read("emission").table("emitters.parquet"))
    inventory = Inventory.read(job.read("segmentation"), job.read("emission"))
    named = {lamp.emitter_id: inventory.name_of(lamp) for lamp in inventory.lamps if lamp.objects}
    table["object"] = [named.get(int(emitter), "") for emitter in table["emitter_id"]]
    for name in [n for n in table if n.startswith(("radiance_", "error_"))]:
        table[name] = (table[name] * recovered.light_scale).astype(np.float32)
    job.writer.table("emitters.parquet", table, {"area_m2": "m^2", "radiance_r": "relative"})
