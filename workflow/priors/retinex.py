"""Prior `retinex`: a baseline without learned weights (docs/method/priors.md#retinex).

It divides the photograph by the irradiance that the other photographs imply, then applies colour retinex.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from iif_core.errors import InputError
from iif_core.priors.features import MEAN_ALBEDO, REACHES, scene_light
from iif_core.priors.retinex import retinex_predictions
from workflow.priors import Keep, Predicted
from workflow.priors.views import CaptureViews
from workflow.scene.normal_form import CaptureReader, View


class Retinex:
    """The light on the surface, estimated once from all photographs that are not held out."""

    def __init__(self, settings: SimpleNamespace, capture: CaptureReader, seed: int, keep: Keep, threads: int = 1):
        self.settings, self.seed = settings.prior, seed
        self.views = CaptureViews(capture, settings.segmentation.kind == "given")
        self.views.calibrate()
        try:
            self.light = scene_light(self.views, self.views.tracer(), MEAN_ALBEDO, seed)
        except InputError:  # no photograph shows the mesh: each is taken by itself
            self.light = None

    def __call__(self, view: View) -> Predicted:
        """Make K predictions of a view."""
        own = self.views.of(view)
        log_light = None
        hit = own.hit.ravel()
        if self.light is not None:
            log_light = np.zeros((len(REACHES), hit.size, 3))
            if hit.any():
                log_light[:, hit] = self.light.log_at(*self.light.around(own)) + np.log(own.camera.exposure)
                log_light[:, ~hit] = log_light[:, hit].mean(1, keepdims=True)
            log_light = log_light.reshape(len(REACHES), *own.depth.shape, 3)
        maps = retinex_predictions(
            own.value,
            self.settings.samples,
            MEAN_ALBEDO,
            own.object_id,
            own.normals,
            (own.valid | ~hit.reshape(own.depth.shape)) & ~own.saturated,
            log_light,
            self.seed,
        )
        return Predicted(maps)


prepare = Retinex
