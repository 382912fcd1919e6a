"""shading: the light that arrives at every pixel, integrated over the diffuse lobe and the split specular lobes
(docs/method/shading.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from iif_core.errors import InputError
from iif_core.reflectance.directional_albedo import uniform_lobes
from iif_core.reflectance.material import MATTE_ROUGHNESS
from iif_core.surface.cells import grid_origin
from iif_core.surface.shading_cells import DiffuseShading, ShadingCellBuilder, ShadingCells, combine_estimates, diffuse_of_cells
from workflow.artifacts.store import split_rgb
from workflow.decisions import light as decisions
from workflow.decisions import numerics
from workflow.decisions.materials import METALLIC_PRIOR
from workflow.decisions.plan import included, matte_by_predictions
from workflow.decisions.record import PROVISIONAL, Decision
from workflow.fitting.fit_pixels import FitPixels, count_eligible
from workflow.runtime.job import Job
from workflow.scene.base_scene import (
    BaseScene,
    ViewPixels,
    read_lit_scene,
    read_object_gains,
    read_radiance_cache,
    view_pixels,
)
from workflow.scene.cached_light import UNITS, SpecularLight, table_of
from workflow.scene.normal_form import CaptureReader, View

if TYPE_CHECKING:
    from iif_core.light.transport.cache import RadianceCache
    from iif_core.light.transport.geometry import Geometry
    from iif_core.light.transport.scene import Scene

_SEEDS = 0x736861  # keeps the random streams of this stage apart from those of others
LEAST_CELLS = 20  # of an object whose predictions speak for or against specular lobes
COVERAGE_RAYS = 8192  # by which the share of surface that the radiance cache knows is measured


def roughness_levels(count: int) -> np.ndarray:
    """Return (count,) float64 roughness levels from 0.02 to 1, closer together at the glossy end (Eq. S.4).

    >>> roughness_levels(3).round(3)
    array([0.02 , 0.366, 1.   ])
    """
    return 0.02 + 0.98 * (np.arange(count) / (count - 1)) ** 1.5


def run(job: Job) -> None:
    """Write maps/<view>.exr with the diffuse integral of every pixel (0 where nothing was hit), pixels/<view>.parquet with the
    specular integrals of the pixels that are read, both in two independent halves, levels.parquet and shading.json.

    In a scene without specular lobes nothing is traced for the pixels: their lobes are those of uniform light (Eq. S.22)."""
    from iif_core.light.transport.scene import Scene

    capture, (scene, light) = CaptureReader(job.read("capture")), read_lit_scene(job)
    levels = roughness_levels(job.settings.shading.levels)
    mixed = light.emits | scene.is_sheer
    cells, counts = _cells(job, capture, scene, mixed)
    pixels = job.settings.shading.pixels
    drawn = None if pixels == "all" else FitPixels.evenly(counts, int(pixels), mixed, job.seed)
    # Surface outside all photographs is given the object gains that stage emission found.
    geometry, material = scene.with_gains(read_object_gains(job, scene.n_objects)).traceable(light.emits)
    cache = read_radiance_cache(job)
    decision, specular = _indirect(job, geometry, cache, mixed, cells), _specular(job, scene)
    job.log.info("specular lobes: %s (%s)", "traced" if specular["included"] else "none", specular["reason"])
    world = Scene(geometry, material, light.emitters(geometry), cache if decision["included"] else None)
    with job.timed("diffuse"):
        diffuse = _diffuse(job, world, cells)
    with job.timed("specular"):
        lit = world if specular["included"] else None
        traced = _views(job, capture, scene, lit, levels, cells, diffuse, drawn)
    job.writer.table("levels.parquet", {"level": np.arange(len(levels), dtype=np.int32), "roughness": levels})
    facts = {"diffuse": _facts(cells, diffuse), "specular": {"pixels": traced}, "plan": [specular, decision]}
    job.writer.json("shading.json", {**facts, "numerics": numerics.of_shading(diffuse, job.settings.shading.noise)})


def _cells(job: Job, capture: CaptureReader, scene: BaseScene, mixed: np.ndarray) -> tuple[ShadingCells, np.ndarray]:
    """Cells of all views; and how many pixels of each object may enter the fit, (O,)."""
    edge = job.settings.shading.cell_edge
    builder = ShadingCellBuilder(edge, grid_origin(scene.vertices[scene.faces.ravel()], edge))
    counts = np.zeros(max(scene.n_objects, 1), np.int64)
    for view in capture.views:
        pixels = view_pixels(job, capture, scene, view)
        builder.add(pixels.points, pixels.normals, pixels.object_id, _seed(job, view.view_id))
        if view.split != "test":
            counts += count_eligible(pixels, mixed, scene.n_objects)
    return builder.finish(), counts


def _indirect(
    job: Job, geometry: Geometry, cache: RadianceCache, uncached: np.ndarray, cells: ShadingCells
) -> decisions.Decision:
    """Decide whether paths end in the radiance cache, by the share of visible surface that it contains (Eq. S.14), where it
    should: `uncached` (m,) are faces that shine or let light through."""
    from iif_core.light.transport.geometry import cosine_directions, trace

    rng = np.random.default_rng([job.seed, _SEEDS])
    share = cells.pixels / cells.pixels.sum()
    cell = rng.choice(len(cells), COVERAGE_RAYS, p=share)
    normal = cells.normals[cell, 0]
    origin, way = cells.points[cell, 0] + 1e-3 * normal, cosine_directions(normal, rng)
    face, t = trace(geometry, origin, way)
    hit = (face >= 0) & ~uncached[np.maximum(face, 0)]
    covered = cache.covers((origin + t[:, None] * way)[hit]) if hit.any() else np.zeros(0, bool)
    censored = job.read("emission").table("radiance_cache.parquet")["censored"].astype(bool)
    return decisions.radiance_cache(
        job.settings.shading.indirect,
        float(covered.mean()) if covered.size else 0.0,
        float(censored.mean()) if censored.size else 0.0,
    )


def _specular(job: Job, scene: BaseScene) -> Decision:
    """Settle whether the scene needs specular lobes; where the photographs alone did not tell, by the fused predictions."""
    planned = included(job.read("plan").json("plan.json")["plan"], "specular")
    lowest, metal = 1.0, False
    if planned["status"] == PROVISIONAL:
        order = np.argsort(scene.cell_object, kind="stable")
        groups = np.split(order, np.flatnonzero(np.diff(scene.cell_object[order])) + 1)
        groups = [group for group in groups if len(group) >= LEAST_CELLS]
        lowest = min((float(np.quantile(scene.cell_values[group, 3], 0.05)) for group in groups), default=0.0)
        metal = max((float(np.median(scene.cell_values[group, 4])) for group in groups), default=1.0) > METALLIC_PRIOR
    return matte_by_predictions(planned, lowest, metal, MATTE_ROUGHNESS)


def _diffuse(job: Job, world: Scene, cells: ShadingCells) -> DiffuseShading:
    """Diffuse integrals of all cells, twice."""
    from iif_core.light.transport.scene import PathOptions
    from iif_core.light.transport.shading import shading_caches

    settings = job.settings.shading

    def trace(points: np.ndarray, normals: np.ndarray, paths: int, seed: int, number: np.ndarray) -> np.ndarray:
        # Seen head-on: without specular levels the direction of the viewer does not matter.
        return shading_caches(world, points, normals, normals, [], PathOptions(paths, settings.max_bounces, seed), number)[0]

    found = diffuse_of_cells(
        cells, trace, settings.samples, settings.noise, settings.max_samples, (job.seed << 32 | _SEEDS) << 32 | 0xFFFFFFFF
    )
    job.log.info(
        "diffuse light of %d cells: %.0f paths each; noise %.1f %% after the first paths, %.1f %% at the end"
        " (%d objects above %.1f %%)",
        len(cells),
        found.samples.mean(),
        100 * found.noise_first,
        100 * found.noise_last,
        found.noisy_objects,
        100 * settings.noise,
    )
    return found


def _views(
    job: Job,
    capture: CaptureReader,
    scene: BaseScene,
    world: Scene | None,
    levels: np.ndarray,
    cells: ShadingCells,
    diffuse: DiffuseShading,
    drawn: FitPixels | None,
) -> int:
    """Write the specular light of the pixels that are `drawn` (None = all), and the diffuse light of the cells. The latter is
    averaged with the diffuse light that the pixels' own paths find (Eq. S.19). Nothing is traced for held-out views, and nothing
    at all without a `world`. Returns the number of pixels that were traced."""
    count = 0
    for done, view in enumerate(capture.views):
        job.progress(done, len(capture.views), "views cached")
        pixels = view_pixels(job, capture, scene, view)
        light = diffuse.diffuse[:, cells.find(pixels.points, pixels.normals, pixels.object_id)].astype(np.float32)
        own = np.arange(len(pixels.index)) if drawn is None else drawn.of(pixels, view)
        own = own[:0] if view.split == "test" else own
        if world is None:
            chosen = pixels.take(own)
            s0, s1 = uniform_lobes(light[:, own], (chosen.normals * chosen.wo).sum(1), levels)
        else:
            traced, s0, s1 = _traced(job, world, levels, view, pixels.take(own))
            light[:, own] = combine_estimates(light[:, own], diffuse.noise_last, traced)
            count += len(own)
        if not all(np.isfinite(part).all() for part in (light, s0, s1)):
            raise InputError(f"view {view.name}: cached shading is not finite; please report it with the scene")
        channels: dict[str, np.ndarray] = {}
        for half in range(2):
            channels |= _channels(f"half{half}.diffuse", light[half], pixels.index, view.height, view.width)
        job.writer.exr(f"maps/{view.name}.exr", channels, "relative")
        job.writer.table(table_of(view), SpecularLight(pixels.index[own], s0, s1).columns(), UNITS)
    job.progress(len(capture.views), len(capture.views), "views cached")
    return count


def _traced(job: Job, world: Scene, levels: np.ndarray, view: View, pixels: ViewPixels) -> tuple[np.ndarray, ...]:
    """Diffuse (2, n, 3) and specular (2, n, J, 3) twice of the pixels of a view, in two independent halves."""
    from iif_core.light.transport.scene import PathOptions
    from iif_core.light.transport.shading import shading_caches

    settings, surface = job.settings.shading, (pixels.points, pixels.normals, pixels.wo)
    paths = [
        PathOptions(max(1, settings.samples // 2), settings.max_bounces, _seed(job, view.view_id) * 2 + half) for half in range(2)
    ]
    halves = [shading_caches(world, *surface, levels, half) for half in paths]
    return tuple(np.stack(part) for part in zip(*halves, strict=True))


def _facts(cells: ShadingCells, diffuse: DiffuseShading) -> dict[str, Any]:
    return {
        "cells": len(cells),
        "cell_edge_m": cells.edge,
        "pixels_per_cell": float(cells.pixels.mean()),
        "paths_per_cell": float(diffuse.samples.mean()),
        "noise_first": diffuse.noise_first,
        "noise_last": diffuse.noise_last,
        "noisy_objects": diffuse.noisy_objects,
    }


def _seed(job: Job, view_id: int) -> int:
    return ((job.seed << 32) | _SEEDS) << 32 | view_id


def _channels(layer: str, values: np.ndarray, index: np.ndarray, height: int, width: int) -> dict[str, np.ndarray]:
    image = np.zeros((height * width, 3), np.float32)
    image[index] = values
    return split_rgb(image.reshape(height, width, 3), layer)
