"""The camera response in the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from workflow.report import pictures as pic
from workflow.scene.recovered import response_samples

CHANNEL_COLOURS = ("red", "green", "blue")
TITLE = "Response of the camera: sensor value over exposed radiance, in red, green and blue"


def response_drawing(table: Mapping[str, np.ndarray], truth: Any) -> tuple[str, str]:
    """Draw the response that was fitted.

    Args:
        table: camera_response.parquet.
        truth: (3, S) samples over [0, 1] of the true response; None where it is not known.

    Returns:
        An SVG, and what is to be said about it; both empty where the table holds parameters only.
    """
    x, curves = response_samples(table)
    if not len(x):
        return "", ""
    drawn = [(x, curve, colour, False) for curve, colour in zip(curves, CHANNEL_COLOURS, strict=True)]
    note = "Sensor value over exposed radiance, red, green and blue, as fitted."
    if truth is not None:
        truth = np.asarray(truth, np.float64)
        grid = np.linspace(0, 1, truth.shape[1])
        drawn += [(grid, curve, colour, True) for curve, colour in zip(truth, CHANNEL_COLOURS, strict=True)]
        fitted = np.stack([np.interp(grid, x, curve) for curve in curves])
        rms = float(np.sqrt(np.mean((fitted - truth) ** 2)))
        note += f" Dashed: what the camera did; difference {rms:.4f} (root mean square, sensor units)."
    return pic.curves_svg(drawn, TITLE), note
