"""From a promptable model's many answers to one label map: the choice that the automatic mask generator of Segment Anything makes
(Kirillov et al. 2023, appendix B: confidence, stability under the threshold, non-maximum suppression)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

Array = np.ndarray


def point_grid(side: int) -> Array:
    """(side^2, 2) float32 points (x, y) in (0, 1): the centres of side x side equal cells, row by row."""
    at = (np.arange(side, dtype=np.float32) + 0.5) / side
    return np.stack(np.meshgrid(at, at), -1).reshape(-1, 2)


def threshold_stability(logits: ArrayLike, offset: float = 1.0) -> Array:
    """|logit > offset| / |logit > -offset| of every mask, (n,) float64 in [0, 1] of (n, H, W); 0 where nothing is above -offset.

    The overlap over union of the two masks that the thresholds +-offset make (the one lies in the other): 1 = a sharp border.
    """
    logits = np.asarray(logits)
    inner, outer = ((logits > level).sum((1, 2)) for level in (offset, -offset))
    return inner / np.maximum(outer, 1)


def suppressed(masks: ArrayLike, score: ArrayLike, overlap: float) -> Array:
    """Rows to keep, (k,) int64, surest first: of masks whose overlap over union is above `overlap` only the surest.

    Greedy, by falling score, of equal scores the first. masks (n, H, W) bool; score (n,).
    """
    masks = np.asarray(masks, bool)
    flat = masks.reshape(len(masks), masks[:1].size if len(masks) else 0)
    bits = np.packbits(np.pad(flat, ((0, 0), (0, -flat.shape[1] % 64))), axis=1).view(np.uint64)
    area = flat.sum(1)
    kept: list[int] = []
    for i in np.argsort(-np.asarray(score), kind="stable").tolist():
        common = np.bitwise_count(bits[kept] & bits[i]).sum(1, dtype=np.int64)
        if not (common > overlap * (area[kept] + area[i] - common)).any():
            kept.append(i)
    return np.array(kept, np.int64)
