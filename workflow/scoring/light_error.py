"""The error of the computed light, in scenes whose materials are known."""

from __future__ import annotations

import numpy as np

from iif_core.evaluation.light import LightSpread
from iif_core.evaluation.metrics import Score
from iif_core.reflectance.brdf import compose, kd_ks
from workflow.artifacts.store import ids_from_disk, rgb
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_lit_scene
from workflow.scene.normal_form import CaptureReader, View


def light_error(job: Job, capture: CaptureReader) -> list[Score]:
    """Score the light of stage shading at interior pixels, in the views that were used.

    Left out is surface that emits in truth, whatever was found, and surface that was found to let light through.
    """
    if capture.facts["source"] == "folder" and not capture.is_hdr:
        return [Score("light_spread", "raw", None, "8-bit photographs of a folder are no true radiance")]
    sheer, spread = read_lit_scene(job)[0].is_sheer, LightSpread()
    levels = job.read("shading").table("levels.parquet")["roughness"]
    for view in capture.used:
        spread.add(*_pixels(job, capture, view, sheer, levels))
    found = spread.finish()
    return [Score("light_spread", "raw", found, "" if found is not None else "fewer than two objects are large enough")]


def _pixels(
    job: Job, capture: CaptureReader, view: View, sheer: np.ndarray, levels: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True radiance and that of the true materials under the computed light, (n, 3) each, and objects (n,)."""
    file, truth = f"maps/{view.name}.exr", capture.truth(view)
    channels, maps = job.read("shading").exr(file), job.read("segmentation").exr(file)
    face, object_id = capture.gbuffer(view)[1], ids_from_disk(maps["object.id"])
    use = truth.valid & (face >= 0) & (object_id >= 0) & (maps["interior"] > 0.5) & ~sheer[np.maximum(face, 0)]
    use &= ~truth.emission.any(-1)

    def both(layer: str) -> np.ndarray:
        return 0.5 * (rgb(channels, f"half0.{layer}")[use] + rgb(channels, f"half1.{layer}")[use])

    r = np.clip(truth.roughness[use], levels[0], levels[-1])
    lower = np.clip(np.searchsorted(levels, r, side="right") - 1, 0, len(levels) - 2)
    upper = ((r - levels[lower]) / (levels[lower + 1] - levels[lower]))[:, None]
    lobes = []
    for name in ("s0", "s1"):
        value = np.zeros((len(r), 3))
        for j in range(len(levels)):
            weight = np.where(lower == j, 1 - upper[:, 0], np.where(lower == j - 1, upper[:, 0], 0.0))
            value += weight[:, None] * both(f"{name}.{j:02d}")
        lobes.append(value)
    predicted = compose(*kd_ks(truth.albedo[use], truth.metallic[use][:, None]), both("diffuse"), *lobes)
    return truth.radiance[use], predicted, object_id[use]
