"""What stage base reads of views for the fusion: surface cells, weights and geometry of their pixels (docs/method/fusion.md)."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from iif_core.errors import InputError
from iif_core.fusion.options import CellOptions
from iif_core.fusion.pixels import pixel_weights, relative_footprints, surface_tangents
from iif_core.surface.cell_grid import CellGrid, build_cell_grid, median_footprint, smallest_edge
from iif_core.surface.triangles import face_geometry
from workflow.runtime.job import Job
from workflow.scene.decoded import DecodedViews
from workflow.scene.normal_form import View


def on_surface(decoded: DecodedViews, view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pixels on the mesh that show an object (m,), as index into the flattened image, their points (m, 3) and their
    object ids (m,)."""
    (depth, face_id), object_id = decoded.gbuffer(view), decoded.segmented(view).object_id
    index = np.flatnonzero((face_id >= 0) & (depth > 0) & (object_id >= 0)).astype(np.int32)
    points = decoded.capture.points(view, depth).reshape(-1, 3)[index]
    return index, points, object_id.ravel()[index]


def cells_of_views(job: Job, options: CellOptions, decoded: DecodedViews, views: list[View]) -> tuple[CellGrid, list[np.ndarray]]:
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
    pixels = []

    def points() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for view in views:
            index, points, objects = on_surface(decoded, view)
            pixels.append(index)
            yield points, objects

    grid, cell_of_pixel = build_cell_grid(points(), corners, edge)
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


def weights_and_segments(
    options: CellOptions, decoded: DecodedViews, views: list[View]
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Weight and segment of every pixel of each view, flattened; pixels that the photograph does not show weigh 0."""
    weights, segments = [], []
    footprints = [None] * len(views)
    if options.footprint_power > 0:
        pixels = _pixel_geometry(decoded, views)
        footprints = relative_footprints((*pixels(position), view.fx) for position, view in enumerate(views))
    for view, footprint in zip(views, footprints, strict=True):
        segmented, (_, valid) = decoded.segmented(view), decoded.capture.photo(view)
        weights.append(
            pixel_weights(segmented.interior, valid, options.border_weight, footprint, options.footprint_power).ravel()
        )
        segments.append(segmented.segment_id.ravel())
    return weights, segments


def points_of_views(decoded: DecodedViews, views: list[View]) -> Callable[[int], np.ndarray]:
    """view -> (H * W, 3) float32 surface points."""
    return lambda position: decoded.capture.points(views[position], decoded.gbuffer(views[position])[0]).reshape(-1, 3)


def tangents_of_views(decoded: DecodedViews, views: list[View]) -> Callable[[int], np.ndarray]:
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
