"""The search for a sun that no camera sees: rays towards every direction in which it may stand (docs/method/light.md#the-sun)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from iif_core.camera.pixels import ViewPixels
from iif_core.light.emission.cache import RadianceVoxels
from iif_core.light.emission.emitters import base_albedo, believed_metallic, comparison_tile, light_prior, trace_rows
from iif_core.light.emission.environment import Sky
from iif_core.light.emission.groups import EmitterGroups
from iif_core.light.emission.photographs import SEEDS, Photographs, choose_rows, radiance_cache
from iif_core.light.emission.pixels import TILE_PIXELS, EmissionPixels
from iif_core.light.emission.problem import assemble
from iif_core.light.emission.rows import TracedTransport
from iif_core.light.emission.sun import (
    FINER,
    RADII,
    Disc,
    SunEvidence,
    SunQuestion,
    around,
    direct_light,
    discs,
    is_needed,
    size_of_sun,
    sun_texels,
    with_columns,
    with_sun,
)
from iif_core.light.environment import direction_in, solid_angles
from iif_core.numerics.xp import NUMPY

ROWS = 8_000
"""Pixels from which the place and the size of the sun are found."""
FIRST_ROWS = 5_000
"""Pixels from which the texel of the sun is found."""


def find_sun(photos: Photographs, sky: Sky, threshold: float) -> tuple[Sky, SunEvidence | None]:
    """Return the sky with a sun, if the photographs are explained clearly better by one, and what speaks for it; None = cameras
    see light from outside in all directions, unsaturated.

    threshold: radiance from which surface is a candidate for an emitter. Here all surface reflects.
    """
    texels = sun_texels(sky)
    if not len(texels):
        return sky, None
    height, width = sky.columns.shape
    cache = radiance_cache(photos, EmitterGroups.none(len(photos.scene.faces)))
    coarse = _Rows.traced(photos, sky, cache, threshold, comparison_tile(photos), FIRST_ROWS)
    question = coarse.question(texels, (height, width))
    none = question.look()
    promising = question.decrease([np.array([i]) for i in range(len(texels))], none).argmax()
    found = question.look(np.array([promising]))
    if not is_needed(none.misfit, found.misfit):
        return sky, SunEvidence(None, none.misfit, found.misfit)
    texel = int(texels[promising])
    photos.log.say(f"is there a sun? misfit {found.misfit:.4f} instead of {none.misfit:.4f}")
    # Which disc it is shows at the borders of what it lights: small tiles.
    fine = _Rows.traced(photos, sky, cache, threshold, TILE_PIXELS, ROWS)
    near = around(sky, texel)
    question = fine.question(near, (FINER * height, FINER * width))
    shapes = discs(sky, texel, near)
    lit = question.look(np.flatnonzero(np.isin(near, _members(texel, height, width))))
    decrease = question.decrease([shape.texels for shape in shapes], lit).reshape(-1, len(RADII))
    best = int(decrease.max(1).argmax())
    size = size_of_sun(decrease[best])
    disc = shapes[best * len(RADII) + size.number]
    disc = disc._replace(texels=near[disc.texels])
    if not size.is_sharp:
        return sky, SunEvidence(disc, none.misfit, found.misfit, size.narrow)
    evidence = SunEvidence(disc, *fine.held_out(disc), size.narrow)
    return (with_sun(sky, disc) if evidence.is_sun else sky), evidence


def _members(texel: int, height: int, width: int) -> np.ndarray:
    """Texels of the finer map inside one texel of the map."""
    row, column = np.divmod(np.arange(FINER**2), FINER)
    return (FINER * (texel // width) + row) * FINER * width + FINER * (texel % width) + column


@dataclass(frozen=True)
class _Rows:
    """Pixels of surface that only reflects, and how the sky lights them."""

    photos: Photographs
    sky: Sky
    pixels: ViewPixels
    shown: EmissionPixels
    transport: TracedTransport

    @classmethod
    def traced(cls, photos: Photographs, sky: Sky, cache: RadianceVoxels, threshold: float, tile_edge: int, rows: int) -> _Rows:
        """Trace `rows` pixels, to be averaged in tiles; the cache covers all surface."""
        none = EmitterGroups.none(len(photos.scene.faces))
        thin = -(-photos.options.rows // rows)
        pixels, shown = choose_rows(photos, none, threshold, thin, tile_edge)
        transport = trace_rows(photos, pixels, none, cache, sky, 4)
        return cls(photos, sky, pixels, shown, transport.without_lobes())

    def take(self, keep: np.ndarray) -> _Rows:
        """Some of the pixels."""
        return replace(self, pixels=self.pixels.take(keep), shown=self.shown.take(keep), transport=self.transport.take(keep))

    def held_out(self, disc: Disc) -> tuple[float, float]:
        """Misfit without a sun and with it: every second view under the light and the gains that the others have, and the other
        way round. Of a single view nothing is held out, and its misfit says that there is no sun."""
        view, sun = self.shown.view, np.arange(len(disc.texels))
        first = np.isin(view, np.unique(view)[::2])
        shape = (FINER * self.sky.columns.shape[0], FINER * self.sky.columns.shape[1])
        halves = [self.take(np.flatnonzero(half)).question(disc.texels, shape) for half in (first, ~first)]
        pairs = [halves, halves[::-1]]
        without, with_it = ([told.misfit(asked.look(own), own) for asked, told in pairs] for own in (None, sun))
        return float(np.mean(without)), float(np.mean(with_it))

    def question(self, texels: np.ndarray, shape: tuple[int, int]) -> SunQuestion:
        """Ask which of some texels of a map of `shape` are the sun."""
        light = self._direct(texels, shape)
        count, matrix = self.sky.size, self.transport.matrix
        every = np.zeros((*matrix.shape[:3], count + len(texels), 3), np.float32)
        every[:, :, :, :count] = matrix
        every[:, 0, :, count:] = light
        transport = TracedTransport(every, self.transport.cached)
        sky = with_columns(self.sky, len(texels))
        problem = assemble(self.shown, transport, sky.size, None, sky)
        none = EmitterGroups.none(len(self.photos.scene.faces))
        prior = light_prior(self.photos, none, self.shown, self.sky)[1]
        solid = solid_angles(*shape).ravel()[texels]
        return SunQuestion(problem, prior, solid, self.sky.mean, base_albedo(self.photos, self.sky), self.photos.scene.n_objects)

    def _direct(self, texels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """(2, n, T, 3) what the points reflect of each texel directly, twice with one ray into each."""
        pixels, base = self.pixels, self.pixels.base
        normal = pixels.normals.astype(np.float64)
        start, count = pixels.points + 1e-3 * normal, len(normal)
        albedo = base[:, :3] * (1.0 - believed_metallic(base))[:, None]
        solid, rng = solid_angles(*shape).ravel()[texels], np.random.default_rng([self.photos.options.seed, SEEDS, 4])
        out = np.zeros((2, count, len(texels), 3), np.float32)
        for half in range(2):
            for i, texel in enumerate(texels):
                row, column = np.divmod(float(texel), shape[1])
                way = np.stack(direction_in(NUMPY, row, column, rng.random(count), rng.random(count), *shape), -1)
                cosine, escapes = (way * normal).sum(1), np.zeros(count, bool)
                up = np.flatnonzero(cosine > 0)
                if len(up):
                    escapes[up] = self.photos.tracer.meets(start[up], way[up])[0] < 0
                out[half, :, i] = direct_light(albedo, cosine[:, None], escapes[:, None], solid[i : i + 1])[:, 0]
            self.photos.log.progress(half + 1, 2, "halves of the rays towards the sun traced")
        return out
