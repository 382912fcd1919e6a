"""The pixels of the fit, drawn evenly over the objects (docs/method/fitting.md#which-pixels)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.camera.pixels import ViewPixels
from iif_core.fitting.shares import fair_shares
from workflow.scene.normal_form import View

THIN_PIXELS = 50
"""Objects with fewer interior pixels are fitted with their border pixels too, which mix with the neighbouring surface."""
_STREAM = 0x616666
"""Random stream of the draw."""


def count_eligible(pixels: ViewPixels, mixed: np.ndarray, n_objects: int) -> np.ndarray:
    """Return how many interior pixels of a view may enter the fit, of each object (O,). `mixed` as in `PixelDraw`."""
    use = _eligible(pixels, mixed) & pixels.interior
    return np.bincount(pixels.object_id[use], minlength=max(n_objects, 1))


def _eligible(pixels: ViewPixels, mixed: np.ndarray) -> np.ndarray:
    return pixels.valid & pixels.of_object & ~mixed[pixels.face]


@dataclass(frozen=True)
class PixelDraw:
    """A draw of pixels, the same number from each object. A larger draw with the same seed contains a smaller one.

    Attributes:
        mixed: (m,) bool, faces that shine or let light through, whose pixels are left out.
        thin: (O,) bool, objects whose border pixels are drawn too; share: (O,) of the pixels to draw.
        seed: of the draw.
    """

    mixed: np.ndarray
    thin: np.ndarray
    share: np.ndarray
    seed: int

    @classmethod
    def evenly(cls, counts: np.ndarray, budget: int, mixed: np.ndarray, seed: int) -> PixelDraw:
        """Draw about `budget` pixels, given the number of eligible ones of each object, (O,)."""
        return cls(mixed, counts < THIN_PIXELS, fair_shares(counts, budget), seed)

    def of(self, pixels: ViewPixels, view: View) -> np.ndarray:
        """Return the places (k,), increasing, of the drawn ones among the pixels of a view."""
        inside = pixels.interior | self.thin[np.maximum(pixels.object_id, 0)]
        use = np.flatnonzero(_eligible(pixels, self.mixed) & inside)
        rng = np.random.default_rng([self.seed, _STREAM, view.view_id])
        return use[rng.random(len(use)) < self.share[pixels.object_id[use]]]
