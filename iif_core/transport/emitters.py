"""Emitters: radiance per face, and drawing points on them with an exactly known density."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from .arrays import rows_of, table
from .geometry import Geometry

Array = np.ndarray

MIN_SLOTS = 4096


class Emitters:
    """Emitting faces of one geometry.

    radiance (m, 3) per face, linear, >= 0; side (m,) int8: +1 the side of the right-hand normal emits, -1 the
    other, 0 both (default 0); environment (3,) constant radiance of escaping rays; sampling_weight (m,) >= 0:
    how often a face is drawn (default area x mean radiance). A face with weight 0 is still found by
    directions that hit it; faces with a positive weight and unknown radiance 0 may be candidates. Emitting
    faces reflect too, with whatever the material says.
    """

    def __init__(
        self,
        geometry: Geometry,
        radiance: ArrayLike,
        side: ArrayLike | None = None,
        environment: ArrayLike = (0.0, 0.0, 0.0),
        sampling_weight: ArrayLike | None = None,
    ):
        faces = len(geometry.faces)
        radiance = rows_of(radiance, faces, 3, "emitter radiance")
        environment = rows_of(environment, 3, None, "environment radiance")
        side = np.zeros(faces, np.int8) if side is None else np.asarray(side)
        if side.shape != (faces,) or not np.isin(side, (-1, 0, 1)).all():
            raise InputError(f"emitter side has shape {side.shape}; expected ({faces},) of -1, 0 or +1")
        if min(radiance.min(), environment.min()) < 0:
            raise InputError("emitter radiance is negative somewhere; radiance is never negative")
        if sampling_weight is None:
            weight = geometry.areas * radiance.mean(axis=1, dtype=np.float64)
        else:
            weight = rows_of(sampling_weight, faces, None, "sampling_weight").astype(np.float64)
            if weight.min() < 0:
                raise InputError("sampling_weight is negative somewhere")
        self.radiance, self.side, self.environment = radiance, side.astype(np.int8), environment
        self.slots, self.pdf_area = _slots(np.where(geometry.areas > 0, weight, 0.0), geometry.areas)
        self.can_be_sampled = len(self.slots) > 0
        self._slots = mi.UInt32(self.slots) if self.can_be_sampled else None
        self._radiance_pdf = table(np.column_stack([radiance, self.pdf_area]))
        self._side = table(self.side) if np.any(self.side) else None
        self._environment = [dr.opaque(mi.Float, float(value)) for value in environment]

    def environment_radiance(self) -> Any:
        """Radiance of the environment (device type)."""
        return mi.Color3f(*self._environment)

    def surface(self, face: Any, cos_front: Any, active: Any) -> tuple[Any, Any, Any, Any]:
        """(radiance, area density, emits, is_emitter) of a face seen under the cosine `cos_front` to its
        right-hand normal.

        `emits`: the side that is seen is a radiating one; `is_emitter`: the face is one at all.
        """
        record = dr.gather(mi.Vector4f, self._radiance_pdf, face, active)
        is_emitter = active & ((record.w > 0) | (dr.maximum(dr.maximum(record.x, record.y), record.z) > 0))
        emits = is_emitter & (cos_front != 0)
        if self._side is not None:
            side = dr.gather(mi.Float, self._side, face, is_emitter)
            emits &= (side == 0) | (side * cos_front > 0)
        return mi.Color3f(record.x, record.y, record.z), record.w, emits, is_emitter

    def sample_face(self, u: Any, active: Any) -> Any:
        """Face drawn with the density that `surface` reports, from a uniform u in [0, 1)."""
        count = len(self.slots)
        slot = dr.minimum(mi.UInt32(u * count), count - 1)
        return dr.gather(mi.UInt32, self._slots, slot, active)


def _slots(weight: Array, areas: Array) -> tuple[Array, Array]:
    """(slots uint32, pdf_area (m,) float32): face of every slot and count / slots / area, the density of one
    draw.

    Each face of positive weight owns at least one slot; the rest follow the weights by largest remainder,
    ties to the lower face id. A table replaces the search in a cumulative sum: one read, no rounding at its
    ends (METHOD H22).
    """
    pdf = np.zeros(len(weight), np.float32)
    faces = np.flatnonzero(weight > 0)
    if not len(faces):
        return np.zeros(0, np.uint32), pdf
    count = max(MIN_SLOTS, 1 << int(4 * len(faces) - 1).bit_length())
    share = weight[faces] / weight[faces].max()
    share *= (count - len(faces)) / share.sum()
    counts = 1 + np.floor(share).astype(np.int64)
    rest = count - counts.sum()
    counts[np.argsort(-(share - np.floor(share)), kind="stable")[:rest]] += 1
    pdf[faces] = counts / count / areas[faces]
    return np.repeat(faces, counts).astype(np.uint32), pdf
