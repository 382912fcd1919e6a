"""Stage base: the predictions of all views fused into one material per surface cell (docs/method/fusion.md)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np

from iif_core.errors import InputError
from iif_core.fusion.direct import solve_direct
from iif_core.fusion.gauge import parts_per_object
from iif_core.fusion.options import FusionOptions
from iif_core.fusion.pixels import pixel_weights, relative_footprints, surface_tangents
from iif_core.fusion.problem import FusionProblem, FusionResult, with_every_object
from iif_core.reflectance.material import CHANNELS, PROPERTIES
from iif_core.surface.cell_grid import CellGrid, CellValues, build_cell_grid, median_footprint, smallest_edge
from iif_core.surface.cells import neighbour_pairs, unpack_keys
from iif_core.surface.triangles import face_geometry
from workflow.artifacts.scratch import Scratch
from workflow.artifacts.store import StageReader, ids_from_disk, ids_to_disk, rgb, split_rgb
from workflow.decisions import numerics
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader, View

MEMORY_BYTES = 1 << 30
"""Predictions that stay in memory between sweeps; those of further views are mapped from a file without a name."""


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
    settings = job.settings.base
    found = read_inputs(job, prior)
    options = FusionOptions(
        temperature=max(settings.temperature, settings.final_temperature),
        memory=MEMORY_BYTES,
        spill=Scratch(job.writer.directory),
        **{name: getattr(settings, name) for name in ("sweeps", "anneal", "ridge", "final_temperature", "robust", "seams")},
    )
    with job.timed("solve"):
        result = solve_direct(found.problem, options, partial(job.progress, what="passes over the views"), job.threads)
    write(job, found, result)


@dataclass(frozen=True)
class Inputs:
    """What is fused: the problem, and what its numbers stand for.

    Attributes:
        problem: predictions on cells; used: predictions of each view.
        capture: photographs; views: those with predictions; surface: their points.
        grid: of the cells; segment_id: (S,) of the segments of the problem; n_objects: of the scene.
    """

    problem: FusionProblem
    used: int
    capture: CaptureReader
    views: list[View]
    surface: _Surface
    grid: CellGrid
    segment_id: np.ndarray
    n_objects: int


def read_inputs(job: Job, prior: Predictions, most: int | None = None) -> Inputs:
    """Put predictions on cells; at most the first `most` of each view, None = as many as the settings say."""
    capture = CaptureReader(job.read("capture"))
    segmentation, settings = job.read("segmentation"), job.settings.base
    views = [view for view in capture.used if prior.has(view)]
    surface = _Surface(capture, segmentation)
    grid, cell_maps = _cells(job, capture, surface, views)
    weights, segment_maps = _pixels(job, capture, segmentation, views)
    segments = segmentation.table("segments.parquet")
    n_objects = int(segmentation.table("objects.parquet")["object_id"].max(initial=-1)) + 1
    used = min(prior.samples, most or settings.predictions or prior.samples)
    problem = FusionProblem(
        lambda position: prior.maps(views[position], used),
        cell_maps,
        segment_maps,
        len(grid),
        grid.object_id,
        segments["object_id"].astype(np.int32),
        weights,
        point=_points(capture, views),
        tangent=_tangents(capture, views),
        neighbours=neighbour_pairs(grid.keys) if settings.seams else None,
        scale=lambda position: prior.scale(views[position]),
    )
    return Inputs(problem, used, capture, views, surface, grid, segments["segment_id"], n_objects)


def write(
    job: Job,
    found: Inputs,
    result: FusionResult,
    *,
    solver: str = "direct",
    variant: str = "full",
    calibrated: bool = True,
    facts: Mapping[str, Any] | None = None,
    over: Callable[[View, np.ndarray], dict[str, np.ndarray]] | None = None,
) -> None:
    """Write the artefacts of stage base.

    Args:
        job: the job; found: what was fused; result: of it.
        solver, variant: how; calibrated: whether `uncertainty_*` are errors, or only rank cells.
        facts: further ones for base.json.
        over: channels of a view, from the pixels (H, W) bool that show a cell, that replace those of the cells.
    """
    result = with_every_object(result, found.n_objects)
    for dropped in result.dropped:
        if dropped.k < 0:
            job.log.warning("view %s: %s", found.views[dropped.view].name, dropped.reason)
    _write_cells(job, found.grid, found.n_objects, result)
    _write_segments(job, result, found.segment_id, found.problem.object_of_segment)
    every = np.concatenate([result.value, result.scale, result.uncertainty], 1)
    unseen = np.quantile(every[:, 5:], 0.9, axis=0)  # scale and uncertainty of surface that no prediction shows
    values, views = CellValues(found.grid, every), found.capture.views
    for done, view in enumerate(views):
        maps = _maps(found.surface, values, unseen, result, view)
        if over is not None:
            maps |= over(view, ids_from_disk(maps["cell.id"]) >= 0)
        job.writer.exr(f"maps/{view.name}.exr", maps)
        job.progress(done + 1, len(views), "maps")
    grid, problem = found.grid, found.problem
    job.writer.json(
        "base.json",
        {
            "cell_edge_m": grid.edge,
            "origin": [float(x) for x in grid.origin],
            "cells": len(grid),
            "predictions": found.used,
            "solver": solver,
            "variant": variant,
            "sweeps": len(result.history),
            "history": [{name: round(float(value), 8) for name, value in entry.items()} for entry in result.history],
            "objects_in_separate_parts": {
                str(name): count for name, count in parts_per_object(grid.object_id, result.part_of_cell).items()
            },
            "filled_share": float((result.coverage == 0).mean()),
            "seen_once_share": float((result.views == 1).mean()),
            "uncertainty_calibrated": calibrated,
            "numerics": numerics.of_base(result, found.used * len(problem.cell_of_pixel)),
            **(facts or {}),
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


class _Surface:
    """Reader of the surface points and object ids of the pixels of a view."""

    def __init__(self, capture: CaptureReader, segmentation: StageReader):
        self.capture, self.segmentation = capture, segmentation

    def __call__(self, view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(index of pixels on the mesh (m,), points (m, 3), object ids (m,)); index is into the flattened image."""
        depth, face_id = self.capture.gbuffer(view)
        object_id = ids_from_disk(self.segmentation.exr(f"maps/{view.name}.exr")["object.id"])
        index = np.flatnonzero((face_id >= 0) & (depth > 0) & (object_id >= 0)).astype(np.int32)
        points = self.capture.points(view, depth).reshape(-1, 3)[index]
        return index, points, object_id.ravel()[index]


def _cells(job: Job, capture: CaptureReader, surface: _Surface, views: list[View]) -> tuple[CellGrid, list[np.ndarray]]:
    """The grid and the cell of every pixel, (H * W,) int32 per view with -1 = none."""
    vertices, faces = capture.mesh()
    corners = vertices[np.unique(faces)]
    edge = job.settings.base.cell_edge
    if edge is None:
        footprint = median_footprint(_seen_depths(capture, views))
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
            index, points, objects = surface(view)
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


def _seen_depths(capture: CaptureReader, views: list[View]) -> Iterator[tuple[np.ndarray, float]]:
    """z-depths of the pixels of each view that see the mesh, and the focal length in pixels."""
    for view in views:
        depth, face_id = capture.gbuffer(view)
        yield depth[(face_id >= 0) & (depth > 0)], view.fx


def _pixels(
    job: Job, capture: CaptureReader, segmentation: StageReader, views: list[View]
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Weight and segment of every pixel of each view, flattened; pixels that the photograph does not show weigh 0."""
    settings = job.settings.base
    weights, segments = [], []
    footprints = [None] * len(views)
    if settings.footprint_power > 0:
        pixels = _pixel_geometry(capture, views)
        footprints = relative_footprints((*pixels(position), view.fx) for position, view in enumerate(views))
    for view, footprint in zip(views, footprints, strict=True):
        channels = segmentation.exr(f"maps/{view.name}.exr")
        _, valid = capture.photo(view)
        interior = channels["interior"] > 0.5
        weights.append(pixel_weights(interior, valid, settings.border_weight, footprint, settings.footprint_power).ravel())
        segments.append(ids_from_disk(channels["segment.id"]).ravel())
    return weights, segments


def _points(capture: CaptureReader, views: list[View]) -> Callable[[int], np.ndarray]:
    """view -> (H * W, 3) float32 surface points."""
    return lambda position: capture.points(views[position], capture.gbuffer(views[position])[0]).reshape(-1, 3)


def _tangents(capture: CaptureReader, views: list[View]) -> Callable[[int], np.ndarray]:
    """view -> (H * W, 2, 3) float32 displacement of the surface point over one pixel to the right and down, m."""
    pixels = _pixel_geometry(capture, views)
    return lambda position: surface_tangents(*pixels(position)).reshape(-1, 2, 3)


def _pixel_geometry(capture: CaptureReader, views: list[View]) -> Callable[[int], tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """view -> z-depth (H, W) in m, viewing directions (H, W, 3) and normals (H, W, 3) of the faces."""
    normals, _ = face_geometry(*capture.mesh())

    def of_view(position: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        depth, face_id = capture.gbuffer(views[position])
        return depth, views[position].directions(), normals[face_id]

    return of_view


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


def _maps(surface: _Surface, cells: CellValues, unseen: np.ndarray, result: FusionResult, view: View) -> dict[str, np.ndarray]:
    """Channels of one view; pixels without surface are 0.

    `cells` holds value, scale and uncertainty (n_cells, 15). Surface in no cell, which test views show, has the mean of the
    cells around it, or else the mean of its object with the scale and uncertainty `unseen` (10,).
    """
    index, points, objects = surface(view)
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
