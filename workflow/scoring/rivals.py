"""Rivals of the result that the photographs give without any model of light (docs/method/evaluation.md#rivals)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from iif_core.camera.interpolation import Shown, by_others
from iif_core.camera.pixels import pixel_gains
from iif_core.evaluation.consistency import held_out_gain
from iif_core.light.emission.sensor import Sensor
from iif_core.numerics.filling import fill_from_neighbours
from iif_core.surface.triangles import face_geometry, towards_viewer
from workflow.artifacts.store import ids_from_disk, rgb
from workflow.runtime.job import Job
from workflow.scene.base_scene import read_base, read_gains
from workflow.scene.decoded import MEMORY_MB, Kept
from workflow.scene.normal_form import CaptureReader, View
from workflow.scene.recovered import read_response
from workflow.scene.unexplained import name_of

BLOCK = 1 << 16
"""Pixels that are predicted at once."""
DARKEST = 1e-4
"""Least radiance, relative to the mean, and albedo of which a logarithm is taken."""


class OtherPhotographs:
    """The photographs that are used as radiance, by the response and the gains that were found.

    Attributes:
        albedo: (cells + 1, 3) float32, the mean radiance that they show of every cell of the base, taken for its albedo (Eq.
            E.23); 0 in cells that none shows, and in the last row.
    """

    def __init__(self, job: Job, capture: CaptureReader):
        self._job, self._capture, self._kept = job, capture, Kept(MEMORY_MB)
        self._curve, self._gains = read_response(job.read("affines")), read_gains(job)
        self._normals = face_geometry(*capture.mesh())[0]
        self._number = {view.view_id: number for number, view in enumerate(capture.views)}
        self.albedo = self._as_albedo()

    def _factor(self, view: View) -> np.ndarray:
        each = np.arange(view.height * view.width)
        return pixel_gains(self._gains, self._number[view.view_id], view, each).reshape(view.height, view.width, 3)

    def shown(self, view: View) -> Shown:
        """Return what a used photograph shows."""
        return self._kept.once(view.view_id, lambda: self._shown(view))

    def _shown(self, view: View) -> Shown:
        (photo, valid), (depth, face) = self._capture.photo(view), self._capture.gbuffer(view)
        radiance, bound = Sensor(self._curve, self._capture.is_hdr).radiance(photo, self._factor(view))
        return Shown(view, radiance.astype(np.float32), valid & (face >= 0), bound.any(-1), depth)

    def predictions(self, view: View, photo: np.ndarray, counted: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
        """Yield (variant, sensor values (H, W, 3)) of a view by the other photographs that are used; a pixel that none of these
        shows has the colour of its neighbour.

        Args:
            view: held out, or used: then its own photograph is left out.
            photo: (H, W, 3) and counted: (H, W), what it shows and where it is scored, for its gain where that is not known.
        """
        depth, face = self._capture.gbuffer(view)
        eye, at = view.world_from_camera[:3, 3], np.flatnonzero(face >= 0)
        points = view.points(depth, np.float64).reshape(-1, 3)[at]
        normals, _ = towards_viewer(self._normals[face.ravel()[at]], eye - points)
        others = [self.shown(other) for other in self._capture.used if other.view_id != view.view_id]
        pictures = np.full((2, view.height * view.width, 3), np.nan)
        for start in range(0, len(at), BLOCK):
            part = slice(start, start + BLOCK)
            mean, blend, seen = by_others(points[part], normals[part], eye, others)
            pictures[:, at[part][seen]] = mean[seen], blend[seen]
        for variant, picture in zip(("photo_mean", "photo_nearest"), pictures.reshape(2, *photo.shape), strict=True):
            if np.isfinite(picture).any():
                yield variant, self._developed(view, fill_from_neighbours(picture)[0], photo, counted, fitted=True)

    def corrected(self, view: View, radiance: np.ndarray, photo: np.ndarray, counted: np.ndarray) -> np.ndarray | None:
        """Return the sensor values of a re-rendering (H, W, 3) times the light that the model lacks (Eq. S.24); None where no
        such light is known."""
        render = self._job.read("render")
        if not render.has(name_of(view)):
            return None
        factor = rgb(render.exr(name_of(view))).astype(np.float32)
        return self._developed(view, factor * radiance, photo, counted, fitted=view.split == "test")

    def _developed(self, view: View, radiance: np.ndarray, photo: np.ndarray, counted: np.ndarray, fitted: bool) -> np.ndarray:
        """Return the sensor values of radiance in a view, as stage render finds those of its re-rendering; `fitted`: where
        exposures are estimated, with the gain that brings it nearest to the photograph."""
        exposed = self._factor(view) * radiance
        if fitted and self._capture.facts.get("exposure_estimated"):
            white_balance = bool((self._gains.gain != self._gains.gain[:, :1]).any())
            exposed = exposed * held_out_gain(exposed, photo, counted, self._curve, white_balance)
        return np.clip(self._curve(np.clip(exposed, 0, 1)), 0, 1)

    def _as_albedo(self) -> np.ndarray:
        base = read_base(self._job)
        albedo = np.stack([base.table("cells.parquet")[f"albedo_{c}"] for c in "rgb"], 1)
        sums, count = np.zeros(albedo.shape), np.zeros(len(albedo))
        for view in self._capture.used:
            if base.has(file := f"maps/{view.name}.exr"):
                shown, cell = self.shown(view), ids_from_disk(base.exr(file)["cell.id"])
                use = shown.usable & (cell >= 0)
                count += np.bincount(cell[use], minlength=len(count))
                for c in range(3):
                    sums[:, c] += np.bincount(cell[use], shown.radiance[use][:, c], len(count))
        seen = count > 0
        out = np.zeros((len(albedo) + 1, 3), np.float32)
        if seen.any():
            mean = sums[seen] / count[seen, None]
            lit = np.maximum(mean, max(DARKEST * float(mean.mean()), np.finfo(float).tiny))
            level = np.average(np.log(np.maximum(albedo[seen], DARKEST)) - np.log(lit), axis=0, weights=count[seen])
            out[np.flatnonzero(seen)] = np.minimum(mean * np.exp(level), 1)
        return out
