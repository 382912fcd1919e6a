"""Texture of surface cells from the photographs (docs/method/fitting.md#texture-of-cells-from-the-photographs)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iif_core.fitting.cell_pixels import AlbedoSums
from iif_core.fitting.cell_texture import smooth_light, textured_albedo
from iif_core.fitting.problem import FitResult
from iif_core.light.base_scene import BaseScene
from iif_core.reflectance.material import apply_affines
from iif_core.surface.cells import neighbour_pairs, pack_keys
from workflow.fitting.cell_pixels import CellPixels
from workflow.fitting.inputs import roughness_levels
from workflow.runtime.job import Job
from workflow.scene.decoded import DecodedViews


def _points(job: Job) -> np.ndarray:
    """Return the mean observed position of each cell, (C, 3), m."""
    cells = job.read("base").table("cells.parquet", (*"xyz",))
    return np.stack([cells[c] for c in "xyz"], 1)


@dataclass(frozen=True)
class CellTextures:
    """Cells and pixels from which the texture of the photographs is taken, for priors that could not divide by the light."""

    job: Job
    scene: BaseScene
    views: CellPixels
    levels: np.ndarray

    @classmethod
    def of(cls, job: Job, decoded: DecodedViews, scene: BaseScene, mixed: np.ndarray) -> CellTextures | None:
        """Read them, or return None where the settings do not ask for them; `mixed` as in `CellPixels`."""
        cells = len(scene.cell_object)
        if not job.settings.affines.textured or not cells:
            return None
        views = CellPixels(job, decoded, scene, mixed, np.arange(cells), cells)
        views.diffuse = smooth_light(views.diffuse, _points(job), scene.cell_object)
        return cls(job, scene, views, roughness_levels(job))

    def albedo(self, fit: FitResult) -> np.ndarray:
        """Return the albedo of the cells with the texture of the photographs, (C, 3)."""
        fitted, scene = self._fitted(fit), self.scene
        sums = self._sums(fit, fitted[:, 3:])
        pairs = neighbour_pairs(pack_keys(scene.cell_ijk, scene.cell_object))
        return textured_albedo(fitted[:, :3], *sums.sums, scene.cell_ijk, pairs, _points(self.job), scene.cell_object)

    def _fitted(self, fit: FitResult) -> np.ndarray:
        """Return the materials of the cells under the fit, (C, 5)."""
        return apply_affines(fit.affine, self.scene.cell_object.astype(np.int64), self.scene.cell_values)

    def _sums(self, fit: FitResult, gloss: np.ndarray) -> AlbedoSums:
        """Collect the albedo sums, given roughness and metallic of the cells (C, 2)."""
        sums, scale = AlbedoSums(len(gloss)), np.float32(fit.light_scale)
        for rows, cell in self.views:
            rows = replace(rows, diffuse=rows.diffuse * scale, s0=rows.s0 * scale, s1=rows.s1 * scale)
            sums.add(rows, self.levels, *gloss[cell].T, fit.response, self.views.dark * float(scale))
        return sums
