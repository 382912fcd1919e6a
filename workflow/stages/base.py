"""base: the predictions of all views fused into one material per surface cell, by object and by voxel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from iif_core.errors import InputError
from iif_core.fusion.direct import describe_fit, solve_base
from iif_core.fusion.hashgrid.levels import HashGridOptions
from iif_core.fusion.matching import REGULARISER
from iif_core.fusion.options import BaseOptions
from iif_core.fusion.problem import CHANNELS, NEUTRAL, PROPERTIES, BaseProblem, BaseResult, one_segment_per_view
from iif_core.fusion.reference_loss import loss_of_result
from iif_core.fusion.sgd.options import sgd_options
from iif_core.fusion.sgd.solve import SgdFit, converged, solve_base_sgd
from iif_core.surface.cells import (
    COARSE_SHIFT,
    INDEX_LIMIT,
    coarse_cells,
    grid_origin,
    neighbour_pairs,
    pack_keys,
    unpack_keys,
    voxel_indices,
)
from iif_core.surface.mesh import face_geometry
from workflow.artifacts.store import StageReader, ids_from_disk, ids_to_disk, rgb, split_rgb
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader, View

FOOTPRINT_WEIGHTS = (0.05, 4.0)
"""Smallest and largest weight by footprint."""
STEEPEST = 5.0
"""Longest step on the surface over one pixel, in steps across the line of sight."""
MEMORY = 1 << 30
"""Bytes of predictions that are kept in memory; more are read again every sweep."""


@dataclass(frozen=True)
class Cells:
    """The voxel grid, and the cells that some pixel fell into, in key order."""

    edge: float
    origin: np.ndarray  # (3,) float32
    keys: np.ndarray  # (n,) uint64, sorted
    centre: np.ndarray  # (n, 3) float32 mean of the pixels' surface points


def run(job: Job) -> None:
    """Write cells, object means, segments, selection, maps of every view and base.json."""
    capture = CaptureReader(job.read("capture"))
    prior, segmentation = job.read("prior"), job.read("segmentation")
    settings = job.settings.base
    views = [view for view in capture.used if prior.has(f"maps/{view.name}.exr")]
    surface = _Surface(capture, segmentation)
    cells, cell_maps = _cells(job, capture, surface, views)
    weights, segment_maps = _pixels(job, capture, segmentation, views)
    segments = segmentation.table("segments.parquet")
    n_objects = int(segmentation.table("objects.parquet")["object_id"].max(initial=-1)) + 1
    samples = int(prior.table("predictions.parquet")["k"].max(initial=0)) + 1
    used = 1 if settings.variant == "raw" else min(samples, settings.predictions or samples)
    problem = BaseProblem(
        lambda position: _read_predictions(prior, views[position], used),
        cell_maps,
        segment_maps,
        len(cells.keys),
        unpack_keys(cells.keys)[1],
        segments["object_id"].astype(np.int32),
        weights,
        point=_points(capture, views),
        tangent=_tangents(capture, views),
        neighbours=neighbour_pairs(cells.keys) if settings.seams else None,
    )
    if settings.variant == "image_affine":
        problem = one_segment_per_view(problem)
    with job.timed("solve"):
        result, fit = _solve(job, problem)
    result = _with_every_object(result, n_objects)
    for dropped in result.dropped:
        if dropped.k < 0:
            job.log.warning("view %s: %s", views[dropped.view].name, dropped.reason)
    _write_tables(job, cells, n_objects, result, segments, problem)
    for done, view in enumerate(capture.views):
        maps = _maps(surface, cells, result, view)
        if settings.variant == "raw" and view in views:
            maps |= _raw_maps(prior, view, samples, ids_from_disk(maps["cell.id"]) >= 0)
        job.writer.exr(f"maps/{view.name}.exr", maps)
        job.progress(done + 1, len(capture.views), "maps")
    _write_facts(job, cells, problem, result, fit, used)


def _write_facts(job: Job, cells: Cells, problem: BaseProblem, result: BaseResult, fit: SgdFit | None, used: int) -> None:
    """base.json, and the same in a line of the log; `used` predictions a view."""
    settings = job.settings.base
    job.writer.json(
        "base.json",
        {
            "cell_edge_m": cells.edge,
            "origin": [float(x) for x in cells.origin],
            "cells": len(cells.keys),
            "predictions": used,
            "solver": settings.solver,
            "variant": settings.variant,
            "sweeps": len(result.history),
            "history": [{name: round(float(value), 8) for name, value in entry.items()} for entry in result.history],
            "objects_in_separate_parts": _parts_of_objects(unpack_keys(cells.keys)[1], result.part_of_cell),
            "filled_share": float((result.coverage == 0).mean()),
            "seen_once_share": float((result.views == 1).mean()),
            "uncertainty_calibrated": _calibrated(job),
            **({"reference_loss": _judged(job, problem, result, fit)} if settings.judge else {}),
        },
    )
    job.log.info(
        "%d cells of %.1f mm (%.0f %% seen in one view), %d segments; %s",
        len(cells.keys),
        1e3 * cells.edge,
        100 * (result.views == 1).mean(),
        len(np.unique(np.concatenate([np.unique(m[m >= 0]) for m in problem.segment_of_pixel]))),
        ", ".join(f"{name} {value:.4g}" for name, value in result.history[-1].items()),
    )


def _calibrated(job: Job) -> bool:
    """Whether uncertainty_* are calibrated for this way of solving (docs/base.md); else they rank and no more."""
    settings = job.settings.base
    return settings.solver == "direct" and settings.variant == "full" and settings.objective == "least_squares"


def _solve(job: Job, problem: BaseProblem) -> tuple[BaseResult, SgdFit | None]:
    """The result, and what the paper's optimiser left when it was asked for."""
    settings = job.settings.base

    def progress(done: int, total: int) -> None:
        job.progress(done, total, "passes over the views" if settings.solver == "direct" else "steps")

    if settings.solver == "sgd":
        published = settings.preset == "paper"
        size = {"levels": settings.hash_levels, "log2_entries": settings.hash_entries}
        grid = {} if published else {"levels": 16, "log2_entries": 17}
        own = {
            "texture": settings.texture or ("hashgrid" if published else "cells"),
            "iterations": settings.iterations,
            "median_gradient": settings.median_gradient,
        }
        chosen = sgd_options(
            settings.preset,
            grid=HashGridOptions(**grid | {name: value for name, value in size.items() if value is not None}),
            seed=job.seed,
            **{name: value for name, value in own.items() if value is not None},
        )
        fit = solve_base_sgd(problem, chosen, progress, job.threads)
        texture = fit.value, fit.scale, fit.corrections, fit.alpha
        return describe_fit(problem, *texture, fit.history, job.threads, MEMORY), fit
    variant = {"raw": "texel_mean", "image_affine": "full"}.get(settings.variant, settings.variant)
    options = BaseOptions(
        variant,
        settings.sweeps,
        max(settings.temperature, settings.final_temperature),
        settings.anneal,
        settings.ridge,
        final_temperature=settings.final_temperature,
        robust=settings.robust,
        objective=settings.objective,
        polish=settings.polish,
        seams=settings.seams,
        memory=MEMORY,
    )
    return solve_base(problem, options, progress, job.threads), None


class _Surface:
    """Surface points and object ids of the pixels of a view."""

    def __init__(self, capture: CaptureReader, segmentation: StageReader):
        self.capture, self.segmentation = capture, segmentation

    def __call__(self, view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(index of pixels on the mesh (m,), points (m, 3), object ids (m,)); index is into the flattened image."""
        depth, face_id = self.capture.gbuffer(view)
        object_id = ids_from_disk(self.segmentation.exr(f"maps/{view.name}.exr")["object.id"])
        index = np.flatnonzero((face_id >= 0) & (depth > 0) & (object_id >= 0))
        points = self.capture.points(view, depth).reshape(-1, 3)[index]
        return index, points, object_id.ravel()[index]


def _cells(job: Job, capture: CaptureReader, surface: _Surface, views: list[View]) -> tuple[Cells, list[np.ndarray]]:
    """The grid and the cell of every pixel, (H * W,) int32 a view with -1 = none.

    The edge is the setting, or so many footprints of the median pixel (median over views of depth / focal length).
    """
    vertices, faces = capture.mesh()
    corners = vertices[np.unique(faces)]
    edge = job.settings.base.cell_edge
    if edge is None:
        footprints = []
        for view in views:
            depth, face_id = capture.gbuffer(view)
            hit = (face_id >= 0) & (depth > 0)
            if hit.any():
                footprints.append(float(np.median(depth[hit])) / view.fx)
        if not footprints:
            raise InputError("base: no pixel of any view with predictions sees the mesh; check the alignment of the capture")
        edge = job.settings.base.cell_footprints * float(np.median(footprints))
    extent = float(np.ptp(corners, axis=0).max())
    smallest = extent / (INDEX_LIMIT - 8)
    if edge < smallest:
        job.log.warning("cells of %g m are too many for a mesh %g m across; using %g m", edge, extent, smallest)
        edge = smallest
    origin = grid_origin(corners, edge)
    found, centres = [], []
    for view in views:
        index, points, objects = surface(view)
        keys = pack_keys(voxel_indices(points, edge, origin), objects)
        unique, inverse, count = np.unique(keys, return_inverse=True, return_counts=True)
        found.append((view, index, unique, inverse))
        centres.append((count, np.stack([np.bincount(inverse, points[:, a], len(unique)) for a in range(3)], 1)))
    keys = np.unique(np.concatenate([unique for _, _, unique, _ in found])) if found else np.zeros(0, np.uint64)
    if not len(keys):
        raise InputError("base: no pixel of any view with predictions sees an object; check segmentation and capture")
    total, summed = np.zeros(len(keys)), np.zeros((len(keys), 3))
    maps = []
    for (view, index, unique, inverse), (count, sums) in zip(found, centres, strict=True):
        rows = np.searchsorted(keys, unique)
        total[rows] += count
        summed[rows] += sums
        cell = np.full(view.height * view.width, -1, np.int32)
        cell[index] = rows[inverse]
        maps.append(cell)
    return Cells(edge, origin, keys, (summed / total[:, None]).astype(np.float32)), maps


def _pixels(
    job: Job, capture: CaptureReader, segmentation: StageReader, views: list[View]
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Weight and segment of every pixel of each view, flattened; pixels that the photograph does not show weigh 0."""
    settings = job.settings.base
    weights, segments = [], []
    footprints = _footprints(capture, views) if settings.footprint_power > 0 else None
    for position, view in enumerate(views):
        channels = segmentation.exr(f"maps/{view.name}.exr")
        _, valid = capture.photo(view)
        weight = np.where(channels["interior"] > 0.5, 1.0, settings.border_weight) * valid
        if footprints is not None:
            weight *= np.clip(footprints[position] ** -settings.footprint_power, *FOOTPRINT_WEIGHTS)
        weights.append(weight.astype(np.float32).ravel())
        segments.append(ids_from_disk(channels["segment.id"]).ravel())
    return weights, segments


def _footprints(capture: CaptureReader, views: list[View]) -> list[np.ndarray]:
    """(H, W) size of each pixel on the surface over the median: depth / focal length / sqrt(cosine at the surface)."""
    vertices, faces = capture.mesh()
    normals, _ = face_geometry(vertices, faces)
    sizes = []
    for view in views:
        depth, face_id = capture.gbuffer(view)
        direction = capture.directions(view)
        cosine = np.abs(np.einsum("hwi,hwi->hw", direction, normals[face_id])) / np.linalg.norm(direction, axis=-1)
        sizes.append(np.where(depth > 0, depth, np.nan) / view.fx / np.sqrt(np.maximum(cosine, 1e-3)))
    median = np.nanmedian(np.concatenate([size.ravel() for size in sizes]))
    return [np.nan_to_num(size / median, nan=1.0) for size in sizes]


def _with_every_object(result: BaseResult, n_objects: int) -> BaseResult:
    """Rows for objects that no prediction shows."""
    missing = max(0, n_objects - len(result.object_value))
    value = np.concatenate([result.object_value, np.tile(NEUTRAL, (missing, 1))])
    return replace(result, object_value=value, object_cells=np.pad(result.object_cells, (0, missing)))


def _judged(job: Job, problem: BaseProblem, result: BaseResult, fit: SgdFit | None) -> dict[str, dict[str, float]]:
    """The paper's loss of the result; of `sgd` also of `direct` on the same objective at the same selection.

    Every pixel counts 1, as in the paper; `direct` solves with `border_weight`, so set that to 1 to compare.
    """
    problem = replace(problem, weight=[(np.asarray(w) > 0).astype(np.float32) for w in problem.weight])  # the paper's pool
    judged = {job.settings.base.solver: loss_of_result(problem, result if fit is None else fit)}
    if fit is not None:
        options = BaseOptions(objective="distribution", polish=job.settings.base.polish, memory=MEMORY)
        with job.timed("direct_at_the_same_selection"):
            twin = solve_base(problem, options, threads=job.threads, chosen=fit.alpha.argmax(1))
        judged["direct_at_the_same_selection"] = loss_of_result(problem, twin)
    out = {}
    for name, loss in judged.items():
        regulariser = REGULARISER * (loss.regulariser_albedo + loss.regulariser_roughness + loss.regulariser_metallic)
        out[name] = {"data": loss.data, "regulariser": regulariser, "total": loss.data + regulariser}
    if fit is not None:
        out["sgd"]["converged"] = converged(fit.history)
    return out


def _points(capture: CaptureReader, views: list[View]) -> Callable[[int], np.ndarray]:
    """view -> (H * W, 3) float32 surface points."""
    return lambda position: capture.points(views[position], capture.gbuffer(views[position])[0]).reshape(-1, 3)


def _tangents(capture: CaptureReader, views: list[View]) -> Callable[[int], np.ndarray]:
    """view -> (H * W, 2, 3) float32 how the surface point moves over one pixel to the right and down, on its face's plane.

    x = o + z d with z = n.(x - o) / n.d, so dx = z (dd - d n.dd / n.d); at grazing angles limited to `STEEPEST` of z dd.
    """
    vertices, faces = capture.mesh()
    normals, _ = face_geometry(vertices, faces)

    def of_view(position: int) -> np.ndarray:
        view = views[position]
        depth, face_id = capture.gbuffer(view)
        direction, normal = capture.directions(view).astype(np.float64), normals[face_id]
        across = np.einsum("hwi,hwi->hw", normal, direction)
        out = np.empty((view.height, view.width, 2, 3), np.float32)
        for axis in range(2):
            change = np.gradient(direction, axis=1 - axis)
            slide = np.einsum("hwi,hwi->hw", normal, change) / np.where(across == 0, 1e-12, across)
            moved = change - direction * slide[..., None]
            length, limit = np.linalg.norm(moved, axis=-1), STEEPEST * np.linalg.norm(change, axis=-1)
            moved *= np.minimum(1, limit / np.maximum(length, 1e-20))[..., None]
            out[..., axis, :] = np.where(depth > 0, depth, 0)[..., None] * moved
        return out.reshape(-1, 2, 3)

    return of_view


def _read_predictions(prior: StageReader, view: View, samples: int) -> np.ndarray:
    channels = prior.exr(f"maps/{view.name}.exr")
    out = np.full((samples, view.height, view.width, 5), np.nan, np.float16)
    for k in range(samples):
        layer = f"prior.{k:03d}"
        if f"{layer}.roughness" in channels:
            out[k, ..., :3] = rgb(channels, f"{layer}.albedo")
            out[k, ..., 3], out[k, ..., 4] = channels[f"{layer}.roughness"], channels[f"{layer}.metallic"]
    return np.clip(out, 0, 1, out=out)  # every solver reads the same values; NaN stays


def _raw_maps(prior: StageReader, view: View, samples: int, surface: np.ndarray) -> dict[str, np.ndarray]:
    """The first usable prediction of a view as it is, where there is surface."""
    maps = _read_predictions(prior, view, samples)
    good = np.isfinite(maps).mean((1, 2, 3)) > 0.99
    first = np.where(surface[..., None], maps[int(np.argmax(good))], 0).astype(np.float32)
    return {**split_rgb(first[..., :3], "albedo"), "roughness": first[..., 3], "metallic": first[..., 4]}


def _write_tables(
    job: Job,
    cells: Cells,
    n_objects: int,
    result: BaseResult,
    segments: dict[str, np.ndarray],
    problem: BaseProblem,
) -> None:
    ijk, objects = unpack_keys(cells.keys)
    job.writer.table(
        "cells.parquet",
        {
            "cell_id": np.arange(len(cells.keys), dtype=np.int32),
            **{name: ijk[:, a] for a, name in enumerate("ijk")},
            "object_id": objects,
            "part_id": result.part_of_cell,
            **{name: cells.centre[:, a] for a, name in enumerate("xyz")},
            "observations": result.observations,
            "views": result.views,
            "coverage": result.coverage,
            **{name: result.value[:, c] for c, name in enumerate(CHANNELS)},
            **{f"scale_{name}": result.scale[:, c] for c, name in enumerate(CHANNELS)},
            **{f"uncertainty_{name}": result.uncertainty[:, c] for c, name in enumerate(CHANNELS)},
        },
        {**dict.fromkeys("xyz", "m"), "coverage": "weighted pixels"},
    )
    means, counted = result.object_value[:n_objects], result.object_cells[:n_objects].astype(np.int32)
    columns = {name: means[:, c] for c, name in enumerate(CHANNELS)}
    job.writer.table("objects.parquet", {"object_id": np.arange(n_objects, dtype=np.int32), "cells": counted, **columns})
    n, k = result.weight.shape[:2]
    ids = segments["segment_id"].astype(np.int32) if n == len(segments["segment_id"]) else np.arange(n, dtype=np.int32)
    best = result.weight.argmax(1).astype(np.int32)
    job.writer.table(
        "segments.parquet",
        {
            "segment_id": ids,
            "object_id": np.asarray(problem.object_of_segment, np.int32),
            **{f"best_{name}": best[:, p] for p, name in enumerate(PROPERTIES)},
            **{f"margin_{name}": result.margin[:, p] for p, name in enumerate(PROPERTIES)},
            **{f"effective_{name}": result.effective[:, p] for p, name in enumerate(PROPERTIES)},
        },
    )
    job.writer.table(
        "selection.parquet",
        {
            "segment_id": np.repeat(ids, k),
            "k": np.tile(np.arange(k, dtype=np.int32), n),
            **{f"weight_{name}": result.weight[..., p].ravel() for p, name in enumerate(PROPERTIES)},
            **{f"probability_{name}": result.probability[..., p].ravel() for p, name in enumerate(PROPERTIES)},
            "affine_albedo": result.affine_albedo.reshape(n * k, 12),
            "affine_roughness": result.affine_roughness.reshape(n * k, 2),
            "affine_metallic": result.affine_metallic.reshape(n * k, 2),
            **{f"error_{name}": result.error[..., p].ravel() for p, name in enumerate(PROPERTIES)},
        },
    )


def _maps(surface: _Surface, cells: Cells, result: BaseResult, view: View) -> dict[str, np.ndarray]:
    """Channels of one view; surface in no cell (test views) has the mean of the cells around or else of its object,
    pixels without surface are 0."""
    index, points, objects = surface(view)
    ijk = voxel_indices(points, cells.edge, cells.origin)
    row, known = _rows_of(cells.keys, pack_keys(ijk, objects))
    every = np.concatenate([result.value, result.scale, result.uncertainty], 1)
    unsure = np.quantile(every[:, 5:], 0.9, axis=0)  # of surface that no prediction shows
    values = np.concatenate([result.object_value[objects], np.broadcast_to(unsure, (len(index), 10))], 1)
    if not known.all():
        coarse_ijk, coarse_object, coarse = coarse_cells(*unpack_keys(cells.keys), every)
        keys = pack_keys(coarse_ijk, coarse_object)
        near, around = _rows_of(keys, pack_keys(ijk >> COARSE_SHIFT, objects))
        values[around] = coarse[near[around]]
    values[known] = every[row[known]]
    size = view.height * view.width
    cell, covered = np.full(size, -1, np.int32), np.zeros(size, np.float32)
    cell[index] = np.where(known, row, -1)
    covered[index] = np.where(known, result.coverage[row], 0)
    full = np.zeros((size, 15), np.float32)
    full[index] = values
    shape = (view.height, view.width)
    full = full.reshape(*shape, 15)
    out = {
        "cell.id": ids_to_disk(cell.reshape(shape)),
        **split_rgb(full[..., :3], "albedo"),
        "roughness": full[..., 3],
        "metallic": full[..., 4],
        "coverage": covered.reshape(shape),
    }
    for name, first in (("scale", 5), ("uncertainty", 10)):
        out[f"{name}.albedo"] = full[..., first : first + 3].mean(-1)
        out[f"{name}.roughness"], out[f"{name}.metallic"] = full[..., first + 3], full[..., first + 4]
    return out


def _rows_of(keys: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row of each wanted key in the sorted `keys` (any row where it is missing), and whether it is there."""
    row = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return row, keys[row] == wanted


def _parts_of_objects(objects: np.ndarray, parts: np.ndarray) -> dict[str, int]:
    """object id -> number of parts that share no cell, for objects with more than one (their levels are tied by seams)."""
    seen = parts >= 0
    pairs = np.unique(np.stack([objects[seen], parts[seen]]), axis=1)
    ids, count = np.unique(pairs[0], return_counts=True)
    return {str(i): int(n) for i, n in zip(ids.tolist(), count.tolist(), strict=True) if n > 1}
