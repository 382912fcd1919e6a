"""Choice among the masks of a promptable model, by the rules of Segment Anything (docs/method/objects.md#proposals)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

Array = np.ndarray


def point_grid(side: int) -> Array:
    """Compute the centres of side x side equal cells of the unit square, (side^2, 2) float32 as (x, y), row by row."""
    at = (np.arange(side, dtype=np.float32) + 0.5) / side
    return np.stack(np.meshgrid(at, at), -1).reshape(-1, 2)


def threshold_stability(logits: ArrayLike, offset: float = 1.0) -> Array:
    """Compute |logit > offset| / |logit > -offset| of every mask, (n,) float64 in [0, 1] of (n, H, W) (Eq. O.18).

    This is the overlap over union of the masks at the thresholds +-offset; 1 = a sharp border, 0 also for an empty mask.
    """
    logits = np.asarray(logits)
    inner, outer = ((logits > level).sum((1, 2)) for level in (offset, -offset))
    return inner / np.maximum(outer, 1)


def suppress_overlaps(masks: ArrayLike, score: ArrayLike, overlap: float) -> Array:
    """Keep, of masks that overlap by more than `overlap` (Eq. O.19), only the one with the highest score.

    masks (n, H, W) bool, score (n,). Returns rows (k,) int64 in the order of falling score; of equal scores the first comes
    first.
    """
    masks = np.asarray(masks, bool)
    flat = masks.reshape(len(masks), masks[:1].size if len(masks) else 0)
    # 64 pixels in one word; the padding is false.
    bits = np.packbits(np.pad(flat, ((0, 0), (0, -flat.shape[1] % 64))), axis=1).view(np.uint64)
    area = flat.sum(1)
    kept: list[int] = []
    for i in np.argsort(-np.asarray(score), kind="stable").tolist():
        common = np.bitwise_count(bits[kept] & bits[i]).sum(1, dtype=np.int64)
        if not (common > overlap * (area[kept] + area[i] - common)).any():  # Eq. O.19 times the union, which may be 0
            kept.append(i)
    return np.array(kept, np.int64)
