"""One mesh of many depth maps: a truncated signed distance, averaged in voxels (Curless and Levoy 1996), by Open3D."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from iif_core.numerics.graph import component_labels
from iif_core.reconstruction.sweep import Picture
from iif_core.surface.triangles import face_geometry

BLOCK = 8  # voxels along the edge of a block
TRUNCATED = 4.0
"""Distance in voxels beyond which a depth map says nothing about a voxel."""
LEAST_MAPS = 1.5
"""Depth maps that must have met a voxel, between whole numbers."""
SMOOTHING = 10
"""Rounds of smoothing without shrinking (Taubin 1995): noise of a voxel would turn normals by tens of degrees."""
LEAST_AREA = 1e-3
"""Share of the area below which a piece that hangs together is left out."""


def fused_mesh(depths: Sequence[NDArray], pictures: Sequence[Picture], voxel: float) -> tuple[NDArray, NDArray]:
    """Return vertices (n, 3) float64 and faces (m, 3) int64 of the surface that depth maps show.

    Args:
        depths: (H, W) z-depth, NaN = unknown.
        pictures: their cameras.
        voxel: edge of the voxels, in the unit of the depths; at most a few millions of them lie near the surface.

    Returns:
        The mesh, without small loose pieces, normals towards the cameras; nothing where no two maps agree.
    """
    import open3d as o3d

    grid = o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight"),
        attr_dtypes=(o3d.core.float32, o3d.core.float32),
        attr_channels=((1), (1)),
        voxel_size=voxel,
        block_resolution=BLOCK,
        block_count=20_000,
    )
    for depth, picture in zip(depths, pictures, strict=True):
        if not np.isfinite(depth).any():
            continue
        farthest = float(np.nanmax(depth)) + voxel
        image = o3d.t.geometry.Image(np.ascontiguousarray(np.nan_to_num(depth), np.float32))
        at_integers = picture.intrinsics - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        camera = o3d.core.Tensor(np.ascontiguousarray(at_integers, np.float64))
        pose = o3d.core.Tensor(np.vstack([picture.camera_from_world, [0.0, 0.0, 0.0, 1.0]]))
        blocks = grid.compute_unique_block_coordinates(image, camera, pose, 1.0, farthest, TRUNCATED)
        grid.integrate(blocks, image, camera, pose, 1.0, farthest, TRUNCATED)
    if not grid.hashmap().size():
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    mesh = grid.extract_triangle_mesh(weight_threshold=LEAST_MAPS)
    if "positions" not in mesh.vertex or "indices" not in mesh.triangle:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    smooth = mesh.to_legacy().filter_smooth_taubin(SMOOTHING)
    return large_pieces(np.asarray(smooth.vertices, np.float64), np.asarray(smooth.triangles, np.int64))


def large_pieces(vertices: NDArray, faces: NDArray, among: NDArray | None = None) -> tuple[NDArray, NDArray]:
    """Return a mesh without pieces that hang together and have less than `LEAST_AREA` of its area.

    among: (m,) bool, faces of the mesh that are left; None = all.
    """
    if not len(faces):
        return vertices[:0], faces
    area = face_geometry(vertices, faces)[1]
    least = LEAST_AREA * area.sum()
    if among is not None:
        faces, area = faces[among], area[among]
    piece = component_labels(len(vertices), faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel())[faces[:, 0]]
    of_piece = np.bincount(piece, area)
    kept = faces[of_piece[piece] >= least]
    used, local = np.unique(kept, return_inverse=True)
    return vertices[used], local.reshape(-1, 3)
