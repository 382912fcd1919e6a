"""The pixels of surface cells, view by view, with the light that was cached for them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from iif_core.camera.pixels import ViewPixels
from iif_core.fitting.cell_pixels import DARK, BlockLight, PixelRows
from iif_core.light.base_scene import BaseScene
from workflow.fitting.inputs import balanced, cells_of, exposure_and_balance, roughness_levels
from workflow.models.denoise import denoise, require_denoiser
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_gains, sensor_bounds
from workflow.scene.cached_light import read_diffuse, read_specular
from workflow.scene.decoded import DecodedViews
from workflow.scene.normal_form import View

BORDER_WEIGHT = 0.1
"""Weight of a pixel on the border of an object."""


class CellPixels:
    """Valid pixels of surface that neither emits nor lets light through (`mixed` (m,) bool), view by view: rows by block, and
    the cell of each pixel.

    Attributes:
        count: number of pixels; dark: light below which a pixel is not used (`PixelRows.usable`).
        diffuse: (B, 3) mean diffuse light of the blocks.
    """

    def __init__(self, job: Job, decoded: DecodedViews, scene: BaseScene, mixed: np.ndarray, block_of: np.ndarray, blocks: int):
        self.job, self.decoded, self.scene, self.mixed, self.block_of = job, decoded, scene, mixed, block_of
        require_denoiser()
        self.levels = len(roughness_levels(job))
        light, samples, self.count = BlockLight(blocks), [np.zeros(0)], 0
        for rows, _ in self._views(None):
            light.add(rows.cell, rows.diffuse)
            own = rows.light()
            samples.append(own[np.isfinite(own)][:: max(1, len(own) // 4096)])
            self.count += len(own)
        joined = np.concatenate(samples)
        self.dark = DARK * float(np.median(joined)) if len(joined) else 0.0
        self.diffuse = light.mean()

    def __iter__(self) -> Iterator[tuple[PixelRows, np.ndarray]]:
        return self._views(self.diffuse)

    def _views(self, diffuse: np.ndarray | None) -> Iterator[tuple[PixelRows, np.ndarray]]:
        """Yield rows and cells with the diffuse light of blocks; if None, with the diffuse light of the pixels, without lobes."""
        job, capture, gains = self.job, self.decoded.capture, read_gains(self.job)
        views = capture.used
        for done, view in enumerate(views):
            pixels = self.decoded.pixels(view, self.scene.normals)
            cell = cells_of(job, view)[pixels.index]
            use = pixels.valid & (cell >= 0) & ~self.mixed[pixels.face]
            d = _denoised(read_diffuse(job, view), view, pixels)[use] if diffuse is None else np.zeros(0)
            pixels, cell = pixels.take(use), cell[use]
            block = self.block_of[cell]
            s0 = s1 = np.zeros((len(cell), 0, 3), np.float32)
            if diffuse is not None:
                specular = read_specular(job, view).at(pixels.index)
                s0, s1, d = specular.s0.mean(0), specular.s1.mean(0), diffuse[block]
            value = np.asarray(pixels.value, np.float32)
            value, saturated = sensor_bounds(value, capture.is_hdr)
            exposure, balance = exposure_and_balance(capture, gains, view, pixels.index)
            if diffuse is not None:  # blocks average light before the white balance of a photograph
                d = balanced(d, balance)
            s0, s1 = balanced(s0, balance), balanced(s1, balance)
            weight = np.where(pixels.interior, 1.0, BORDER_WEIGHT)
            rows = PixelRows(
                cell=block, weight=weight, diffuse=d, s0=s0, s1=s1, value=value, exposure=exposure, saturated=saturated
            )
            yield rows, cell
            job.progress(done + 1, len(views), "views read")


def _denoised(light: np.ndarray, view: View, pixels: ViewPixels) -> np.ndarray:
    """Return the denoised diffuse light (2, H, W, 3) of pixels, (n, 3), as FIPT does; a free albedo would keep all its noise."""
    normals = np.zeros((view.height * view.width, 3), np.float32)
    normals[pixels.index] = pixels.normals
    shape = (view.height, view.width, 3)
    return denoise(light.mean(0), np.ones(shape, np.float32), normals.reshape(shape)).reshape(-1, 3)[pixels.index]
