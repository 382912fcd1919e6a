"""Stage shading as published: light of one bounce at every pixel, lobe by lobe (lab/docs/published.md#shading)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from iif_core.camera.pixels import ViewPixels
from lab.simulated.denoise import denoise_alone
from workflow.artifacts.store import split_rgb
from workflow.models.denoise import require_denoiser
from workflow.runtime import device
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_lit_scene, read_radiance_cache
from workflow.scene.cached_light import UNITS, SpecularLight, table_of
from workflow.scene.decoded import DecodedViews
from workflow.scene.normal_form import CaptureReader, View

if TYPE_CHECKING:
    from iif_core.light.transport.scene import Scene

LEVELS = 6
DIFFUSE_PATHS = 256
SHARPEST_PATHS, SPECULAR_PATHS = 64, 128
"""Paths of the sharpest specular level, and of each other one."""
_SEEDS = 0x707368  # keeps the random streams of this stage apart from those of others


def published_levels() -> np.ndarray:
    """Return (6,) float64 roughness levels, evenly from 0.02 to 1.

    >>> published_levels().round(3)
    array([0.02 , 0.216, 0.412, 0.608, 0.804, 1.   ])
    """
    return 0.02 + 0.98 * np.arange(LEVELS) / (LEVELS - 1)


def run(job: Job) -> None:
    """Write the files of stage shading. The published method has no halves, so both halves are the same."""
    from iif_core.light.transport.scene import Scene

    require_denoiser()
    capture, (scene, light) = CaptureReader(job.read("capture")), read_lit_scene(job)
    levels, count = published_levels(), 0
    device.mitsuba()
    geometry, material = scene.traceable()
    world = Scene(geometry, material, light.emitters(geometry), read_radiance_cache(job))
    for done, view in enumerate(capture.used):
        job.progress(done, len(capture.used), "views cached")
        if job.writer.part_kept(view.name) is None:
            _view(job, world, levels, view, DecodedViews(capture, job.read("segmentation"), 0).pixels(view, scene.normals))
        count += len(job.writer.columns(table_of(view))["index"])
    job.writer.table("levels.parquet", {"level": np.arange(LEVELS, dtype=np.int32), "roughness": levels})
    facts = {"cells": 0, "cell_edge_m": scene.cell_edge, "paths_per_pixel": DIFFUSE_PATHS}
    job.writer.json("shading.json", {"diffuse": facts, "specular": {"pixels": count}, "plan": []})
    job.progress(len(capture.used), len(capture.used), "views cached")


def _view(job: Job, world: Scene, levels: np.ndarray, view: View, pixels: ViewPixels) -> None:
    """Write the light of one view."""
    from iif_core.light.transport.scene import PathOptions
    from lab.published.light.single_bounce import shade_lobe

    surface = pixels.points, pixels.normals, pixels.wo
    seed = ((job.seed << 32) | _SEEDS) << 32 | view.view_id

    def lobe(number: int, roughness: float | None, paths: int) -> list[np.ndarray]:
        found = shade_lobe(world, *surface, roughness, PathOptions(paths, 1, seed * (LEVELS + 1) + number))
        return [_denoised(part, pixels.index, view) for part in found]

    diffuse = lobe(0, None, DIFFUSE_PATHS)[0]
    s0, s1 = np.zeros((2, len(pixels.index), LEVELS, 3), np.float32)
    for j, roughness in enumerate(levels):
        s0[:, j], s1[:, j] = lobe(1 + j, float(roughness), SPECULAR_PATHS if j else SHARPEST_PATHS)
    image = np.zeros((view.height * view.width, 3), np.float32)
    image[pixels.index] = diffuse
    channels: dict[str, np.ndarray] = {}
    for half in range(2):
        channels |= split_rgb(image.reshape(view.height, view.width, 3), f"half{half}.diffuse")
    job.writer.exr(f"maps/{view.name}.exr", channels, "relative")
    twice = (np.stack([part, part]) for part in (s0, s1))
    job.writer.table(table_of(view), SpecularLight(pixels.index, *twice).columns(), UNITS)
    job.writer.part_done(view.name, [f"maps/{view.name}.exr", table_of(view)], {})


def _denoised(values: np.ndarray, index: np.ndarray, view: View) -> np.ndarray:
    """Denoise values (n, 3) of the pixels `index` as a picture; the rest of it is black."""
    image = np.zeros((view.height * view.width, 3), np.float32)
    image[index] = values
    return denoise_alone(image.reshape(view.height, view.width, 3)).reshape(-1, 3)[index]
