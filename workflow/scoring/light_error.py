"""The error of the computed light, in scenes whose materials are known."""

from __future__ import annotations

import numpy as np

from iif_core.evaluation.light import LightSpread
from iif_core.evaluation.metrics import Score
from iif_core.reflectance.brdf import compose, kd_ks
from workflow.artifacts.store import ids_from_disk
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_lit_scene
from workflow.scene.cached_light import read_diffuse, read_specular
from workflow.scene.normal_form import CaptureReader, View


def light_error(job: Job, capture: CaptureReader, views: list[View]) -> list[Score]:
    """Score the light of stage shading at interior pixels of the `views`, none of which is held out.

    Left out is surface that emits in truth, whatever was found, and surface that was found to let light through.
    """
    if capture.facts["source"] == "folder" and not capture.is_hdr:
        return [Score("light_spread", "raw", None, "8-bit photographs of a folder are no true radiance")]
    sheer, spread = read_lit_scene(job)[0].is_sheer, LightSpread()
    levels = job.read("shading").table("levels.parquet")["roughness"]
    for view in views:
        spread.add(*_pixels(job, capture, view, sheer, levels))
    found = spread.finish()
    return [Score("light_spread", "raw", found, "" if found is not None else "fewer than two objects are large enough")]


def _pixels(
    job: Job, capture: CaptureReader, view: View, sheer: np.ndarray, levels: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return, where specular light was traced, the true radiance and the radiance of the true materials under the computed light,
    (n, 3) each, and objects (n,); and the objects of all pixels that count."""
    truth, maps = capture.truth(view), job.read("segmentation").exr(f"maps/{view.name}.exr")
    face, object_id = capture.gbuffer(view)[1], ids_from_disk(maps["object.id"])
    use = truth.valid & (face >= 0) & (object_id >= 0) & (maps["interior"] > 0.5) & ~sheer[np.maximum(face, 0)]
    use &= ~truth.emission.any(-1)
    traced = read_specular(job, view)
    some = traced.index[use.ravel()[traced.index]]
    specular = traced.at(some)

    def flat(image: np.ndarray) -> np.ndarray:
        return image.reshape(use.size, *image.shape[2:])[some]

    r = np.clip(flat(truth.roughness), levels[0], levels[-1])
    lower = np.clip(np.searchsorted(levels, r, side="right") - 1, 0, len(levels) - 2)
    upper = ((r - levels[lower]) / (levels[lower + 1] - levels[lower]))[:, None]
    row = np.arange(len(some))
    lobes = []
    for cached in (specular.s0.mean(0), specular.s1.mean(0)):
        lobes.append((1 - upper) * cached[row, lower] + upper * cached[row, lower + 1])
    material = kd_ks(flat(truth.albedo), flat(truth.metallic)[:, None])
    predicted = compose(*material, flat(read_diffuse(job, view).mean(0)), *lobes)
    return flat(truth.radiance), predicted, flat(object_id), object_id[use]
