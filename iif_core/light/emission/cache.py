"""The radiance cache: mean outgoing radiance per voxel of everything that does not shine
(docs/method/light.md#radiance-cache)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iif_core.surface.cells import pack_keys, unpack_keys, voxel_indices


@dataclass(frozen=True)
class RadianceVoxels:
    """A sparse voxel radiance cache.

    Attributes:
        edge: m; origin: (3,) corner of voxel (0, 0, 0).
        ijk: (n, 3) int32, in order of key; a voxel that is not listed is unknown, not black
            (docs/method/numerics.md#empty-voxels-of-the-radiance-cache).
        radiance: (n, 3) float32 mean of the unsaturated observations; where there are none the largest saturated one, a lower
            bound (Eq. L.6).
        samples: (n,) int32 observations behind `radiance`.
        censored: (n,) bool, `radiance` is a lower bound.
    """

    edge: float
    origin: np.ndarray
    ijk: np.ndarray
    radiance: np.ndarray
    samples: np.ndarray
    censored: np.ndarray

    def raised(self, points: np.ndarray, radiance: np.ndarray) -> RadianceVoxels:
        """Return the cache with its lower bounds raised to what the light that was found lets the surface show (Eq. L.42).

        radiance (n, 3): of surface at `points` (n, 3), m; points outside voxels that hold bounds are left out.
        """
        own = np.flatnonzero(self.censored)
        # Voxels are in order of key, so those that hold bounds are too and can be searched.
        keys = pack_keys(self.ijk[own])
        found = pack_keys(voxel_indices(points, self.edge, self.origin))
        at = np.minimum(np.searchsorted(keys, found), max(len(keys) - 1, 0))
        hit = keys[at] == found if len(keys) else np.zeros(len(found), bool)
        # Mean over the points in a voxel, and no bound is ever lowered.
        count = np.bincount(at[hit], minlength=len(own))
        total = np.stack([np.bincount(at[hit], radiance[hit, c], len(own)) for c in range(3)], 1)
        values = self.radiance.copy()
        values[own] = np.maximum(values[own], total / np.maximum(count, 1)[:, None])
        return replace(self, radiance=values)


@dataclass(frozen=True)
class VoxelPixels:
    """Pixels with the voxels that they lie in, from which the cache of some of them is made at once.

    Attributes:
        edge, origin: as in `RadianceVoxels`.
        keys: (V,) uint64 voxels that some pixel lies in, in order.
        voxel: (n,) int32 row of `keys`; radiance: (n, 3) linear; censored: (n,) bool, `radiance` is a lower bound.
    """

    edge: float
    origin: np.ndarray
    keys: np.ndarray
    voxel: np.ndarray
    radiance: np.ndarray
    censored: np.ndarray

    @classmethod
    def of(cls, edge: float, origin: np.ndarray, points: np.ndarray, radiance: np.ndarray, censored: np.ndarray) -> VoxelPixels:
        """Find the voxels of pixels at `points` (n, 3), m. Radiance has to be finite.

        Raises:
            InputError: edge not positive, or a point outside the 65536 voxels an axis from the origin.
        """
        keys, voxel = np.unique(pack_keys(voxel_indices(points, edge, origin)), return_inverse=True)
        return cls(float(edge), np.asarray(origin, np.float32), keys, voxel.astype(np.int32), radiance, censored)

    def cache(self, use: np.ndarray) -> RadianceVoxels:
        """Return the cache of the pixels `use`, (n,) bool. Those of one voxel are added in their order."""
        size = len(self.keys)
        plain, clipped = np.flatnonzero(use & ~self.censored), np.flatnonzero(use & self.censored)
        voxel = self.voxel[plain]
        count, bounds = np.bincount(voxel, minlength=size), np.bincount(self.voxel[clipped], minlength=size)
        sums = np.stack([np.bincount(voxel, self.radiance[plain, c], size) for c in range(3)], 1)
        largest = np.zeros((size, 3))
        np.maximum.at(largest, self.voxel[clipped], self.radiance[clipped])
        own = np.flatnonzero(count + bounds)
        bound = count[own] == 0
        mean = sums[own] / np.maximum(count[own], 1)[:, None]
        radiance = np.where(bound[:, None], largest[own], mean).astype(np.float32)
        samples = np.where(bound, bounds[own], count[own]).astype(np.int32)
        return RadianceVoxels(self.edge, self.origin, unpack_keys(self.keys[own])[0], radiance, samples, bound)
