"""The tables that stage segmentation writes (docs/reference/artefacts.md)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from iif_core.surface.segments import SegmentTable
from iif_core.surface.triangles import face_geometry
from workflow.segmentations.surface import Objects, Stability, Surface

UNITS = {"area_m2": "m^2"}


def face_columns(objects: Objects) -> dict[str, np.ndarray]:
    """Return the columns of faces.parquet: the object of each face."""
    return {"face_id": np.arange(len(objects.object_of_face), dtype=np.int32), "object_id": objects.object_of_face}


def object_columns(
    surface: Surface, objects: Objects, names: Sequence[str], stability: Stability, segments: SegmentTable
) -> dict[str, Any]:
    """Return the columns of objects.parquet: size, what was seen and how reliable it is; stability -1 where nothing is known."""
    count, area = len(names), face_geometry(surface.vertices, surface.faces)[1]
    return {
        "object_id": np.arange(count, dtype=np.int32),
        "name": list(names),
        "faces": np.bincount(objects.object_of_face, minlength=count).astype(np.int32),
        "area_m2": np.bincount(objects.object_of_face, area, count).astype(np.float32),
        "pixels": np.bincount(segments.object, segments.pixels, count).astype(np.int64),
        "views": np.bincount(segments.object, minlength=count).astype(np.int32),
        "agreement": objects.agreement.astype(np.float32),
        "stability": np.nan_to_num(stability.of_object, nan=-1.0).astype(np.float32),
    }


def segment_columns(segments: SegmentTable, view_ids: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of segments.parquet; `view_ids` (views,) are the ids of the views in the order of the table."""
    return {
        "segment_id": segments.segment_id,
        "view_id": view_ids[segments.view],
        "object_id": segments.object,
        "pixels": segments.pixels,
    }
