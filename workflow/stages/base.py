"""Stage base: the predictions of all views fused into one material per surface cell (docs/method/fusion.md)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Protocol

import numpy as np

from iif_core.errors import InputError
from iif_core.fusion.direct import describe_fit, solve_direct
from iif_core.fusion.gauge import parts_per_object
from iif_core.fusion.matching import REGULARISER
from iif_core.fusion.options import FusionOptions
from iif_core.fusion.pixels import pixel_weights, relative_footprints, surface_tangents
from iif_core.fusion.problem import FusionProblem, FusionResult, one_segment_per_view, with_every_object
from iif_core.fusion.reference_loss import loss_of_result
from iif_core.fusion.sgd.options import preset_grid, sgd_options
from iif_core.fusion.sgd.solve import SgdFit, SgdState, converged, solve_sgd
from iif_core.reflectance.material import CHANNELS, PROPERTIES
from iif_core.surface.cell_grid import CellGrid, CellValues, build_cell_grid, median_footprint, smallest_edge
from iif_core.surface.cells import neighbour_pairs, unpack_keys
from iif_core.surface.triangles import face_geometry
from workflow.artifacts.scratch import Scratch
from workflow.artifacts.store import StageReader, ids_from_disk, ids_to_disk, rgb, split_rgb
from workflow.decisions import numerics
from workflow.runtime.job import Job
from workflow.scene.decoded import DecodedViews
from workflow.scene.normal_form import CaptureReader, View

MEMORY_BYTES = 1 << 30
"""Predictions that stay in memory between sweeps; those of further views are mapped from a file without a name."""

KEPT_EVERY = 30.0
"""Seconds between two states of a descent that are written; each has 335 MB with the paper's hash grid."""


class Predictions(Protocol):
    """The predictions of a capture, view by view."""

    samples: int
    """K."""

    def has(self, view: View) -> bool:
        """Return whether there are predictions of a view."""
        ...

    def maps(self, view: View, samples: int) -> np.ndarray:
        """Return the first `samples` predictions of a view, (K, H, W, 5) float16 in [0, 1], NaN where one is missing."""
        ...

    def scale(self, view: View) -> np.ndarray | None:
        """Return the Laplace scales (H, W, 3) that the prior states for a view, or None."""
        ...


class StoredPredictions:
    """Predictions as stage prior wrote them."""

    def __init__(self, prior: StageReader):
        self._prior = prior
        self.samples = int(prior.table("predictions.parquet")["k"].max(initial=0)) + 1

    def has(self, view: View) -> bool:
        return self._prior.has(f"maps/{view.name}.exr")

    def maps(self, view: View, samples: int) -> np.ndarray:
        channels = self._prior.exr(f"maps/{view.name}.exr")
        out = np.full((samples, view.height, view.width, 5), np.nan, np.float16)
        for k in range(samples):
            layer = f"prior.{k:03d}"
            if f"{layer}.roughness" in channels:
                out[k, ..., :3] = rgb(channels, f"{layer}.albedo")
                out[k, ..., 3], out[k, ..., 4] = channels[f"{layer}.roughness"], channels[f"{layer}.metallic"]
        return np.clip(out, 0, 1, out=out)  # every solver reads the same values; NaN stays

    def scale(self, view: View) -> np.ndarray | None:
        channels = self._prior.exr(f"maps/{view.name}.exr")
        names = [f"scale.{name}" for name in PROPERTIES]
        return np.stack([channels[name] for name in names], -1) if names[0] in channels else None


def run(job: Job) -> None:
    """Write cells, object means, segments, selection, maps of every view and base.json."""
    fuse(job, StoredPredictions(job.read("prior")))


def fuse(job: Job, prior: Predictions) -> None:
    """Fuse predictions, and write what stage base writes; the job has the settings `base` and `seed`, and capture and
    segmentation upstream."""
    capture = CaptureReader(job.read("capture"))
    segmentation, settings = job.read("segmentation"), job.settings.base
    views = [view for view in capture.used if prior.has(view)]
    decoded = DecodedViews(capture, segmentation)
    grid, cell_maps = _cells(job, decoded, views)
    weights, segment_maps = _pixels(job, decoded, views)
    segments = segmentation.table("segments.parquet")
    n_objects = int(segmentation.table("objects.parquet")["object_id"].max(initial=-1)) + 1
    used = 1 if settings.variant == "raw" else min(prior.samples, settings.predictions or prior.samples)
    problem = FusionProblem(
        lambda position: prior.maps(views[position], used),
        cell_maps,
        segment_maps,
        len(grid),
        grid.object_id,
        segments["object_id"].astype(np.int32),
        weights,
        point=_points(decoded, views),
        tangent=_tangents(decoded, views),
        neighbours=neighbour_pairs(grid.keys) if settings.seams else None,
        scale=lambda position: prior.scale(views[position]),
    )
    if settings.variant == "image_affine":
        problem = one_segment_per_view(problem)
    with job.timed("solve"):
        result, fit = _solve(job, problem)
    result = with_every_object(result, n_objects)
    for dropped in result.dropped:
        if dropped.k < 0:
            job.log.warning("view %s: %s", views[dropped.view].name, dropped.reason)
    _write_cells(job, grid, n_objects, result)
    _write_segments(job, result, segments["segment_id"], problem.object_of_segment)
    every = np.concatenate([result.value, result.scale, result.uncertainty], 1)
    unseen = np.quantile(every[:, 5:], 0.9, axis=0)  # scale and uncertainty of surface that no prediction shows
    values = CellValues(grid, every)
    for done, view in enumerate(capture.views):
        maps = _maps(decoded, values, unseen, result, view)
        if settings.variant == "raw" and view in views:
            maps |= _raw_maps(prior, view, ids_from_disk(maps["cell.id"]) >= 0)
        job.writer.exr(f"maps/{view.name}.exr", maps)
        job.progress(done + 1, len(capture.views), "maps")
    _write_facts(job, grid, problem, result, fit, used)


def _write_facts(job: Job, grid: CellGrid, problem: FusionProblem, result: FusionResult, fit: SgdFit | None, used: int) -> None:
    """Write base.json and a summary to the log; `used` predictions per view."""
    settings = job.settings.base
    job.writer.json(
        "base.json",
        {
            "cell_edge_m": grid.edge,
            "origin": [float(x) for x in grid.origin],
            "cells": len(grid),
            "predictions": used,
            "solver": settings.solver,
            "variant": settings.variant,
            "sweeps": len(result.history),
            "history": [{name: round(float(value), 8) for name, value in entry.items()} for entry in result.history],
            "objects_in_separate_parts": {
                str(name): count for name, count in parts_per_object(grid.object_id, result.part_of_cell).items()
            },
            "filled_share": float((result.coverage == 0).mean()),
            "seen_once_share": float((result.views == 1).mean()),
            "uncertainty_calibrated": _calibrated(job),
            "numerics": numerics.of_base(result, used * len(problem.cell_of_pixel)),
            **({"reference_loss": _judged(job, problem, result, fit)} if settings.judge else {}),
        },
    )
    job.log.info(
        "%d cells of %.1f mm (%.0f %% seen in one view), %d segments; %s",
        len(grid),
        1e3 * grid.edge,
        100 * (result.views == 1).mean(),
        len(np.unique(np.concatenate([np.unique(m[m >= 0]) for m in problem.segment_of_pixel]))),
        ", ".join(f"{name} {value:.4g}" for name, value in result.history[-1].items()),
    )


def _calibrated(job: Job) -> bool:
    """Whether uncertainty_* are calibrated for this way of solving; otherwise they only rank cells."""
    settings = job.settings.base
    return settings.solver == "direct" and settings.variant == "full" and settings.objective == "least_squares"


def _solve(job: Job, problem: FusionProblem) -> tuple[FusionResult, SgdFit | None]:
    """The result, and the fit of the paper's optimiser if that solved."""
    settings = job.settings.base

    def progress(done: int, total: int) -> None:
        job.progress(done, total, "passes over the views" if settings.solver == "direct" else "steps")

    if settings.solver == "sgd":
        own = {
            "texture": settings.texture or ("hashgrid" if settings.preset == "paper" else "cells"),
            "iterations": settings.iterations,
            "median_gradient": settings.median_gradient,
        }
        grid = preset_grid(settings.preset, settings.hash_levels, settings.hash_entries)
        given = {name: value for name, value in own.items() if value is not None}
        chosen = sgd_options(settings.preset, grid=grid, seed=job.seed, **given)
        last = time.monotonic()

        def load() -> SgdState | None:
            kept = job.kept_state("descent")
            if kept is None:
                return None
            job.log.info("the descent continues from step %d", kept[1]["step"])
            return SgdState(*kept)

        def keep(state_of: Callable[[], SgdState]) -> None:
            nonlocal last
            if time.monotonic() - last >= KEPT_EVERY:
                state = state_of()
                job.keep_state("descent", state.arrays, state.facts)
                last = time.monotonic()

        fit = solve_sgd(problem, chosen, progress, job.threads, load, keep)
        texture = fit.value, fit.scale, fit.corrections, fit.alpha
        return describe_fit(problem, *texture, fit.history, job.threads, MEMORY_BYTES), fit
    variant = {"raw": "texel_mean", "image_affine": "full"}.get(settings.variant, settings.variant)
    same = ("sweeps", "anneal", "ridge", "final_temperature", "robust", "objective", "polish", "seams")
    options = FusionOptions(
        variant,
        temperature=max(settings.temperature, settings.final_temperature),
        memory=MEMORY_BYTES,
        spill=Scratch(job.writer.directory),
        **{name: getattr(settings, name) for name in same},
    )
    return solve_direct(problem, options, progress, job.threads), None


def _on_surface(decoded: DecodedViews, view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pixels on the mesh that show an object (m,), as index into the flattened image, their points (m, 3) and their
    object ids (m,)."""
    (depth, face_id), object_id = decoded.gbuffer(view), decoded.segmented(view).object_id
    index = np.flatnonzero((face_id >= 0) & (depth > 0) & (object_id >= 0)).astype(np.int32)
    points = decoded.capture.points(view, depth).reshape(-1, 3)[index]
    return index, points, object_id.ravel()[index]


def _cells(job: Job, decoded: DecodedViews, views: list[View]) -> tuple[CellGrid, list[np.ndarray]]:
    """The grid and the cell of every pixel, (H * W,) int32 per view with -1 = none."""
    vertices, faces = decoded.capture.mesh()
    corners = vertices[np.unique(faces)]
    edge = job.settings.base.cell_edge
    if edge is None:
        footprint = median_footprint(_seen_depths(decoded, views))
        if footprint is None:
            raise InputError("base: no pixel of any view with predictions sees the mesh; check the alignment of the capture")
        edge = job.settings.base.cell_footprints * footprint
    smallest = smallest_edge(corners)
    if edge < smallest:
        extent = float(np.ptp(corners, axis=0).max())
        job.log.warning("cells of %g m are too many for a mesh %g m across; using %g m", edge, extent, smallest)
        edge = smallest
    pixels = []

    def points_of_views() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for view in views:
            index, points, objects = _on_surface(decoded, view)
            pixels.append(index)
            yield points, objects

    grid, cell_of_pixel = build_cell_grid(points_of_views(), corners, edge)
    if not len(grid):
        raise InputError("base: no pixel of any view with predictions sees an object; check segmentation and capture")
    maps = []
    for view, index, cell in zip(views, pixels, cell_of_pixel, strict=True):
        maps.append(np.full(view.height * view.width, -1, np.int32))
        maps[-1][index] = cell
    return grid, maps


def _seen_depths(decoded: DecodedViews, views: list[View]) -> Iterator[tuple[np.ndarray, float]]:
    """z-depths of the pixels of each view that see the mesh, and the focal length in pixels."""
    for view in views:
        depth, face_id = decoded.gbuffer(view)
        yield depth[(face_id >= 0) & (depth > 0)], view.fx


def _pixels(job: Job, decoded: DecodedViews, views: list[View]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Weight and segment of every pixel of each view, flattened; pixels that the photograph does not show weigh 0."""
    settings = job.settings.base
    weights, segments = [], []
    footprints = [None] * len(views)
    if settings.footprint_power > 0:
        pixels = _pixel_geometry(decoded, views)
        footprints = relative_footprints((*pixels(position), view.fx) for position, view in enumerate(views))
    for view, footprint in zip(views, footprints, strict=True):
        segmented, (_, valid) = decoded.segmented(view), decoded.capture.photo(view)
        weights.append(
            pixel_weights(segmented.interior, valid, settings.border_weight, footprint, settings.footprint_power).ravel()
        )
        segments.append(segmented.segment_id.ravel())
    return weights, segments


def _judged(job: Job, problem: FusionProblem, result: FusionResult, fit: SgdFit | None) -> dict[str, dict[str, float]]:
    """The paper's loss of the result, and for `sgd` also the loss of `direct` with the same objective and selection.

    Every pixel counts 1, as in the paper. `direct` solves with `border_weight`, which must be 1 for an exact comparison.
    """
    problem = replace(problem, weight=[(np.asarray(w) > 0).astype(np.float32) for w in problem.weight])  # the paper's pool
    judged = {job.settings.base.solver: loss_of_result(problem, result if fit is None else fit)}
    if fit is not None:
        options = FusionOptions(objective="distribution", polish=job.settings.base.polish, memory=MEMORY_BYTES)
        with job.timed("direct_at_the_same_selection"):
            twin = solve_direct(problem, options, threads=job.threads, chosen=fit.alpha.argmax(1))
        judged["direct_at_the_same_selection"] = loss_of_result(problem, twin)
    out = {}
    for name, loss in judged.items():
        regulariser = REGULARISER * (loss.regulariser_albedo + loss.regulariser_roughness + loss.regulariser_metallic)
        out[name] = {"data": loss.data, "regulariser": regulariser, "total": loss.data + regulariser}
    if fit is not None:
        out["sgd"]["converged"] = converged(fit.history)
    return out


def _points(decoded: DecodedViews, views: list[View]) -> Callable[[int], np.ndarray]:
    """view -> (H * W, 3) float32 surface points."""
    return lambda position: decoded.capture.points(views[position], decoded.gbuffer(views[position])[0]).reshape(-1, 3)


def _tangents(decoded: DecodedViews, views: list[View]) -> Callable[[int], np.ndarray]:
    """view -> (H * W, 2, 3) float32 displacement of the surface point over one pixel to the right and down, m."""
    pixels = _pixel_geometry(decoded, views)
    return lambda position: surface_tangents(*pixels(position)).reshape(-1, 2, 3)


def _pixel_geometry(decoded: DecodedViews, views: list[View]) -> Callable[[int], tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """view -> z-depth (H, W) in m, viewing directions (H, W, 3) and normals (H, W, 3) of the faces."""
    normals, _ = face_geometry(*decoded.capture.mesh())

    def of_view(position: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        depth, face_id = decoded.gbuffer(views[position])
        return depth, views[position].directions(), normals[face_id]

    return of_view


def _raw_maps(prior: Predictions, view: View, surface: np.ndarray) -> dict[str, np.ndarray]:
    """Channels of the first usable prediction of a view, unchanged, where there is surface."""
    maps = prior.maps(view, prior.samples)
    good = np.isfinite(maps).mean((1, 2, 3)) > 0.99
    first = np.where(surface[..., None], maps[int(np.argmax(good))], 0).astype(np.float32)
    return {**split_rgb(first[..., :3], "albedo"), "roughness": first[..., 3], "metallic": first[..., 4]}


def _write_cells(job: Job, grid: CellGrid, n_objects: int, result: FusionResult) -> None:
    """Write cells.parquet and objects.parquet."""
    ijk, objects = unpack_keys(grid.keys)
    job.writer.table(
        "cells.parquet",
        {
            "cell_id": np.arange(len(grid), dtype=np.int32),
            **{name: ijk[:, a] for a, name in enumerate("ijk")},
            "object_id": objects,
            "part_id": result.part_of_cell,
            **{name: grid.centre[:, a] for a, name in enumerate("xyz")},
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


def _write_segments(job: Job, result: FusionResult, segment_id: np.ndarray, object_id: np.ndarray) -> None:
    """Write segments.parquet and selection.parquet; `object_id` (S,) of the segments that were solved for."""
    n, k = result.weight.shape[:2]
    ids = segment_id.astype(np.int32) if n == len(segment_id) else np.arange(n, dtype=np.int32)
    best = result.weight.argmax(1).astype(np.int32)
    job.writer.table(
        "segments.parquet",
        {
            "segment_id": ids,
            "object_id": np.asarray(object_id, np.int32),
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


def _maps(
    decoded: DecodedViews, cells: CellValues, unseen: np.ndarray, result: FusionResult, view: View
) -> dict[str, np.ndarray]:
    """Channels of one view; pixels without surface are 0.

    `cells` holds value, scale and uncertainty (n_cells, 15). Surface in no cell, which test views show, has the mean of the
    cells around it, or else the mean of its object with the scale and uncertainty `unseen` (10,).
    """
    index, points, objects = _on_surface(decoded, view)
    fallback = np.concatenate([result.object_value[objects], np.broadcast_to(unseen, (len(index), 10))], 1)
    values, row = cells.at(points, objects, fallback)
    shape, size = (view.height, view.width), view.height * view.width
    cell, covered, full = np.full(size, -1, np.int32), np.zeros(size, np.float32), np.zeros((size, 15), np.float32)
    cell[index], full[index] = row, values
    covered[index] = np.where(row >= 0, result.coverage[row], 0)
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
