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
        surface, pixels = scene.surface, np.mean([view.width * view.height for view in capture.views])
        self._light = UnexplainedLight(nested_blocks(surface.cell_ijk, surface.cell_object, scene.cell_centres, pixels))
        self._number: dict[int, int] = {}  # view -> its place in the collection
        self._emits: dict[int, np.ndarray] = {}

    def _cell(self, view: View) -> np.ndarray:
        """(H, W) surface cell of the pixels that only reflect, -1 = none."""
        file = f"maps/{view.name}.exr"
        if not self._base.has(file):
            return np.full((view.height, view.width), -1, np.int32)
        emits = np.unpackbits(self._emits[view.view_id], count=view.height * view.width).reshape(view.height, view.width)
        return np.where(emits, -1, ids_from_disk(self._base.exr(file)["cell.id"]))

    def add(self, view: View, radiance: np.ndarray, factor: np.ndarray, emits: np.ndarray) -> None:
        """Add a view: its re-rendering and the factor to the sensor (H, W, 3), and pixels that emit (H, W). Nothing is read of a
        held-out photograph."""
        self._emits[view.view_id] = np.packbits(emits)
        if view.split == "test":
            return
        (photo, valid), cell = self._capture.photo(view), self._cell(view)
        shown, bound = Sensor(self._curve, self._capture.is_hdr).radiance(photo, factor)
        # A pixel that is saturated in either picture says little, and only in one direction.
        use = valid & (cell >= 0) & ~bound.any(-1)
        if not self._capture.is_hdr:
            use &= (factor * radiance < 1).all(-1)
        if not use.any():
            return
        least = max(DARKEST * float(shown[use].mean()), np.finfo(np.float32).tiny)
        # A pixel counts by how much its sensor value changes with the logarithm of its radiance, as scores do.
        exposed = np.clip((factor * shown)[use], 0, 1)
        weight = (exposed * self._curve.evaluate(exposed)[1]) ** 2
        self._number[view.view_id] = len(self._light.views)
        self._light.add(view.world_from_camera[:3, 3], cell[use], shown[use] + least, radiance[use] + least, weight)

    def write(self) -> tuple[Strength, Decision]:
        """Write unexplained/<view>.exr, if it brings photographs nearer; return how far it is believed, and the decision."""
        job, views = self._job, self._capture.views
        strength = self._light.strength(lambda done, of: job.progress(done, of, "photographs compared for unexplained light"))
        for done, view in enumerate(views if strength.beta.any() else ()):
            job.progress(done, len(views), "views with unexplained light")
            cell, factor = self._cell(view), np.ones((view.height, view.width, 3))
            known, own = cell >= 0, self._number.get(view.view_id)
            factor[known] = self._light.factor(view.world_from_camera[:3, 3], cell[known], strength.beta, own)
            job.writer.exr(name_of(view), split_rgb(factor, dtype=np.float16), "factor")
        return strength, decide(strength)
