"""export: the recovered scene for other programs (glTF, Mitsuba)."""

from __future__ import annotations

from typing import Any

import numpy as np

from iif_core.errors import InputError
from iif_core.light.environment import as_map, solid_angles
from workflow.exporters.glb import glb_bytes
from workflow.exporters.mitsuba_scene import mitsuba_files
from workflow.exporters.surface import RecoveredScene, build_parts, seen_sides, up_axis
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader
from workflow.scene.recovered import Recovered, read_recovered

VERTEX_SPACING = 0.05
"""Edges are halved until they are this short, m; two cells where cells are larger."""

SPLIT_FACES = 200_000
"""Largest number of faces that splitting makes; a mesh that has more is exported unchanged."""

MAX_SENSORS = 16


def run(job: Job) -> None:
    """Write scene.glb, mitsuba/, emitters.parquet and export.json."""
    capture = CaptureReader(job.read("capture"))
    recovered = read_recovered(job)
    if len(recovered.surface.faces) > job.settings.export.max_faces_glb:
        raise InputError(
            f"scene {job.scene}: the mesh has {len(recovered.surface.faces)} faces, export.max_faces_glb allows"
            f" {job.settings.export.max_faces_glb}. Raise it, or decimate the mesh."
        )
    scene = _with_observers(capture, recovered)
    budget = max(len(recovered.surface.faces), min(SPLIT_FACES, job.settings.export.max_faces_glb))
    parts = build_parts(scene, max(VERTEX_SPACING, 2 * recovered.surface.cell_edge), budget)
    provenance = {"scene": job.scene, "fingerprint": job.fingerprint, "units": "metres, linear radiance"}
    provenance |= _environment_note(recovered.light.environment)
    job.writer.bytes("scene.glb", glb_bytes(parts, scene.up, provenance))
    for name, data in mitsuba_files(parts, capture.views[:MAX_SENSORS], recovered.light.environment).items():
        job.writer.bytes(f"mitsuba/{name}", data)
    _emitter_table(job, recovered)
    facts = {
        "up": scene.up.tolist(),
        "parts": len(parts),
        "faces": sum(len(part.faces) for part in parts),
        "double_sided": [part.name for part in parts if part.double_sided],
        "light_scale": recovered.light_scale,
    }
    job.writer.json("export.json", facts)


def _with_observers(capture: CaptureReader, recovered: Recovered) -> RecoveredScene:
    """Return the scene with the number of pixels that see each side of a face, and the up direction."""
    front, back = np.zeros((2, len(recovered.surface.faces)), np.int64)
    vertices = recovered.surface.vertices.astype(np.float64)
    for view in capture.views:
        _, face_id = capture.gbuffer(view)
        sides = seen_sides(vertices, recovered.surface.faces, face_id, view.world_from_camera[:3, 3])
        front += sides[0]
        back += sides[1]
    up = capture.facts.get("up")
    poses = np.stack([view.world_from_camera for view in capture.views])
    surface = recovered.surface
    return RecoveredScene(
        surface.vertices,
        surface.faces,
        surface.object_id,
        recovered.object_names,
        recovered.cell_centres,
        surface.cell_object,
        surface.cell_values,
        surface.object_values,
        recovered.emitter_id,
        recovered.light.side,
        recovered.emitter_radiance,
        recovered.light.environment,
        front,
        back,
        np.asarray(up, np.float64) if up else up_axis(poses),
        surface.transmittance,
    )


def _environment_note(environment: np.ndarray) -> dict[str, Any]:
    """Return mean radiance and map of the environment for `asset.extras`, because glTF has no light from outside."""
    if not environment.any():
        return {}
    radiance = as_map(environment)
    mean = np.average(radiance, (0, 1), np.repeat(solid_angles(*radiance.shape[:2])[..., None], 3, -1))
    note: dict[str, Any] = {"mean_radiance": [round(float(value), 6) for value in mean]}
    return {"environment": note | ({"map": "mitsuba/environment.exr"} if environment.ndim == 3 else {})}


def _emitter_table(job: Job, recovered: Recovered) -> None:
    """Write the emitters times the light scale of the fit, which goes with the published albedo."""
    table = dict(job.read("emission").table("emitters.parquet"))
    for name in [n for n in table if n.startswith(("radiance_", "error_"))]:
        table[name] = (table[name] * recovered.light_scale).astype(np.float32)
    job.writer.table("emitters.parquet", table, {"area_m2": "m^2", "radiance_r": "relative"})
