"""What stage render writes about the light that the model lacks (docs/method/shading.md#unexplained-light)."""

from __future__ import annotations

import numpy as np

from iif_core.camera.response import Response
from iif_core.light.emission.sensor import Sensor
from iif_core.light.unexplained import Strength, UnexplainedLight, nested_blocks
from workflow.artifacts.store import ids_from_disk, split_rgb
from workflow.decisions.light import unexplained as decide
from workflow.decisions.record import Decision
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_base
from workflow.scene.normal_form import CaptureReader, View
from workflow.scene.recovered import Recovered

DARKEST = 0.02
"""Added to both radiances before the logarithm, as a share of the mean of the photograph: noise and black tell nothing."""


def name_of(view: View) -> str:
    """Return the file of stage render that holds the factor on the re-rendering of a view, if there is unexplained light."""
    return f"unexplained/{view.name}.exr"


class Unexplained:
    """Collects what the photographs that are used show beside their re-renderings, and writes a factor for each view."""

    def __init__(self, job: Job, capture: CaptureReader, scene: Recovered, curve: Response):
        self._job, self._capture, self._curve, self._base = job, capture, curve, read_base(job)
        surface = scene.surface
        self._light = UnexplainedLight(nested_blocks(surface.cell_ijk, surface.cell_object, scene.cell_centres))
        self._added: dict[int, int] = {}

    def _cell(self, view: View) -> np.ndarray:
        """(H, W) surface cell of the pixels, -1 = none."""
        file = f"maps/{view.name}.exr"
        if not self._base.has(file):
            return np.full((view.height, view.width), -1, np.int32)
        return ids_from_disk(self._base.exr(file)["cell.id"])

    def add(self, view: View, radiance: np.ndarray, factor: np.ndarray, emits: np.ndarray) -> None:
        """Add a used view: its re-rendering and the factor to the sensor (H, W, 3), and pixels that emit (H, W)."""
        (photo, valid), cell = self._capture.photo(view), self._cell(view)
        shown, bound = Sensor(self._curve, self._capture.is_hdr).radiance(photo, factor)
        exposed = factor * radiance
        use = valid & (cell >= 0) & ~emits & ~bound.any(-1) & (exposed < 1).all(-1)
        if not use.any():
            return
        least = max(DARKEST * float(shown[use].mean()), np.finfo(np.float32).tiny)
        ratio = np.log(shown[use] + least) - np.log(radiance[use] + least)
        # A pixel counts by how much its sensor value changes with the logarithm of its radiance, as scores do.
        slope = exposed[use] * self._curve.evaluate(exposed[use])[1]
        self._added[view.view_id] = len(self._light.views)
        self._light.add(view.world_from_camera[:3, 3], cell[use], ratio, slope**2)

    def write(self) -> tuple[Strength, Decision]:
        """Write unexplained/<view>.exr, if it brings photographs nearer; return how far it is believed, and the decision."""
        strength = self._light.strength()
        for view in self._capture.views if strength.beta.any() else ():
            cell, factor = self._cell(view), np.ones((view.height, view.width, 3))
            known = cell >= 0
            own = self._added.get(view.view_id)
            factor[known] = self._light.factor(view.world_from_camera[:3, 3], cell[known], strength.beta, own)
            self._job.writer.exr(name_of(view), split_rgb(factor, dtype=np.float16), "factor")
        return strength, decide(strength)
