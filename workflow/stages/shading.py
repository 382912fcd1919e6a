"""shading: the light that arrives at every pixel, integrated over the diffuse lobe and the split specular lobes
(docs/method/shading.md)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from iif_core.camera.pixels import ViewPixels
from iif_core.light.base_scene import BaseScene, cache_origin
from iif_core.light.options import ShadingOptions
from iif_core.light.shading import (
    cells_of_views,
    diffuse_light,
    glossiest,
    light_of_pixels,
    photographed_share,
    roughness_levels,
)
from iif_core.reflectance.material import MATTE_ROUGHNESS
from workflow.decisions import light as decisions
from workflow.decisions import numerics
from workflow.decisions.materials import METALLIC_PRIOR
from workflow.decisions.plan import included, matte_by_predictions
from workflow.decisions.record import PROVISIONAL, Decision
from workflow.fitting.fit_pixels import PixelDraw, count_eligible
from workflow.runtime import device
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_lit_scene, read_object_gains, read_radiance_cache
from workflow.scene.cached_light import facts_of_diffuse, words_of_diffuse, write_light_of_view
from workflow.scene.decoded import DecodedViews
from workflow.scene.normal_form import CaptureReader
from workflow.settings.options import options_of


def run(job: Job) -> None:
    """Write maps/<view>.exr with the diffuse integral of every pixel (0 where nothing was hit), pixels/<view>.parquet with the
    specular integrals of the pixels that are read, both in two independent halves, levels.parquet and shading.json.

    In a scene without specular lobes nothing is traced for the pixels: their lobes are those of uniform light (Eq. S.22)."""
    from iif_core.light.transport.scene import Scene

    (scene, light), own = read_lit_scene(job), job.settings.shading
    options = options_of(ShadingOptions, own, seed=job.seed)
    levels, mixed = roughness_levels(own.levels), light.emits | scene.is_sheer
    decoded = DecodedViews(CaptureReader(job.read("capture")), job.read("segmentation"))
    counts = np.zeros(max(scene.n_objects, 1), np.int64)  # of the pixels of each object that may enter the fit

    def seen() -> Iterator[tuple[int, ViewPixels]]:
        for view in decoded.capture.used:
            pixels = decoded.pixels(view, scene.normals)
            yield view.view_id, pixels
            counts[:] += count_eligible(pixels, mixed, scene.n_objects)

    cells = cells_of_views(seen(), options.cell_edge, cache_origin(scene, options.cell_edge), options)
    drawn = None if own.pixels == "all" else PixelDraw.evenly(counts, int(own.pixels), mixed, job.seed)
    device.mitsuba()
    # Surface outside all photographs is given the object gains that stage emission found.
    geometry, material = scene.with_gains(read_object_gains(job, scene.n_objects)).traceable(light.emits)
    cache, specular = read_radiance_cache(job), _specular(job, scene)
    indirect = _indirect(job, photographed_share(geometry, cache, mixed, cells, job.seed))
    job.log.info("specular lobes: %s (%s)", "traced" if specular["included"] else "none", specular["reason"])
    world = Scene(geometry, material, light.emitters(geometry), cache if indirect["included"] else None)
    with job.timed("diffuse"):
        diffuse = diffuse_light(world, cells, options)
    job.log.info("%s", words_of_diffuse(cells, diffuse, own.noise))
    with job.timed("specular"):
        traced, lit = 0, world if specular["included"] else None
        for done, view in enumerate(decoded.capture.used):
            job.progress(done, len(decoded.capture.used), "views cached")
            pixels = decoded.pixels(view, scene.normals)
            places = np.arange(len(pixels.index)) if drawn is None else drawn.of(pixels, view)
            found = light_of_pixels(lit, view.view_id, pixels, places, levels, cells, diffuse, options)
            write_light_of_view(job, view, pixels, found)
            traced += found.traced
        job.progress(len(decoded.capture.used), len(decoded.capture.used), "views cached")
    job.writer.table("levels.parquet", {"level": np.arange(len(levels), dtype=np.int32), "roughness": levels})
    facts = {"diffuse": facts_of_diffuse(cells, diffuse), "specular": {"pixels": traced}, "plan": [specular, indirect]}
    job.writer.json("shading.json", {**facts, "numerics": numerics.of_shading(diffuse, own.noise)})


def _indirect(job: Job, covered: float) -> Decision:
    """Decide whether paths end in the radiance cache, by the share of visible surface that it contains (Eq. S.14)."""
    censored = job.read("emission").table("radiance_cache.parquet")["censored"].astype(bool)
    return decisions.radiance_cache(job.settings.shading.indirect, covered, float(censored.mean()) if censored.size else 0.0)


def _specular(job: Job, scene: BaseScene) -> Decision:
    """Settle whether the scene needs specular lobes; where the photographs alone did not tell, by the fused predictions."""
    planned = included(job.read("plan").json("plan.json")["plan"], "specular")
    lowest, metal = glossiest(scene, METALLIC_PRIOR) if planned["status"] == PROVISIONAL else (1.0, False)
    return matte_by_predictions(planned, lowest, metal, MATTE_ROUGHNESS)
