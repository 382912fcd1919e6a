"""The picture of a view that a model trained on photographs receives: values in [0, 1], without holes."""

from __future__ import annotations

import numpy as np

from iif_core.numerics.color import key_exposure, srgb_from_linear
from iif_core.numerics.filling import fill_from_neighbours
from workflow.scene.normal_form import CaptureReader, View

GAMMA = 2.2
"""Power that stands for the unknown inverse response of an LDR photograph (Eq. P.17)."""


def picture_for_model(view: View, capture: CaptureReader, linear: bool) -> np.ndarray:
    """Return (H, W, 3) float32 in [0, 1], linear or encoded for display (Eq. P.17).

    LDR photographs are display-encoded already and become linear by the power 2.2. Radiance is exposed to a log-average of 0.18
    and clipped at 1. Pixels that are not valid take the colour of their neighbours.
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
