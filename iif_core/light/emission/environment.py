"""Light from outside the mesh: what escaping camera rays see, and which texels share one unknown radiance
(docs/method/light.md#environment-map)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.light.environment import direction_in, texel_of
from iif_core.numerics.xp import NUMPY

HEIGHT, WIDTH = 16, 32  # texels of the map
MAX_GROUPS = 12
MIN_PIXELS = 50
"""Escaping camera pixels from which a texel is known by itself."""


@dataclass(frozen=True)
class Sky:
    """The environment as groups of texels.

    Attributes:
        columns: (H, W) int32 group of every texel.
        pixels: (E,) camera pixels that see each group; radiance: (E, 3) their mean; bounded: (E,) most are saturated.
    """

    columns: np.ndarray
    pixels: np.ndarray
    radiance: np.ndarray
    bounded: np.ndarray

    @property
    def size(self) -> int:
        return len(self.pixels)

    @property
    def is_unseen(self) -> bool:
        """No camera sees any of the groups, as for those of `SkySums.directions`."""
        return not self.pixels.any()


class SkySums:
    """Sums of what camera rays see that leave the mesh: `add` one view after another, then `groups`."""

    def __init__(self, height: int = HEIGHT, width: int = WIDTH):
        self.shape = (height, width)
        self._sums = np.zeros((height * width, 5))  # R G B, pixels, saturated

    def add(self, directions: np.ndarray, radiance: np.ndarray, bound: np.ndarray) -> None:
        """directions (n, 3) of any length; radiance (n, 3) finite; bound (n, 3) bool: only a lower bound."""
        texel = texels(directions, *self.shape)
        values = np.concatenate([radiance, np.ones((len(texel), 1)), bound.any(1)[:, None]], 1)
        for i in range(5):
            self._sums[:, i] += np.bincount(texel, values[:, i], len(self._sums))

    @property
    def pixels(self) -> int:
        return int(self._sums[:, 3].sum())

    def mean(self) -> np.ndarray:
        """Return the mean radiance (3,) of all escaping pixels, 0 without any."""
        return self._sums[:, :3].sum(0) / max(self.pixels, 1)

    def groups(self, max_ratio: float = 1.5, max_groups: int = MAX_GROUPS, min_pixels: int = MIN_PIXELS) -> Sky:
        """Group texels that share an unknown radiance: those of similar brightness, saturated ones apart from the others; all
        texels that too few pixels have seen are the last group, since nothing tells them apart.

        max_ratio: brightest to darkest texel of a group, doubled in log until `max_groups` suffice; min_pixels: of a texel that
        counts as seen.
        """
        count, saturated = self._sums[:, 3], self._sums[:, 4]
        mean = self._sums[:, :3] / np.maximum(count, 1)[:, None]
        seen, hidden = count >= min_pixels, 2 * saturated > count
        level = np.log(np.maximum(mean.sum(1), 1e-12))
        number, step = np.zeros(len(count), np.int64), np.log(max_ratio)
        while True:
            number[:] = -1
            for part in (seen & ~hidden, seen & hidden):
                if part.any():
                    steps = np.floor((level[part] - level[part].min()) / step).astype(np.int64)
                    number[part] = number.max() + 1 + np.unique(steps, return_inverse=True)[1]
            if number.max() + 1 < max_groups:
                break
            step *= 2
        unseen = number < 0
        number[unseen] = number.max() + 1
        size = int(number.max()) + 1
        pixels = np.bincount(number, count, size)
        radiance = np.stack([np.bincount(number, self._sums[:, c], size) for c in range(3)], 1) / np.maximum(pixels, 1)[:, None]
        radiance[pixels == 0] = self.mean()
        bounded = 2 * np.bincount(number, saturated, size) > pixels
        return Sky(number.reshape(self.shape).astype(np.int32), pixels.astype(np.int64), radiance, bounded)

    def directions(self) -> Sky:
        """Divide the outside of a mesh with large openings into twelve directions, all unknown
        (docs/method/light.md#open-meshes).

        A texel belongs to the nearest of the twelve vertices of an icosahedron; all start at the mean of what was seen.
        """
        golden = (1 + 5**0.5) / 2
        corners = [np.roll([0.0, a, b * golden], i) for i in range(3) for a in (-1, 1) for b in (-1, 1)]
        towards = np.stack(direction_in(NUMPY, *np.indices(self.shape), 0.5, 0.5, *self.shape), -1)
        number = (towards @ np.array(corners).T).argmax(-1)
        size = len(corners)
        return Sky(number.astype(np.int32), np.zeros(size, np.int64), np.tile(self.mean(), (size, 1)), np.zeros(size, bool))


def texels(directions: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return (n,) int, the texel that each direction (n, 3), of any length > 0, points to."""
    unit = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-30)
    row, column = texel_of(NUMPY, tuple(unit.astype(np.float64).T), height, width)
    return row.astype(np.int64) * width + column.astype(np.int64)


def cosine_directions(normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw one unit vector for each normal (n, 3), with density cos / pi around it."""
    sphere = rng.normal(size=normals.shape)
    sphere /= np.maximum(np.linalg.norm(sphere, axis=1, keepdims=True), 1e-12)
    # A uniform point on the sphere that touches the surface from above is cosine-distributed.
    way = normals + sphere
    return way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-6)
