"""Polygons of mesh files as triangles: concave ones by ear clipping, because a fan of triangles would close a doorway."""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def triangulated(vertices: Array, polygons: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return the triangles of polygons, in their order in the file and wound as they are.

    Args:
        vertices: (n, 3) float64.
        polygons: for each number k of corners: (p,) int64 places in the file, and (p, k) int64 vertices, in 0 ... n - 1.

    Returns:
        (m, 3) int64 vertices, and (m,) int64 place of the polygon of each. Polygons of fewer than three corners are left out.
    """
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
            parts = [_clipped(vertices[one])[:, :] for one in corners]
            faces += [one[part] for one, part in zip(corners, parts, strict=True)]
            places += [np.full(len(part), at) for at, part in zip(place, parts, strict=True)]
            continue
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
