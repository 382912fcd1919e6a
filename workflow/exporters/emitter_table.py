"""emitters.parquet of the deliverable: every emitter that was considered, and the objects that it is on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

UNITS = {"area_m2": "m^2", "radiance_r": "relative"}


def emitter_columns(found: Mapping[str, np.ndarray], objects: Mapping[int, str], light_scale: float) -> dict[str, Any]:
    """Return the columns of the table.

    Args:
        found: emitters.parquet of stage emission.
        objects: emitter id -> names of the objects that it is on.
        light_scale: factor that the fit found, by which radiances and their errors go with the fitted albedo.
    """
    out: dict[str, Any] = {**found, "object": [objects.get(int(emitter), "") for emitter in found["emitter_id"]]}
    scaled = [name for name in found if name.startswith(("radiance_", "error_"))]
    return out | {name: (found[name] * light_scale).astype(np.float32) for name in scaled}
