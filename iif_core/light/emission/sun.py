"""A sun that cameras do not see, or see saturated: a small disc of light, found by the surface that it falls on
(docs/method/light.md#the-sun)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from iif_core.light.emission.direct import EmissionPrior
from iif_core.light.emission.environment import Sky, middles, sun_prior
from iif_core.light.emission.gains import BaseAlbedo, ObjectGains
from iif_core.light.emission.problem import EmissionProblem
from iif_core.light.emission.search import QUICK, STEP, decrease, lit_problem

FINER = 4
"""How many times finer the map of a scene with a sun is."""
NEAR = 2.25
"""Distance, in texels, from the texel that explains the photographs best, up to which the disc may reach; its middle is at most
1 texel away."""
RADII = (0.0, 1.0, 1.5, 2.0, 3.0)
"""Radii of discs in texels of the finer map; 0 = a single texel."""
NARROW = 1.0
"""Radius up to which a disc is narrow, in the same unit."""
SHARP = 0.75
"""Share of what the best disc takes off the misfit that a narrow one must: a sun casts sharp shadows, a bright part of the sky
does not."""
AS_GOOD = 0.95
"""Share of it from which the smallest disc is taken."""


class Disc(NamedTuple):
    """A disc on a map: unit vector (3,) to its middle, radius in radians, and (k,) int texels, flattened."""

    direction: np.ndarray
    radius: float
    texels: np.ndarray


def sun_texels(sky: Sky) -> np.ndarray:
    """Return (K,) int: flattened texels in which the sun may be, those that no camera sees unsaturated."""
    clear = (sky.pixels > 0) & ~sky.bounded
    return np.flatnonzero(~clear[sky.columns.ravel()])


def around(sky: Sky, texel: int) -> np.ndarray:
    """Return (M,) int: texels of the finer map up to `NEAR` texels from `texel` of the sky's map, in which the sun may be."""
    height, width = sky.columns.shape
    free = np.isin(np.arange(height * width), sun_texels(sky)).reshape(height, width).repeat(FINER, 0).repeat(FINER, 1)
    middle = middles(height, width)[texel]
    near = middles(FINER * height, FINER * width) @ middle >= np.cos(NEAR * np.pi / height)
    return np.flatnonzero(near & free.ravel())


def discs(sky: Sky, texel: int, texels: np.ndarray) -> list[Disc]:
    """Return discs of texels out of `texels` (M,) of the finer map: `RADII` around middles that are at most one texel of the
    sky's map from `texel`, one middle after another. Near the poles, where texels are narrow, middles are at least half a texel
    apart.

    Their members are positions in `texels`.
    """
    height, width = sky.columns.shape
    fine, near = middles(FINER * height, FINER * width)[texels], np.pi / height
    found, apart = [], np.ones(len(texels), bool)
    for i in np.flatnonzero(fine @ middles(height, width)[texel] >= np.cos(near)):
        if not apart[i]:
            continue
        cosine = fine @ fine[i]
        # Further middles are at least half a fine texel from this one.
        apart &= cosine < np.cos(0.5 * near / FINER)
        for radius in RADII:
            angle = radius * near / FINER
            # The margin takes in texels at the radius itself, whatever rounding says.
            own = np.flatnonzero(cosine >= np.cos(angle) - 1e-9) if radius else np.array([i])
            found.append(Disc(fine[i], angle, own))
    return found


def direct_light(albedo: np.ndarray, cosine: np.ndarray, escapes: np.ndarray, solid_angle: np.ndarray) -> np.ndarray:
    """Return what diffuse surface reflects of a texel of radiance 1, albedo / pi x cosine x solid angle where rays escape.

    albedo (n, 3); cosine (n, T) to the ray into each of T texels, negative below the horizon; escapes (n, T) bool; solid_angle
    (T,). The result is (n, T, 3) float32.
    """
    light = np.where(escapes, np.maximum(cosine, 0.0), 0.0) * (solid_angle / np.pi)
    return (albedo[:, None] * light[:, :, None]).astype(np.float32)


def with_sun(sky: Sky, disc: Disc) -> Sky:
    """Return the sky on the finer map with the sun as its last group; `disc` has texels of that map."""
    columns = sky.columns.repeat(FINER, 0).repeat(FINER, 1)
    columns.ravel()[disc.texels] = sky.size
    mean = sky.mean
    return replace(
        sky,
        columns=columns,
        pixels=np.append(sky.pixels, 0),
        radiance=np.concatenate([sky.radiance, mean[None]]),
        bounded=np.append(sky.bounded, False),
        direction=np.concatenate([sky.direction, disc.direction[None]]),
        sun=sky.size,
    )


def with_columns(sky: Sky, count: int) -> Sky:
    """Return the sky followed by `count` groups that no camera sees, to be asked whether they are the sun; its map stays."""
    return replace(
        sky,
        pixels=np.append(sky.pixels, np.zeros(count, np.int64)),
        radiance=np.concatenate([sky.radiance, np.tile(sky.mean, (count, 1))]),
        bounded=np.append(sky.bounded, np.zeros(count, bool)),
        direction=None,
    )


class Look(NamedTuple):
    """Light that was solved for: its misfit (Eq. L.40), radiance (G, 3), and the gains of objects under it."""

    misfit: float
    radiance: np.ndarray
    gains: ObjectGains


@dataclass(frozen=True)
class SunQuestion:
    """Is one of the last groups of a problem the sun?

    Attributes:
        problem: rows of all G groups, of which the last T may be the sun (the others are the rest of the light).
        prior: of the groups that are not the sun; solid_angle: (T,) of the others.
        mean: (3,) radiance of the sky, the scale of the sun's prior.
        albedo: of the base, if known; n_objects.
    """

    problem: EmissionProblem
    prior: EmissionPrior
    solid_angle: np.ndarray
    mean: np.ndarray
    albedo: BaseAlbedo | None
    n_objects: int

    def look(self, sun: np.ndarray | None = None) -> Look:
        """Solve with the groups `sun`, positions among the last T, as a sun of one radiance; None = without a sun."""
        prior = self.prior
        if sun is not None:
            prior = prior.beside(sun_prior(self.mean, self.solid_angle[sun].sum()))
        rows, gains = self._of(sun).solve_object_gains(prior, self.albedo, self.n_objects, QUICK)
        radiance = prior.radiance(rows.rows, QUICK.rounds)
        return Look(rows.misfit(radiance), radiance, gains)

    def misfit(self, look: Look, sun: np.ndarray | None = None) -> float:
        """Return the misfit of light and gains that were found on other rows."""
        return self._of(sun).with_gains(look.gains).misfit(look.radiance)

    def _of(self, sun: np.ndarray | None) -> EmissionProblem:
        """The problem of the other groups, and of those of a sun as one."""
        # Columns of the last T groups are summed over the texels of one sun, which have one radiance.
        matrix = self.problem.rows.matrix
        some = matrix[:, :, :, : len(self.prior.initial)]
        if sun is not None:
            some = np.concatenate([some, self._together(matrix, sun)[:, :, :, None]], 3)
        return replace(self.problem, rows=replace(self.problem.rows, matrix=some))

    def decrease(self, suns: list[np.ndarray], look: Look) -> np.ndarray:
        """Return by how much the light of each of some suns, positions among the last T, would lower the misfit, to first order
        (Eq. L.41), under the gains and the other light of `look`."""
        size = len(self.prior.initial)
        light = np.zeros((self.problem.rows.groups, 3))
        light[:size] = look.radiance[:size]
        lit = lit_problem(self.problem.with_gains(look.gains), light)
        matrices = lit.rows.matrices
        return np.array([decrease(lit, self._together(matrices, own)) for own in suns])

    def _together(self, matrix: np.ndarray, sun: np.ndarray) -> np.ndarray:
        """Sum of columns (..., G, 3) of the sun: (..., 3)."""
        return matrix[..., len(self.prior.initial) + sun, :].sum(-2)


class SunSize(NamedTuple):
    """Which disc of several is the sun, and the share of what the best one explains that a narrow one does."""

    number: int
    narrow: float

    @property
    def is_sharp(self) -> bool:
        """It may be a sun."""
        return self.narrow >= SHARP


def size_of_sun(decreases: np.ndarray) -> SunSize:
    """Choose the smallest disc that explains the photographs nearly as well as the best one.

    decreases: of the misfit by each of the discs of `RADII` around one direction, >= 0.
    """
    share = decreases / max(float(decreases.max()), 1e-300)
    return SunSize(int(np.argmax(share >= AS_GOOD)), float(share[np.asarray(RADII) <= NARROW].max()))


def is_needed(without: float, with_it: float) -> bool:
    """The misfit falls by more than `STEP`; one below zero, which noise of the traces can make, cannot fall."""
    return without > 0 and with_it < (1.0 - STEP) * without


@dataclass(frozen=True)
class SunEvidence:
    """What speaks for a sun that no camera sees.

    Attributes:
        disc: that explains the photographs best; None = no single direction helps.
        without, with_it: misfit of the light (Eq. L.40) without a sun and with the disc; of held-out views, if the disc is sharp.
        narrow: share of what the best disc takes off the misfit that a narrow one does.
    """

    disc: Disc | None
    without: float
    with_it: float
    narrow: float = 0.0

    @property
    def is_sun(self) -> bool:
        """The photographs are explained clearly better, and by a narrow disc."""
        return self.disc is not None and is_needed(self.without, self.with_it) and self.narrow >= SHARP
