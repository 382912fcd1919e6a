"""Pixels of surface cells with what was cached for them, and the sums that give the cells an albedo of their own (Eq. M.54)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.camera.response import Response
from iif_core.errors import InputError
from iif_core.fitting.levels import interpolate_levels
from iif_core.numerics.color import SRGB_KNEE
from iif_core.numerics.rows import Rows
from iif_core.reflectance.brdf import F0_DIELECTRIC as F0

DARK = 1e-3
"""Share of the median diffuse light below which pixels are left out (docs/method/numerics.md#pixels-without-light)."""
BOUND_WEIGHT = 1e-3
"""Weight of a saturated value, which bounds the radiance from below: it decides only where the cell has no other value."""


@dataclass(frozen=True, kw_only=True)
class PixelRows(Rows):
    """Pixels with what was cached for them; n pixels, J levels.

    Attributes:
        cell: (n,) int surface cell, -1 is left out.
        weight: (n,) of the pixel in the loss.
        diffuse: (n, 3) D of Eq. M.1; s0, s1: (n, J, 3) S0 and S1 at the levels.
        value: (n, 3) sensor value (HDR: radiance); exposure: (n,); saturated: (n, 3) bool, `value` is a lower bound.
    """

    cell: np.ndarray
    weight: np.ndarray
    diffuse: np.ndarray
    s0: np.ndarray
    s1: np.ndarray
    value: np.ndarray
    exposure: np.ndarray
    saturated: np.ndarray

    def __post_init__(self) -> None:
        n = len(self.cell)
        shapes = {"weight": (n,), "diffuse": (n, 3), "value": (n, 3), "exposure": (n,), "saturated": (n, 3)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InputError(f"pixels of cells: {name} has shape {getattr(self, name).shape}, needed {shape}")
        if self.s0.ndim != 3 or self.s0.shape != (n, self.s0.shape[1], 3) or self.s1.shape != self.s0.shape:
            raise InputError(f"pixels of cells: shading of shapes {self.s0.shape}, {self.s1.shape}, needed ({n}, J, 3) twice")

    def usable(self, dark: float = 0.0) -> np.ndarray:
        """Return which pixels have a cell, finite values, positive weight and exposure, and more light than `dark`, (n,)."""
        use = (self.cell >= 0) & np.isfinite(self.weight) & (self.weight > 0)
        use &= np.isfinite(self.exposure) & (self.exposure > 1e-6) & np.isfinite(self.value).all(1)
        use &= np.isfinite(self.diffuse).all(1) & np.isfinite(self.s0).all((1, 2)) & np.isfinite(self.s1).all((1, 2))
        with np.errstate(invalid="ignore"):
            use &= self.light() > dark
        return use

    def light(self) -> np.ndarray:
        """Return the exposed diffuse light, summed over the channels, (n,)."""
        return self.diffuse.sum(1) * self.exposure

    def radiance(self, response: Response) -> tuple[np.ndarray, np.ndarray]:
        """Return observed radiance y = f^-1(I) / e and squared slope w^2 = (e f'(e y))^2 of the sensor there, (n, 3) each.

        For `identity` (HDR) this gives FIPT's loss: it is measured through the sRGB curve, continued above 1 as a power.
        """
        if response.family == "identity":
            y = np.maximum(self.value.astype(np.float64), 0.0)
            slope = np.where(y <= SRGB_KNEE, 12.92, 1.055 / 2.4 * np.maximum(y, SRGB_KNEE) ** (1 / 2.4 - 1))
            return y, slope**2
        exposed = np.maximum(response.inverse(self.value.astype(np.float64)), 0.0)
        exposure = self.exposure[:, None].astype(np.float64)
        return exposed / exposure, (exposure * response.derivative(exposed)) ** 2


class BlockLight:
    """Mean diffuse light of blocks over their pixels; it does not depend on the view, so its noise averages out."""

    def __init__(self, blocks: int):
        self._sums, self._count = np.zeros((blocks, 3)), np.zeros(blocks)

    def add(self, block: np.ndarray, diffuse: np.ndarray) -> None:
        """Add pixels: block (n,) int, -1 = none, diffuse (n, 3); values that are not finite are left out."""
        use = np.isfinite(diffuse).all(1) & (block >= 0)
        for c in range(3):
            self._sums[:, c] += np.bincount(block[use], diffuse[use, c], len(self._sums))
        self._count += np.bincount(block[use], minlength=len(self._count))

    def mean(self) -> np.ndarray:
        """Return the means, (B, 3) float32; 0 for blocks without pixels."""
        return (self._sums / np.maximum(self._count, 1)[:, None]).astype(np.float32)


class AlbedoSums:
    """Collects the sums of Eq. M.54 from pixels in any number of pieces; 7 numbers for each cell."""

    def __init__(self, cells: int):
        self._square, self._cross, self._pixels = np.zeros((cells, 3)), np.zeros((cells, 3)), np.zeros(cells)

    def add(
        self, rows: PixelRows, levels: np.ndarray, roughness: np.ndarray, metallic: np.ndarray, curve: Response, dark: float = 0.0
    ) -> None:
        """Add pixels.

        Args:
            rows: pixels, with the cell of each; levels: (J,) roughness of the cached levels.
            roughness, metallic: (n,) of each pixel's block; curve: camera response; dark: see `PixelRows.usable`.
        """
        use = np.flatnonzero(rows.usable(dark))
        rows, m = rows.take(use), metallic[use, None]
        y, slope = rows.radiance(curve)
        slope = slope * rows.weight[:, None] * np.where(rows.saturated, BOUND_WEIGHT, 1.0)
        s0, s1 = (interpolate_levels(s, levels, roughness[use])[0] for s in (rows.s0, rows.s1))
        gain = (1.0 - m) * rows.diffuse + m * s0
        rest = y - F0 * (1.0 - m) * s0 - s1
        for c in range(3):
            self._square[:, c] += np.bincount(rows.cell, slope[:, c] * gain[:, c] ** 2, len(self._square))
            self._cross[:, c] += np.bincount(rows.cell, slope[:, c] * gain[:, c] * rest[:, c], len(self._cross))
        self._pixels += np.bincount(rows.cell, rows.weight, len(self._pixels))

    @property
    def sums(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Sums of w G^2 (C, 3), of w G (y - h) (C, 3) and of the pixels' weights (C,), for L = a G + h."""
        return self._square, self._cross, self._pixels
