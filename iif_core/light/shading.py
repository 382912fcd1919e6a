"""The light that arrives at surface cells and at pixels, integrated over the lobes (docs/method/shading.md).

`world` is a scene on the device with its emitters, whose paths end in its radiance cache if it has one.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from iif_core.camera.pixels import ViewPixels
from iif_core.light.base_scene import BaseScene
from iif_core.light.options import SEEDS, ShadingOptions
from iif_core.reflectance.directional_albedo import uniform_lobes
from iif_core.surface.shading_cells import DiffuseShading, ShadingCellBuilder, ShadingCells, combine_estimates, diffuse_of_cells

if TYPE_CHECKING:
    from iif_core.light.transport.cache import RadianceCache
    from iif_core.light.transport.geometry import Geometry
    from iif_core.light.transport.scene import Scene

LEAST_CELLS = 20  # of an object whose predictions speak for or against specular lobes
COVERAGE_RAYS = 8192  # by which the share of surface that the radiance cache knows is measured


@dataclass(frozen=True)
class PixelLight:
    """Light at the pixels of a view, in two independent halves.

    Attributes:
        diffuse: (2, n, 3) of all pixels.
        own: (k,) places of the pixels that have specular light; s0, s1: (2, k, J, 3) of these.
        traced: number of pixels that paths were traced for.
    """

    diffuse: np.ndarray
    own: np.ndarray
    s0: np.ndarray
    s1: np.ndarray
    traced: int


def roughness_levels(count: int) -> np.ndarray:
    """Return (count,) float64 roughness levels from 0.02 to 1, closer together at the glossy end (Eq. S.4).

    >>> roughness_levels(3).round(3)
    array([0.02 , 0.366, 1.   ])
    """
    return 0.02 + 0.98 * (np.arange(count) / (count - 1)) ** 1.5


def cells_of_views(
    views: Iterable[tuple[int, ViewPixels]], edge: float, origin: np.ndarray, options: ShadingOptions
) -> ShadingCells:
    """Collect the cells of edge `edge` (m) on a grid from `origin` (3,) that the pixels of views show; each view with its id."""
    builder = ShadingCellBuilder(edge, origin)
    for view_id, pixels in views:
        builder.add(pixels.points, pixels.normals, pixels.object_id, options.of_view(view_id))
    return builder.finish()


def photographed_share(geometry: Geometry, cache: RadianceCache, uncached: np.ndarray, cells: ShadingCells, seed: int) -> float:
    """Measure how much of the surface that rays from visible surface meet the radiance cache knows, where it should (Eq. S.14).

    Args:
        geometry: of the scene.
        cache: photographed radiance.
        uncached: (m,) bool, faces that shine or let light through.
        cells: visible surface.
        seed: of the scene.
    """
    from iif_core.light.transport.geometry import cosine_directions, trace

    rng = np.random.default_rng([seed, SEEDS])
    share = cells.pixels / cells.pixels.sum()
    cell = rng.choice(len(cells), COVERAGE_RAYS, p=share)
    normal = cells.normals[cell, 0]
    origin, way = cells.points[cell, 0] + 1e-3 * normal, cosine_directions(normal, rng)
    face, t = trace(geometry, origin, way)
    hit = (face >= 0) & ~uncached[np.maximum(face, 0)]
    covered = cache.covers((origin + t[:, None] * way)[hit]) if hit.any() else np.zeros(0, bool)
    return float(covered.mean()) if covered.size else 0.0


def glossiest(scene: BaseScene, metallic: float) -> tuple[float, bool]:
    """Return the lowest 5 % quantile of roughness of an object, and whether an object's median metalness is above `metallic`; of
    objects with at least `LEAST_CELLS` cells. Without any, 0 and True."""
    order = np.argsort(scene.cell_object, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(scene.cell_object[order])) + 1)
    groups = [group for group in groups if len(group) >= LEAST_CELLS]
    lowest = min((float(np.quantile(scene.cell_values[group, 3], 0.05)) for group in groups), default=0.0)
    return lowest, max((float(np.median(scene.cell_values[group, 4])) for group in groups), default=1.0) > metallic


def diffuse_light(world: Scene, cells: ShadingCells, options: ShadingOptions) -> DiffuseShading:
    """Trace the diffuse integrals of all cells, twice."""
    from iif_core.light.transport.scene import PathOptions
    from iif_core.light.transport.shading import shading_caches

    def trace(points: np.ndarray, normals: np.ndarray, paths: int, seed: int, number: np.ndarray) -> np.ndarray:
        # Seen head-on: without specular levels the direction of the viewer does not matter.
        return shading_caches(world, points, normals, normals, [], PathOptions(paths, options.max_bounces, seed), number)[0]

    seed = options.of_view(0xFFFFFFFF)
    return diffuse_of_cells(cells, trace, options.samples, options.noise, options.max_samples, seed)


def light_of_pixels(
    world: Scene | None,
    view_id: int,
    pixels: ViewPixels,
    own: np.ndarray,
    levels: np.ndarray,
    cells: ShadingCells,
    diffuse: DiffuseShading,
    options: ShadingOptions,
) -> PixelLight:
    """Compute the light at the pixels of a view.

    Diffuse light is the light of the cells, averaged with what the pixels' own paths find (Eq. S.19).

    Args:
        world: None = the scene has no specular lobes: those of uniform light take their place (Eq. S.22), and nothing is traced.
        view_id: of the view.
        pixels: all pixels of the view.
        own: (k,) places of those whose specular light is read.
        levels: (J,) roughness.
        cells, diffuse: cells and their diffuse light.
        options: how much is traced.
    """
    light = diffuse.diffuse[:, cells.find(pixels.points, pixels.normals, pixels.object_id)].astype(np.float32)
    chosen = pixels.take(own)
    if world is None:
        return PixelLight(light, own, *uniform_lobes(light[:, own], (chosen.normals * chosen.wo).sum(1), levels), 0)
    traced, s0, s1 = _traced(world, chosen, levels, options, options.of_view(view_id))
    light[:, own] = combine_estimates(light[:, own], diffuse.noise_last, traced)
    return PixelLight(light, own, s0, s1, len(own))


def _traced(world: Scene, pixels: ViewPixels, levels: np.ndarray, options: ShadingOptions, seed: int) -> tuple[np.ndarray, ...]:
    """Diffuse (2, n, 3) and specular (2, n, J, 3) twice of pixels, in two independent halves."""
    from iif_core.light.transport.scene import PathOptions
    from iif_core.light.transport.shading import shading_caches

    surface = (pixels.points, pixels.normals, pixels.wo)
    paths = [PathOptions(max(1, options.samples // 2), options.max_bounces, seed * 2 + half) for half in range(2)]
    halves = [shading_caches(world, *surface, levels, half) for half in paths]
    return tuple(np.stack(part) for part in zip(*halves, strict=True))
