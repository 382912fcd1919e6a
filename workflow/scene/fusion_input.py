"""What stage base reads for the fusion: predictions, and cells, weights and geometry of their pixels (docs/method/fusion.md)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from iif_core.errors import InputError
from iif_core.fusion.options import CellOptions, FusionOptions
from iif_core.fusion.pixels import pixel_weights, relative_footprints, surface_tangents
from iif_core.fusion.problem import FusionProblem
from iif_core.surface.cell_grid import CellGrid, build_cell_grid, median_footprint, smallest_edge
from iif_core.surface.cells import neighbour_pairs
from iif_core.surface.triangles import face_geometry
from workflow.runtime.job import Job
from workflow.scene.decoded import DecodedViews
from workflow.scene.normal_form import CaptureReader, View
from workflow.scene.predictions import Predictions
from workflow.settings.options import options_of


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """What is fused: the problem, and what its numbers stand for.

    Attributes:
        problem: predictions on cells; used: predictions of each view.
        decoded: photographs and what belongs to them; views: those with predictions; normals: (m, 3) of the faces.
        grid: of the cells; segment_id: (S,) of the segments of the problem; n_objects: of the scene.
    """

    problem: FusionProblem
    used: int
    decoded: DecodedViews
    views: list[View]
    normals: np.ndarray
    grid: CellGrid
    segment_id: np.ndarray
    n_objects: int


def read_inputs(job: Job, prior: Predictions, most: int | None = None) -> Inputs:
    """Put predictions on cells; at most the first `most` of each view, None = as many as the settings say."""
    capture = CaptureReader(job.read("capture"))
    segmentation, options = job.read("segmentation"), options_of(CellOptions, job.settings.base)
    views = [view for view in capture.used if prior.has(view)]
    decoded, (normals, _) = DecodedViews(capture, segmentation), face_geometry(*capture.mesh())
    grid, cell_maps = _cells_of_views(job, options, decoded, views, normals)
    weights, segment_maps = _weights_and_segments(options, decoded, views, normals)
    segments = segmentation.table("segments.parquet")
    used = min(prior.samples, most or options.predictions or prior.samples)
    pixels = _pixel_geometry(decoded, views, normals)
    problem = FusionProblem(
        predictions=lambda position: prior.maps(views[position], used),
        cell_of_pixel=cell_maps,
        segment_of_pixel=segment_maps,
        n_cells=len(grid),
        object_of_cell=grid.object_id,
        object_of_segment=segments["object_id"].astype(np.int32),
        weight=weights,
        point=lambda position: decoded.maps(views[position], photograph=False).points().reshape(-1, 3),
        tangent=lambda position: surface_tangents(*pixels(position)).reshape(-1, 2, 3),
        neighbours=neighbour_pairs(grid.keys) if options_of(FusionOptions, job.settings.base).seams else None,
        scale=lambda position: prior.scale(views[position]),
    )
    return Inputs(
        problem=problem,
        used=used,
        decoded=decoded,
        views=views,
        normals=normals,
        grid=grid,
        segment_id=segments["segment_id"],
        n_objects=int(segmentation.table("objects.parquet")["object_id"].max(initial=-1)) + 1,
    )


def _cells_of_views(
    job: Job, options: CellOptions, decoded: DecodedViews, views: list[View], normals: np.ndarray
) -> tuple[CellGrid, list[np.ndarray]]:
    """The grid and the cell of every pixel, (H * W,) int32 per view with -1 = none."""
    vertices, faces = decoded.capture.mesh()
    corners = vertices[np.unique(faces)]
    edge = options.cell_edge
    if edge is None:
        footprint = median_footprint(_seen_depths(decoded, views))
        if footprint is None:
            raise InputError("base: no pixel of any view with predictions sees the mesh; check the alignment of the capture")
        edge = options.cell_footprints * footprint
    smallest = smallest_edge(corners)
    if edge < smallest:
        extent = float(np.ptp(corners, axis=0).max())
        job.log.warning("cells of %g m are too many for a mesh %g m across; using %g m", edge, extent, smallest)
        edge = smallest
    index = []

    def points() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for view in views:
            pixels = decoded.on_objects(view, normals)
            index.append(pixels.index.astype(np.int32))
            yield pixels.points, pixels.object_id

    grid, cell_of_pixel = build_cell_grid(points(), corners, edge)
    if not len(grid):
        raise InputError("base: no pixel of any view with predictions sees an object; check segmentation and capture")
    maps = []
    for view, own, cell in zip(views, index, cell_of_pixel, strict=True):
        maps.append(np.full(view.height * view.width, -1, np.int32))
        maps[-1][own] = cell
    return grid, maps


def _seen_depths(decoded: DecodedViews, views: list[View]) -> Iterator[tuple[np.ndarray, float]]:
    """z-depths of the pixels of each view that see the mesh, and the focal length in pixels."""
    for view in views:
        maps = decoded.maps(view, photograph=False)
        yield maps.depth[maps.hit], view.fx


def _weights_and_segments(
    options: CellOptions, decoded: DecodedViews, views: list[View], normals: np.ndarray
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Weight and segment of every pixel of each view, flattened; pixels that the photograph does not show weigh 0."""
    weights, segments = [], []
    footprints = [None] * len(views)
    if options.footprint_power > 0:
        pixels = _pixel_geometry(decoded, views, normals)
        footprints = relative_footprints((*pixels(position), view.fx) for position, view in enumerate(views))
    for view, footprint in zip(views, footprints, strict=True):
        maps = decoded.maps(view)
        weight = pixel_weights(maps.interior, maps.valid, options.border_weight, footprint, options.footprint_power)
        weights.append(weight.ravel())
        segments.append(maps.segment_id.ravel())
    return weights, segments


def _pixel_geometry(
    decoded: DecodedViews, views: list[View], normals: np.ndarray
) -> Callable[[int], tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """view -> z-depth (H, W) in m, viewing directions (H, W, 3) and normals (H, W, 3) of the faces."""

    def of_view(position: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        depth, face_id = decoded.gbuffer(views[position])
        return depth, views[position].directions(), normals[face_id]

    return of_view
