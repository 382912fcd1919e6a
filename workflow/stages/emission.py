"""emission: which faces shine and how brightly, and the radiance cache of everything else (docs/method/light.md)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from iif_core.camera.calibration.choice import CalibratedResponse, candidates
from iif_core.camera.response import response
from iif_core.light.emission.find import FirstLook, FoundLight, find_light, look_around
from iif_core.light.emission.gains import PRIOR_LEVEL_ERROR
from iif_core.light.emission.options import EmissionOptions, Log
from iif_core.light.emission.photographs import Photographs
from iif_core.light.emission.response import calibrated
from iif_core.light.emission.see_through import seen_through, translucent_objects
from iif_core.light.emission.sensor import Sensor
from iif_core.light.tracer import Tracer
from iif_core.surface.segments import face_adjacency
from workflow.decisions import light as decisions
from workflow.decisions.plan import ESCAPE_OPEN, included
from workflow.decisions.plan import environment as from_outside
from workflow.decisions.record import SETTLED, Decision
from workflow.fitting.inputs import prediction_errors
from workflow.runtime import device
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_base_scene
from workflow.scene.emission_views import ViewRecords, view_exposures
from workflow.scene.light_files import write_found_light
from workflow.scene.named import object_names
from workflow.scene.normal_form import CaptureReader, stated_exposures
from workflow.scene.response_file import read_response_file
from workflow.settings.options import options_of


def run(job: Job) -> None:
    """Write emitters.parquet, emitter_faces.parquet, object_gains.parquet, radiance_cache.parquet, environment_texels.parquet
    and emission.json."""
    device.mitsuba()
    notes: list[str] = []
    photos, camera = _photographs(job, CaptureReader(job.read("capture")), notes)
    adjacency = face_adjacency(photos.scene.faces, photos.scene.vertices)
    light, plan = _light(job, photos, adjacency)
    sheer = translucent_objects(photos, light.look.glowing)
    if sheer.any():
        names = ", ".join(photos.names[o] for o in np.flatnonzero(sheer))
        job.log.info("%s: does it shine, or does light pass through it?", names)
        photos.forget()  # so that both assumptions need no more memory than one
        through, plan_through = _light(job, seen_through(photos, sheer), adjacency)
        same_kind = through.outside is not None and through.is_open <= light.is_open
        decision = decisions.transmission(names, light.misfit(sheer), through.misfit(sheer), same_kind)
        light, plan = (through, plan_through) if decision["included"] else (light, plan)
        plan, notes = [*plan, decision], [*notes, decision["reason"]]
        job.log.info("%s", decision["reason"])
    write_found_light(job, light, camera, plan, notes)


def _photographs(job: Job, capture: CaptureReader, notes: list[str]) -> tuple[Photographs, CalibratedResponse]:
    """Return the photographs with response and gains, and how these were found."""
    scene, setting, stated = read_base_scene(job), job.settings.affines.response, prediction_errors(job)
    options = options_of(EmissionOptions, job.settings.emission, seed=job.seed)
    photos = Photographs(
        views=capture.used,
        every=capture.views,
        scene=scene,
        names=object_names(job.read("segmentation"), scene.n_objects),
        tracer=Tracer(scene),
        sensor=Sensor(response("identity"), capture.is_hdr),
        gains=view_exposures(capture, notes),
        records=ViewRecords(job, capture, scene, options.pixels),
        options=options,
        log=Log(job.log.info, job.progress),
        base_level_error=PRIOR_LEVEL_ERROR if stated is None else stated.level,
        up=tuple(capture.up),
    )
    measured = None
    if not isinstance(setting, str) and not capture.is_hdr:
        measured = read_response_file(Path(setting.file)), f"measured: {setting.file}"
    families = () if measured else candidates(setting, capture.facts["dynamic_range"])
    given = not capture.facts.get("exposure_estimated", False)
    photos, camera = calibrated(photos, families, measured, given, stated_exposures(capture.facts, capture.views))
    notes.extend([camera.gauge] if camera.gauge else [])
    return photos, camera


def _light(job: Job, photos: Photographs, adjacency: np.ndarray) -> tuple[FoundLight, list[Decision]]:
    """Find the light of the scene, and what was decided about light from outside."""
    look = look_around(photos, adjacency)
    environment = _environment(job, photos, look)
    light = find_light(photos, look, environment["included"], look.secondary > ESCAPE_OPEN)
    asked_for_sun = light.outside is not None and not light.is_open
    return light, [environment, *([decisions.sun(light.sun)] if asked_for_sun else [])]


def _environment(job: Job, photos: Photographs, look: FirstLook) -> Decision:
    planned = included(job.read("plan").json("plan.json")["plan"], "environment")
    # Where light passes through surface, the mesh is another one than the plan was made for.
    if planned["status"] == SETTLED and photos.scene.transmittance is None:
        return planned
    return from_outside(job.settings.emission.environment, look.primary, look.secondary, look.brightness)
