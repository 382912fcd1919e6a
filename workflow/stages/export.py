"""export: the recovered scene for other programs (glTF, USD, Mitsuba)."""

from __future__ import annotations

import numpy as np

from workflow.artifacts.store import split_rgb
from workflow.exporters import camera_files
from workflow.exporters.atlas import bake, base_color_picture, encoded, read_parts, surface_picture, texture_facts
from workflow.exporters.emitter_table import UNITS, emitter_columns
from workflow.exporters.glb import fitting_glb
from workflow.exporters.joining import joined
from workflow.exporters.mitsuba_scene import mitsuba_files
from workflow.exporters.normal_map import normal_picture
from workflow.exporters.object_table import csv_bytes, recovered_objects
from workflow.exporters.usd import BASE_COLOR, SURFACE, usd_bytes
from workflow.relighting.inventory import Inventory
from workflow.runtime.job import Job
from workflow.scene.named import new_names
from workflow.scene.normal_form import CaptureReader
from workflow.scene.picture_facts import view_attributes
from workflow.scene.recovered import read_recovered, read_response

MAX_SENSORS = 16
MASK = "textures/seen.png"


def run(job: Job) -> None:
    """Write scene.glb, scene.usdc, textures/, mitsuba/, the tables, cameras, photographs and export.json."""
    capture = CaptureReader(job.read("capture"))
    recovered = read_recovered(job)
    unwrapped = job.read("unwrap").json("unwrap.json")
    parts = read_parts(job.read("unwrap"), recovered)
    uncertainty = job.read("affines").table("cells.parquet", ("uncertainty",))["uncertainty"]
    atlas = bake(parts, recovered, uncertainty, unwrapped["size"])
    up = capture.up
    provenance = {"scene": job.scene, "fingerprint": job.fingerprint, "units": "metres, linear radiance"}
    environment = recovered.light.environment
    wanted, outside = job.settings.export, camera_files.environment_note(environment)
    # glTF has no light from outside.
    has_map = {"map": "mitsuba/environment.exr"} if environment.ndim == 3 else {}
    notes = provenance | ({"environment": outside | has_map} if outside else {})
    bumpy = wanted.normal_map and any(part.simplified for part in parts)
    normals = normal_picture(parts, recovered, atlas.size) if bumpy else None
    taken = joined(parts, wanted.max_parts)
    data, texture = fitting_glb(taken, atlas, up, notes, capture.views, wanted.max_mb, normals)
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
    job.writer.bytes("scene.usdc", usd_bytes(taken, up, environment, capture.views, provenance))
    for name, data in mitsuba_files(taken, atlas, capture.views[:MAX_SENSORS], environment).items():
        job.writer.bytes(f"mitsuba/{name}", data)
    inventory = Inventory.read(job.read("segmentation"), job.read("emission"), new_names(job))
    lamps = {lamp.emitter_id: inventory.name_of(lamp) for lamp in inventory.lamps if lamp.objects}
    emitters = emitter_columns(job.read("emission").table("emitters.parquet"), lamps, recovered.light_scale)
    job.writer.table("emitters.parquet", emitters, UNITS)
    objects = recovered_objects(recovered, job.read("affines"), job.read("segmentation").table("objects.parquet"))
    job.writer.bytes("objects.csv", csv_bytes(objects))
    _camera_files(job, capture, environment)
    facts = {
        "up": up.tolist(),
        "parts": len(parts),
        "meshes": len(taken),
        "faces": sum(len(part.faces) for part in parts),
        "double_sided": [part.name for part in parts if part.double_sided],
        "light_scale": recovered.light_scale,
        "texture": texture | texture_facts(parts, atlas, unwrapped, job.read("unwrap").table("parts.parquet"), texture["size"]),
    }
    job.writer.json("export.json", facts)


def _camera_files(job: Job, capture: CaptureReader, environment: np.ndarray) -> None:
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
    note = camera_files.environment_note(environment)
    if note and environment.ndim == 3:
        note = note | {"map": "environment.exr"}
        job.writer.exr("environment.exr", split_rgb(camera_files.environment_picture(environment)), "relative")
    gains = job.read("emission").json("emission.json")["gain"]
    origin = capture.facts.get("origin") or (0.0, 0.0, 0.0)
    cameras = camera_files.cameras_json(capture.views, names, np.asarray(gains), capture.up, note, response, origin)
    job.writer.bytes("cameras.json", cameras)
    job.writer.bytes(camera_files.SCRIPT, camera_files.script())
