"""The loss of a free material in every surface cell, reduced to sums over the pixels of the cell (Eq. M.1, M.50).

A cell is 15 J + 3 numbers, whatever the number of photographs. Between levels the loss, not the shading, is interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.camera.response import Response
from iif_core.errors import InputError
from iif_core.numerics.color import SRGB_KNEE

SUMS = 5
"""SS, SD, SZ, DZ, ZZ of a level."""
DARK = 1e-3
"""Share of the median diffuse light below which pixels are left out (docs/method/numerics.md#pixels-without-light)."""
BOUND_WEIGHT = 1e-3
"""Weight of a saturated value, which bounds the radiance from below: it decides only where the cell has no other value."""
_PIECE = 1 << 15


@dataclass(frozen=True)
class PixelRows:
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

    def take(self, choice: np.ndarray) -> PixelRows:
        """Return some of the pixels."""
        return PixelRows(**{name: array[choice] for name, array in self.__dict__.items()})

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


@dataclass(frozen=True)
class CellProblem:
    """The loss of all cells, as `CellSums` collects it; C cells, J levels.

    Attributes:
        object_id: (C,) int in [0, n_objects).
        levels: (J,) roughness of the levels, increasing.
        pixels: (C,) summed pixel weight; 0 = the cell was not seen.
        dd: (C, 3); lobes: (C, J, 5, 3) SS, SD, SZ, DZ, ZZ.
        specular: (C, J, 2) sums of S0 and S1, mean over the channels.
    """

    object_id: np.ndarray
    n_objects: int
    levels: np.ndarray
    pixels: np.ndarray
    dd: np.ndarray
    lobes: np.ndarray
    specular: np.ndarray

    @property
    def known(self) -> np.ndarray:
        """Cells that light reached in every channel of some pixel, (C,) bool."""
        return (self.pixels > 0) & (self.dd > 0).all(1)

    def take(self, choice: np.ndarray) -> CellProblem:
        """Return some of the cells."""
        return CellProblem(
            self.object_id[choice],
            self.n_objects,
            self.levels,
            self.pixels[choice],
            self.dd[choice],
            self.lobes[choice],
            self.specular[choice],
        )


class CellSums:
    """Collects a `CellProblem` from pixels in any number of pieces; memory grows with the number of cells alone."""

    def __init__(self, object_id: np.ndarray, n_objects: int, levels: np.ndarray):
        levels = np.asarray(levels, np.float64)
        if len(levels) < 2 or np.any(np.diff(levels) <= 0):
            raise InputError("cells: needs at least two increasing roughness levels")
        object_id = np.asarray(object_id, np.int64)
        if object_id.size and not 0 <= object_id.min() <= object_id.max() < n_objects:
            found = f"{object_id.min()} ... {object_id.max()}"
            raise InputError(f"cells: object ids {found}; allowed are 0 ... {n_objects - 1}")
        self.object_id, self.n_objects, self.levels = object_id, n_objects, levels
        cells, count = len(object_id), len(levels)
        self._pixels, self._dd = np.zeros(cells), np.zeros((cells, 3), np.float32)
        self._lobes = np.zeros((cells, count, SUMS, 3), np.float32)
        self._specular = np.zeros((cells, count, 2), np.float32)

    def add(self, rows: PixelRows, response: Response, dark: float = 0.0) -> None:
        """Add the usable pixels (`PixelRows.usable`), seen through `response`."""
        rows = rows.take(np.flatnonzero(rows.usable(dark)))
        rows = rows.take(np.argsort(rows.cell, kind="stable"))
        for start in range(0, len(rows.cell), _PIECE):
            self._add_piece(rows.take(np.arange(start, min(start + _PIECE, len(rows.cell)))), response)

    def _add_piece(self, rows: PixelRows, response: Response) -> None:
        starts = np.flatnonzero(np.r_[True, np.diff(rows.cell) != 0])
        cell = rows.cell[starts]
        y, slope = rows.radiance(response)
        slope = slope * rows.weight[:, None] * np.where(rows.saturated, BOUND_WEIGHT, 1.0)
        d = rows.diffuse.astype(np.float64)
        self._pixels[cell] += np.add.reduceat(rows.weight.astype(np.float64), starts)
        self._dd[cell] += np.add.reduceat(slope * d * d, starts)
        for j in range(len(self.levels)):
            s0, s1 = rows.s0[:, j].astype(np.float64), rows.s1[:, j].astype(np.float64)
            z = y - s1
            for number, (left, right) in enumerate(((s0, s0), (s0, d), (s0, z), (d, z), (z, z))):
                self._lobes[cell, j, number] += np.add.reduceat(slope * left * right, starts)
            means = np.stack([s0.mean(1), s1.mean(1)], 1) * rows.weight[:, None]
            self._specular[cell, j] += np.add.reduceat(means, starts)

    def problem(self) -> CellProblem:
        """Return the sums collected so far."""
        return CellProblem(self.object_id, self.n_objects, self.levels, self._pixels, self._dd, self._lobes, self._specular)
