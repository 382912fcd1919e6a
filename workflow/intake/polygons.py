"""Polygons of mesh files as triangles: concave ones by ear clipping, because a fan of triangles would close a doorway."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from iif_core.errors import InputError

Array = np.ndarray
MOST_CORNERS, MOST_SQUARES = 10_000, 10**10
"""Corners of one polygon, and the sum of their squares over all polygons, which ear clipping takes time for."""


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Put the file before what is wrong with its polygons."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def triangulated(vertices: Array, polygons: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return the triangles of polygons, in their order in the file and wound as they are.

    Args:
        vertices: (n, 3) float64.
        polygons: for each number k of corners: (p,) int64 places in the file, and (p, k) int64 vertices, in 0 ... n - 1.

    Returns:
        (m, 3) int64 vertices, and (m,) int64 place of the polygon of each. Polygons of fewer than three corners are left out.

    Raises:
        InputError: a polygon has more corners than are allowed, or all have.
    """
    most = max((corners.shape[1] for _, corners in polygons if len(corners)), default=0)
    squares = sum(len(corners) * corners.shape[1] ** 2 for _, corners in polygons if corners.shape[1] > 4)
    if most > MOST_CORNERS or squares > MOST_SQUARES:
        raise InputError(
            f"a polygon of {most} corners; allowed are {MOST_CORNERS}, fewer if there are many: triangulate the mesh"
        )
    faces, places = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    for place, corners in polygons:
        k = corners.shape[1]
        if k < 3 or not len(corners):
            continue
        if k == 3:
            own = corners[:, None]
        elif k == 4:
            own = _of_quads(vertices, corners)
        else:
            own, is_right = _of_fans(vertices, corners)
            left = np.flatnonzero(~is_right)
            parts = [corners[i][_clipped(vertices[corners[i]])] for i in left]
            faces += parts
            places += [np.full(len(part), place[i]) for i, part in zip(left, parts, strict=True)]
            place, own = place[is_right], own[is_right]
        faces.append(own.reshape(-1, 3))
        places.append(np.repeat(place, own.shape[1]))
    joined, place = np.concatenate(faces), np.concatenate(places)
    order = np.argsort(place, kind="stable")
    return joined[order], place[order]


def _of_quads(vertices: Array, corners: Array) -> Array:
    """(p, 2, 3) triangles of quads (p, 4), split along the diagonal that lies inside."""
    split = np.stack([corners[:, [0, 1, 2, 0, 2, 3]], corners[:, [1, 2, 3, 1, 3, 0]]]).reshape(2, -1, 2, 3)
    # Both halves face the same side along the diagonal that is inside; of a plane convex quad along either.
    at = vertices[split]
    normal = np.cross(at[..., 1, :] - at[..., 0, :], at[..., 2, :] - at[..., 0, :])
    alike = (normal[:, :, 0] * normal[:, :, 1]).sum(-1)
    return split[np.where((alike[0] >= 0) | ~(alike[1] > 0), 0, 1), np.arange(len(corners))]


def _of_fans(vertices: Array, corners: Array) -> tuple[Array, Array]:
    """(p, k - 2, 3) triangles of polygons (p, k) around their first corner, and for which polygons (p,) none is turned over."""
    k = corners.shape[1]
    fan = np.stack([np.zeros(k - 2, np.int64), np.arange(1, k - 1), np.arange(2, k)], 1)
    at = vertices[corners]
    spokes = at - at[:, :1]
    normal = np.cross(spokes[:, 1:-1], spokes[:, 2:])
    along = (normal * normal.sum(1, keepdims=True)).sum(-1)
    return corners[:, fan], (along >= 0).all(1) & (along > 0).any(1)


def _clipped(corners: Array) -> Array:
    """(k - 2, 3) triangles of one polygon (k, 3) by ear clipping in its plane; a fan where it has no area."""
    import mapbox_earcut

    k = len(corners)
    fan = np.stack([np.zeros(k - 2, np.int64), np.arange(1, k - 1), np.arange(2, k)], 1)
    away = corners - corners.mean(0)
    # Newell's normal: twice the area of the polygon's shadow on each plane of two axes; robust against corners on a line.
    normal = np.cross(away, np.roll(away, -1, 0)).sum(0)
    size = np.linalg.norm(normal)
    if not np.isfinite(size) or size <= 1e-12 * max(float((away**2).sum()), 1e-300):
        return fan
    u = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    u /= np.linalg.norm(u)
    flat = np.stack([away @ u, away @ np.cross(normal / size, u)], 1)  # counterclockwise, as u, v and the normal are right-handed
    found = mapbox_earcut.triangulate_float64(flat, np.array([k], np.uint32)).astype(np.int64).reshape(-1, 3)
    if not len(found):
        return fan
    a, b, c = (flat[found[:, i]] for i in range(3))
    turned = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]) < 0
    found[turned] = found[turned][:, ::-1]
    return found
