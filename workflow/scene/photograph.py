"""What a model trained on photographs gets to see of a view: a picture in [0, 1], without holes."""

from __future__ import annotations

import numpy as np

from iif_core.numerics.color import key_exposure, srgb_from_linear
from iif_core.numerics.filters import fill_from_neighbours
from workflow.scene.normal_form import CaptureReader, View

GAMMA = 2.2
"""Stands for the unknown inverse response of an LDR photograph, as in the reference's prior (METHOD 1.3)."""


def seen(view: View, capture: CaptureReader, linear: bool) -> np.ndarray:
    """(H, W, 3) float32 in [0, 1], linear or encoded for display; pixels that do not count take their neighbours' colour.

    LDR photographs are display-encoded already and are made linear by the power 2.2; radiance is exposed to a log-average of
    0.18 first and cut at 1.
    """
    photo, valid = capture.photo(view)
    if capture.is_hdr:
        exposed = np.clip(photo * key_exposure(photo, valid), 0, 1)
        picture = exposed if linear else srgb_from_linear(exposed)
    else:
        picture = np.clip(photo, 0, 1)
        picture = picture**GAMMA if linear else picture
    if not valid.any():
        return picture.astype(np.float32)
    return fill_from_neighbours(np.where(valid[..., None], picture, np.nan))[0].astype(np.float32)
