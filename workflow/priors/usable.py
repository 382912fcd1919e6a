"""Which predictions of a view can be used, and how they are stored."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from iif_core.errors import InputError
from iif_core.fusion.problem import prediction_faults
from iif_core.numerics.filling import fill_from_neighbours
from iif_core.reflectance.material import PROPERTIES
from workflow.artifacts.store import split_rgb
from workflow.priors import Predicted
from workflow.scene.normal_form import View

Row = tuple[int, int, bool, str]
"""view_id, k, whether the prediction is used, reason if not (or how it was repaired)."""


def usable(found: Predicted, view: View, samples: int) -> tuple[dict[str, np.ndarray], list[Row]]:
    """Return the channels of the map of a view, none if no prediction can be used, and its rows of predictions.parquet.

    Raises:
        InputError: the prior did not make `samples` predictions of the size of the view.
    """
    maps, expected = found.maps, (samples, view.height, view.width, 5)
    if maps.shape != expected:
        raise InputError(f"view {view.name}: the prior made {maps.shape}, needed {expected}; please report it")
    rows: list[Row] = []
    channels: dict[str, np.ndarray] = {}
    for k, fault in enumerate(prediction_faults(maps)):
        note = ""
        if not fault:
            filled, count = fill_from_neighbours(maps[k])
            layer = f"prior.{k:03d}"
            channels |= split_rgb(filled[..., :3], f"{layer}.albedo", np.float16)
            channels |= {f"{layer}.{of}": filled[..., 3 + i].astype(np.float16) for i, of in enumerate(PROPERTIES[1:])}
            note = f"{count} pixels without a finite value, filled from their neighbours" if count else ""
        rows.append((view.view_id, k, not fault, fault or note))
    if channels and found.scale is not None:
        channels |= {f"scale.{of}": found.scale[..., i].astype(np.float16) for i, of in enumerate(PROPERTIES)}
    return channels, rows


def prediction_columns(rows: Sequence[Row], kind: str) -> dict[str, np.ndarray]:
    """Return the columns of predictions.parquet.

    Raises:
        InputError: none of the predictions of the prior `kind` can be used.
    """
    view_id, k, used, reason = zip(*rows, strict=True) if rows else ((), (), (), ())
    if not any(used):
        why = f"; the first: {reason[0]}" if reason else ": no view is left to predict"
        raise InputError(f"prior {kind}: none of {len(used)} predictions can be used{why}")
    return {
        "view_id": np.array(view_id, np.int32),
        "k": np.array(k, np.int32),
        "used": np.array(used, bool),
        "reason": np.array(reason, object),
    }
