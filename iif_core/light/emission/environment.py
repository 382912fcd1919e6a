"""Light from outside the mesh: what escaping camera rays see, and which texels share one unknown radiance
(docs/method/light.md#environment-map)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from iif_core.light.emission.direct import EmissionPrior
from iif_core.light.environment import direction_in, solid_angles, texel_of
from iif_core.numerics.xp import NUMPY

HEIGHT, WIDTH = 16, 32  # texels of the map
MIN_PIXELS = 50
"""Escaping camera pixels that suffice for a texel to count as seen."""
REACH = 0.7
"""Angle in radians over which the light from outside is correlated (Eq. L.9)."""
LIKENESS = 0.99
"""Correlation of two groups in the same direction."""
OUTSIDE_SPREAD = 1.0
"""Standard deviation of the light from outside over all directions, relative to the mean of what cameras see of it."""
SUN_WIDTH = 30.0
"""The same of what is saturated outside, relative to the bound."""
SUN_LIGHT = 10.0
"""Standard deviation of the irradiance from a sun, relative to that from a whole sky."""


@dataclass(frozen=True)
class Sky:
    """The environment as groups of texels.

    Attributes:
        columns: (H, W) int32 group of every texel.
        pixels: (E,) camera pixels that see each group; radiance: (E, 3) their mean; bounded: (E,) most are saturated.
        direction: (E, 3) unit vector to the middle of each group; None = unrelated groups.
        sun: the group that is the sun (`iif_core.light.emission.sun`); None = none.
    """

    columns: np.ndarray
    pixels: np.ndarray
    radiance: np.ndarray
    bounded: np.ndarray
    direction: np.ndarray | None = None
    sun: int | None = None

    @property
    def size(self) -> int:
        return len(self.pixels)

    @property
    def no_sun(self) -> np.ndarray:
        """(k,) numbers of the groups that are no sun, which is not like the sky around it."""
        every = np.arange(self.size)
        return every if self.sun is None else np.delete(every, self.sun)

    @property
    def solid_angle(self) -> np.ndarray:
        """(E,) steradians of each group."""
        angle = np.broadcast_to(solid_angles(*self.columns.shape), self.columns.shape)
        return np.bincount(self.columns.ravel(), angle.ravel(), self.size)

    @property
    def is_unseen(self) -> bool:
        """No camera sees any of the groups, as for those of `SkySums.directions`."""
        return not self.pixels.any()

    @property
    def mean(self) -> np.ndarray:
        """(3,) mean over the groups that cameras see unsaturated; over all if there are none."""
        clear = (self.pixels > 0) & ~self.bounded
        share = np.where(clear, 1.0, 0.0) if clear.any() else np.ones(self.size)
        return (share[:, None] * self.radiance).sum(0) / share.sum()

    @property
    def texel_weight(self) -> np.ndarray | None:
        """(H, W) how often texels are drawn: half by solid angle, half on the sun; None = all by solid angle."""
        if self.sun is None:
            return None
        solid = solid_angles(*self.columns.shape)
        sun = np.where(self.columns == self.sun, solid, 0.0)
        return 0.5 * solid / solid.sum() + 0.5 * sun / sun.sum()


class SkySums:
    """Sums of what camera rays see that leave the mesh: `add` one view after another, then `groups`."""

    def __init__(self, height: int = HEIGHT, width: int = WIDTH):
        self.shape = (height, width)
        self._sums = np.zeros((height * width, 6))  # R G B times share, pixels, saturated, squares of the share

    def add(self, directions: np.ndarray, radiance: np.ndarray, bound: np.ndarray, share: np.ndarray | None = None) -> None:
        """Add the pixels of one view.

        Args:
            directions: (n, 3) of any length; radiance: (n, 3) finite; bound: (n, 3) bool, only a lower bound.
            share: (n,) of the light from outside that reaches the camera, None = 1. Means are sum y s / sum s^2, in which pixels
                that little light reaches count little.
        """
        texel = texels(directions, *self.shape)
        share = np.ones(len(texel)) if share is None else share
        columns = [share[:, None] * radiance, np.ones((len(texel), 1)), bound.any(1)[:, None], share[:, None] ** 2]
        values = np.concatenate(columns, 1)
        for i in range(6):
            self._sums[:, i] += np.bincount(texel, values[:, i], len(self._sums))

    @property
    def pixels(self) -> int:
        return int(self._sums[:, 3].sum())

    def mean(self) -> np.ndarray:
        """Return the mean radiance (3,) of all escaping pixels, 0 without any."""
        return self._sums[:, :3].sum(0) / max(float(self._sums[:, 5].sum()), 1e-30)

    def groups(self, min_pixels: int = MIN_PIXELS) -> Sky:
        """Divide the sphere into 42 directions, and each into what cameras see unsaturated, what they see saturated, and what
        they do not see (docs/method/light.md#groups-of-texels).

        min_pixels: that suffice for a texel to count as seen, if no other has fifty times as many.
        """
        count, saturated = self._sums[:, 3], self._sums[:, 4]
        towards, solid = middles(*self.shape), solid_angles(*self.shape).ravel()
        # Small pictures have few pixels in any texel; a texel counts that has a fiftieth of the most.
        enough = np.clip(0.02 * count.max(), 1, min_pixels)
        # Parts of a direction: 0 seen unsaturated, 1 mostly saturated, 2 hardly seen or not at all.
        seen, hidden = count >= enough, 2 * saturated > count
        part = np.where(seen, np.where(hidden, 1, 0), 2)
        # A group is a part of a direction; empty parts get no number.
        number = np.unique(3 * (towards @ _bins().T).argmax(1) + part, return_inverse=True)[1]
        size = int(number.max()) + 1
        known = np.where(seen, count, 0.0)
        pixels = np.bincount(number, known, size)
        # A texel counts by its solid angle, however many pixels look at it.
        weight = np.where(seen, solid, 0.0)
        mean = self._sums[:, :3] / np.maximum(self._sums[:, 5], 1e-30)[:, None]
        radiance = np.stack([np.bincount(number, weight * mean[:, c], size) for c in range(3)], 1)
        total = np.bincount(number, weight, size)
        average = (weight[:, None] * mean).sum(0) / weight.sum() if weight.any() else self.mean()
        radiance = np.where(total[:, None] > 0, radiance / np.maximum(total, 1e-30)[:, None], average)
        direction = np.stack([np.bincount(number, solid * towards[:, c], size) for c in range(3)], 1)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        bounded = np.bincount(number, part == 1, size) > 0
        return Sky(number.reshape(self.shape).astype(np.int32), pixels.astype(np.int64), radiance, bounded, direction)

    def directions(self) -> Sky:
        """Divide the outside of a mesh with large openings into twelve directions, all unknown
        (docs/method/light.md#open-meshes).

        A texel belongs to the nearest of the twelve vertices of an icosahedron; all start at the mean of what was seen.
        """
        number = (middles(*self.shape) @ _icosahedron().T).argmax(1).reshape(self.shape)
        size = 12
        return Sky(number.astype(np.int32), np.zeros(size, np.int64), np.tile(self.mean(), (size, 1)), np.zeros(size, bool))


def sky_prior(sky: Sky) -> EmissionPrior:
    """Return the prior of groups with directions: a field around the mean of what cameras see; what is saturated is apart."""
    initial = np.where(sky.bounded[:, None], sky.radiance, sky.mean)
    width = np.where(sky.bounded, SUN_WIDTH, OUTSIDE_SPREAD)
    apart = sky.bounded.copy()
    if sky.sun is not None:
        solid = solid_angles(*sky.columns.shape)[sky.columns == sky.sun].sum()
        apart[sky.sun], width[sky.sun] = True, sun_prior(sky.mean, solid).width[0]
    # What is saturated, and the sun, say nothing about the rest of the sky, nor the other way round.
    related = correlation(sky.direction)
    related[apart], related[:, apart] = 0.0, 0.0
    np.fill_diagonal(related, 1.0)
    return EmissionPrior(initial, width, related)


def sun_prior(mean: np.ndarray, solid_angle: float) -> EmissionPrior:
    """Return the prior of a sun of `solid_angle` under a sky of mean radiance (3,): it gives `SUN_LIGHT` times the light of the
    sky, or less."""
    # Irradiance is pi x radiance from a whole sky of one radiance, and solid angle x radiance from a sun overhead.
    return EmissionPrior(mean[None], np.array([SUN_LIGHT * np.pi / solid_angle]))


def correlation(direction: np.ndarray, reach: float = REACH) -> np.ndarray:
    """Return the correlation (n, n) of the light from unit vectors (n, 3), LIKENESS exp(-angle / reach) off the diagonal
    (Eq. L.9): positive definite, also where the seen and the unseen part of a direction have the same middle."""
    related = LIKENESS * np.exp(-np.arccos(np.clip(direction @ direction.T, -1.0, 1.0)) / reach)
    np.fill_diagonal(related, 1.0)
    return related


def middles(height: int, width: int) -> np.ndarray:
    """Unit vectors (H W, 3) to the middles of all texels."""
    return np.stack(direction_in(NUMPY, *np.indices((height, width)), 0.5, 0.5, height, width), -1).reshape(-1, 3)


def _icosahedron() -> np.ndarray:
    golden = (1 + 5**0.5) / 2
    corners = np.array([np.roll([0.0, a, b * golden], i) for i in range(3) for a in (-1, 1) for b in (-1, 1)])
    return corners / np.linalg.norm(corners, axis=1, keepdims=True)


def _bins() -> np.ndarray:
    """Unit vectors (42, 3): the corners of an icosahedron and the middles of its edges."""
    corners = _icosahedron()
    first, second = np.triu_indices(len(corners), 1)
    near = (corners[first] * corners[second]).sum(1) > 0.4  # neighbours enclose 63 degrees, others 117 or 180
    edges = corners[first[near]] + corners[second[near]]
    return np.concatenate([corners, edges / np.linalg.norm(edges, axis=1, keepdims=True)])


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
