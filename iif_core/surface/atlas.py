"""A texture atlas: charts of a mesh laid out in one square picture by xatlas, and the surface that lies under each texel.

Texture coordinates are those of glTF: (0, 0) is the top left corner of the picture, v grows downwards. Texel (row i, column j)
of an atlas of S x S has its centre at u = (j + 1/2) / S, v = (i + 1/2) / S.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iif_core.errors import InputError
from iif_core.surface.triangles import face_geometry
from iif_core.surface.xatlas_process import Packed, pack

PADDING = 4
"""Texels between two charts: two levels of mip maps do not mix them; beyond, every texel has the value of the nearest chart."""
FULL = 0.7
"""Share of an atlas that charts may fill, at most about; the rest is between them."""
STEP = 64
"""Sizes of atlases are multiples of this, in texels."""
UNSEEN = 64
"""Texels along the side of a square for a mesh that no photograph shows, at most; its material is the mean of its object."""
SEEN_SHARE = 4.0
"""Texels of a mesh over those of what photographs show of it, at most: a lawn of which a window shows a strip stays small."""
LEAST_SCALE = 0.25
"""Part of the density that fits by area below which a larger atlas is better: many small charts fill it with what is between."""
MOST_TIMES = 4
"""Times that an atlas may be larger along a side than was asked for."""
_ROUNDS = 12
_UNIT = 1e-3
"""Texels per unit of length in xatlas, which ignores faces with an area below 1e-7 squared units."""


@dataclass(frozen=True)
class Unwrapped:
    """Texture coordinates of several meshes in one atlas.

    Attributes:
        source: for each mesh, (n,) int64 vertex of the input from which each new one is copied.
        uv: for each mesh, (n, 2) float32 in [0, 1].
        faces: for each mesh, (m, 3) int64 of the new vertices, in the order of the input.
        size: S, texels.
        shrunk: factor <= 1 on all densities that made the charts fit.
        charts: number of charts.
    """

    source: list[NDArray]
    uv: list[NDArray]
    faces: list[NDArray]
    size: int
    shrunk: float
    charts: int


def texel_density(area: ArrayLike, seen_area: ArrayLike, footprint: ArrayLike, edge: float) -> NDArray:
    """Choose texels a metre for meshes: one texel for a pixel of the photographs or a surface cell, whichever is larger.

    Args:
        area: (n,) of each mesh, m^2, > 0.
        seen_area: (n,) of it that photographs show, m^2.
        footprint: (n,) size of a pixel on it where it was seen from near, m; infinite where it was not seen.
        edge: of the surface cells, m; nothing finer was recovered.

    Returns:
        (n,) float64 density d, with d^2 area <= UNSEEN^2 + SEEN_SHARE d_0^2 seen_area where d_0 = 1 / max(edge, footprint).
    """
    area = np.maximum(np.asarray(area, np.float64), 1e-12)
    texel = np.maximum(np.asarray(footprint, np.float64), edge)
    finest = np.where(np.isfinite(texel), 1 / texel, 1 / (8 * edge))  # surface that nobody saw is of one colour
    most = UNSEEN**2 + SEEN_SHARE * finest**2 * np.asarray(seen_area, np.float64)
    return np.minimum(finest, np.sqrt(most / area))


def unwrap(meshes: Sequence[tuple[NDArray, NDArray]], density: ArrayLike, largest: int) -> Unwrapped:
    """Cut meshes into charts and pack them into one square atlas, which is as small as it can be.

    Args:
        meshes: vertices (n, 3) metres and faces (m, 3), m >= 1, of each.
        density: texels a metre wanted for each mesh, > 0. All are lowered by one factor where they do not fit.
        largest: side of the atlas in texels, at most; twice or four times that where the charts do not fit at any density,
            because there are so many, each with texels around it.

    Raises:
        InputError: there are still too many.
    """
    density = np.asarray(density, np.float64)
    texels = sum(d * d * face_geometry(*mesh)[1].sum() for mesh, d in zip(meshes, density, strict=True))
    limit = largest
    while (fitted := _fitted(meshes, density, limit, texels)) is None:
        limit *= 2
        if limit > MOST_TIMES * largest:
            limit //= 2
            raise InputError(f"texture atlas: the charts do not fit into {limit} x {limit} texels, because there are too many")
    packed, scale = fitted
    width, height = packed.width, packed.height
    size = min(STEP * -(-max(width, height) // STEP), limit)
    source, uv, new = [], [], []
    for (vertices, _), (rows, faces, coordinates, chart) in zip(meshes, packed.meshes, strict=True):
        source.append(rows.astype(np.int64))
        new.append(faces.astype(np.int64))
        coordinates = coordinates[_nearest_with(chart >= 0, vertices[rows])]
        # Coordinates of xatlas run over its own width and height; the picture is a square of whole steps.
        uv.append((coordinates * np.array([width / size, height / size])).astype(np.float32))
    return Unwrapped(source, uv, new, size, scale, packed.charts)


def _fitted(
    meshes: Sequence[tuple[NDArray, NDArray]], density: NDArray, limit: int, texels: float
) -> tuple[Packed, float] | None:
    """Return charts in one atlas of at most `limit` texels along a side, and the factor <= 1 on the densities that made them fit;
    None if none does. `texels`: of all meshes at the densities wanted."""
    # First guess: charts fill the share FULL of the largest atlas. Each round that does not fit lowers all densities.
    scale = first = min(1.0, float(limit * np.sqrt(FULL / max(texels, 1e-12))))
    for _ in range(_ROUNDS):
        if scale < LEAST_SCALE * first:
            break
        scaled = []
        for (vertices, faces), own in zip(meshes, density, strict=True):
            middle = vertices.mean(0)  # small numbers lose less in single precision
            scaled.append((((vertices - middle) * (own * scale / _UNIT)).astype(np.float32), faces.astype(np.uint32)))
        packed = pack(scaled, PADDING, _UNIT)
        if 0 < max(packed.width, packed.height) <= limit and packed.atlases == 1:
            return packed, scale
        scale *= min(0.97, 0.99 * limit / max(packed.width, packed.height, 1))
    return None


def _nearest_with(has: NDArray, points: NDArray) -> NDArray:
    """Return for each point (n,) itself, or the nearest one that `has` (n,): corners of faces without an area are in no chart."""
    own = np.arange(len(points))
    if has.all() or not has.any():
        return own
    from scipy.spatial import cKDTree

    rows = np.flatnonzero(has)
    own[~has] = rows[cKDTree(points[rows]).query(points[~has])[1]]
    return own


def texel_surface(uv: ArrayLike, faces: ArrayLike, size: int) -> tuple[NDArray, NDArray]:
    """Find the face under the centre of every texel.

    Args:
        uv: (n, 2) texture coordinates; faces: (m, 3). Charts do not overlap.
        size: S, which need not be the size of the atlas.

    Returns:
        face (S, S) int32, -1 = none, and barycentric coordinates (S, S, 3) float32 of the centre in it, >= 0, of sum 1.
    """
    uv, faces = np.asarray(uv, np.float32), np.asarray(faces)
    if not len(faces):
        return np.full((size, size), -1, np.int32), np.zeros((size, size, 3), np.float32)
    import open3d as o3d

    # The charts lie in the plane z = 0, in units of texels, and a ray comes down through the centre of each texel.
    plane = np.concatenate([uv * np.float32(size), np.zeros((len(uv), 1), np.float32)], 1)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(plane), o3d.core.Tensor(np.ascontiguousarray(faces, np.uint32)))
    face, barycentric = np.empty((size, size), np.int32), np.empty((size, size, 3), np.float32)
    column = np.arange(size, dtype=np.float32) + 0.5
    rows = max(1, (1 << 20) // size)  # about a million rays at a time
    for first in range(0, size, rows):
        row = np.arange(first, min(first + rows, size), dtype=np.float32) + 0.5
        rays = np.zeros((len(row), size, 6), np.float32)
        rays[..., 0], rays[..., 1] = column[None, :], row[:, None]
        rays[..., 2], rays[..., 5] = 1, -1
        hit = scene.cast_rays(o3d.core.Tensor(rays))
        found = hit["primitive_ids"].numpy()
        second = np.clip(hit["primitive_uvs"].numpy(), 0, 1)
        here = slice(first, first + len(row))
        face[here] = np.where(found == scene.INVALID_ID, -1, found).astype(np.int32)
        # Open3D gives the weights of the second and third corner.
        barycentric[here] = np.stack([np.maximum(1 - second.sum(-1), 0), second[..., 0], second[..., 1]], -1)
    return face, barycentric / np.maximum(barycentric.sum(-1, keepdims=True), np.float32(1e-12))


def texels_around(uv: ArrayLike, faces: ArrayLike, size: int, reach: float) -> NDArray:
    """Mark at least the texels whose centre lies within `reach` texels of a face: (S, S) bool, those around the box of each face.

    Args:
        uv, faces, size: as for `texel_surface`.
    """
    corners = (np.asarray(uv, np.float32) * np.float32(size))[np.asarray(faces)]
    low = np.clip(np.floor(corners.min(1) - 0.5 - reach), 0, size).astype(np.int64)
    high = np.clip(np.ceil(corners.max(1) - 0.5 + reach) + 1, 0, size).astype(np.int64)
    # Sums over rows and columns of these corners count the boxes that hold each texel.
    count = np.zeros((size + 1, size + 1), np.int64)
    for ends, sign in (((low, low), 1), ((low, high), -1), ((high, low), -1), ((high, high), 1)):
        np.add.at(count, (ends[0][:, 1], ends[1][:, 0]), sign)
    return count.cumsum(0).cumsum(1)[:size, :size] > 0


def texel_values(values: ArrayLike, faces: ArrayLike, face: NDArray, barycentric: NDArray) -> NDArray:
    """Interpolate values (n, C) of the vertices at texels: (t, C) float32, for `face` (t,) >= 0 and `barycentric` (t, 3)."""
    values = np.asarray(values, np.float32)
    corner = np.asarray(faces)[face]
    return sum(values[corner[:, i]] * barycentric[:, i, None] for i in range(3))


def nearest_covered(covered: ArrayLike) -> NDArray:
    """Return the flat index (S, S) int64 of the nearest covered texel of each; its own where nothing is covered.

    A picture that is filled in this way has no background that filters or mip maps could mix into a chart.
    """
    from scipy.ndimage import distance_transform_edt

    covered = np.asarray(covered, bool)
    own = np.arange(covered.size).reshape(covered.shape)
    if not covered.any():
        return own
    row, column = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    return own[row, column]
