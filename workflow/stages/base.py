"""base: the predictions of all views fused into one material per surface cell, by object and by voxel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from iif_core.base.direct import BaseOptions, solve_base
from iif_core.base.gauge import covisible_parts
from iif_core.base.problem import CHANNELS, BaseProblem, BaseResult
from iif_core.cells import INDEX_LIMIT, grid_origin, pack_keys, unpack_keys, voxel_indices
from iif_core.errors import InputError
from workflow.artifacts.store import StageReader, ids_from_disk, ids_to_disk, rgb, split_rgb
from workflow.job import Job
from workflow.normal_form import CaptureReader, View

BORDER_WEIGHT = 0.1
"""Pixels next to another object: predictions bleed across borders, but thin objects have nothing else."""
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
    """Write cells, object means, selection, maps of every view and base.json."""
    capture = CaptureReader(job.read("capture"))
    prior, segmentation = job.read("prior"), job.read("segmentation")
    views = [view for view in capture if view.split != "test" and prior.has(f"maps/{view.name}.exr")]
    surface = _Surface(capture, segmentation)
    cells, cell_maps = _cells(job, capture, surface, views)
    weights, segment_maps = _pixels(capture, segmentation, views)
    objects = unpack_keys(cells.keys)[1]
    n_objects = int(segmentation.table("objects.parquet")["object_id"].max(initial=-1)) + 1
    samples = int(prior.table("predictions.parquet")["k"].max(initial=0)) + 1
    segments = segmentation.table("segments.parquet")
    settings = job.settings.base
    problem = BaseProblem(
        _predictions(prior, views, samples),
        cell_maps,
        segment_maps,
        len(cells.keys),
        objects,
        segments["object_id"].astype(np.int32),
        weights,
    )
    options = BaseOptions(settings.variant, settings.sweeps, anneal=settings.anneal, ridge=settings.ridge)
    result = solve_base(problem, options, lambda done, total: job.progress(done, total, "passes over the views"), job.threads)
    for dropped in result.dropped:
        if dropped.k < 0:
            job.log.warning("view %s: %s", views[dropped.view].name, dropped.reason)
    _write_tables(job, cells, objects, n_objects, result, segments["segment_id"])
    for done, view in enumerate(capture.views):
        job.writer.exr(f"maps/{view.name}.exr", _maps(surface, cells, result, view))
        job.progress(done + 1, len(capture.views), "maps")
    seen = np.unique(np.concatenate([np.unique(m[m >= 0]) for m in segment_maps]))
    parts = covisible_parts(problem)
    split = _parts_of_objects(problem.object_of_segment[seen], parts[seen])
    job.writer.json(
        "base.json",
        {
            "cell_edge_m": cells.edge,
            "origin": [float(x) for x in cells.origin],
            "cells": len(cells.keys),
            "solver": settings.solver,
            "variant": settings.variant,
            "sweeps": len(result.history),
            "history": [{name: round(value, 8) for name, value in entry.items()} for entry in result.history],
            "objects_in_separate_parts": split,
        },
    )
    last = result.history[-1]
    job.log.info(
        "%d cells of %.1f mm, %d segments; last sweep: albedo error %.5f, mean gain %.2f",
        len(cells.keys),
        1e3 * cells.edge,
        len(seen),
        last["error_albedo"],
        last["gain"],
    )


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


def _pixels(capture: CaptureReader, segmentation: StageReader, views: list[View]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Weight and segment of every pixel of each view, flattened; pixels that the photograph does not show weigh 0."""
    weights, segments = [], []
    for view in views:
        channels = segmentation.exr(f"maps/{view.name}.exr")
        _, valid = capture.photo(view)
        weight = np.where(channels["interior"] > 0.5, 1.0, BORDER_WEIGHT) * valid
        weights.append(weight.astype(np.float32).ravel())
        segments.append(ids_from_disk(channels["segment.id"]).ravel())
    return weights, segments


def _predictions(prior: StageReader, views: list[View], samples: int) -> Callable[[int], np.ndarray]:
    """view -> (K, H, W, 5) float16, NaN for predictions that were dropped; kept in memory as far as `MEMORY` goes."""
    kept: dict[int, np.ndarray] = {}
    budget = MEMORY
    for position, view in enumerate(views):
        budget -= samples * view.height * view.width * 10
        if budget >= 0:
            kept[position] = _read_predictions(prior, view, samples)
    return lambda position: kept[position] if position in kept else _read_predictions(prior, views[position], samples)


def _read_predictions(prior: StageReader, view: View, samples: int) -> np.ndarray:
    channels = prior.exr(f"maps/{view.name}.exr")
    out = np.full((samples, view.height, view.width, 5), np.nan, np.float16)
    for k in range(samples):
        layer = f"prior.{k:03d}"
        if f"{layer}.roughness" in channels:
            out[k, ..., :3] = rgb(channels, f"{layer}.albedo")
            out[k, ..., 3], out[k, ..., 4] = channels[f"{layer}.roughness"], channels[f"{layer}.metallic"]
    return out


def _write_tables(
    job: Job, cells: Cells, objects: np.ndarray, n_objects: int, result: BaseResult, segment_id: np.ndarray
) -> None:
    ijk, _ = unpack_keys(cells.keys)
    job.writer.table(
        "cells.parquet",
        {
            "cell_id": np.arange(len(cells.keys), dtype=np.int32),
            **{name: ijk[:, a] for a, name in enumerate("ijk")},
            "object_id": objects,
            **{name: cells.centre[:, a] for a, name in enumerate("xyz")},
            "observations": result.observations,
            "views": result.views,
            **{name: result.value[:, c] for c, name in enumerate(CHANNELS)},
            **{f"scale_{name}": result.scale[:, c] for c, name in enumerate(CHANNELS)},
        },
        dict.fromkeys("xyz", "m"),
    )
    known = min(n_objects, len(result.object_value))
    means = np.tile(np.float32([0.5, 0.5, 0.5, 0.9, 0.0]), (n_objects, 1))
    counted = np.zeros(n_objects, np.int32)
    means[:known], counted[:known] = result.object_value[:known], result.object_cells[:known]
    columns = {name: means[:, c] for c, name in enumerate(CHANNELS)}
    job.writer.table("objects.parquet", {"object_id": np.arange(n_objects, dtype=np.int32), "cells": counted, **columns})
    n, k = result.weight.shape[:2]
    job.writer.table(
        "selection.parquet",
        {
            "segment_id": np.repeat(segment_id.astype(np.int32), k),
            "k": np.tile(np.arange(k, dtype=np.int32), n),
            **{f"weight_{name}": result.weight[..., p].ravel() for p, name in enumerate(("albedo", "roughness", "metallic"))},
            "affine_albedo": result.affine_albedo.reshape(n * k, 12),
            "affine_roughness": result.affine_roughness.reshape(n * k, 2),
            "affine_metallic": result.affine_metallic.reshape(n * k, 2),
            **{f"error_{name}": result.error[..., p].ravel() for p, name in enumerate(("albedo", "roughness", "metallic"))},
        },
    )


def _maps(surface: _Surface, cells: Cells, result: BaseResult, view: View) -> dict[str, np.ndarray]:
    """Channels of one view; surface in no cell (test views) has its object's mean, pixels without surface are 0."""
    index, points, objects = surface(view)
    keys = pack_keys(voxel_indices(points, cells.edge, cells.origin), objects)
    row = np.minimum(np.searchsorted(cells.keys, keys), len(cells.keys) - 1)
    known = cells.keys[row] == keys
    size = view.height * view.width
    cell, value, scale = np.full(size, -1, np.int32), np.zeros((size, 5), np.float32), np.zeros((size, 5), np.float32)
    cell[index] = np.where(known, row, -1)
    value[index] = np.where(known[:, None], result.value[row], result.object_value[objects])
    unsure = np.quantile(result.scale, 0.9, axis=0)
    scale[index] = np.where(known[:, None], result.scale[row], unsure)
    shape = (view.height, view.width)
    return {
        "cell.id": ids_to_disk(cell.reshape(shape)),
        **split_rgb(value[:, :3].reshape(*shape, 3), "albedo"),
        "roughness": value[:, 3].reshape(shape),
        "metallic": value[:, 4].reshape(shape),
        "scale.albedo": scale[:, :3].mean(1).reshape(shape),
        "scale.roughness": scale[:, 3].reshape(shape),
        "scale.metallic": scale[:, 4].reshape(shape),
    }


def _parts_of_objects(objects: np.ndarray, parts: np.ndarray) -> dict[str, int]:
    """object id -> number of parts that share no cell, for objects with more than one (their tone may differ)."""
    pairs = np.unique(np.stack([objects, parts]), axis=1)
    ids, count = np.unique(pairs[0], return_counts=True)
    return {str(i): int(n) for i, n in zip(ids.tolist(), count.tolist(), strict=True) if n > 1}
