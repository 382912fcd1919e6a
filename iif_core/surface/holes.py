"""Small holes of a scan, closed: Open3D fills the loops of open edges, and what continues the surface around stays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iif_core.numerics.graph import component_labels
from iif_core.surface.closest import closest_points
from iif_core.surface.simplify import MIN_AREA

SMOOTH = 0.5
"""Least cosine between the filling and the surface beside it for an edge of a hole to count as continued."""
CONTINUED = 0.8
"""Least share, by length, of the edges around a hole that the filling continues."""
_PASSES = 3
_CLOSE, _INSIDE = 0.5, 0.3  # of the distance to the rim, and of the radius of the hole: where other surface counts as near


class Closing(NamedTuple):
    """What closes the holes of a mesh.

    Attributes:
        faces: (k, 3) int64, corners among the vertices of the mesh, oriented as the faces around them.
        beside: (k,) int64 a face of the mesh beside the same hole, from which properties are taken over; it is of the part that
            most of the border of the hole is of.
        holes: how many were closed; area: of all of them, in square units of the vertices.
    """

    faces: NDArray
    beside: NDArray
    holes: int
    area: float


def close_holes(vertices: ArrayLike, faces: ArrayLike, widest: float, part: ArrayLike | None = None) -> Closing:
    """Find the faces that close the holes of a mesh up to a width.

    A hole is closed if its filling continues the surface around it, and no other surface is near the filling. The rim of a lamp
    shade, of a box without a lid and of a curtain are loops of open edges too: their filling is square to the surface beside
    it, or folded back onto it. A basin in a counter and a lamp in a ceiling lie in the hole that is made for them.

    Args:
        vertices, faces: (n, 3) and (m, 3); vertices at the same place count as one.
        widest: largest diameter of a hole, in the unit of the vertices; 0 = no hole is closed.
        part: (m,) number of the part that each face belongs to; None = all are of one.

    Returns:
        The faces, none where no hole is that small.
    """
    vertices, faces = np.asarray(vertices, np.float64).reshape(-1, 3), np.asarray(faces, np.int64).reshape(-1, 3)
    part = np.zeros(len(faces), np.int64) if part is None else np.asarray(part)
    found = Closing(np.zeros((0, 3), np.int64), np.zeros(0, np.int64), 0, 0.0)
    own = np.arange(len(faces))
    for _ in range(_PASSES if widest > 0 and len(faces) else 0):  # of holes that touch, one pass closes some
        new = _close(vertices, np.concatenate([faces, found.faces]), widest, np.concatenate([part, part[found.beside]]))
        if not new.holes:
            break
        beside = np.concatenate([own, found.beside])[new.beside]
        both = np.concatenate([found.faces, new.faces]), np.concatenate([found.beside, beside])
        found = Closing(*both, found.holes + new.holes, found.area + new.area)
    return found


def _close(vertices: NDArray, faces: NDArray, widest: float, part: NDArray) -> Closing:
    """One pass of `close_holes`."""
    nothing = Closing(np.zeros((0, 3), np.int64), np.zeros(0, np.int64), 0, 0.0)

    # -------- edges of one face only, once vertices at the same place are one --------
    places, first, place = np.unique(vertices.astype(np.float32), axis=0, return_index=True, return_inverse=True)
    whole = place.ravel()[faces]
    solid = np.flatnonzero((whole != np.roll(whole, 1, 1)).all(1))
    start, end, of_face = _edges(whole[solid])
    border = _count(start, end, len(places)) == 1
    if not border.any():
        return nothing

    # -------- fillings of all loops, by Open3D, and the border that each of their edges shares --------
    filling = _filled(places, whole[solid], widest)
    if not len(filling):
        return nothing
    n, corners = len(places), places[filling]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).astype(np.float64)
    doubled = np.linalg.norm(normal, axis=1)
    a, b, triangle = _edges(filling)
    key = np.minimum(a, b) * n + np.maximum(a, b)
    known = np.minimum(start, end)[border] * n + np.maximum(start, end)[border]
    order = np.argsort(known)
    at = order[np.minimum(np.searchsorted(known[order], key), len(known) - 1)]
    shared = known[at] == key
    beside = solid[of_face[border][at]]
    # An edge that filling and face run through in opposite directions orients both alike.
    agrees = np.where(a == start[border][at], -1.0, 1.0)

    # -------- one patch for each hole: triangles that share an edge --------
    inner, edge = np.unique(key, return_inverse=True)
    patch = component_labels(len(filling) + len(inner), triangle, len(filling) + edge.ravel())[: len(filling)]
    patch = np.unique(patch, return_inverse=True)[1].ravel()
    count = int(patch.max()) + 1
    of_edge = patch[triangle]

    # -------- which of them continue the surface, are as small as allowed, and are not near other surface --------
    around = np.cross(*(vertices[faces[beside]][:, k] - vertices[faces[beside]][:, 0] for k in (1, 2)))
    scale = np.maximum(np.linalg.norm(around, axis=1) * doubled[triangle], 1e-300)
    cosine = agrees * (around * normal[triangle]).sum(1) / scale
    length = np.where(shared, np.linalg.norm(places[a] - places[b], axis=1), 0.0)
    total = np.bincount(of_edge, length, count)
    continued = np.bincount(of_edge, length * (cosine > SMOOTH), count)
    rim = 0.5 * (places[a] + places[b])
    share = length / np.maximum(total, 1e-300)[of_edge]
    middle = np.stack([np.bincount(of_edge, share * rim[:, k], count) for k in range(3)], 1)
    radius = np.zeros(count)
    np.maximum.at(radius, patch, np.linalg.norm(corners - middle[patch][:, None], axis=2).max(1))
    area = 0.5 * np.bincount(patch, doubled, count)
    good = (continued >= CONTINUED * total) & (area > MIN_AREA) & (2.0 * radius <= widest)
    points = np.concatenate([corners.mean(1), rim[~shared]])
    of_point = np.concatenate([patch, of_edge[~shared]])
    use = good[of_point]
    on_rim = np.concatenate([places[a[shared]], rim[shared]]), np.tile(of_edge[shared], 2)
    good[of_point[use][_near_other(vertices, faces, points[use], of_point[use], on_rim, radius)]] = False

    # -------- their faces, turned as the surface is; each takes after the part with the longest border --------
    turned = np.bincount(of_edge, length * agrees, count) < 0
    kept = np.flatnonzero(good[patch] & (0.5 * doubled > MIN_AREA))
    new = np.where(turned[patch[kept], None], filling[kept][:, ::-1], filling[kept])
    owner = _longest(of_edge[shared], part[beside[shared]], length[shared], beside[shared], count)
    return Closing(first[new], owner[patch[kept]], int(good.sum()), float(area[good].sum()))


def _near_other(
    vertices: NDArray, faces: NDArray, points: NDArray, patch: NDArray, rim: tuple[NDArray, NDArray], radius: NDArray
) -> NDArray:
    """Which points (k,) of fillings are much nearer to the mesh than to the rim of their hole; those near the rim do not tell.

    patch (k,): of the points; rim: points of the rims, and the patch of each; radius: of the patches.
    """
    out = np.zeros(len(points), bool)
    if not len(points):
        return out
    to_mesh = np.linalg.norm(closest_points(vertices, faces, points).points - points, axis=1)
    order, by_rim = np.argsort(patch, kind="stable"), np.argsort(rim[1], kind="stable")
    for p in np.unique(patch):
        own = order[slice(*np.searchsorted(patch[order], (p, p + 1)))]
        around = rim[0][by_rim[slice(*np.searchsorted(rim[1][by_rim], (p, p + 1)))]]
        to_rim = np.sqrt(((points[own][:, None] - around) ** 2).sum(2).min(1))
        out[own] = (to_rim > _INSIDE * radius[p]) & (to_mesh[own] < _CLOSE * to_rim)
    return out


def _edges(faces: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Start, end and face of each directed edge, (3 m,)."""
    return faces.ravel(), np.roll(faces, -1, 1).ravel(), np.repeat(np.arange(len(faces)), 3)


def _count(start: NDArray, end: NDArray, n: int) -> NDArray:
    """How many faces have the edge, whichever way they run through it."""
    _, edge, count = np.unique(np.minimum(start, end) * n + np.maximum(start, end), return_inverse=True, return_counts=True)
    return count[edge.ravel()]


def _filled(places: NDArray, faces: NDArray, widest: float) -> NDArray:
    """Triangles (k, 3) that fill the loops of open edges; Open3D asks for the radius of a sphere around the hole."""
    import open3d as o3d

    mesh = o3d.t.geometry.TriangleMesh(o3d.core.Tensor(places), o3d.core.Tensor(np.ascontiguousarray(faces)))
    found = mesh.fill_holes(hole_size=widest).triangle.indices.numpy()
    return found[len(faces) :].astype(np.int64)


def _longest(patch: NDArray, part: NDArray, length: NDArray, face: NDArray, count: int) -> NDArray:
    """For each patch a face of the part that has the longest border with it, (count,)."""
    kinds, kind = np.unique(part, return_inverse=True)
    pairs, pair = np.unique(patch * len(kinds) + kind.ravel(), return_inverse=True)
    border = np.bincount(pair.ravel(), length, len(pairs))
    one = np.zeros(len(pairs), np.int64)
    one[pair.ravel()] = face
    out = np.zeros(count, np.int64)
    order = np.argsort(border, kind="stable")  # the longest is written last
    out[pairs[order] // len(kinds)] = one[order]
    return out
