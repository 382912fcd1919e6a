"""render: every view again, from the recovered materials and emitters, by path tracing."""

from __future__ import annotations

import numpy as np

from iif_core.camera import direction_derivatives, pixel_directions
from iif_core.errors import InputError
from workflow.artifacts.store import split_rgb
from workflow.job import Job
from workflow.normal_form import CaptureReader, View
from workflow.recovered import Recovered, read_recovered, read_response

BLACK = (0.0, 0.0, 0.0, 1.0, 0.0)


def run(job: Job) -> None:
    """Write radiance, sensor value (through the fitted response and the view's exposure) and emission of every view."""
    import mitsuba

    mitsuba.set_variant("llvm_ad_rgb")
    from iif_core.transport import Emitters, build_geometry, render

    capture = CaptureReader(job.read("capture"))
    scene = read_recovered(job)
    curve = read_response(job.read("affines"))
    object_id, material = black_emitters(scene)
    geometry = build_geometry(scene.vertices, scene.faces, object_id)
    emitters = Emitters(geometry, scene.face_radiance, scene.emitter_side, scene.environment)
    if not (emitters.can_be_sampled or scene.environment.any()):
        job.log.warning("no emitter and no environment: the re-renderings are black (see emission.json)")
    for done, view in enumerate(capture.views):
        job.progress(done, len(capture.views), "views re-rendered")
        radiance = render(
            geometry,
            material,
            emitters,
            view.world_from_camera[:3, 3],
            _directions(view).reshape(-1, 3),
            job.settings.render.samples,
            job.settings.render.max_bounces,
            seed=(job.seed << 20) + view.view_id,
            jitter=direction_derivatives(view.fx, view.fy, view.world_from_camera),
        ).reshape(view.height, view.width, 3)
        if not np.isfinite(radiance).all():
            raise InputError(f"view {view.name}: {np.sum(~np.isfinite(radiance))} re-rendered values are not finite; please report it")
        sensor = np.clip(curve(np.clip(view.exposure * radiance, 0, 1)), 0, 1)
        _, face_id = capture.gbuffer(view)
        emission = scene.emission_map(face_id, view.world_from_camera[:3, 3])
        channels = {**split_rgb(radiance), **split_rgb(sensor, "ldr"), **split_rgb(emission, "emission")}
        job.writer.exr(f"maps/{view.name}.exr", channels, "relative")
    job.progress(len(capture.views), len(capture.views), "views re-rendered")


def black_emitters(scene: Recovered):
    """(object id of each face, materials) for the renderer, in which emitting faces are an object of their own that is black."""
    from iif_core.transport import CellMaterials

    black = len(scene.object_values)
    object_id = np.where(scene.emitter_id >= 0, black, scene.object_id)
    object_values = np.concatenate([scene.object_values, np.float32([BLACK])])
    material = CellMaterials(
        scene.cell_edge, scene.cell_origin, scene.cell_ijk, scene.cell_object, scene.cell_values, object_values
    )
    return object_id, material


def _directions(view: View) -> np.ndarray:
    return pixel_directions(view.fx, view.fy, view.cx, view.cy, view.width, view.height, view.world_from_camera)
