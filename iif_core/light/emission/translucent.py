"""Which objects let light through (docs/method/light.md#surface-that-lets-light-through)."""

from __future__ import annotations

import numpy as np

TRANSMITTANCE = 0.5
"""Share of the light that passes straight through curtains and blinds. What a room shows is this times the light behind them,
so another value changes that light first of all (docs/method/light.md#surface-that-lets-light-through)."""
OPEN_SHARE = 0.05
"""Share of the pixels of an object with nothing behind them, and with something, at least: fewer are those of its edge, as a
pane has them beside the wall."""
OPEN_RATIO = 1.5
"""Mean radiance of these pixels relative to the others of the object, at least."""


def is_brighter_where_open(
    object_id: np.ndarray, is_open: np.ndarray, radiance: np.ndarray, n_objects: int, min_pixels: int = 8
) -> np.ndarray:
    """Find objects that are much brighter where a ray through them leaves the scene than where it meets something.

    Cloth that glows by itself, or a lampshade, is as bright before a wall as before a window.

    Args:
        object_id: (n,) of pixels, >= 0; is_open: (n,) bool; radiance: (n,) mean over channels, >= 0.
        n_objects: objects are 0 ... n_objects - 1.
        min_pixels: of either kind.

    Returns:
        (n_objects,) bool; False where an object has too few pixels of one kind to compare.
    """
    kinds = [np.bincount(object_id[kind], minlength=n_objects) for kind in (is_open, ~is_open)]
    means = [
        np.bincount(object_id[kind], radiance[kind], n_objects) / np.maximum(count, 1)
        for kind, count in zip((is_open, ~is_open), kinds, strict=True)
    ]
    enough = np.minimum(*kinds) >= np.maximum(min_pixels, OPEN_SHARE * (kinds[0] + kinds[1]))
    return enough & (means[0] >= OPEN_RATIO * means[1])
