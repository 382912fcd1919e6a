"""What an EXR says about itself: the standard attributes of OpenEXR for the picture of a view."""

from __future__ import annotations

from typing import Any

import numpy as np

from iif_core.numerics.color import REC709_PRIMARIES
from workflow.scene.normal_form import View

FLIP_Y = np.diag([1.0, -1.0, 1.0, 1.0])


def view_attributes(view: View, exposure: float) -> dict[str, Any]:
    """Return the attributes of the picture of a view.

    `worldToCamera`: x right, y up, z forward, as OpenEXR defines it (left-handed); `worldToNDC`: (0, 0) is the upper left corner,
    (1, 1) the lower right one. Both are for row vectors, as all matrices of OpenEXR: (x, y, z, 1) M. Lengths are metres in the
    world of the capture. `exposure`, not a standard name, is the factor on `R G B` before the camera's response, its mean
    over pixels and channels.
    """
    to_camera = np.linalg.inv(np.asarray(view.world_from_camera, np.float64))  # x right, y down, z forward; column vectors
    to_pixel = np.array(
        [
            [view.fx / view.width, 0.0, view.cx / view.width, 0.0],
            [0.0, view.fy / view.height, view.cy / view.height, 0.0],
            [0.0, 0.0, 1.0, 0.0],
            [0.0, 0.0, 1.0, 0.0],
        ]
    )
    return {
        "worldToCamera": _row_vectors(FLIP_Y @ to_camera),
        "worldToNDC": _row_vectors(to_pixel @ to_camera),
        "chromaticities": tuple(value for pair in REC709_PRIMARIES for value in pair),
        "colorInteropID": "lin_rec709_scene",
        "exposure": float(exposure),
        "comments": "Linear, relative radiance; metres; world of the capture. Channels: docs/reference/artefacts.md, render.",
    }


def _row_vectors(matrix: np.ndarray) -> np.ndarray:
    """Return a matrix for column vectors as one for row vectors; OpenEXR reads its memory without regard to strides."""
    return np.ascontiguousarray(matrix.T, np.float32)
